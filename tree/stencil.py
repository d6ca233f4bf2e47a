"""The data points around a point, and their linear weights: seamless interpolation over the levels of a tree.

Comes in: points. Goes out: taps, eight for each of the one or two levels that a point needs.

On the finest level whose dual cell around p has any corner, the corners count by their trilinear weights w_i. What
belongs to missing corners goes to the next coarser level, *at the centroid of the missing corners*,

    I_l(p) = sum over corners that exist  w_i D_i  +  w_m I_(l-1)(p_m),     w_m = sum over the others w_i,
                                                                           p_m = sum over the others w_i c_i / w_m.

Linear fields are exact, since w_m I(p_m) is what the missing corners would have added. The value is continuous: on
a face between two dual cells only the face's corners have weight, the same on either side, and a dual cell with
no corner at all has p_m = p. Partial dilation gives every p_m a full neighbourhood on the next level.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .dualcells import CORNERS, DualCells
from .grid import Grid

__all__ = ["Taps", "taps"]

NOTHING = 1e-9
"""Weight of missing corners below which they are rounding."""


@dataclass(frozen=True)
class Taps:
    """Taps of some points on one level.

    Parameters
    ----------
    point : (m,) int64
        Which points; each once.
    row : (8, m) int32
        Rows of the data points, 0 where the weight is 0.
    weight : (8, m) float32
        Linear weights; over all levels they sum to 1 for each point, less what lies outside the first level.
    place : (3, m) float32
        The point, relative to the centre of the first corner [voxels of the level].
    size : float
        Voxel size [m].
    """

    point: np.ndarray
    row: np.ndarray
    weight: np.ndarray
    place: np.ndarray
    size: float


def taps(grid: Grid, levels: list[DualCells], points: np.ndarray, finest: int) -> Iterator[Taps]:
    """Find the data points that surround points.

    Parameters
    ----------
    grid : Grid
        The lattice.
    levels : list of DualCells
        Of all levels, the first one first.
    points : (3, n) float64
        Relative to the grid's origin [m].
    finest : int
        Level to start from; finer ones do not count.

    Yields
    ------
    Taps
        From fine to coarse; levels that no point needs are left out.

    Notes
    -----
    Error: linear fields to rounding, continuous; `tests/tree/test_stencil.py`.
    Source: row 9 of the talk; evaluating the coarse level at the centroid is ours.
    """
    point, center = np.arange(points.shape[1]), points
    share = np.ones(points.shape[1], np.float32)
    for level in range(finest, -1, -1):
        if not len(point):
            return
        size = float(grid.voxel_size(level))
        base = center * (1.0 / size) - 0.5
        place = base.copy()
        np.floor(base, out=base)
        number = levels[level].find(base.astype(np.int64))
        row = np.ascontiguousarray(np.take(levels[level].corners, number, axis=0).T)
        weight = _trilinear((place - base).astype(np.float32), share)
        missing = weight * (row < 0)
        if number.any():
            yield _taps(point, points, row, weight - missing, base, size, number)
        point, center, share = _onward(point, center, base, missing, number, size)


def _onward(point, center: np.ndarray, base: np.ndarray, missing: np.ndarray, number: np.ndarray, size: float):
    """Points whose corners are not all there: where the coarser level is evaluated, and with what weight."""
    share = missing.sum(axis=0)
    on = np.flatnonzero(share > NOTHING)
    share = share[on]
    moved = CORNERS.T.astype(np.float32) @ missing[:, on]
    moved = (base[:, on] + 0.5 + moved / share) * size
    bare = np.flatnonzero(number[on] == 0)
    moved[:, bare] = center[:, on[bare]]
    return point[on], moved, share


def _trilinear(place: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(8, n) weights of the corners."""
    x, y, z = np.stack([1 - place, place], axis=1)
    yz = z[:, None] * y[None, :] * share
    return (yz[:, :, None] * x).reshape(8, -1)


def _taps(point, points: np.ndarray, row, weight, base, size: float, number: np.ndarray) -> Taps:
    """Taps of the points that some corner exists for."""
    if not number.all():
        touched = np.flatnonzero(number)
        point, row, weight, base = point[touched], row[:, touched], weight[:, touched], base[:, touched]
    at = points if len(point) == points.shape[1] else points[:, point]
    place = at * (1.0 / size) - 0.5 - base
    return Taps(point, np.maximum(row, 0), weight, place.astype(np.float32), size)
