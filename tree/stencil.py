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

__all__ = ["Taps", "in_order", "pick", "taps"]

NOTHING = 1e-9
"""Weight of missing corners below which they are rounding."""


@dataclass(frozen=True)
class Taps:
    """Taps of some points on one level.

    Parameters
    ----------
    point : (m,) int64
        Which points; each once.
    row : (8, m) int64
        Rows of the data points, 0 where the weight is 0.
    weight : (8, m) float32
        Linear weights; over all levels they sum to 1 for each point, less what lies outside the first level.
    at : (3, m) float64
        The points [m].
    place : (3, m) float32
        The points, relative to the centre of the first corner [voxels of the level].
    level : int
        The level.
    linear : (8, m) float32, optional
        The linear weights alone, where `weight` is more than that.
    """

    point: np.ndarray
    row: np.ndarray
    weight: np.ndarray
    at: np.ndarray
    place: np.ndarray
    level: int
    linear: np.ndarray | None = None


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
    point, center = np.arange(points.shape[1]), points.copy()
    share = np.ones(points.shape[1], np.float32)
    for level in range(finest, -1, -1):
        size = float(grid.voxel_size(level))
        place = center * (1.0 / size) - 0.5
        base = np.floor(place)
        number = levels[level].find(base.astype(np.int64))
        goes_on, touched = number == 0, np.flatnonzero(number > 0)
        if len(touched):
            corners = _corners(levels[level], place, base, share, number, touched)
            used, base = pick(point, touched), pick(base, touched)
            some, moved, missing = _missing(corners, base, size)
            some = touched[some]
            center[:, some], share[some], goes_on[some] = moved, missing, True
            row = np.maximum(corners[0], 0, out=corners[0])
            at = pick(points, used)
            yield Taps(used, row, corners[1], at, _place(at, base, size), level)
        rest = np.flatnonzero(goes_on)
        if not level or not len(rest):
            return
        point, center, share = pick(point, rest), pick(center, rest), pick(share, rest)


def in_order(parts: np.ndarray) -> np.ndarray:
    """Sum rows one after the other, so that results do not depend on how many columns there are.

    Parameters
    ----------
    parts : (k, n) float32
        At least two rows.

    Returns
    -------
    (n,) float32
        Their sum.
    """
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


def pick(values: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Take columns, in their order.

    Parameters
    ----------
    values : (..., n) ndarray
        Any.
    some : (m,) int64
        Which, ascending, each once; so n of them are all.

    Returns
    -------
    (..., m) ndarray
        Not a copy if it is all of them.
    """
    return values if len(some) == values.shape[-1] else np.take(values, some, axis=-1, mode="clip")


def _corners(cells: DualCells, place, base, share, number, touched: np.ndarray) -> tuple[np.ndarray, ...]:
    """(8, m) rows and linear weights of dual cells that have corners, and whether all of them exist."""
    number = pick(number, touched)
    row = np.take(cells.corners, number, axis=1, mode="clip")
    weight = _trilinear(pick(place - base, touched).astype(np.float32), pick(share, touched))
    return row, weight, cells.whole[number]


def _missing(corners: tuple[np.ndarray, ...], base: np.ndarray, size: float) -> tuple[np.ndarray, ...]:
    """Take weight from missing corners: which points lack some, their centroids, and how much they weigh."""
    row, weight, whole = corners
    some = np.flatnonzero(~whole)
    missing = weight[:, some] * (row[:, some] < 0)
    weight[:, some] -= missing
    share = in_order(missing)
    on = np.flatnonzero(share > NOTHING)
    moved = np.stack([in_order(missing[CORNERS[:, axis] == 1]) for axis in range(3)])
    return some[on], (pick(base, some[on]) + 0.5 + moved[:, on] / share[on]) * size, share[on]


def _trilinear(place: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(8, n) weights of the corners."""
    x, y, z = np.stack([1 - place, place], axis=1)
    yz = z[:, None] * y[None, :] * share
    return (yz[:, :, None] * x).reshape(8, -1)


def _place(at: np.ndarray, base: np.ndarray, size: float) -> np.ndarray:
    """(3, m) float32 points relative to the centres of the first corners [voxels]."""
    place = at * (1.0 / size)
    place -= 0.5
    place -= base
    return place.astype(np.float32)
