"""Averages values over the data points that light a point; coarser levels fill up what cannot be trusted.

Comes in: values at all data points, points, normals. Goes out: their weighted mean F_L at the finest level L, with

    F_l(p) = (sum of weight * value + (ENOUGH - s)+ F_(l-1)(p)) / max(s, ENOUGH),    s = sum of weights

over the stencil that starts at level l. F_-1, the last resort, has no cosine and no planes, and for voxels without a
data point the nearest one stands in. The ramp keeps the value continuous where the last trusted data point fades out.
"""

from __future__ import annotations

import numpy as np

from .interpolate import PAIRS, DataPoints, last_resort, layers
from .stencil import Taps

__all__ = ["ENOUGH", "blend", "clamp"]

ENOUGH = 0.02
"""Weights that sum to less are filled up: a twentieth of what one data point straight before a wall has."""
FAR = 2.0**36
"""Points are clamped to this many first-level voxels, so that coordinates of all levels fit into int64."""


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
    if level < 0:
        sums, total = _accumulate(last_resort(data, points), values, points.shape[1])
        return sums / np.where(total > 0, total, 1)[:, None]
    sums, total = _accumulate(layers(data, points, normals, level), values, points.shape[1])
    low = np.flatnonzero(total < ENOUGH)
    if len(low):
        rest = _fill(data, values, points[:, low], normals[:, low], level - 1)
        sums[low] += (ENOUGH - total[low, None]) * rest
        total[low] = ENOUGH
    sums /= total[:, None]
    return sums


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
