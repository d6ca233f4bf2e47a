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
    level : int
        The level.
    """

    point: np.ndarray
    row: np.ndarray
    weight: np.ndarray
    place: np.ndarray
    level: int


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
        place = center * (1.0 / size) - 0.5
        base = np.floor(place)
        number = levels[level].find(base.astype(np.int64))
        bare, touched = np.flatnonzero(number == 0), np.flatnonzero(number)
        rest = [(point[bare], center[:, bare], share[bare])] if len(bare) else []
        if len(touched):
            if len(bare):
                point, place, base, share = point[touched], place[:, touched], base[:, touched], share[touched]
                number = number[touched]
            row = np.ascontiguousarray(np.take(levels[level].corners, number, axis=0).T)
            weight = _trilinear((place - base).astype(np.float32), share)
            rest += _onward(point, base, row, weight, ~levels[level].whole[number], size)
            yield Taps(point, np.maximum(row, 0, out=row), weight, _place(points, point, base, size), level)
        if not rest:
            return
        point, center, share = (np.concatenate(parts, axis=-1) for parts in zip(*rest, strict=True))


def _onward(point, base: np.ndarray, row: np.ndarray, weight: np.ndarray, partial: np.ndarray, size: float) -> list:
    """Takes weight from missing corners: the points that have some, where the coarser level counts, and how much."""
    some = np.flatnonzero(partial)
    if not len(some):
        return []
    missing = weight[:, some] * (row[:, some] < 0)
    weight[:, some] -= missing
    faces = [[missing[corner] for corner in np.flatnonzero(CORNERS[:, axis])] for axis in range(3)]
    share = _sum(missing)
    on = share > NOTHING
    moved = np.stack([_sum(face) for face in faces]) / np.where(on, share, 1)
    return [(point[some[on]], (base[:, some[on]] + 0.5 + moved[:, on]) * size, share[on])]


def _sum(parts) -> np.ndarray:
    """Sum in a fixed order, so that results do not depend on how many points there are."""
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


def _trilinear(place: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(8, n) weights of the corners."""
    x, y, z = np.stack([1 - place, place], axis=1)
    yz = z[:, None] * y[None, :] * share
    return (yz[:, :, None] * x).reshape(8, -1)


def _place(points: np.ndarray, point: np.ndarray, base: np.ndarray, size: float) -> np.ndarray:
    """Points relative to the centres of the first corners [voxels]."""
    at = points if len(point) == points.shape[1] else points[:, point]
    return (at * (1.0 / size) - 0.5 - base).astype(np.float32)
