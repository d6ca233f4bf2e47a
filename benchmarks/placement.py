"""Probe placement against uniform grids and random places, at equal count.

    python benchmarks/placement.py SNAPSHOT... [--counts 16,64,256] [--cells I,J/I,J] [--record]

Two judges that the placement has not seen. Patches at other points of the same surfaces give the part of what
reflections show that is seen well, its own measure. The other judge are mirror rays: from 10,000 random points of
surfaces, about the normal by the cosine, to what they meet at a distance r. For each ray

    seen       some probe sees the hit
    nearest    the probe that is nearest to the ray's start sees it
    error      how far beside the hit a look-up lands, over r: parallax-corrected with exact distances, the probe looks
               towards the hit and finds the first surface on the way; half a texel's footprint there comes on top.
               Mean of errors held at 1; of the probe with the best worth (`bake/views.py`), or of the nearest one

Grids fill the box around these surfaces, their spacing is such that as many places as wanted are free; random
places are free ones of that box.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import candidates, patches, probes, receivers, snapshot_file, views, warp
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.settings import choose_grid
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree.build import build, occupied_cells

RAYS = 10_000
TEXEL = np.sqrt(4 * np.pi) / 126
"""Mean width of a texel of a map of 126 x 126 [rad]."""

MANY = 1000
"""Probes that are placed, at least, for the time that it takes."""

DRAWS = 4
"""Random choices, over whose measures the mean is taken."""

OTHER_SEED = 7
"""Of judges and grids."""

SHIFT = 1.83
"""Spacing of the judging points over that of the placement: other points of the same surfaces, a third as many."""


@dataclass(frozen=True)
class Rays:
    """Mirror rays: (3, n) starts and hits just off surfaces [m], normals at hits, and (n,) lengths [m]."""

    start: np.ndarray
    hit: np.ndarray
    normal: np.ndarray
    length: np.ndarray


def judging_points(scene: Scene, forest: patches.Forest) -> receivers.Receivers:
    """Spread points over the surfaces that the placement looks at, others than its own ones.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    forest : Forest
        Where.

    Returns
    -------
    Receivers
        Of surfaces that others see.
    """
    return patches.spread_over(scene, forest, 0, SHIFT)


def mirror_rays(scene: Scene, at: receivers.Receivers) -> Rays:
    """Choose points by area, and directions by the cosine.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    at : Receivers
        Points to choose from.

    Returns
    -------
    Rays
        Those of `RAYS` or a little more that meet a front.
    """
    generator = np.random.default_rng(OTHER_SEED)
    found = []
    for _ in range(64):
        rows = generator.choice(len(at.area), RAYS, p=at.area / at.area.sum(dtype=np.float64))
        start = receivers.lifted(scene, at)[:, rows]
        direction = warp.cosine(*generator.random((2, RAYS), np.float32), at.normal[rows].T)
        hits = scene.tracer.intersect(start, direction)
        front = np.flatnonzero((hits.triangle != MISS) & (warp.dot(hits.normal, direction) < 0))
        normal = hits.facing(direction)
        hit = start + direction * np.where(hits.triangle == MISS, np.float32(0), hits.distance)
        hit += normal * (4 * scene.tracer.offset(hit, hits.distance))
        found.append((start[:, front], hit[:, front], normal[:, front], hits.distance[front]))
        if sum(len(part[3]) for part in found) >= RAYS:
            break
    return Rays(*(np.concatenate(part, axis=-1)[..., :RAYS] for part in zip(*found, strict=True)))


def free_places(scene: Scene, position: np.ndarray) -> np.ndarray:
    """Drop places inside walls, and those that see nothing.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    position : (n, 3) float64 ndarray
        Places [m].

    Returns
    -------
    (m, 3) float64 ndarray
        Those that are left.
    """
    judged = candidates.judge(scene, position, np.arange(len(position), dtype=np.uint32), 0)
    return position[judged.is_free]


def uniform(scene: Scene, box: np.ndarray, count: int) -> np.ndarray:
    """Place a lattice.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    box : (2, 3) float64 ndarray
        Where [m].
    count : int
        How many.

    Returns
    -------
    (count, 3) float64 ndarray
        Free points of the widest lattice that has as many; what is too many is dropped at random.
    """
    size = box[1] - box[0]
    spacing = (size.prod() / count) ** (1 / 3)
    for _ in range(60):
        number = np.maximum(1, np.round(size / spacing)).astype(int)
        axes = [box[0][axis] + (np.arange(n) + 0.5) / n * size[axis] for axis, n in enumerate(number)]
        found = free_places(scene, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        if len(found) >= count:
            break
        spacing *= 0.97
    return found[np.sort(np.random.default_rng(OTHER_SEED).permutation(len(found))[:count])]


def random(scene: Scene, box: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Place at random.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    box : (2, 3) float64 ndarray
        Where [m].
    count : int
        How many.
    seed : int
        Another one chooses other places.

    Returns
    -------
    (count, 3) float64 ndarray
        Free points.
    """
    generator = np.random.default_rng(seed)
    found = np.zeros((0, 3))
    while len(found) < count:
        found = np.concatenate([found, free_places(scene, generator.uniform(*box, (4 * count, 3)))])
    return found[:count]


def judge(scene: Scene, place: np.ndarray, judges: patches.Patches, rays: Rays) -> dict[str, float]:
    """Measure how well places do.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    place : (k, 3) float64 ndarray
        Probes [m].
    judges : Patches
        What is to be seen.
    rays : Rays
        What reflections show.

    Returns
    -------
    dict of str to float
        By name.
    """
    seeing = views.views(scene, place, judges)
    best = np.zeros(len(judges.weight))
    np.maximum.at(best, seeing.patch, seeing.worth)
    place = place.T.astype(np.float32)
    ones = np.ones(len(rays.length), np.float32)
    worth, seen, number = np.zeros_like(ones), np.zeros(len(ones), bool), np.zeros(len(ones), np.int64)
    nearest, close = np.zeros(len(ones), np.int64), np.full(len(ones), np.inf)
    as_patches = patches.Patches(rays.hit, rays.normal, ones, rays.length)
    for probe in range(place.shape[1]):
        here = np.broadcast_to(place[:, probe, None], rays.hit.shape)
        free = ~scene.tracer.blocked(rays.hit, np.ascontiguousarray(here - rays.hit), ones)
        worthy = np.where(free, views.worths(place[:, probe, None], as_patches)[0], 0)
        seen |= worthy > 0
        number = np.where(worthy > worth, probe, number)
        worth = np.maximum(worth, worthy)
        distance = warp.dot(here - rays.start, here - rays.start)
        nearest, close = np.where(distance < close, probe, nearest), np.minimum(distance, close)
    beside, ok = _beside(scene, place[:, nearest], rays)
    chosen, _ = _beside(scene, place[:, np.where(worth > 0, number, nearest)], rays)
    return {
        "seen well": float(best @ judges.weight / judges.weight.sum(dtype=np.float64)),
        "seen": float(seen.mean()),
        "nearest": float(ok.mean()),
        "error": float(chosen.mean()),
        "error of nearest": float(beside.mean()),
    }


def _beside(scene: Scene, place: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """(n,) errors held at 1, and whether probes see the hits."""
    toward = rays.hit - place
    distance = np.sqrt(warp.dot(toward, toward))
    hits = scene.tracer.intersect(np.ascontiguousarray(place), np.ascontiguousarray(toward))
    way = np.where(hits.triangle == MISS, np.float32(1e3), hits.distance)
    cosine = np.abs(warp.dot(toward, rays.normal)) / np.maximum(distance, 1e-12)
    sees = (np.abs(way - 1) * distance < 1e-3 * rays.length + 1e-3 * distance) & (warp.dot(toward, rays.normal) < 0)
    texel = 0.5 * TEXEL * distance / np.sqrt(np.maximum(cosine, 0.01))
    off = np.where(sees, 0, np.abs(way - 1) * distance) + texel
    return np.minimum(off / np.maximum(rays.length, 1e-6), 1), sees


def figures(path: Path, counts: list[int], cells: list[tuple[int, int]] | None) -> dict[str, dict[str, float]]:
    """Measure one scene.

    Parameters
    ----------
    path : Path
        Its snapshot.
    counts : list of int
        Numbers of probes.
    cells : list of (i, j), optional
        Only these world cells.

    Returns
    -------
    dict of str to dict
        Measures by name of method and count.
    """
    snapshot = snapshot_file.load(path)
    scene = prepare(snapshot, Model(local=False))
    grid = choose_grid(scene.soup.corners, snapshot.origin, 0.0)
    cells = cells or [tuple(cell) for cell in occupied_cells(scene.soup.corners, grid)]
    forest = patches.Forest(grid, tuple(build(scene.soup.corners, grid, cell) for cell in cells))
    start = time.perf_counter()
    ours = probes.place(scene, forest, probes.Request(max(MANY, *counts), least_gain=0.0), Effort(0))
    seconds = time.perf_counter() - start
    at = judging_points(scene, forest)
    judges, rays = patches.of_receivers(scene, at, Effort(0, seed=OTHER_SEED)), mirror_rays(scene, at)
    box = np.stack([at.position.min(axis=0), at.position.max(axis=0)])
    rows = {f"seconds for {len(ours.position)}": {"seconds": seconds, "candidates": ours.candidates}}
    for count in counts:
        rows[f"ours, {count}"] = judge(scene, ours.position[:count], judges, rays)
        rows[f"grid, {count}"] = judge(scene, uniform(scene, box, count), judges, rays)
        draws = [judge(scene, random(scene, box, count, seed), judges, rays) for seed in range(DRAWS)]
        rows[f"random, {count}"] = {name: float(np.mean([draw[name] for draw in draws])) for name in draws[0]}
    return rows


def main() -> None:
    """Read the command line, measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshots", nargs="+", type=Path)
    parser.add_argument("--counts", default="16,64,256")
    parser.add_argument("--cells", help="I,J/I,J...")
    parser.add_argument("--record", action="store_true", help="append rows to results.csv")
    words = parser.parse_args()
    cells = [tuple(map(int, pair.split(","))) for pair in words.cells.split("/")] if words.cells else None
    for path in words.snapshots:
        found = figures(path, [int(count) for count in words.counts.split(",")], cells)
        for name, row in found.items():
            print(f"{path.stem:12} {name:20} " + "  ".join(f"{key} {value:.3f}" for key, value in row.items()))
            if words.record:
                add_row("placement", path.stem, {f"{name}: {key}": value for key, value in row.items()})


if __name__ == "__main__":
    main()
