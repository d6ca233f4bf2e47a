"""Patches: what reflections show, in pieces, with how much each one counts and from how far it is seen.

Comes in: a scene and the trees of its cells. Goes out: points on surfaces. The more of a patch's own view is filled by
surfaces, the more rays that leave these hit the patch (reciprocity): area times that share is what it counts. Flat
ground below an open sky is mirrored by nothing and counts for nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..tree.grid import Grid
from ..tree.topology import Topology
from . import warp
from .gather import Effort, seeded
from .parallel import run_tiles, tile_size, tiles
from .rays import MISS
from .receivers import Receivers, among, lifted, none, spread, touching
from .scene import Scene
from .sobol import Sampler

__all__ = ["Forest", "Patches", "of_receivers", "patches", "spread_over"]

MOST = 1 << 14
"""Patches of a scene, about: with as many candidates as there are at most, 2e8 pairs, half of them facing."""

SPARE = 4
"""Points that are looked around from for each patch that stays."""

DENSEST = 1 / 32
"""Least distance between points, in voxels of the first level: 0.25 m at human scale."""

FIRST = 1 / 2
"""Distance between the points of the first look, in the same unit."""

SHIFT = 0.5
"""Shift of the steps by which patches are thinned, 0 to 1."""

FEELERS = 32
"""Rays that look around from a patch: a share of a half is known to within 0.09 (one standard deviation)."""


@dataclass(frozen=True, eq=False)
class Forest:
    """The trees of a bake's cells.

    grid : Grid, the lattice
    trees : tuple of Topology, of the cells where probes are wanted
    """

    grid: Grid
    trees: tuple[Topology, ...]


@dataclass(frozen=True, eq=False)
class Patches:
    """Pieces of surfaces.

    start : (3, n) float32 [m], just off the surface, relative to the scene's origin
    normal : (3, n) float32, unit vectors towards free space
    weight : (n,) float32 [m2], area times the share of the view that surfaces fill
    reach : (n,) float32 [m], geometric mean of the distances to these surfaces
    """

    start: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    reach: np.ndarray

    def take(self, rows: np.ndarray) -> Patches:
        """Some of them.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        Patches
            Copies.
        """
        return Patches(self.start[:, rows], self.normal[:, rows], self.weight[rows], self.reach[rows])


def patches(scene: Scene, forest: Forest, effort: Effort) -> Patches:
    """Cut surfaces into patches.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    forest : Forest
        Where to look.
    effort : Effort
        Seed, threads.

    Returns
    -------
    Patches
        About `MOST`, those that count for more the denser; none where no surface sees another one. They do not depend
        on the number of threads.
    """
    receivers = spread_over(scene, forest, effort.threads)
    return _thinned(of_receivers(scene, receivers, effort))


def _thinned(all_of_them: Patches) -> Patches:
    """About `MOST`, by chance in proportion to their weight, which those that stay make up for."""
    weight = all_of_them.weight.astype(np.float64)
    if len(weight) <= MOST:
        return all_of_them
    chance = np.minimum(1, weight / _even(weight, MOST))
    # In their order one stays for each unit of chance: of any stretch as many as its chances sum to, give or take one.
    rows = np.flatnonzero(np.diff(np.floor(np.cumsum(chance) + SHIFT), prepend=0.0) > 0)
    parts = all_of_them.start[:, rows], all_of_them.normal[:, rows]
    return Patches(*parts, (weight / chance)[rows].astype(np.float32), all_of_them.reach[rows])


def _even(weight: np.ndarray, count: int) -> float:
    """The weight w for which min(1, weight / w) sum to a count."""
    falling = np.sort(weight)[::-1]
    rest = falling.sum() - np.cumsum(falling) + falling
    levels = rest / np.maximum(count - np.arange(len(falling)), 1)
    return float(levels[np.argmax(falling <= levels)])


def of_receivers(scene: Scene, receivers: Receivers, effort: Effort) -> Patches:
    """Find out which receivers other surfaces see, and from how far.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    receivers : Receivers
        Points on them.
    effort : Effort
        Seed, threads.

    Returns
    -------
    Patches
        One for each receiver that sees anything.
    """
    start = lifted(scene, receivers)
    hits, reach = _look_around(scene, receivers, start, effort)
    kept = np.flatnonzero(hits)
    weight = (receivers.area * hits / FEELERS).astype(np.float32)
    normal = np.ascontiguousarray(receivers.normal.T)
    return Patches(start[:, kept], normal[:, kept], weight[kept], reach[kept])


def spread_over(scene: Scene, forest: Forest, threads: int, scale: float = 1.0) -> Receivers:
    """Spread points over the surfaces that others see.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    forest : Forest
        Trees.
    threads : int
        Worker threads; 0 uses every core.
    scale : float
        Spacing in units of what gives about `SPARE * MOST` points.

    Returns
    -------
    Receivers
        Those in first-level voxels that the trees subdivide, or where a first look finds that surfaces see something.
    """
    size = forest.grid.first_size
    voxels, area = _first_look(scene, forest, threads)
    spacing = scale * max(math.sqrt(area / (SPARE * MOST)), DENSEST * size)
    return _within(scene, voxels, size, spacing, threads)


def _first_look(scene: Scene, forest: Forest, threads: int) -> tuple[np.ndarray, float]:
    """First-level voxels with anything to see, and about how much surface they hold [m2]."""
    size, dense, divided = forest.grid.first_size, [np.zeros((0, 3), np.int64)], [np.zeros((0, 3), np.int64)]
    for tree in forest.trees:
        coords = tree.voxels()[1][: tree.grid_count]
        dense.append(coords)
        divided.append(coords[tree.nodes["mask"][: tree.grid_count] != 0])
    found = _within(scene, np.concatenate(dense), size, FIRST * size, threads)
    voxel = np.floor(found.position / size).astype(np.int64)
    hits, _ = _look_around(scene, found, lifted(scene, found), Effort(0, threads=threads))
    voxels = np.unique(np.concatenate([*divided, voxel[hits > 0]]), axis=0)
    return voxels, float(found.area[among(voxels)(voxel)].sum(dtype=np.float64))


def _within(scene: Scene, voxels: np.ndarray, size: float, spacing: float, threads: int) -> Receivers:
    """Receivers in some voxels of a size."""
    if not len(voxels):
        return none()
    has, touches = among(voxels), touching(voxels, size)
    box = voxels.min(axis=0) * size, (voxels.max(axis=0) + 1) * size

    def inside(position: np.ndarray) -> np.ndarray:
        return has(np.floor(position / size).astype(np.int64))

    return spread(scene, *box, spacing, inside, threads, touches=touches)


def _look_around(scene: Scene, receivers: Receivers, start: np.ndarray, effort: Effort):
    """(n,) how many feelers meet something, (n,) the geometric mean of how far they go [m]."""
    count = np.zeros(len(receivers.key), np.int64)
    reach = np.zeros(len(receivers.key), np.float32)
    keys = seeded(receivers.key, effort.seed)

    def work(rows: np.ndarray) -> int:
        lane, sample = np.divmod(np.arange(len(rows) * FEELERS), FEELERS)
        sampler = Sampler(keys[rows], 0, FEELERS)
        normal = np.ascontiguousarray(receivers.normal[rows][lane].T)
        direction = warp.cosine(*(sampler.uniform(lane, sample, dimension) for dimension in (0, 1)), normal)
        hits = scene.tracer.intersect(np.ascontiguousarray(start[:, rows[lane]]), direction)
        met = (hits.triangle != MISS).reshape(-1, FEELERS)
        distance = np.where(met, np.maximum(hits.distance.reshape(met.shape), np.float32(1e-30)), 1)
        count[rows] = met.sum(axis=1)
        reach[rows] = np.exp(np.log(distance).sum(axis=1) / np.maximum(count[rows], 1))
        return len(rows)

    run_tiles(work, tiles(len(keys), tile_size() // FEELERS), effort.threads)
    return count, reach
