"""Averages values over the data points that light a point; coarser levels fill up what cannot be trusted.

Comes in: values at all data points, points, normals. Goes out: their weighted mean F_L at the finest level L, with

    F_l(p) = (sum of weight * value + (ENOUGH - s)+ fill_l(p) F_(l-1)(p)) / max(s, ENOUGH),    s = sum of weights

over the stencil that starts at level l. As it is dark in cracks, voxels hold back a part of what fills up there, and
F_-1, the last resort, is multiplied with the cell's shade; it has no cosine and no planes, and the nearest data point
stands in for voxels without one. The ramp keeps the value continuous where the last trusted data point fades out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from .interpolate import PAIRS, DataPoints, last_resort, layers
from .stencil import Taps, in_order, pick

__all__ = ["ENOUGH", "blend", "clamp", "shares"]

ENOUGH = 0.002
"""Weights that sum to less are filled up. A corner of a room that lies on the voxel grid has 0.009: its own data points
have to count alone there, or a lit room behind the wall shines in."""
DONE = -2
"""Level of points that need no more."""
BLOCK = 1 << 15
"""Numbers of as many points as are added at a time; with all that they read 1.2 MB."""
FAR = 2.0**36
"""Points are clamped to this many first-level voxels, so that coordinates of all levels fit into int64."""


def blend(data: DataPoints, values: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Average values around points.

    Parameters
    ----------
    data : DataPoints
        The bake.
    values : (rows, m) float32
        Finite values of every voxel; those of voxels without a data point do not count.
    points : (n, 3) float64
        Relative to the origin [m]; see `clamp`.
    normals : (n, 3) float
        Unit length, or zero where no surface is meant: then all directions count alike.

    Returns
    -------
    (n, m) float32
        Weighted means; zeros in a bake without any valid data point.
    """
    result = np.zeros((len(points), values.shape[1]), np.float32)
    for part in shares(data, points, normals) if values.size else ():
        _add(result, values, *part)
    return result


def shares(
    data: DataPoints, points: np.ndarray, normals: np.ndarray, resort: bool = True
) -> Iterator[tuple[np.ndarray, ...]]:
    """Find out which data points count around points, and how much each does.

    Parameters
    ----------
    data, points, normals
        As for `blend`.
    resort : bool
        Whether the last resort counts, which does not know of walls.

    Yields
    ------
    to : (m,) int64 ndarray
        Some of the points, each once.
    row : (8, m) int64 ndarray
        Data points.
    weight : (8, m) float32 ndarray
        Parts of the points' values that are theirs; over all that is yielded they sum to 1 for a point, less what
        is held back and shaded, in a bake with any valid data point.
    """
    points, normals = np.ascontiguousarray(points.T), np.ascontiguousarray(normals.T, np.float32)
    count = points.shape[1]
    share, due = np.ones(count, np.float32), np.full(count, data.grid.levels - 1)
    for level in range(data.grid.levels - 1, -1, -1):
        some = np.flatnonzero(due == level)
        found = list(layers(data, pick(points, some), pick(normals, some), level))
        total, start = _trust(found, len(some))
        left = np.maximum(np.float32(ENOUGH) - total, 0) / np.float32(ENOUGH)
        left **= (level - start + 1).astype(np.float32)
        yield from _scaled(found, some, pick(share, some) * (1 - left) / np.where(total > 0, total, 1))
        due[some] = np.where(left > 0, start - 1, DONE)
        share[some] *= _hold_back(data, found, start, left)
    some = np.flatnonzero(due > DONE) if resort else due[:0]
    yield from _scaled(last_resort(data, pick(points, some)), some, share[some])


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
    voxel = np.floor(points.T * (1.0 / data.grid.first_size)).astype(np.int64)
    first = data.dual_cells[0]
    outside = np.flatnonzero(first.corners[0, first.find(voxel)] < 0)
    step = max(1, PAIRS // len(data.boxes))
    for start in range(0, len(outside), step):
        part = outside[start : start + step]
        inside = np.clip(points[part, None], data.boxes[:, 0], data.boxes[:, 1])
        best = ((inside - points[part, None]) ** 2).sum(axis=2).argmin(axis=1)
        points[part] = inside[np.arange(len(part)), best]
    return points


def _trust(found: list[Taps], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums of weights, and the finest level with taps, of each point."""
    total, start = np.zeros(count, np.float32), np.zeros(count, np.int64)
    for taps in found:
        total[taps.point] += in_order(taps.weight)
        start[taps.point] = np.maximum(start[taps.point], taps.level)
    return total, start


def _hold_back(data: DataPoints, found: list[Taps], start: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(m,) what is left for coarser levels after the voxels of the finest level have held back theirs."""
    for taps in found if data.holds_back is not None else ():
        rows = np.flatnonzero((left.take(taps.point) > 0) & (start.take(taps.point) == taps.level))
        held = data.holds_back.take(pick(taps.row, rows))
        held *= pick(taps.linear, rows)
        left[taps.point[rows]] *= np.maximum(1 - in_order(held), 0)
    return left


def _scaled(found: Iterable[Taps], some: np.ndarray, scale: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Taps of some points as `shares` yields them, their weights scaled."""
    for taps in found:
        yield pick(some, taps.point), taps.row, taps.weight * pick(scale, taps.point)


def _add(result: np.ndarray, values: np.ndarray, to: np.ndarray, rows: np.ndarray, weight: np.ndarray) -> None:
    """Add weighted values of data points to some points' results, in blocks that stay in the processor's cache."""
    step, whole = max(1, BLOCK // values.shape[1]), np.dtype((np.void, result.itemsize * result.shape[1]))
    for start in range(0, len(to), step):
        part = slice(start, start + step)
        row = np.ascontiguousarray(rows[:, part].T)
        read = values.take(row.reshape(-1), axis=0, mode="clip").reshape(*row.shape, -1)
        mean = np.matmul(np.ascontiguousarray(weight[:, part].T)[:, None], read)[:, 0]
        mean += result.take(to[part], axis=0, mode="clip")
        np.put(result.view(whole), to[part], mean.view(whole), mode="clip")
