"""Where voxels are: sizes of the levels, world cells, and local metres against voxel coordinates.

Comes in: the extent of a scene. Goes out: one record that every cell of a bake shares. Level 0 is the first
level; each further one divides voxels by 4 along each axis. Voxel c of a level spans [c, c + 1) * its size,
relative to the origin. World cell (i, j) owns the first-level columns [16 i, 16 i + 16) x [16 j, 16 j + 16).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

__all__ = ["BRANCH", "CELL_VOXELS", "FIRST_SIZE", "Grid", "choose"]

BRANCH = 4
"""Children along each axis of a voxel."""
CELL_VOXELS = 16
"""First-level voxels along x and y of a world cell."""
FIRST_SIZE = 8.0
"""Size of a first-level voxel in a scene of human scale [m]."""
SMALLEST_HUMAN_EXTENT = 4.0
"""A scene smaller than this, a small room, gets smaller voxels [m]."""
LARGEST_HUMAN_EXTENT = 4096.0
"""A scene larger than this, a town with its surroundings, gets larger voxels [m]."""
LARGEST_TRIANGLE_IN_CELLS = 64
"""A single triangle, a ground for example, may not ask for more than 64 x 64 cells."""
TAIL = 0.01
"""Share of the geometry at either end of an axis that does not count for the extent: strays, far backdrops."""


@dataclass(frozen=True)
class Grid:
    """The lattice of a bake.

    Parameters
    ----------
    first_size : float
        Size of a first-level voxel [m], 8 m times a power of two.
    levels : int
        Number of levels, 1 to 8; the finest voxels have `first_size / 4 ** (levels - 1)`.
    origin : (3,) float64
        Where local metres start in world metres; a snapshot uses a multiple of 1024 m.

    Raises
    ------
    ValueError
        For a size that is no power of two times 8 m, a number of levels out of range, an origin not finite.
    """

    first_size: float = FIRST_SIZE
    levels: int = 3
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        size = float(self.first_size)
        if not (math.isfinite(size) and size > 0 and math.frexp(size)[0] == 0.5):
            raise ValueError(f"first_size {self.first_size} m is not 8 m times a power of two")
        if not 1 <= self.levels <= 8:
            raise ValueError(f"{self.levels} levels; a tree has 1 to 8")
        origin = np.asarray(self.origin, np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"origin {self.origin} is not three finite numbers")
        object.__setattr__(self, "first_size", size)
        object.__setattr__(self, "levels", int(self.levels))
        object.__setattr__(self, "origin", tuple(origin.tolist()))

    @property
    def cell_size(self) -> float:
        """Width of a world cell along x and y [m]."""
        return CELL_VOXELS * self.first_size

    def voxel_size(self, level: int | np.ndarray) -> float | np.ndarray:
        """Return the size of the voxels of a level.

        Parameters
        ----------
        level : int or (n,) int
            0 is the first, coarsest level.

        Returns
        -------
        float or (n,) float64
            Size [m].
        """
        return self.first_size / np.float64(BRANCH) ** level

    def to_local(self, p_world: np.ndarray) -> np.ndarray:
        """Subtract the origin, in double precision.

        Parameters
        ----------
        p_world : (n, 3) float64
            Points in world space [m].

        Returns
        -------
        (n, 3) float64
            Points relative to the origin [m].
        """
        return np.asarray(p_world, np.float64) - self.origin

    def centers(self, level: np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Return the centres of voxels.

        Parameters
        ----------
        level : (n,) int
            Level of each voxel.
        coords : (n, 3) int64
            Global voxel coordinates of that level.

        Returns
        -------
        (n, 3) float64
            Centres relative to the origin [m].
        """
        return (np.asarray(coords) + 0.5) * np.asarray(self.voxel_size(np.asarray(level)))[..., None]

    def voxels_at(self, level: int, p_local: np.ndarray) -> np.ndarray:
        """Return the voxels of a level that hold points.

        Parameters
        ----------
        level : int
            The level.
        p_local : (n, 3) float64
            Points relative to the origin [m].

        Returns
        -------
        (n, 3) int64
            Global voxel coordinates.
        """
        return np.floor(p_local / float(self.voxel_size(level))).astype(np.int64)

    def cells_of(self, bounds: np.ndarray) -> np.ndarray:
        """Return every world cell that a box overlaps; a box that only touches a cell's lower border is not in it.

        Parameters
        ----------
        bounds : (2, 3) float64
            Lowest and highest corner, relative to the origin [m].

        Returns
        -------
        (n, 2) int64
            Cells (i, j), sorted.
        """
        first, last = cell_range(self, np.asarray(bounds, np.float64)[0, :2], np.asarray(bounds, np.float64)[1, :2])
        i, j = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        return np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2)


def cell_range(grid: Grid, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last cell along each axis that intervals overlap.

    Parameters
    ----------
    grid : Grid
        The lattice.
    low, high : (..., 2) float64
        Interval ends along x and y, relative to the origin [m].

    Returns
    -------
    first, last : (..., 2) int64
        Inclusive; an interval that ends on a border belongs to the cell below, one of no length to the cell above.
    """
    first = np.floor(low / grid.cell_size).astype(np.int64)
    last = np.ceil(high / grid.cell_size).astype(np.int64) - 1
    return first, np.maximum(first, last)


def choose(triangles: np.ndarray, levels: int = 3, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Grid:
    """Choose voxel sizes for a scene: 8 m at human scale, a power of two smaller or larger beyond it.

    A scene shrinks the voxels when both the bulk of its triangles and the bulk of its area lie within less than
    4 m, and enlarges them when both need more than 4096 m, or one triangle more than 64 cells.

    Parameters
    ----------
    triangles : (n, 3, 3) float
        Corners, relative to the origin [m].
    levels : int
        Number of levels.
    origin : (3,) float64
        Passed on to the grid [m].

    Returns
    -------
    Grid
        The lattice.

    Raises
    ------
    ValueError
        Without triangles, or when a corner is not finite.
    """
    corners = np.asarray(triangles, np.float64)
    if corners.ndim != 3 or corners.shape[1:] != (3, 3) or not len(corners):
        raise ValueError(f"triangles have shape {corners.shape}; (n, 3, 3) with n > 0 is needed")
    if not np.isfinite(corners).all():
        raise ValueError("a triangle's corner is not finite")
    low, high = corners.min(axis=1), corners.max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    extents = [_extent(low, high, np.ones(len(corners))), _extent(low, high, area)]
    return Grid(FIRST_SIZE * 2.0 ** _exponent(extents, float((high - low)[:, :2].max())), levels, origin)


def _extent(low: np.ndarray, high: np.ndarray, weight: np.ndarray) -> float:
    """Longest side of the box that holds all but the tails of the weight."""
    return max(
        _quantile(high[:, axis], weight, 1.0 - TAIL) - _quantile(low[:, axis], weight, TAIL) for axis in range(3)
    )


def _quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """Smallest value below which at least a share of the weight lies."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weight[order])
    return float(values[order[min(np.searchsorted(sums, share * sums[-1]), len(order) - 1)]])


def _exponent(extents: list[float], widest: float) -> int:
    """Power of two that brings a scene into the range of human scale."""
    exponent = 0
    if 0 < max(extents) < SMALLEST_HUMAN_EXTENT:
        exponent = math.floor(math.log2(max(extents) / SMALLEST_HUMAN_EXTENT))
    elif min(extents) > LARGEST_HUMAN_EXTENT:
        exponent = math.ceil(math.log2(min(extents) / LARGEST_HUMAN_EXTENT))
    if widest > 0:
        cells = widest / (LARGEST_TRIANGLE_IN_CELLS * CELL_VOXELS * FIRST_SIZE)
        exponent = max(exponent, math.ceil(math.log2(cells)))
    return exponent
