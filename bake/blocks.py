"""Sets of voxels of several levels, and the pools of data points over which changes are averaged.

Comes in: voxels. Goes out: which others touch them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..tree.grid import Grid
from . import receivers
from .measured import BRANCH_BITS, Measured

__all__ = ["BLOCK", "Blocks", "by_level", "pool_keys", "pool_level", "pools", "voxels_of"]

BLOCK = 2
"""Level of the voxels in which surfaces are compared: 0.5 m at human scale."""


class Blocks:
    """Voxels of several levels.

    Parameters
    ----------
    marks : list of (int, (n, 3) int64 ndarray)
        Levels, and voxels there.
    """

    def __init__(self, marks: list[tuple[int, np.ndarray]]) -> None:
        self.marks = [(level, coords) for level, coords in marks if len(coords)]
        self._known: dict = {}

    def __bool__(self) -> bool:
        return bool(self.marks)

    def touch(self, level: int, coords: np.ndarray) -> np.ndarray:
        """Say which voxels are, hold or lie in one of these.

        Parameters
        ----------
        level : int
            Their level.
        coords : (n, 3) int64 ndarray
            Voxels.

        Returns
        -------
        (n,) bool ndarray
            Of each.
        """
        found = np.zeros(len(coords), bool)
        for number, (own, marked) in enumerate(self.marks):
            if (number, level) not in self._known:
                self._known[number, level] = receivers.among(_up(marked, own - level))
            found |= self._known[number, level](_up(coords, level - own))
        return found

    def beside(self, level: int, coords: np.ndarray) -> np.ndarray:
        """Say for which voxels one of the 26 neighbours, or they themselves, are among these.

        Parameters
        ----------
        level : int
            Their level.
        coords : (n, 3) int64 ndarray
            Voxels.

        Returns
        -------
        (n,) bool ndarray
            Of each.
        """
        return Blocks([mark for mark in self.marks if mark[0] == level]).around(level, coords)

    def around(self, level: int, coords: np.ndarray) -> np.ndarray:
        """Say for which voxels one of the 26 neighbours, or they themselves, touch these.

        Parameters
        ----------
        level : int
            Their level.
        coords : (n, 3) int64 ndarray
            Voxels.

        Returns
        -------
        (n,) bool ndarray
            Of each.
        """
        found = np.zeros(len(coords), bool)
        for step in np.ndindex(3, 3, 3):
            left = np.flatnonzero(~found)
            found[left] = self.touch(level, coords[left] + np.array(step) - 1)
        return found


def pool_level(grid: Grid, level: np.ndarray | int) -> np.ndarray | int:
    """Choose the voxels over which changes at data points are averaged.

    Parameters
    ----------
    grid : Grid
        The lattice.
    level : int or int ndarray
        Levels of data points.

    Returns
    -------
    int or int ndarray
        That of their parents, at most `BLOCK`.
    """
    return np.clip(np.asarray(level, np.int64) - 1, 0, min(BLOCK, grid.levels - 1))


def pool_keys(grid: Grid, measured: Measured) -> np.ndarray:
    """Name the pools of data points: those of one level that share a voxel of `pool_level`.

    Parameters
    ----------
    grid : Grid
        The lattice.
    measured : Measured
        n data points.

    Returns
    -------
    (n, 4) int64 ndarray
        Level of each data point, and its pool's voxel.
    """
    level = measured.level.astype(np.int64)
    return np.column_stack([level, measured.coords >> (BRANCH_BITS * (level - pool_level(grid, level)))[:, None]])


def pools(grid: Grid, measured: Measured) -> list[tuple[int, np.ndarray]]:
    """List the pools of data points.

    Parameters
    ----------
    grid : Grid
        The lattice.
    measured : Measured
        Data points.

    Returns
    -------
    list of (int, (m, 3) int64 ndarray)
        For each level of data points the voxels of their pools, of `pool_level`.
    """
    keys = np.unique(pool_keys(grid, measured), axis=0)
    return [(int(level), keys[keys[:, 0] == level, 1:]) for level in np.unique(keys[:, 0])]


def voxels_of(measured: Measured) -> Blocks:
    """Take the voxels of data points.

    Parameters
    ----------
    measured : Measured
        Data points.

    Returns
    -------
    Blocks
        Their voxels.
    """
    return Blocks([(int(level), measured.coords[measured.level == level]) for level in np.unique(measured.level)])


def by_level(judge: Callable[[int, np.ndarray], np.ndarray], measured: Measured) -> np.ndarray:
    """Ask something about the voxels of data points.

    Parameters
    ----------
    judge : callable
        A method of `Blocks`.
    measured : Measured
        n data points.

    Returns
    -------
    (n,) bool ndarray
        What it says of each.
    """
    out = np.zeros(len(measured.level), bool)
    for level in np.unique(measured.level):
        rows = np.flatnonzero(measured.level == level)
        out[rows] = judge(int(level), measured.coords[rows])
    return out


def _up(coords: np.ndarray, levels: int) -> np.ndarray:
    """Ancestors of voxels so many levels up; they themselves for none or fewer."""
    return coords >> (BRANCH_BITS * max(levels, 0))
