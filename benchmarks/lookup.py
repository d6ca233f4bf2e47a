"""How fast a bake is looked up on one core: a million surface points in random order, against bare reads of memory.

    python benchmarks/lookup.py BAKE... [--points 1000000] [--record]

Points lie on all surfaces of the scene, with normals, shuffled, so that neighbouring points share nothing. Each figure
is the median of five runs after one to warm up, and the best, in seconds of the processor, since the machine may be
shared; wall time is printed too. The limit is what reading 8 or 16 rows of 27 numbers takes, at the data points that
lie around the same points. `--record` adds rows to `benchmarks/results.csv`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import receivers, snapshot_file
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import from_header, model
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import world
from gi_volumes.tree.interpolate import weigh

RUNS = 5
COARSE = 0.5
"""Spacing of the first receivers, which tell how many a spacing gives [m]."""
WIDTH = 27
"""Numbers of a transport at a data point."""


def surface_points(path: Path, baked: world.World, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points all over a scene's surfaces in random order.

    Parameters
    ----------
    path : Path
        Folder of the bake.
    baked : World
        The same, loaded.
    count : int
        How many.

    Returns
    -------
    points, normals : (n, 3) float64 ndarray
        World space [m], and unit vectors.
    """
    settings = from_header(baked.header["settings"])
    scene = prepare(*model(snapshot_file.load(path / SNAPSHOT_NAME), settings))
    low, high = np.array(baked.header["bounds"]) - scene.origin
    spacing = COARSE
    found = receivers.spread(scene, low, high, spacing)
    while len(found.position) < count:
        spacing *= max(0.3, min(0.9, np.sqrt(len(found.position) / count)))
        found = receivers.spread(scene, low, high, spacing)
    rows = np.random.default_rng(0).permutation(len(found.position))[:count]
    return found.position[rows] + scene.origin, found.normal[rows].astype(np.float64)


def measure(runs: dict[str, Callable[[], None]], count: int) -> dict[str, float]:
    """Time look-ups, in turns, so that other work on the machine slows them alike.

    Parameters
    ----------
    runs : dict of str to callable
        What does each once.
    count : int
        How many points it looks up.

    Returns
    -------
    dict of str to float
        Points for each second of one core's work.
    """
    taken = {name: [] for name in runs}
    for turn in range(RUNS + 1):
        for name, run in runs.items():
            start = time.process_time(), time.perf_counter()
            run()
            if turn:
                taken[name].append((time.process_time() - start[0], time.perf_counter() - start[1]))
    found = {}
    for name, seconds in taken.items():
        cpu, wall = np.median(seconds, axis=0)
        print(f"{name}: {count / wall:.4g} points per second by the clock")
        found[f"{name} [points per second of a core]"] = count / cpu
        found[f"{name}, best [points per second of a core]"] = count / min(seconds)[0]
    return found


def bare_reads(baked: world.World, points: np.ndarray, rows: int) -> Callable[[], None]:
    """What no look-up can do without.

    Parameters
    ----------
    baked : World
        The bake.
    points : (n, 3) float64 ndarray
        World space [m].
    rows : int
        How many data points each one reads, 8 or 16.

    Returns
    -------
    callable
        Reads them all once.
    """
    data, chunk = baked._data, world.CHUNK
    values = np.zeros((len(data.valid), WIDTH), np.float32)
    row = np.zeros((rows, len(points)), np.int64)
    for start in range(0, len(points), chunk):
        local = baked.grid.to_local(points[start : start + chunk])
        found = weigh(data, local, np.zeros_like(local))[0].T[:rows]
        row[: len(found), start : start + chunk] = found
    read = np.empty((chunk, WIDTH), np.float32)

    def run() -> None:
        for start in range(0, len(points), chunk):
            for part in row[:, start : start + chunk]:
                np.take(values, part, axis=0, out=read[: len(part)], mode="clip")

    return run


def figures(path: Path, count: int) -> dict[str, float]:
    """Measure one bake.

    Parameters
    ----------
    path : Path
        Its folder.
    count : int
        How many points.

    Returns
    -------
    dict
        Figures by name.
    """
    baked = world.load(path)
    points, normals = surface_points(path, baked, count)
    names = [name for name in world.TRANSPORTS[1:] if name in baked.header["transports"]]
    cells = baked.header["cells"]
    found = {
        "data points": sum(cell["data_points"] for cell in cells),
        "bytes": sum(file["bytes"] for cell in cells for file in cell["files"].values()),
        "transports": len(names),
        "points looked up": len(points),
    }
    runs = {
        f"{names[-1]} alone": lambda: baked.irradiance(points, normals, transport=names[-1]),
        "all transports": lambda: baked.irradiance(points, normals),
        "limit, 8 reads": bare_reads(baked, points, 8),
        "limit, 16 reads": bare_reads(baked, points, 16),
    }
    return found | measure(runs, len(points))


def main() -> None:
    """Measure bakes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bakes", type=Path, nargs="+")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    for path in options.bakes:
        found = figures(path, options.points)
        for name, value in found.items() if not options.record else ():
            print(f"{path.name}: {name} = {value:.6g}")
        if options.record:
            add_row("lookup", path.name, found)


if __name__ == "__main__":
    main()
