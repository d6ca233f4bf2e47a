"""Cells of a large scene: how long one takes, and whether memory is bounded.

    python benchmarks/city.py [--snapshot FILE] [--cells i,j/i,j ...] [--quality draft] [--blocks N] [--record]

Without a snapshot a city is made up: blocks of houses with windows, ledges and doors, between streets, from a seed.
Each group of cells is baked by a process of its own, so that the peak of its memory is its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from gi_volumes.bake import job, snapshot_file
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import QUALITIES, Settings, model
from gi_volumes.bake.snapshot import Channel, LightKind, Material, Snapshot
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tests.build_scenes import BOX_FACES, lamps, quad, snapshot, sun_frame

BLOCKS = 25
"""Blocks along each side of the city; each is 40 m wide, street included, so that 25 of them are 1 km."""

BLOCK, STREET = 40.0, 10.0
HOUSES = 4
"""Along each side of a block: 16 in all, 10,000 in a city."""

STOREY, BAY = 3.0, 5.0
"""Height of storeys, and width of the bays that windows stand in [m]."""

MATERIALS = tuple(
    Material(name, Channel((albedo,) * 3), specular_level=0.0)
    for name, albedo in (("street", 0.2), ("wall", 0.6), ("window", 0.1))
)


def city(seed: int = 0, blocks: int = BLOCKS) -> Snapshot:
    """Make a city up.

    Parameters
    ----------
    seed : int
        Which one.
    blocks : int
        Blocks along each side.

    Returns
    -------
    Snapshot
        A street level, houses, and sills and recesses of windows; under a sky, in the sun.
    """
    rng = np.random.default_rng(seed)
    low, high = _houses(rng, blocks)
    half = blocks * BLOCK / 2
    ground = quad((-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0))
    sills = _sills(low, high)
    parts = [ground, _boxes(low, high), _boxes(*sills)]
    lights = lamps({"kind": LightKind.SUN, "strength": (3,) * 3, "frame": sun_frame((1, 0.4, 0.8)), "size": (0.01, 0)})
    return snapshot(list(zip(parts, MATERIALS, strict=True)), lights, sky=(0.5, 0.6, 0.8))


def _houses(rng: np.random.Generator, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) lowest and highest corners, with foundations."""
    place = np.stack(np.meshgrid(*[np.arange(blocks * HOUSES)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    width = (BLOCK - STREET) / HOUSES
    corner = (place // HOUSES - blocks / 2) * BLOCK + STREET / 2 + place % HOUSES * width
    size = np.concatenate([rng.uniform(0.75, 0.98, corner.shape) * width, np.zeros((len(corner), 1))], axis=1)
    size[:, 2] = STOREY * rng.integers(2, 9, len(corner)) + 1
    low = np.concatenate([corner, np.full((len(corner), 1), -1.0)], axis=1)
    return low, low + size + [0, 0, 1]


def _sills(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) corners of the windows' boxes, which stand out of the walls."""
    out = []
    for axis in (0, 1):
        bays = np.maximum(((high - low)[:, axis] / BAY).astype(int), 1)
        storeys = ((high[:, 2] - 1) / STOREY).astype(int)
        count = bays * storeys
        house = np.repeat(np.arange(len(low)), count)
        number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        along = low[house, axis] + (number % bays[house] + 0.5) * ((high - low)[:, axis] / bays)[house]
        for side in (low, high):
            center = np.empty((len(house), 3))
            center[:, axis], center[:, 1 - axis] = along, side[house, 1 - axis]
            center[:, 2] = (number // bays[house] + 0.55) * STOREY
            half = np.array([0.55, 0.1, 0.75]) if axis == 0 else np.array([0.1, 0.55, 0.75])
            out.append((center - half, center + half))
    return tuple(np.concatenate(column) for column in zip(*out, strict=True))


def _boxes(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(12 n, 3, 3) triangles."""
    bits = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
    corners = low[:, None] + bits * (high - low)[:, None]
    faces = np.concatenate([BOX_FACES[:, [0, 1, 2]], BOX_FACES[:, [0, 2, 3]]])
    return corners[:, faces].reshape(-1, 3, 3)


def measure(path: Path, cells: list[tuple[int, int]] | None, quality: str) -> dict[str, float]:
    """Bake cells in this process.

    Parameters
    ----------
    path : Path
        A snapshot.
    cells : list of (i, j), optional
        Which; none only prepares the scene.
    quality : str
        As on the command line.

    Returns
    -------
    dict of str to float
        Seconds, data points, and the process's memory [GB], with the part that is there before the first cell.
    """
    settings = Settings.of(quality)
    scene = snapshot_file.load(path)
    held = {"loaded [GB]": _peak()}
    prepare(*model(scene, settings))
    figures = held | {"prepared [GB]": _peak()}
    if cells:
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            outcome = job.bake(scene, Path(folder), settings, cells)
        figures |= {"cells": len(cells), "data points": outcome.data_points, "seconds": time.perf_counter() - start}
    return figures | {"peak [GB]": _peak(), "triangles": len(scene.geometry.triangles)}


def _peak() -> float:
    """Most memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    """Bake groups of cells, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--snapshot", type=Path)
    parser.add_argument("--cells", nargs="*", default=["0,0"])
    parser.add_argument("--quality", default="draft", choices=QUALITIES)
    parser.add_argument("--blocks", type=int, default=BLOCKS)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        cells = [tuple(int(v) for v in word.split(",")) for word in options.one.split("/") if word]
        print(json.dumps(measure(options.snapshot, cells, options.quality)))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = options.snapshot or Path(folder) / "city.giv"
        if options.snapshot is None:
            snapshot_file.save(city(blocks=options.blocks), path)
        for group in options.cells:
            words = ["--snapshot", str(path), "--quality", options.quality, "--one=" + group]
            run = subprocess.run([sys.executable, __file__, *words], stdout=subprocess.PIPE, text=True, check=True)
            figures, name = json.loads(run.stdout), f"{path.stem} {options.quality} {group}"
            if options.record:
                add_row("cells", name, figures)
            else:
                print(name, figures)


if __name__ == "__main__":
    main()
