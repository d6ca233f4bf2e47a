"""Dilates the upper levels of a tree, so that every neighbourhood has data of one or two levels only.

Comes in: the voxels that a cell has, and those that its neighbours may have. Goes out: the voxels it must have.

The rule: the centre of each missing voxel that is one of the 26 neighbours of an existing one is surrounded by eight
voxels of the next coarser level. No fewer do, since such a centre may be all that is missing around a point. It is
enough at centroids of several missing voxels as well (`stencil`): the 4 x 4 x 4 voxels that share one coarser dual
cell are all missing, all there, which takes their parents, or some are missing next to some that exist. Voxels that
other cells may have count as existing and as missing. Full dilation first gives the finest solid voxels all neighbours.
"""

from __future__ import annotations

import itertools

import numpy as np

from .dualcells import CORNERS
from .grid import BRANCH, CELL_VOXELS
from .outline import Outline
from .region import Region

__all__ = ["DILATIONS", "dilate", "neighbours", "others", "own"]

DILATIONS = ("none", "partial", "full")
STEPS = list(itertools.product((-1, 0, 1), repeat=3))


def dilate(outline: Outline, solid: list[np.ndarray], dilation: str, elsewhere: list[np.ndarray]) -> list[np.ndarray]:
    """Return all voxels of a cell.

    Parameters
    ----------
    outline : Outline
        The cell.
    solid : list of (m, 3) int64
        For each level the solid voxels that the cell is to have; their parents are among them.
    dilation : str
        One of `DILATIONS`.
    elsewhere : list of (b, 3) int64
        From `others`.

    Returns
    -------
    list of (m, 3) int64
        For each level but the first all voxels below the dense grid, sorted by z, y, x; the first entry is empty.
    """
    finest = len(solid) - 1
    voxels = [solid[0][:0], *solid[1:]]
    if dilation == "none" or not finest:
        return voxels
    if dilation == "full":
        inner = np.concatenate([_solid_only(outline, solid[finest]), outline.border[finest]])
        voxels[finest] = own(outline, finest, np.concatenate([solid[finest], neighbours(inner)]))
    for level in range(finest, 1, -1):
        asked = _asked(voxels[level], elsewhere[level])
        asked = np.concatenate([asked, voxels[level] // BRANCH, solid[level - 1]])
        voxels[level - 1] = own(outline, level - 1, asked)
    return voxels


def others(outline: Outline, dilation: str) -> list[np.ndarray]:
    """Return voxels that other cells may have near the border, dilation included.

    What they have depends on what they believe of this cell: all that geometry allows, not what it has.

    Parameters
    ----------
    outline : Outline
        The cell.
    dilation : str
        One of `DILATIONS`: theirs.

    Returns
    -------
    list of (b, 3) int64
        For each level those outside of the cell's columns.
    """
    finest = len(outline.border) - 1
    possible = list(outline.around)
    if dilation == "full":
        possible[finest] = neighbours(outline.border[finest])
    for level in range(finest, 2, -1) if dilation != "none" else ():
        asked = _asked(possible[level][:0], possible[level])
        possible[level - 1] = _once(np.concatenate([asked, possible[level] // BRANCH, possible[level - 1]]))
    widths = [CELL_VOXELS * BRANCH**level for level in range(finest + 1)]
    homes = [coords[:, :2] // width for coords, width in zip(possible, widths, strict=True)]
    return [coords[(home != outline.cell).any(axis=1)] for coords, home in zip(possible, homes, strict=True)]


def _solid_only(outline: Outline, voxels: np.ndarray) -> np.ndarray:
    """Those of the finest voxels that geometry has; the others stand next to them, and other cells expect no more."""
    region = Region.around(np.concatenate([voxels, outline.coords[-1]]))
    return voxels[np.isin(region.keys(voxels), region.keys(outline.coords[-1]))]


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


def neighbours(coords: np.ndarray) -> np.ndarray:
    """Return voxels with their 26 neighbours.

    Parameters
    ----------
    coords : (n, 3) int64
        Voxels, also more than once.

    Returns
    -------
    (m, 3) int64
        Each voxel once.
    """
    bricks, near, _ = _near(coords[:0], coords)
    row, x, y, z = np.nonzero(near)
    return bricks[row] * BRANCH + np.stack([x, y, z], axis=-1)


def _once(coords: np.ndarray) -> np.ndarray:
    """Each voxel once, sorted."""
    return Region.around(coords).unique(coords)


def _asked(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Coarser voxels around the centres of missing ones that have an existing neighbour.

    A child in the lower half of its parent, along an axis, lies between its parent's centre and the one before.
    """
    bricks, near, exists = _near(own, other)
    asking = (near & ~exists).reshape(-1, 2, 2, 2, 2, 2, 2).any(axis=(2, 4, 6))
    row, x, y, z = np.nonzero(asking)
    base = bricks[row] + np.stack([x, y, z], axis=-1) - 1
    return (base[:, None] + CORNERS).reshape(-1, 3)


def _near(own: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bricks of 4 x 4 x 4 voxels: coordinates, what is or neighbours any voxel, what exists for certain."""
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
    return region.coords(bricks), _spread(_padded(occupied, bricks, steps)), exists


def _padded(occupied: np.ndarray, bricks: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Bricks with a layer of voxels from the bricks around them; the last of the occupied ones is empty."""
    padded = np.zeros((len(bricks), *[BRANCH + 2] * 3), bool)
    target = {-1: slice(0, 1), 0: slice(1, -1), 1: slice(-1, None)}
    source = {-1: slice(-1, None), 0: slice(0, BRANCH), 1: slice(0, 1)}
    for offset, step in zip(STEPS, steps, strict=True):
        place = np.searchsorted(bricks, bricks + step)
        found = np.flatnonzero(bricks[np.minimum(place, len(bricks) - 1)] == bricks + step)
        part = occupied[(place[found], *(source[axis] for axis in offset))]
        padded[(found, *(target[axis] for axis in offset))] = part
    return padded


def _spread(padded: np.ndarray) -> np.ndarray:
    """Whether a voxel or any of its neighbours is occupied, one axis after the other."""
    for axis in (1, 2, 3):
        padded = np.logical_or.reduce([np.take(padded, range(step, step + BRANCH), axis=axis) for step in range(3)])
    return padded
