"""Numbers the voxels of a box, so that sets of voxels become sorted rows of integers.

Comes in: global voxel coordinates of one level. Goes out: keys x + nx (y + ny z) relative to the box, and back;
neighbours differ by a constant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["Region", "finder"]


@dataclass(frozen=True, eq=False)
class Region:
    """A box of voxels.

    Parameters
    ----------
    low : (3,) int64
        First voxel.
    shape : (3,) int64
        Number of voxels along each axis.
    """

    low: np.ndarray
    shape: np.ndarray

    @classmethod
    def around(cls, coords: np.ndarray, margin: int = 0) -> Region:
        """Return the smallest box that holds voxels and some more on each side.

        Parameters
        ----------
        coords : (n, 3) int64
            Voxels; without any the box holds the margin only.
        margin : int
            How many more.

        Returns
        -------
        Region
            The box.
        """
        if not len(coords):
            return cls(np.zeros(3, np.int64), np.full(3, 2 * margin, np.int64))
        low = coords.min(axis=0) - margin
        return cls(low, coords.max(axis=0) + margin + 1 - low)

    def contains(self, coords: np.ndarray) -> np.ndarray:
        """Say which voxels lie in the box.

        Parameters
        ----------
        coords : (n, 3) int64
            Voxels.

        Returns
        -------
        (n,) bool
            Whether each does.
        """
        return ((coords >= self.low) & (coords < self.low + self.shape)).all(axis=1)

    def keys(self, coords: np.ndarray) -> np.ndarray:
        """Number voxels.

        Parameters
        ----------
        coords : (..., 3) int64
            Voxels in the box.

        Returns
        -------
        (...) int64
            Their numbers.
        """
        x, y, z = np.moveaxis(coords - self.low, -1, 0)
        return (z * self.shape[1] + y) * self.shape[0] + x

    def coords(self, keys: np.ndarray) -> np.ndarray:
        """Return the voxels with given numbers.

        Parameters
        ----------
        keys : (n,) int64
            Numbers.

        Returns
        -------
        (n, 3) int64
            Voxels.
        """
        rest, x = np.divmod(keys, self.shape[0])
        z, y = np.divmod(rest, self.shape[1])
        return np.stack([x, y, z], axis=-1) + self.low

    def unique(self, coords: np.ndarray) -> np.ndarray:
        """Drop repeated voxels and sort the others by number.

        Parameters
        ----------
        coords : (n, 3) int64
            Voxels in the box.

        Returns
        -------
        (m, 3) int64
            Voxels, z slowest.
        """
        return self.coords(np.unique(self.keys(coords)))


def finder(coords: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from voxels to rows.

    Parameters
    ----------
    coords : (m, 3) int64
        Voxels, each once.

    Returns
    -------
    callable
        (n, 3) int64 voxels to (n,) int64 rows of `coords`, -1 where there is none.
    """
    region = Region.around(coords)
    keys = region.keys(coords)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]

    def find(asked: np.ndarray) -> np.ndarray:
        if not len(keys):
            return np.full(len(asked), -1)
        wanted = np.where(region.contains(asked), region.keys(asked), -1)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[place] == wanted, order[place], -1)

    return find
