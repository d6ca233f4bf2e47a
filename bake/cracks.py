"""Cracks: places that receivers see and no data point lights, filled by data points that move there.

Comes in: a cell and its unlit receivers. Goes out: which data points move, and where to. In a crack the data point of
the finest voxel stands outside; it moves in where that lights more surface than it lights now.
"""

from __future__ import annotations

import numpy as np

from ..tree import interpolate
from ..tree.blend import ENOUGH
from ..tree.cells import OFFSET_STEPS
from ..tree.lookup import Atlas
from . import receivers
from .datapoints import FARTHEST_STEP
from .scene import Scene
from .survey import State

__all__ = ["find"]

AWAY = 0.25
"""A data point that moves to an unlit receiver goes at most this far in front of it [voxels]."""


def find(scene: Scene, state: State, unlit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose data points that are of less use where they are.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    state : State
        A cell.
    unlit : (n,) int64 ndarray
        Rows of receivers without light.

    Returns
    -------
    row : (m,) int64 ndarray
        Data points, each once.
    offset : (m, 3) int8 ndarray
        Where they go, as in `Measured`.
    """
    at = state.seen.at
    row = _leaves(state, at.position[unlit])
    offset, free = _in_front(scene, state, unlit, row)
    unlit, row, offset = unlit[free], row[free], offset[free]
    use, gain = _usefulness(state), np.bincount(row, at.area[unlit], len(state.measured.level))
    order = np.lexsort((-at.area[unlit], row))
    row, first = np.unique(row[order], return_index=True)
    offset, better = offset[order][first], gain[row] > use[row]
    return row[better], offset[better]


def _in_front(scene: Scene, state: State, chosen: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) int8 offsets half-way to what stands before receivers, within their voxels, and (n,) whether the way there
    is free."""
    at = state.seen.at.take(chosen)
    size, origin = state.data.size[row], receivers.lifted(scene, at)
    far = (2 * AWAY * size).astype(np.float32)
    hits = scene.tracer.intersect_opaque(origin, np.ascontiguousarray(at.normal.T), far)
    reach = np.where(hits.triangle >= 0, np.minimum(hits.distance, far), far) / 2
    center = (state.measured.coords[row] + 0.5) * size[:, None]
    steps = (at.position + at.normal * reach[:, None] - center) / size[:, None] * OFFSET_STEPS
    offset = np.clip(np.round(steps), -FARTHEST_STEP, FARTHEST_STEP)
    place = (center + offset * size[:, None] / OFFSET_STEPS).T.astype(np.float32)
    blocked = scene.tracer.blocked(origin, np.ascontiguousarray(place - origin), np.ones(len(row), np.float32))
    height = ((place.T - at.position) * at.normal).sum(axis=1)
    return offset.astype(np.int8), ~blocked & (height > 0)


def _usefulness(state: State) -> np.ndarray:
    """(points,) area of the receivers that each data point lights, by its share [m2]."""
    at = state.seen.at
    row, weight = interpolate.weigh(state.data, at.position, at.normal)
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), ENOUGH) * at.area[:, None]
    return np.bincount(row.ravel(), share.ravel(), len(state.measured.level))


def _leaves(state: State, position: np.ndarray) -> np.ndarray:
    """(n,) finest voxel that holds each position."""
    grid, atlas, row = state.data.grid, Atlas([state.tree]), np.zeros(len(position), np.int64)
    for level in range(grid.levels):
        found = atlas.find(level, grid.voxels_at(level, position))
        row = np.where(found >= 0, found, row)
    return row
