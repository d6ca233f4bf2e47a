"""Chooses the data points that light a point, and their weights.

Comes in: points, normals, the data points of all cells. Goes out: eight rows and weights a point, which sum to 1.
On the finest level with usable data, the eight voxel centres around the point count by trilinear weight times the
cosine between the normal and the direction to the data point. Where no level has such data the cosine is dropped;
where there are no valid centres either, the nearest valid data point of the first level counts alone.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .cells import OFFSET_STEPS
from .grid import Grid
from .lookup import Atlas

__all__ = ["DataPoints", "weigh"]

CORNERS = np.array([corner[::-1] for corner in itertools.product((0, 1), repeat=3)], np.int64)
"""Offsets of the eight voxels around a point, x fastest."""
USABLE = 1e-6
"""Weights that sum to less carry no information: rounding of points that lie in a data point's own plane."""
AT_POINT = 1e-6
"""Distance in voxel sizes within which a point is at the data point, where no direction exists."""
FAR = 2.0**36
"""Points are clamped to this many first-level voxels, so that coordinates of all levels fit into int64."""
PAIRS = 1 << 22
"""Distances computed at a time."""


@dataclass(frozen=True)
class DataPoints:
    """The data points of a bake, over the global index space of its atlas.

    Parameters
    ----------
    grid : Grid
        The lattice.
    atlas : Atlas
        The trees.
    offset : (n, 3) int8
        Data point minus voxel centre, in voxel sizes / 254.
    valid : (n,) bool
        Whether there is a data point.
    first_level : (m,) int64
        Global indices of the valid voxels of the first level.
    first_center : (m, 3) float64
        Their centres, relative to the origin [m].
    boxes : (cells, 2, 3) float64
        Lowest and highest corner of each cell's dense grid, relative to the origin [m].
    """

    grid: Grid
    atlas: Atlas
    offset: np.ndarray
    valid: np.ndarray
    first_level: np.ndarray
    first_center: np.ndarray
    boxes: np.ndarray


def weigh(data: DataPoints, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the data points that light each point.

    Parameters
    ----------
    data : DataPoints
        The bake.
    points : (n, 3) float64
        Relative to the origin [m].
    normals : (n, 3) float64
        Unit length, or zero where no surface is meant: then all directions count alike.

    Returns
    -------
    row : (n, 8) int64
        Global indices of valid voxels; 0 where the weight is 0.
    weight : (n, 8) float64
        Sum 1; all 0 only in a bake without any valid data point.
    """
    row, weight = np.zeros((len(points), 8), np.int64), np.zeros((len(points), 8))
    if not data.valid.any():
        return row, weight
    limit = FAR * data.grid.first_size
    points = np.clip(points, -limit, limit)
    left = np.arange(len(points))
    for facing, level in itertools.product((True, False), range(data.grid.levels - 1, -1, -1)):
        if not len(left):
            return row, weight
        found, part = _neighbourhood(data, level, points[left], normals[left] if facing else None)
        total = part.sum(axis=1)
        usable = total > USABLE
        row[left[usable]], weight[left[usable]] = found[usable], part[usable] / total[usable, None]
        left = left[~usable]
    nearest = _nearest(data, points[left])
    row[left[nearest >= 0], 0], weight[left[nearest >= 0], 0] = nearest[nearest >= 0], 1.0
    return row, weight


def _neighbourhood(
    data: DataPoints, level: int, points: np.ndarray, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Valid ones of the eight voxels around each point, and trilinear weights, times the cosine if asked for."""
    size = float(data.grid.voxel_size(level))
    base = np.floor(points / size - 0.5)
    place = points / size - 0.5 - base
    coords = base.astype(np.int64)[:, None] + CORNERS
    row = data.atlas.find(level, coords.reshape(-1, 3)).reshape(-1, 8)
    valid = (row >= 0) & data.valid[row]
    row = np.where(valid, row, 0)
    weight = np.where(valid, np.where(CORNERS, place[:, None], 1.0 - place[:, None]).prod(axis=2), 0.0)
    if normals is not None:
        weight[valid] *= _cosines(data, size, coords, row, points, normals)[valid]
    return row, weight


def _cosines(
    data: DataPoints, size: float, coords: np.ndarray, row: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Cosine between the normal and the direction to each data point, 0 behind the surface."""
    step = size / OFFSET_STEPS
    arm = (coords + 0.5) * size + data.offset[row] * step - points[:, None]
    length = np.sqrt(np.einsum("nci,nci->nc", arm, arm))
    cosine = np.einsum("nci,ni->nc", arm, normals) / np.maximum(length, AT_POINT * size)
    free = (length < AT_POINT * size) | ~normals.any(axis=1)[:, None]
    return np.where(free, 1.0, np.maximum(cosine, 0.0))


def _nearest(data: DataPoints, points: np.ndarray) -> np.ndarray:
    """Valid voxel of the first level whose centre is nearest to the point clamped to the nearest dense grid."""
    if not len(data.first_level):
        return np.full(len(points), -1)
    size = data.grid.first_size
    clamped = _clamp(data.boxes, points)
    voxels, inverse = np.unique(np.floor(clamped / size), axis=0, return_inverse=True)
    nearest = np.empty(len(voxels), np.int64)
    step = max(1, PAIRS // len(data.first_level))
    for start in range(0, len(voxels), step):
        center = (voxels[start : start + step] + 0.5) * size
        nearest[start : start + step] = _squared(center, data.first_center).argmin(axis=1)
    return data.first_level[nearest[inverse.reshape(-1)]]


def _clamp(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The nearest point of the nearest box."""
    clamped = np.empty_like(points)
    step = max(1, PAIRS // max(len(boxes), 1))
    for start in range(0, len(points), step):
        part = points[start : start + step]
        inside = np.clip(part[:, None], boxes[:, 0], boxes[:, 1])
        best = ((inside - part[:, None]) ** 2).sum(axis=2).argmin(axis=1)
        clamped[start : start + step] = inside[np.arange(len(part)), best]
    return clamped


def _squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distances between all rows of two arrays."""
    return sum((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3))
