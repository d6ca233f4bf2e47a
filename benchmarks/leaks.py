"""Light that leaks to where none can arrive, in scenes made for it.

    python benchmarks/leaks.py [NAME...] [--quality preview] [--finest SIZE] [--method cache] [--record]

Figures are in per cent of the lit side's mean irradiance. Where some light does arrive, only what is above the
path-traced reference counts.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np
from gi_volumes.bake import job, reference
from gi_volumes.bake.settings import QUALITIES, Settings
from gi_volumes.benchmarks.leak_scenes import Case, cases, sample
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import world

POINTS, LIT_POINTS, JUDGED_POINTS = 4000, 400, 600
"""On the dark side, on the lit side, and on a dark side that the reference is asked about."""

SAMPLES = 256


def measure(case: Case, settings: Settings) -> dict[str, float]:
    """Bake a case and look for leaks.

    Parameters
    ----------
    case : Case
        The scene.
    settings : Settings
        How it is baked.

    Returns
    -------
    dict of str to float
        Leaks [%], relative error of the lit side, sizes, seconds.
    """
    lit, dark = sample(case.lit, LIT_POINTS, 2), sample(case.dark, POINTS if case.sealed else JUDGED_POINTS, 1)
    truth = _reference(case, lit, settings)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        outcome = job.bake(case.scene, Path(folder), settings)
        seconds = time.perf_counter() - start
        baked = world.load(folder)
    leak = baked.irradiance(*dark) - (0 if case.sealed else _reference(case, dark, settings))
    leak = np.maximum(leak.mean(axis=1), 0) / truth.mean() * 100
    error = np.sqrt(np.mean((baked.irradiance(*lit) - truth) ** 2)) / truth.mean()
    figures = {"leak mean [%]": leak.mean(), "leak p99 [%]": np.quantile(leak, 0.99), "leak max [%]": leak.max()}
    sizes = {"data points": outcome.data_points, "bytes": sum(outcome.bytes.values()), "seconds": seconds}
    return figures | {"lit rmse": error} | sizes


def _reference(case: Case, points: tuple, settings: Settings) -> np.ndarray:
    """Path-traced irradiance."""
    return reference.irradiance(case.scene, *points, samples=SAMPLES, bounces=settings.bounces, seed=3)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help=f"of {', '.join(cases())}; all when left out")
    parser.add_argument("--quality", default="preview", choices=QUALITIES)
    parser.add_argument("--finest", type=float, default=0.0)
    parser.add_argument("--method", default="cache", choices=("cache", "paths"))
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    settings = dataclasses.replace(Settings.of(options.quality, options.method), finest=options.finest)
    for name in options.names or cases():
        figures = measure(cases()[name](), settings)
        if options.record:
            add_row("leaks", f"{name}, {options.quality}, finest {options.finest:g}, {options.method}", figures)
        else:
            print(f"{name:32s}", "  ".join(f"{key} {value:.5g}" for key, value in figures.items()), flush=True)


if __name__ == "__main__":
    main()
