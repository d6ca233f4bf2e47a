"""The dual cells of one level: cubes between the centres of 2 x 2 x 2 voxels, found without walking a tree.

Comes in: the voxels of a level. Goes out: for any cube that touches one of them, its eight corners' rows.

    base (x, y, z)   the cube between the centres of voxels base and base + 1
    root  -> block of 4 x 4 x 4 -> ... -> number of the dual cell -> 8 rows, x fastest, -1 where there is no voxel

Number 0 is the dual cell that touches nothing, block 0 the block that holds only it: a walk never branches.
"""

from __future__ import annotations

import itertools

import numpy as np

__all__ = ["CORNERS", "DualCells"]

CORNERS = np.array([corner[::-1] for corner in itertools.product((0, 1), repeat=3)], np.int64)
"""Offsets of a dual cell's eight corners from its base, x fastest."""
ROOTS = 1 << 20
"""Entries of the root table; more levels of blocks are added until it is smaller, so that far cells cost nothing."""


class DualCells:
    """Look-up of the dual cells of one level.

    Parameters
    ----------
    coords : (m, 3) int64
        Global coordinates of the voxels that exist, each once.
    rows : (m,) int64
        Number of each voxel.

    Attributes
    ----------
    corners : (8, c) int64
        Rows of each dual cell's corners, -1 where the voxel does not exist; column 0 is -1 throughout.
    whole : (c,) bool
        Whether all corners exist.
    """

    def __init__(self, coords: np.ndarray, rows: np.ndarray):
        base = (coords[:, None] - CORNERS).reshape(-1, 3)
        self._low, self._shape, self._depth = _root_box(base)
        key = _pack(((base >> 2 * self._depth) - self._low).T, self._shape)
        number, self._root = _number(key, int(np.prod(self._shape, dtype=np.int64)))
        self._blocks = []
        for stage in range(self._depth - 1, -1, -1):
            size = (int(number.max(initial=0)) + 1) * 64
            number, block = _number(number * 64 + _step(base.T, stage), size)
            self._blocks.append(block)
        self.corners = np.full((8, int(number.max(initial=0)) + 1), -1, np.int64)
        self.corners[np.arange(8), number.reshape(-1, 8)] = rows[:, None]
        self.whole = (self.corners >= 0).all(axis=0)

    def find(self, base: np.ndarray) -> np.ndarray:
        """Return the number of dual cells.

        Parameters
        ----------
        base : (3, n) int64
            Coordinates of their first corners.

        Returns
        -------
        (n,) int64
            Column of `corners`; 0 where no corner exists.
        """
        number = self._root.take(self._root_key(base), mode="clip")
        for stage, block in zip(range(self._depth - 1, -1, -1), self._blocks, strict=True):
            number = block.take((number << 6) + _step(base, stage), mode="clip")
        return number

    def _root_key(self, base: np.ndarray) -> np.ndarray:
        """Which root each dual cell lies in; all outside of the box lie in the empty ones around it."""
        key = 0
        for axis in (2, 1, 0):
            place = (base[axis] >> 2 * self._depth) - self._low[axis]
            np.clip(place, 0, self._shape[axis] - 1, out=place)
            key = key * self._shape[axis] + place
        return key


def _root_box(base: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Lowest root, number of roots along each axis, and how many levels of blocks make them few; a border is empty."""
    low, high = (base.min(axis=0), base.max(axis=0)) if len(base) else (np.zeros(3, int), np.zeros(3, int))
    depth = 1
    while np.prod(((high >> 2 * depth) - (low >> 2 * depth) + 3).astype(float)) > ROOTS:
        depth += 1
    return (low >> 2 * depth) - 1, (high >> 2 * depth) - (low >> 2 * depth) + 3, depth


def _pack(place, shape: np.ndarray) -> np.ndarray:
    """One number for each (x, y, z) of a box."""
    return place[0] + shape[0] * (place[1] + shape[1] * place[2])


def _step(base: np.ndarray, stage: int) -> np.ndarray:
    """Which of a block's 64 entries lies on the way."""
    x, y, z = (base[axis] >> 2 * stage & 3 for axis in range(3))
    y <<= 2
    z <<= 4
    x |= y
    x |= z
    return x


def _number(key: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct keys from 1, and the table from key to number, 0 where there is none."""
    used, number = np.unique(key, return_inverse=True)
    table = np.zeros(size, np.int64)
    table[used] = np.arange(1, len(used) + 1)
    return number.reshape(-1) + 1, table
