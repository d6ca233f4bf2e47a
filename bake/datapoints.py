"""Data points: where each voxel measures light, moved out of walls where that is possible.

Comes in: voxel centres. Goes out: positions, stored offsets, validity. A point is inside something when too many
of its rays meet the backs of opaque surfaces first; it then moves through the nearest of them, within its own
voxel, or is marked invalid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree.cells import OFFSET_STEPS
from . import warp
from .parallel import run_tiles, tile_size, tiles
from .rays import MISS
from .scene import Scene
from .sobol import Sampler, scramble

PROBE_RAYS = 64
"""Rays that judge a point: a share of a quarter is then known to within 0.055 (one standard deviation)."""

BACKFACE_LIMIT = 0.25
"""A point that sees more backs than this is inside (Majercik et al. 2019, DDGI's relocation)."""

CANDIDATES = 8
"""Nearest ways out that are tried."""

CLEARANCE = 0.04
"""How far beyond the surface a moved point goes, in voxels: a tenth of the way to the next finer point."""

FARTHEST_STEP = OFFSET_STEPS // 2
"""Half a voxel."""


@dataclass(frozen=True)
class Placement:
    """Data points of some voxels.

    position : (3, n) float32 [m], relative to the scene's origin
    offset : (n, 3) int8, position minus voxel centre in steps of the voxel size / 254
    valid : (n,) bool, False inside walls
    """

    position: np.ndarray
    offset: np.ndarray
    valid: np.ndarray


def keys(level: np.ndarray, coords: np.ndarray) -> np.ndarray:
    """Random keys of voxels.

    Parameters
    ----------
    level : (n,) uint8 ndarray
        Level of each voxel.
    coords : (n, 3) int64 ndarray
        Its coordinates on that level, over all cells.

    Returns
    -------
    (n,) uint32 ndarray
        The same for a voxel whichever cell, process or order it is baked in.
    """
    key = scramble(level.astype(np.uint32), 1)
    for axis in range(3):
        key = scramble(key ^ (coords[:, axis] & 0xFFFFFFFF).astype(np.uint32), axis + 2)
    return key


def place(
    scene: Scene,
    center: np.ndarray,
    size: np.ndarray,
    key: np.ndarray,
    threads: int = 0,
    progress: Callable[[int], bool] | None = None,
) -> Placement:
    """Judge every voxel centre, and move those inside something.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    center : (n, 3) float64 ndarray
        Voxel centres, relative to the scene's origin [m].
    size : (n,) float64 ndarray
        Voxel sizes [m].
    key : (n,) uint32 ndarray
        Random keys.
    threads : int
        Worker threads; 0 uses every core.
    progress : callable, optional
        As in `gather.gather`.

    Returns
    -------
    Placement
        One data point for each voxel.

    Notes
    -----
    Source: row 10 of the talk leaves this open; the criterion is DDGI's (Majercik et al. 2019), the move Unity's
    virtual offset, here along the rays that found the backs.
    """
    offset = np.zeros(center.shape, np.int8)
    valid = np.ones(len(center), bool)

    def work(rows: np.ndarray) -> int:
        inside, ways = _judge(scene, center[rows], key[rows])
        valid[rows[inside]] = False
        _move_out(scene, center, size, key, rows[inside], ways, offset, valid)
        return len(rows)

    run_tiles(work, tiles(len(center), tile_size() // PROBE_RAYS), threads, progress)
    position = np.ascontiguousarray(_moved(center, offset, size).T.astype(np.float32))
    return Placement(position, offset, valid)


def morton_order(position: np.ndarray) -> np.ndarray:
    """Order points along a space-filling curve, so that a tile's rays stay together.

    Parameters
    ----------
    position : (3, n) float32 ndarray
        Points.

    Returns
    -------
    (n,) int64 ndarray
        Rows, sorted by 30-bit Morton code.
    """
    if position.shape[1] == 0:
        return np.zeros(0, np.int64)
    low = position.min(axis=1, keepdims=True)
    step = max(float(np.ptp(position, axis=1).max()), 1e-30) / 1023
    code = np.zeros(position.shape[1], np.int64)
    lattice = ((position - low) / step).astype(np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (lattice[axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _judge(scene: Scene, position: np.ndarray, key: np.ndarray):
    """(rows that are inside, ways out): (rows, CANDIDATES, 3) directions and (rows, CANDIDATES) metres to backs."""
    direction, distance, back = _probe(scene, position, key)
    inside = np.flatnonzero(back.mean(axis=1) > BACKFACE_LIMIT)
    reach = np.where(back[inside], distance[inside], np.inf)
    nearest = np.argsort(reach, axis=1, kind="stable")[:, :CANDIDATES]
    toward = direction[inside][np.arange(len(inside))[:, None], nearest]
    return inside, (toward, np.take_along_axis(reach, nearest, axis=1))


def _move_out(scene: Scene, center, size, key, rows, ways, offset, valid) -> None:
    """Try the ways out, nearest first; the first that leads to free space wins.

    A surface inside the voxel can be passed even where the clearance behind it ends at the voxel's border.
    """
    toward, reach = ways
    for attempt in range(reach.shape[1]):
        left = np.flatnonzero(~valid[rows] & np.isfinite(reach[:, attempt]))
        voxel = size[rows[left], None]
        met = toward[left, attempt] * reach[left, attempt, None] / voxel
        beyond = met + toward[left, attempt] * CLEARANCE
        fits = (np.abs(met) <= 0.5).all(axis=1)
        steps = np.clip(np.round(beyond[fits] * OFFSET_STEPS), -FARTHEST_STEP, FARTHEST_STEP).astype(np.int8)
        tried = rows[left[fits]]
        if not len(tried):
            continue
        back = _probe(scene, _moved(center[tried], steps, size[tried]), key[tried])[2]
        free = back.mean(axis=1) <= BACKFACE_LIMIT
        offset[tried[free]] = steps[free]
        valid[tried[free]] = True


def _probe(scene: Scene, position: np.ndarray, key: np.ndarray):
    """Rays all around: (n, rays, 3) directions, (n, rays) distances [m], (n, rays) whether a back was met."""
    point, sample = np.divmod(np.arange(len(position) * PROBE_RAYS), PROBE_RAYS)
    sampler = Sampler(scramble(key, 0), 0, PROBE_RAYS)
    direction = warp.sphere(*(sampler.uniform(point, sample, dimension) for dimension in (0, 1)))
    origin = np.ascontiguousarray(position.T.astype(np.float32)[:, point])
    hits = scene.tracer.intersect(origin, direction)
    back = (hits.triangle != MISS) & (warp.dot(hits.normal, direction) > 0)
    back &= ~scene.surfaces.transparent[hits.triangle]
    shape = (len(position), PROBE_RAYS)
    return direction.T.reshape(*shape, 3), hits.distance.reshape(shape), back.reshape(shape)


def _moved(center: np.ndarray, offset: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(n, 3) float64 positions [m]."""
    return center + offset.astype(np.float64) * (size / OFFSET_STEPS)[:, None]
