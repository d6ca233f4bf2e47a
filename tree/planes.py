"""Occluding planes as files hold them: a table for each cell, and up to three rows of it for each data point.

Comes in: planes over all cells, in double precision. Goes out: 16-bit rows and a float32 table relative to the cell's
corner, and back.

    plane (m, 5)   unit normal x y z | distance of the plane along it | width, both in metres
    point p        s = normal . (p - corner) - distance;  what passes is clamp(1 + s / width, 0, 1)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["NONE", "SLOTS", "CellPlanes", "empty", "join", "of_cell", "planes_defect"]

NONE = 65_535
"""Row that stands for no plane."""
SLOTS = 3
"""Planes of a data point."""
COLUMNS = 5
UNIT_ERROR = 1e-6
"""How far a stored normal's length may be from 1: rounding to float32 changes it by less than a tenth of this."""


@dataclass(frozen=True)
class CellPlanes:
    """Planes of one cell's data points.

    Parameters
    ----------
    planes : (size, 3) uint16
        Rows of `plane`, `NONE` after the last one.
    plane : (m, 5) float32
        Unit normal, distance from the cell's corner along it [m], width [m].
    shade : float
        0 to 1: what is left of the first level's light where no data point is seen, in cracks.
    fill : (size,) uint8, optional
        What is left of coarser levels' light where they fill up around a voxel, times 255; all of it when left out.
    """

    planes: np.ndarray
    plane: np.ndarray
    shade: float = 1.0
    fill: np.ndarray | None = None


def empty(size: int) -> CellPlanes:
    """Return the planes of a cell without any.

    Parameters
    ----------
    size : int
        Data points.

    Returns
    -------
    CellPlanes
        With an empty table.
    """
    return CellPlanes(np.full((size, SLOTS), NONE, np.uint16), np.zeros((0, COLUMNS), np.float32))


def of_cell(
    planes: np.ndarray,
    plane: np.ndarray,
    position: np.ndarray,
    corner: np.ndarray,
    shade: float = 1.0,
    fill: np.ndarray | None = None,
) -> CellPlanes:
    """Take the planes that one cell's data points use.

    Parameters
    ----------
    planes : (size, 3) int32
        Rows of `plane`, -1 for none.
    plane : (m, 5) float64
        Relative to the origin [m].
    position : (size, 3) float64
        The data points, relative to the origin [m].
    corner : (3,) float64
        The cell's corner, (i, j, 0) times the cell's size [m].
    shade : float
    fill : (size,) uint8, optional
        As in `CellPlanes`.

    Returns
    -------
    CellPlanes
        Where a cell has more than 65,535 distinct planes, those that the fewest data points use are left out.

    Notes
    -----
    Error: planes are right near the data point that uses them first. Heights above them are off by half a unit in the
    last place of the distance, below 0.008 mm where that is less than 256 m, and by 1e-7 of the way from there.
    """
    slot_point, slot = np.nonzero(planes >= 0)
    used, first, count = np.unique(planes[slot_point, slot], return_index=True, return_counts=True)
    kept = np.sort(np.argsort(-count, kind="stable")[:NONE])
    table = plane[used[kept]].astype(np.float32)
    anchor = position[slot_point[first[kept]]] - np.asarray(corner, np.float64)
    exact = plane[used[kept]]
    height = (exact[:, :3] * (anchor + corner)).sum(axis=1) - exact[:, 3]
    table[:, 3] = (table[:, :3].astype(np.float64) * anchor).sum(axis=1) - height
    number = np.full(len(plane) + 1, NONE, np.uint16)
    number[used[kept]] = np.arange(len(kept), dtype=np.uint16)
    rows = np.sort(number[planes], axis=1) if len(kept) < len(used) else number[planes]
    return CellPlanes(rows, table, shade, fill)


def join(cells: Sequence[CellPlanes], corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join the planes of some cells.

    Parameters
    ----------
    cells : sequence of CellPlanes
        In the order of their data points.
    corners : (cells, 3) float64
        Their corners, relative to the origin [m].

    Returns
    -------
    planes : (n, 3) int32
        Rows of `plane`, -1 for none.
    plane : (m, 5) float64
        Relative to the origin [m].
    """
    planes, plane, first = [np.zeros((0, SLOTS), np.int32)], [np.zeros((0, COLUMNS))], 0
    for cell, corner in zip(cells, np.asarray(corners, np.float64), strict=True):
        planes.append(np.where(cell.planes == NONE, -1, cell.planes.astype(np.int32) + first).astype(np.int32))
        table = cell.plane.astype(np.float64)
        table[:, 3] += (table[:, :3] * corner).sum(axis=1)
        plane.append(table)
        first += len(table)
    return np.concatenate(planes), np.concatenate(plane)


def planes_defect(cell: CellPlanes, size: int) -> str:
    """Say what is wrong with a cell's planes.

    Parameters
    ----------
    cell : CellPlanes
        Arrays of any shape and type.
    size : int
        Data points of the cell.

    Returns
    -------
    str
        Empty where nothing is.
    """
    planes, plane = cell.planes, cell.plane
    if planes.shape != (size, SLOTS) or planes.dtype != np.uint16:
        return f"planes is {planes.dtype} {planes.shape}; uint16 {(size, SLOTS)} is needed"
    if plane.ndim != 2 or plane.shape[1] != COLUMNS or plane.dtype != np.float32 or len(plane) > NONE:
        return f"plane is {plane.dtype} {plane.shape}; float32 (at most {NONE}, {COLUMNS}) is needed"
    if ((planes != NONE) & (planes >= len(plane))).any():
        return f"a data point uses a plane beyond the {len(plane)} of the table"
    if ((planes[:, :-1] == NONE) & (planes[:, 1:] != NONE)).any():
        return "a data point has a plane after an empty slot"
    if not np.isfinite(plane).all():
        return "a plane is not finite"
    length = np.sqrt((plane[:, :3].astype(np.float64) ** 2).sum(axis=1))
    if (np.abs(length - 1) > UNIT_ERROR).any():
        return "a plane's normal is not of unit length"
    if (plane[:, 4] <= 0).any():
        return "a plane's width is not positive"
    if type(cell.shade) not in (int, float) or not 0 <= cell.shade <= 1:
        return f"the shade {cell.shade!r} is no number from 0 to 1"
    if cell.fill is not None and (cell.fill.shape != (size,) or cell.fill.dtype != np.uint8):
        return f"fill is {cell.fill.dtype} {cell.fill.shape}; uint8 {(size,)} is needed"
    return ""
