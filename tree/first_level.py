"""The dense first level: which voxels it needs so that its data points surround all geometry.

Comes in: triangles. Goes out: the world cells that need a tree, the dense grid of each, and which of its voxels are
solid. A point is surrounded when the eight voxels whose centres are nearest to it exist; these depend only on the
half-size voxel that holds the point, and may lie beyond the border of the cell that holds the geometry.
"""

from __future__ import annotations

import numpy as np

from . import boxes
from .grid import CELL_VOXELS, Grid
from .need import Surfaces, bounds
from .pairs import in_boxes, split, voxels_in
from .region import Region

__all__ = ["around", "check", "dense_box", "occupied_cells", "solid_pairs", "surrounding", "without_undersides"]

PAIRS = 1 << 17
"""Triangles in voxels that are looked at together: about 100 MB."""


def check(triangles: np.ndarray) -> np.ndarray:
    """Refuse what cannot be voxelised.

    Parameters
    ----------
    triangles : (n, 3, 3) float
        Corners [m].

    Returns
    -------
    (n, 3, 3) float
        The same.

    Raises
    ------
    ValueError
        For another shape, and for corners that are not finite.
    """
    triangles = np.asarray(triangles)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise ValueError(f"triangles have shape {triangles.shape}; (n, 3, 3) is needed")
    if not np.isfinite(triangles).all():
        raise ValueError("a triangle's corner is not finite; remove NaN and infinite vertices before the bake")
    return triangles


def occupied_cells(triangles: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the world cells that need a tree, those for which `build` returns one.

    Parameters
    ----------
    triangles : (n, 3, 3) float32
        Corners, relative to the grid's origin [m].
    grid : Grid
        The lattice.

    Returns
    -------
    (m, 2) int64
        Cells (i, j), sorted: those with geometry in them or within half a first-level voxel of them.

    Raises
    ------
    ValueError
        For triangles that are not (n, 3, 3) or not finite.
    """
    triangles = check(triangles)
    low, high = bounds(triangles[:, :, :2])
    margin = 0.5 * grid.first_size
    first = np.ceil((low - margin) / grid.cell_size).astype(np.int64) - 1
    last = np.floor((high + margin) / grid.cell_size).astype(np.int64)
    tallest = np.abs(triangles[:, :, 2]).max(initial=0.0) + grid.cell_size
    half = np.array([0.5 * grid.cell_size + margin, 0.5 * grid.cell_size + margin, tallest])
    found = [np.zeros((0, 2), np.int64)]
    for item, coords in voxels_in(first, last):
        centers = np.concatenate([(coords + 0.5) * grid.cell_size, np.zeros((len(coords), 1))], axis=1)
        apart = np.maximum(high[item] - centers[:, :2], centers[:, :2] - low[item])
        near = (apart <= half[:2]).all(axis=1)
        near[~near] = boxes.overlap(triangles[item[~near]], centers[~near], half)
        found.append(np.unique(coords[near], axis=0))
    return np.unique(np.concatenate(found), axis=0)


def solid_pairs(surfaces: Surfaces, grid: Grid, cell: tuple[int, int], margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the first-level voxels that triangles overlap, in a cell and around it.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).
    margin : int
        Columns beyond the cell's own.

    Returns
    -------
    triangle : (p,) int64
        Triangle of each pair.
    coords : (p, 3) int64
        Voxel of each pair.
    """
    columns = np.asarray(cell) * CELL_VOXELS
    first, last = (np.floor(end / grid.first_size).astype(np.int64) for end in (surfaces.low, surfaces.high))
    first[:, :2], first[:, 2] = columns - margin, first[:, 2] - 1
    last[:, :2] = columns + CELL_VOXELS - 1 + margin
    return in_boxes(surfaces, np.arange(len(surfaces.area)), (first, last), grid.first_size)


def surrounding(
    surfaces: Surfaces, pairs: tuple[np.ndarray, np.ndarray], grid: Grid, cell: tuple[int, int]
) -> np.ndarray:
    """Find the voxels of a cell whose centres surround geometry.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    pairs : tuple
        Triangles and voxels, as from `solid_pairs` with a margin of at least 1.
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    (m, 3) int64
        Voxels of the cell's own columns.
    """
    triangle, coords = pairs
    columns = np.asarray(cell) * CELL_VOXELS
    near = np.flatnonzero(((coords[:, :2] >= columns - 1) & (coords[:, :2] <= columns + CELL_VOXELS)).all(axis=1))
    voxels = around(surfaces, triangle[near], coords[near], grid.first_size)
    return voxels[((voxels[:, :2] >= columns) & (voxels[:, :2] < columns + CELL_VOXELS)).all(axis=1)]


def around(surfaces: Surfaces, triangle: np.ndarray, coords: np.ndarray, size: float) -> np.ndarray:
    """Find the voxels whose centres surround geometry: those that a point on it is looked up from.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    triangle : (p,) int64
        Triangle of each pair.
    coords : (p, 3) int64
        Voxel of each pair; what lies of the triangle in other voxels does not count.
    size : float
        Size of the voxels [m].

    Returns
    -------
    (m, 3) int64
        Voxels, each once.
    """
    found = [np.zeros((0, 3), np.int64)]
    for start in range(0, len(triangle), PAIRS):
        part = slice(start, start + PAIRS)
        _, half = split(surfaces, triangle[part], coords[part], size, 2)
        base = half - 1 >> 1
        found.append(Region.around(base).unique(base))
    voxels = np.concatenate(found)
    for step in np.eye(3, dtype=np.int64):
        voxels = np.concatenate([voxels, voxels + step])
        voxels = Region.around(voxels).unique(voxels)
    return voxels


def without_undersides(
    surfaces: Surfaces, pairs: tuple[np.ndarray, np.ndarray], grid: Grid
) -> tuple[np.ndarray, np.ndarray]:
    """Drop voxels that geometry touches from above only, with nothing further down: nobody sees a ground from below.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    pairs : tuple
        Triangles and voxels, as from `solid_pairs`.
    grid : Grid
        The lattice.

    Returns
    -------
    tuple
        The pairs that remain.
    """
    triangle, coords = pairs
    if not len(coords):
        return pairs
    bottom = np.floor(surfaces.low[:, 2] / grid.first_size).astype(np.int64)
    proper = np.flatnonzero(coords[:, 2] >= bottom[triangle])
    flat = np.concatenate([coords[:, :2], np.zeros((len(coords), 1), np.int64)], axis=1)
    column = Region.around(flat).keys(flat)
    order = proper[np.lexsort((coords[proper, 2], column[proper]))]
    columns, start = np.unique(column[order], return_index=True)
    lowest = coords[order[start], 2]
    kept = coords[:, 2] >= lowest[np.searchsorted(columns, column)]
    return triangle[kept], coords[kept]


def dense_box(coords: np.ndarray, max_points: int) -> Region:
    """Choose the dense grid of a cell: a stray object far above must not blow it up.

    Parameters
    ----------
    coords : (m, 3) int64
        Voxels that it should hold, at least one.
    max_points : int
        Cap on the number of data points.

    Returns
    -------
    Region
        The box around the voxels, or, where that has too many, the layers that hold most of them.

    Raises
    ------
    ValueError
        When the cap is below the size of one layer.
    """
    box = Region.around(coords)
    layer = int(np.prod(box.shape[:2]))
    if layer > max_points:
        raise ValueError(f"{max_points} data points cannot hold one layer of {layer} first-level voxels; raise the cap")
    if layer * int(box.shape[2]) <= max_points:
        return box
    layers = max(1, max_points // 2 // layer)
    z = np.sort(coords[:, 2])
    held = np.searchsorted(z, z + layers) - np.searchsorted(z, z)
    low, high = z[np.argmax(held)], z[-1]
    return Region(np.append(box.low[:2], low), np.append(box.shape[:2], min(layers, high - low + 1)))
