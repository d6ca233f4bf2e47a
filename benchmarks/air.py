"""Light in free air, where moving objects are: what a bake says there, beside paths.

    python benchmarks/air.py BAKE --low x,y,z --high x,y,z [--record]

Points and normals are random in a box in world space; those inside objects don't count. The reference are two
independent sets of paths; the error is the root of the mean of (value - one) * (value - other), so that the reference's
noise does not count, relative to the mean light.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from gi_volumes.bake import datapoints, reference, snapshot_file
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import from_header, model, of_reference
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import world

POINTS, SAMPLES, BOUNCES = 1500, 512, 32

INSIDE = 0.05
"""Part of the rays from a point that may meet backs."""


def figures(path: Path, low: np.ndarray, high: np.ndarray) -> dict[str, float]:
    """Measure one bake.

    Parameters
    ----------
    path : Path
        Its folder.
    low, high : (3,) float64 ndarray
        The box [m].

    Returns
    -------
    dict of str to float
        By transport: error, median of the absolute difference (reference's noise included), and what the mean is off.
    """
    baked, snapshot = world.load(path), snapshot_file.load(path / SNAPSHOT_NAME)
    settings = of_reference(from_header(baked.header["settings"]))
    rng = np.random.default_rng(5)
    points, normals = rng.uniform(low, high, (POINTS, 3)), rng.normal(size=(POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    scene = prepare(*model(snapshot, settings))
    back = datapoints._probe(scene, points - snapshot.origin, np.arange(POINTS, dtype=np.uint32))[2]
    free = back.mean(axis=1) < INSIDE
    points, normals, found = points[free], normals[free], {"points": int(free.sum())}
    for name in baked.header["transports"]:
        halves = [
            reference.irradiance(snapshot, points, normals, name, SAMPLES, BOUNCES, seed, settings).mean(axis=1)
            for seed in (1, 2)
        ]
        one, other = (baked.irradiance(points, normals, transport=name).mean(axis=1) - half for half in halves)
        mean = np.mean(halves)
        found[f"{name} error"] = float(np.sqrt(max((one * other).mean(), 0)) / mean)
        found[f"{name} median"] = float(np.median(np.abs(one + other)) / 2 / mean)
        found[f"{name} mean"] = float((one + other).mean() / 2 / mean)
    return found


def main() -> None:
    """Measure one box of one bake."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bake", type=Path)
    for name in ("--low", "--high"):
        parser.add_argument(name, required=True, type=lambda text: np.array([float(word) for word in text.split(",")]))
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    found = figures(options.bake, options.low, options.high)
    for name, value in found.items():
        print(f"{options.bake.name}: {name} = {value:.4g}")
    if options.record:
        add_row("air", options.bake.name, found)


if __name__ == "__main__":
    main()
