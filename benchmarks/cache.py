"""The surface cache against paths: how much less time it takes for the same error, and how far off its means are.

    python benchmarks/cache.py BAKE... [--points 1000] [--all] [--record]

At data points of a bake both measure all transports that the bake has, or with `--all` local light, 16 suns and the
nine functions of the sky. The reference are two independent sets of paths; errors are the root of the mean over points
of (value - one) * (value - other), so that the reference's noise does not count, relative to the root mean square of
the light. Times are seconds of the processor. At equal error, time goes with the square of the error; the time to fill
the cache is given for itself, as all data points and receivers of a bake share it.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import datapoints, measured, radiosity, snapshot_file
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import CACHED_BOUNCES, from_header, model
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import world

SAMPLES = 64, 256
REFERENCE = 1024
"""Paths of each of the reference's halves."""

RUNS = 3


def places(baked: world.World, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose data points.

    Parameters
    ----------
    baked : World
        A bake.
    count : int
        How many.

    Returns
    -------
    position : (3, n) float32 ndarray
        In the order that a bake measures them in [m].
    key : (n,) uint32 ndarray
        Their random keys.
    """
    data = baked._data
    rows = np.random.default_rng(0).permutation(np.flatnonzero(data.valid))[:count]
    rows = rows[datapoints.morton_order(np.ascontiguousarray(data.position[rows].T.astype(np.float32)))]
    position = np.ascontiguousarray(data.position[rows].T.astype(np.float32))
    return position, datapoints.keys(data.level[rows], data.coords[rows])


def timed(scene: Scene, at: tuple[np.ndarray, np.ndarray], samples: int) -> tuple[float, np.ndarray]:
    """Measure light several times.

    Parameters
    ----------
    scene : Scene
        With or without a cache.
    at : tuple
        Positions and keys.
    samples : int
        Paths per point.

    Returns
    -------
    seconds : float
        Of the processor, for each point; the median.
    light : (runs, n, functions, 9, 3) float32 ndarray
        Of independent runs.
    """
    seconds, light = [], []
    for run in range(RUNS):
        start = time.process_time()
        found = gather(scene, HarmonicsSensor(), *at, Effort(samples, CACHED_BOUNCES, 100 + run))
        seconds.append((time.process_time() - start) / at[0].shape[1])
        light.append(measured.stack(scene, found))
    return float(np.median(seconds)), np.array(light)


def errors(light: np.ndarray, reference: np.ndarray, scene: Scene) -> dict[str, tuple[float, float]]:
    """Compare with a reference.

    Parameters
    ----------
    light : (runs, n, functions, 9, 3) float32 ndarray
        What was measured.
    reference : (2, n, functions, 9, 3) float32 ndarray
        Independent halves.
    scene : Scene
        Says what is modelled.

    Returns
    -------
    dict of str to (error, mean)
        By transport: relative error of one run, and the mean of the first coefficients over that of the reference.
    """
    whole = reference.mean(axis=0)
    parts = [measured.split(scene, part) for part in (*light, *reference, whole)]
    found = {}
    for name, truth in parts[-1].items():
        one, other = parts[-3][name], parts[-2][name]
        squared = np.mean([((part[name] - one) * (part[name] - other)).mean() for part in parts[:-3]])
        mean = np.mean([part[name][:, :, 0].sum() for part in parts[:-3]]) / truth[:, :, 0].sum()
        found[name] = float(np.sqrt(max(squared, 0) / (one * other).mean())), float(mean)
    return found


def figures(path: Path, count: int, everything: bool) -> dict[str, float]:
    """Measure one scene.

    Parameters
    ----------
    path : Path
        A bake of it.
    count : int
        Data points.
    everything : bool
        Whether to model free suns and skies.

    Returns
    -------
    dict of str to float
        By name.
    """
    baked = world.load(path)
    settings = from_header(baked.header["settings"])
    if everything:
        settings = dataclasses.replace(settings, sun="hemisphere", sky="harmonics")
    scene = prepare(*model(snapshot_file.load(path / SNAPSHOT_NAME), settings))
    at = places(baked, count)
    halves = [gather(scene, HarmonicsSensor(), *at, Effort(REFERENCE, CACHED_BOUNCES, seed)) for seed in (1, 2)]
    reference = np.array([measured.stack(scene, half) for half in halves])
    start = time.process_time()
    low, high = scene.soup.bounds
    box = np.stack([low, np.nextafter(high, np.inf)])
    cached = radiosity.around(scene, baked.grid, box, Effort(1, CACHED_BOUNCES, 3))
    found = {"points": count, "surfels": len(cached.cache.light), "filling [s]": time.process_time() - start}
    for samples in SAMPLES:
        seconds, all_errors = {}, {}
        for name, one in (("paths", scene), ("cache", cached)):
            seconds[name], light = timed(one, at, samples)
            all_errors[name] = errors(light, reference, scene)
            found[f"{name} {samples} [us per point]"] = 1e6 * seconds[name]
            for transport, (error, mean) in all_errors[name].items():
                found[f"{name} {samples} {transport} error"] = error
                found[f"{name} {samples} {transport} mean"] = mean
        for transport, (error, _) in all_errors["cache"].items():
            ratio = (all_errors["paths"][transport][0] / max(error, 1e-9)) ** 2
            found[f"times faster at equal error {samples} {transport}"] = ratio * seconds["paths"] / seconds["cache"]
    return found


def main() -> None:
    """Compare on some scenes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bakes", type=Path, nargs="+")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--all", action="store_true", help="local light, 16 suns and nine functions of the sky")
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    for path in options.bakes:
        found = figures(path, options.points, options.all)
        for name, value in found.items() if not options.record else ():
            print(f"{path.name}: {name} = {value:.5g}")
        if options.record:
            add_row("cache", path.name + " all" * options.all, found)


if __name__ == "__main__":
    main()
