"""Averages values over the data points that light a point; coarser levels fill up what cannot be trusted.

Comes in: values at all data points, points, normals. Goes out: their weighted mean F_L at the finest level L, with

    F_l(p) = (sum of weight * value + (ENOUGH - s)+ F_(l-1)(p)) / max(s, ENOUGH),    s = sum of weights

over the stencil that starts at level l. Below the first level counts the mean without cosine and planes, and last
the nearest data point. The ramp keeps the value continuous where the last trusted data point fades out.
"""

from __future__ import annotations

import numpy as np

from .interpolate import DataPoints, layers
from .stencil import Taps, taps

__all__ = ["ENOUGH", "blend", "clamp"]

ENOUGH = 0.02
"""Weights that sum to less are filled up: a twentieth of what one data point straight before a wall has."""
FAR = 2.0**36
"""Points are clamped to this many first-level voxels, so that coordinates of all levels fit into int64."""
PAIRS = 1 << 22
"""Distances computed at a time."""


def blend(data: DataPoints, values: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Average values around points.

    Parameters
    ----------
    data : DataPoints
        The bake.
    values : (rows, m) float32
        Values of every voxel; those of voxels without a data point are never read.
    points : (n, 3) float64
        Relative to the origin [m]; see `clamp`.
    normals : (n, 3) float
        Unit length, or zero where no surface is meant: then all directions count alike.

    Returns
    -------
    (n, m) float32
        Weighted means; zeros in a bake without any valid data point.
    """
    points = np.ascontiguousarray(points.T)
    normals = np.ascontiguousarray(normals.T, np.float32)
    return _fill(data, values, points, normals, data.grid.levels - 1)


def clamp(data: DataPoints, points: np.ndarray) -> np.ndarray:
    """Move points that lie outside of all dense grids to the nearest one.

    Parameters
    ----------
    data : DataPoints
        The bake.
    points : (n, 3) float64
        Relative to the origin [m].

    Returns
    -------
    (n, 3) float64
        Points inside or on the border of a dense grid; only limited in a bake without cells.
    """
    limit = FAR * data.grid.first_size
    points = np.clip(points, -limit, limit)
    if not len(data.boxes):
        return points
    voxel = np.floor(points * (1.0 / data.grid.first_size)).astype(np.int64)
    outside = np.flatnonzero(data.atlas.find(0, voxel) < 0)
    step = max(1, PAIRS // len(data.boxes))
    for start in range(0, len(outside), step):
        part = outside[start : start + step]
        inside = np.clip(points[part, None], data.boxes[:, 0], data.boxes[:, 1])
        best = ((inside - points[part, None]) ** 2).sum(axis=2).argmin(axis=1)
        points[part] = inside[np.arange(len(part)), best]
    return points


def _fill(data: DataPoints, values: np.ndarray, points: np.ndarray, normals: np.ndarray, level: int) -> np.ndarray:
    """F_level of the module's definition."""
    found = layers(data, points, normals, level) if level >= 0 else _plain(data, points)
    sums, total = _accumulate(found, values, points.shape[1])
    low = np.flatnonzero(total < ENOUGH)
    if len(low):
        if level >= 0:
            rest = _fill(data, values, points[:, low], normals[:, low], level - 1)
        else:
            rest = _nearest(data, values, points[:, low])
        sums[low] += (ENOUGH - total[low, None]) * rest
        total[low] = ENOUGH
    sums /= total[:, None]
    return sums


def _plain(data: DataPoints, points: np.ndarray):
    """The first level's taps by linear weight and validity only."""
    for found in taps(data.grid, data.dual_cells, points, 0):
        found.weight[:] *= data.valid[found.row]
        yield found


def _accumulate(found, values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums of values, and of weights, over all taps of each point."""
    sums, total = np.zeros((count, values.shape[1]), np.float32), np.zeros(count, np.float32)
    for part in found:
        if len(part.point) == count:
            sums += _weighted(part, values)
            total += part.weight.sum(axis=0)
        else:
            sums[part.point] += _weighted(part, values)
            total[part.point] += part.weight.sum(axis=0)
    return sums, total


def _weighted(part: Taps, values: np.ndarray) -> np.ndarray:
    """Weighted sum of values over the eight corners."""
    sums = np.zeros((len(part.point), values.shape[1]), np.float32)
    read = np.empty_like(sums)
    for row, weight in zip(part.row, part.weight, strict=True):
        np.take(values, row, axis=0, out=read, mode="clip")
        read *= weight[:, None]
        sums += read
    return sums


def _nearest(data: DataPoints, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of the valid voxels of the first level whose centres are nearest to the points' voxels."""
    rows = np.flatnonzero((data.level == 0) & data.valid)
    if not len(rows):
        return np.zeros((points.shape[1], values.shape[1]), np.float32)
    size = data.grid.first_size
    voxels, inverse = np.unique(np.floor(points / size), axis=1, return_inverse=True)
    center, step = (data.coords[rows] + 0.5) * size, max(1, PAIRS // len(rows))
    found = np.empty(voxels.shape[1], np.int64)
    for start in range(0, len(found), step):
        part = (voxels[:, start : start + step].T + 0.5) * size
        found[start : start + step] = _squared(part, center).argmin(axis=1)
    return values[rows[found[inverse.reshape(-1)]]]


def _squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distances between all rows of two arrays."""
    return sum((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3))
