"""Dilates the upper levels of a tree, so that every neighbourhood has data of one or two levels only.

Comes in: the voxels that a cell has, and those that its neighbours may have. Goes out: the voxels it must have.

A missing voxel takes its value from the eight voxels of the coarser level whose centres surround its own. Where it is
next to a voxel that exists, these eight must exist, or a neighbourhood would mix three levels. On the finest level
"next to" means the 26 neighbours: a neighbourhood is 2 x 2 x 2 voxels there. One that is empty on the finest level
reads up to 3 x 3 x 3 voxels of the next, so that on other levels it means two rings. Voxels that other cells may
have count as existing and as missing. Full dilation first gives the finest solid voxels all their neighbours.
"""

from __future__ import annotations

import itertools

import numpy as np

from .grid import BRANCH, CELL_VOXELS
from .outline import Outline
from .region import Region

__all__ = ["BESIDE_FULL", "DILATIONS", "dilate"]

DILATIONS = ("none", "partial", "full")
BESIDE_FULL = "beside full"
"""Partial dilation next to cells that may be dilated fully: for a cell whose own full dilation the cap forbids."""
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)), np.int64)
STEPS = list(itertools.product((-1, 0, 1), repeat=3))


def dilate(outline: Outline, solid: list[np.ndarray], dilation: str) -> list[np.ndarray]:
    """Return all voxels of a cell.

    Parameters
    ----------
    outline : Outline
        The cell.
    solid : list of (m, 3) int64
        For each level the solid voxels that the cell is to have; their parents are among them.
    dilation : str
        "none", "partial", "full" or "beside full".

    Returns
    -------
    list of (m, 3) int64
        For each level but the first all voxels below the dense grid, sorted by z, y, x; the first entry is empty.
    """
    finest = len(solid) - 1
    voxels = [solid[0][:0], *solid[1:]]
    if dilation == "none" or not finest:
        return voxels
    others = _others(outline, dilation)
    if dilation == "full":
        voxels[finest] = own(outline, finest, _neighbours(np.concatenate([solid[finest], outline.border[finest]])))
    for level in range(finest, 1, -1):
        asked = _asked(voxels[level], others[level], 1 if level == finest else 2)
        asked = np.concatenate([asked, voxels[level] // BRANCH, solid[level - 1]])
        voxels[level - 1] = own(outline, level - 1, asked)
    return voxels


def own(outline: Outline, level: int, coords: np.ndarray) -> np.ndarray:
    """Return each voxel that lies in the cell's dense grid once; there are no others.

    Parameters
    ----------
    outline : Outline
        The cell.
    level : int
        Level of the voxels.
    coords : (n, 3) int64
        Voxels, also outside of the cell, also more than once.

    Returns
    -------
    (m, 3) int64
        Sorted by z, y, x.
    """
    scale = BRANCH**level
    inside = Region(outline.dense.low * scale, outline.dense.shape * scale).contains(coords)
    return _once(coords[inside])


def _others(outline: Outline, dilation: str) -> list[np.ndarray]:
    """Voxels of each level that other cells may have near the border, dilation included.

    What they have depends on what they believe of this cell: all that geometry allows, not what it has. Voxels asked
    for by themselves lie next to solid ones.
    """
    finest = len(outline.border) - 1
    possible = [coords if level == 0 else _neighbours(coords) for level, coords in enumerate(outline.border)]
    for level in range(finest, 2, -1):
        asked = _asked(possible[level][:0], possible[level], 1 if level == finest else 2)
        possible[level - 1] = _once(np.concatenate([asked, possible[level] // BRANCH, possible[level - 1]]))
    widths = [CELL_VOXELS * BRANCH**level for level in range(finest + 1)]
    homes = [coords[:, :2] // width for coords, width in zip(possible, widths, strict=True)]
    return [coords[(home != outline.cell).any(axis=1)] for coords, home in zip(possible, homes, strict=True)]


def _once(coords: np.ndarray) -> np.ndarray:
    """Each voxel once, sorted."""
    return Region.around(coords).unique(coords)


def _neighbours(coords: np.ndarray) -> np.ndarray:
    """All voxels with their 26 neighbours."""
    bricks, near, _ = _near(coords[:0], coords, 1)
    row, x, y, z = np.nonzero(near)
    return bricks[row] * BRANCH + np.stack([x, y, z], axis=-1)


def _asked(own: np.ndarray, other: np.ndarray, rings: int) -> np.ndarray:
    """Coarser voxels from which missing ones take their value, where these are within some rings of existing ones.

    A child in the lower half of its parent, along an axis, lies between its parent's centre and the one before.
    """
    bricks, near, exists = _near(own, other, rings)
    asking = (near & ~exists).reshape(-1, 2, 2, 2, 2, 2, 2).any(axis=(2, 4, 6))
    row, x, y, z = np.nonzero(asking)
    base = bricks[row] + np.stack([x, y, z], axis=-1) - 1
    return (base[:, None] + CORNERS).reshape(-1, 3)


def _near(own: np.ndarray, other: np.ndarray, rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bricks of 4 x 4 x 4 voxels: coordinates, what is within some rings of any voxel, what exists for certain."""
    coords = np.concatenate([own, other])
    region = Region.around(coords // BRANCH, 1)
    keys = region.keys(coords // BRANCH)
    steps = region.keys(np.array(STEPS) + region.low)
    bricks = np.unique((np.unique(keys)[:, None] + steps).reshape(-1))
    occupied = np.zeros((len(bricks) + 1, BRANCH, BRANCH, BRANCH), bool)
    place = np.searchsorted(bricks, keys), *np.moveaxis(coords % BRANCH, -1, 0)
    occupied[tuple(axis[: len(own)] for axis in place)] = True
    exists = occupied[:-1].copy()
    occupied[place] = True
    near = _spread(_padded(occupied, bricks, steps, rings), rings)
    return region.coords(bricks), near, exists


def _padded(occupied: np.ndarray, bricks: np.ndarray, steps: np.ndarray, rings: int) -> np.ndarray:
    """Bricks with some rings of voxels from the bricks around them; the last of the occupied ones is empty."""
    width = BRANCH + 2 * rings
    padded = np.zeros((len(bricks), width, width, width), bool)
    target = {-1: slice(0, rings), 0: slice(rings, rings + BRANCH), 1: slice(rings + BRANCH, width)}
    source = {-1: slice(BRANCH - rings, BRANCH), 0: slice(0, BRANCH), 1: slice(0, rings)}
    for offset, step in zip(STEPS, steps, strict=True):
        place = np.searchsorted(bricks, bricks + step)
        found = np.flatnonzero(bricks[np.minimum(place, len(bricks) - 1)] == bricks + step)
        part = occupied[(place[found], *(source[axis] for axis in offset))]
        padded[(found, *(target[axis] for axis in offset))] = part
    return padded


def _spread(padded: np.ndarray, rings: int) -> np.ndarray:
    """Whether any voxel within some rings is occupied, one axis after the other."""
    for axis in (1, 2, 3):
        windows = [np.take(padded, range(shift, shift + BRANCH), axis=axis) for shift in range(2 * rings + 1)]
        padded = np.logical_or.reduce(windows)
    return padded
