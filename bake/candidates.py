"""Candidates for probes: places in free space, fewer where it is wide.

Comes in: the trees of cells. Goes out: centres of voxels without children, those that exist and those that are empty,
less the ones inside walls or against them. What is left is thinned: of all that share a cube whose size grows with how
wide the space around them is, the one farthest from surfaces stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tree import bits
from ..tree.topology import Topology, child_coords
from . import warp
from .datapoints import BACKFACE_LIMIT
from .datapoints import keys as voxel_keys
from .gather import Effort, seeded
from .parallel import run_tiles, tile_size, tiles
from .patches import Forest
from .rays import MISS
from .scene import Scene
from .sobol import Sampler

__all__ = ["Around", "Candidates", "candidates", "judge"]

MOST = 1 << 14
"""Candidates of a scene: sixteen for each of a thousand probes."""

JUDGED = 1 << 17
"""Places that rays are sent from, at most: a few seconds."""

RAYS = 64
"""Rays that judge a place, as for data points."""

CLEARANCE = 1 / 16
"""A place is too close to a surface when that is nearer than this part of the mean distance: it hides too much there.
In a room 15 cm; places close to everything, in a shelf, are none the less as good as others."""

NARROWEST = 1 / 16
"""Cubes are no smaller than in space this part as wide as half of the whole: cracks and shelves have few candidates."""

FINEST_CUBES, STEPS, OCTAVES = 5, 3, 20
"""Cubes begin at 1/32 of the width of the space, and double in so many steps, so often at most."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Places where probes could be.

    position : (n, 3) float64 [m], relative to the scene's origin
    octave : (n,) int64, binary logarithm of how wide the space is, rounded down
    rank : (n,) int64, 0 for the one farthest from surfaces
    looked_at : places that were judged
    inside : those of them that are inside walls, as they see too many backs of surfaces
    """

    position: np.ndarray
    octave: np.ndarray
    rank: np.ndarray
    looked_at: int
    inside: int

    def thinned(self, most: int) -> Candidates:
        """Leave some out where they are dense for the space.

        Parameters
        ----------
        most : int
            How many may stay.

        Returns
        -------
        Candidates
            The best of each cube, of cubes that grow until there are few enough, or far larger than the space.
        """
        rows = np.arange(len(self.rank))
        for step in range(STEPS * OCTAVES):
            if len(rows) <= most:
                break
            edge = 2.0 ** (self.octave - FINEST_CUBES + step / STEPS)
            cube = np.floor(self.position / edge[:, None]).astype(np.int64)
            rows = _best_of_each(np.column_stack([self.octave, cube]), self.rank)
        return Candidates(self.position[rows], self.octave[rows], self.rank[rows], self.looked_at, self.inside)


@dataclass(frozen=True, eq=False)
class Around:
    """What rays meet around places; one entry for each.

    mean : float64 [m], geometric mean of distances, infinite where they meet nothing
    nearest : float64 [m]
    back : float64, part of the rays that meet backs of opaque surfaces
    met : float64, part of the rays that meet anything
    """

    mean: np.ndarray
    nearest: np.ndarray
    back: np.ndarray
    met: np.ndarray

    def take(self, rows: np.ndarray) -> Around:
        """Some of the places.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        Around
            Copies.
        """
        return Around(self.mean[rows], self.nearest[rows], self.back[rows], self.met[rows])

    @property
    def is_free(self) -> np.ndarray:
        """(n,) bool, not inside walls, and with something to see."""
        return ~self.is_inside & (self.met > 0)

    @property
    def is_inside(self) -> np.ndarray:
        """(n,) bool, inside walls, or outside of rooms whose walls have no outer side."""
        return (self.back > BACKFACE_LIMIT) | (self.back > self.met / 2)


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Centres (n, 3) and sizes (n,) of voxels [m], and random keys (n,) uint32."""

    center: np.ndarray
    size: np.ndarray
    key: np.ndarray

    def take(self, rows: np.ndarray) -> _Voxels:
        return _Voxels(self.center[rows], self.size[rows], self.key[rows])


def candidates(scene: Scene, forest: Forest, deleted: np.ndarray, effort: Effort) -> Candidates:
    """Find places for probes.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    forest : Forest
        Voxels of the cells where probes are wanted.
    deleted : (b, 2, 3) float64 ndarray
        Lowest and highest corners of boxes without candidates [m].
    effort : Effort
        Seed, threads.

    Returns
    -------
    Candidates
        At most `MOST`, the same for any number of threads.
    """
    voxels = _voxels(forest)
    voxels = voxels.take(np.flatnonzero(~_within(voxels.center, deleted)))
    voxels = voxels.take(_first_thinned(voxels))
    around = judge(scene, voxels.center, seeded(voxels.key, effort.seed), effort.threads)
    rows = np.flatnonzero(around.is_free)
    clear = rows[around.nearest[rows] >= CLEARANCE * around.mean[rows]]
    rows = clear if len(clear) else rows
    found = _ranked(voxels.take(rows), around.take(rows))
    return Candidates(*found, len(voxels.key), int(around.is_inside.sum())).thinned(MOST)


def _voxels(forest: Forest) -> _Voxels:
    """All voxels without children, existing or empty."""
    parts = [_Voxels(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.uint32))]
    for tree in forest.trees:
        level, coords = _whole(tree)
        key = voxel_keys(level.astype(np.uint8), coords)
        parts.append(_Voxels(forest.grid.centers(level, coords), forest.grid.voxel_size(level), key))
    return _Voxels(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("center", "size", "key")))


def _whole(tree: Topology) -> tuple[np.ndarray, np.ndarray]:
    """Levels and coordinates of a tree's voxels without children, and of the children that its nodes lack."""
    level, coords = tree.voxels()
    parent = np.flatnonzero(tree.nodes["mask"] != 0)
    row, bit = bits.unpack(~tree.nodes["mask"][parent])
    empty = child_coords(coords[parent[row]], bit)
    leaves = tree.leaves
    return (
        np.concatenate([level[leaves], level[parent[row]] + 1]).astype(np.int64),
        np.concatenate([coords[leaves], empty]),
    )


def _within(position: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n,) whether positions lie in any of the boxes."""
    found = np.zeros(len(position), bool)
    for low, high in boxes:
        found |= ((position >= low) & (position <= high)).all(axis=1)
    return found


def _first_thinned(voxels: _Voxels) -> np.ndarray:
    """(m,) at most `JUDGED` voxels: one of each cube, by chance, of cubes that grow until there are few enough."""
    rows, step = np.arange(len(voxels.key)), 0
    while len(rows) > JUDGED:
        step += 1
        edge = voxels.size.min() * 2.0 ** (step / STEPS)
        rows = _best_of_each(np.floor(voxels.center / edge).astype(np.int64), voxels.key.astype(np.int64))
    return rows


def judge(scene: Scene, position: np.ndarray, key: np.ndarray, threads: int) -> Around:
    """Look around from places.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    position : (n, 3) float64 ndarray
        Places [m].
    key : (n,) uint32 ndarray
        Their random keys.
    threads : int
        Worker threads; 0 uses every core.

    Returns
    -------
    Around
        What `RAYS` rays meet in all directions.
    """
    mean, nearest, back, met_part = np.full((4, len(position)), np.inf)

    def work(rows: np.ndarray) -> int:
        met, distance, behind = _look(scene, position[rows], key[rows])
        back[rows] = behind.mean(axis=1)
        nearest[rows] = np.where(met, distance, np.inf).min(axis=1)
        count = met.sum(axis=1)
        met_part[rows] = count / RAYS
        logs = np.log(distance, where=met, out=np.zeros(met.shape)).sum(axis=1)
        mean[rows] = np.where(count > 0, np.exp(logs / np.maximum(count, 1)), np.inf)
        return len(rows)

    run_tiles(work, tiles(len(position), tile_size() // RAYS), threads)
    return Around(mean, nearest, back, met_part)


def _look(scene: Scene, position: np.ndarray, key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n, RAYS) whether rays meet anything, how far they go [m], whether they meet backs of opaque surfaces."""
    lane, sample = np.divmod(np.arange(len(position) * RAYS), RAYS)
    sampler = Sampler(key, 0, RAYS)
    direction = warp.sphere(*(sampler.uniform(lane, sample, dimension) for dimension in (0, 1)))
    hits = scene.tracer.intersect(np.ascontiguousarray(position[lane].T.astype(np.float32)), direction)
    met = hits.triangle != MISS
    behind = met & (warp.dot(hits.normal, direction) > 0) & ~scene.surfaces.transparent[hits.triangle]
    distance = np.maximum(hits.distance, np.float32(1e-30))
    return tuple(values.reshape(-1, RAYS) for values in (met, distance, behind))


def _ranked(voxels: _Voxels, around: Around) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, octaves, at least those of a part of the usual width, and ranks."""
    if not len(voxels.key):
        return voxels.center, np.zeros(0, np.int64), np.zeros(0, np.int64)
    narrowest = NARROWEST * _median(around.mean, voxels.size**3)
    octave = np.floor(np.log2(np.maximum(around.mean, narrowest))).astype(np.int64)
    return voxels.center, octave, np.argsort(np.lexsort((voxels.key, -around.nearest)))


def _median(values: np.ndarray, weight: np.ndarray) -> float:
    """Value below which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])


def _best_of_each(group: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Ascending rows of the lowest rank in each group of equal rows."""
    order = np.lexsort((rank, *group.T))
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(group[order], axis=0) != 0).any(axis=1)
    return np.sort(order[new])
