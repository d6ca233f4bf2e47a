"""Chooses the data points that light a point, and their weights.

Comes in: points, normals, the data points of all cells. Goes out: rows and weights. Each tap of the stencil counts by

    weight = linear weight * valid * max(0, cosine between the normal and the way to it) * what its planes let through

and irradiance is the mean by these weights. Where they sum to too little, coarser levels fill up the rest
(`blend`). All of it is continuous along surfaces, and rooms stay apart behind their walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .cells import OFFSET_STEPS
from .dualcells import CORNERS, DualCells
from .grid import Grid
from .lookup import Atlas
from .stencil import Taps, in_order, pick, taps
from .topology import Topology

__all__ = ["PLANES", "DataPoints", "join", "last_resort", "layers", "weigh"]

PLANES = 3
"""Occluding planes of a data point."""
NEAR = 1e-3
"""Distance in voxel sizes within which the cosine fades to 1, as no direction exists at the data point itself."""
ANY = np.float32(1e9)
"""Added height that makes every direction count alike."""
COLUMNS = 1 << 13
"""Points whose taps are weighed at a time, in arrays that stay in the processor's cache."""
PAIRS = 1 << 22
"""Distances computed at a time."""


@dataclass(frozen=True, eq=False)
class DataPoints:
    """The data points of a bake, over the global index space of its atlas.

    Parameters
    ----------
    grid : Grid
        The lattice.
    atlas : Atlas
        The trees.
    level : (n,) uint8
        Level of each voxel.
    coords : (n, 3) int64
        Its global coordinates.
    offset : (n, 3) int8
        Data point minus voxel centre, in voxel sizes / 254.
    valid : (n,) bool
        Whether there is a data point.
    planes : (n, 3) int32
        Rows of `plane`, -1 for none.
    plane : (m, 5) float64
        Unit normal, distance along it from the origin [m], width [m]: what is farther than the width behind a plane
        does not see the data points that use it.
    boxes : (cells, 2, 3) float64
        Lowest and highest corner of each cell's dense grid, relative to the origin [m].
    shade : (n,) float32
        What counts of a data point where none is seen, 0 to 1; the same all over a cell.
    fill : (n,) float32
        What counts of coarser levels where they fill up around a voxel, 0 to 1.
    """

    grid: Grid
    atlas: Atlas
    level: np.ndarray
    coords: np.ndarray
    offset: np.ndarray
    valid: np.ndarray
    planes: np.ndarray
    plane: np.ndarray
    boxes: np.ndarray
    shade: np.ndarray
    fill: np.ndarray

    @cached_property
    def size(self) -> np.ndarray:
        """(n,) float64 voxel size of each data point [m]."""
        return np.asarray(self.grid.voxel_size(self.level.astype(np.int64)), np.float64)

    @cached_property
    def position(self) -> np.ndarray:
        """(n, 3) float64 data points, relative to the origin [m]."""
        return (self.coords + 0.5 + self.offset / OFFSET_STEPS) * self.size[:, None]

    @cached_property
    def dual_cells(self) -> list[DualCells]:
        """Look-up of the dual cells of each level."""
        rows = [np.flatnonzero(self.level == level) for level in range(self.grid.levels)]
        return [DualCells(self.coords[row], row) for row in rows]

    @cached_property
    def shift(self) -> np.ndarray:
        """(3, n) float32 offsets [voxels]."""
        return np.ascontiguousarray(self.offset.T.astype(np.float32) / np.float32(OFFSET_STEPS))

    @cached_property
    def has_planes(self) -> np.ndarray:
        """(n,) bool."""
        return (self.planes >= 0).any(axis=1)

    @cached_property
    def falloffs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """What the first, second and third planes of the data points let through, as linear functions of the place.

        For each: which column each data point has, 0 for none, and (4, columns) float64 slope and value at the origin.
        In float64, as planes can be narrower than a ten-thousandth of a voxel.
        """
        found, planes = [], -np.sort(-self.planes, axis=1)
        for column in planes.T:
            used, row = np.unique(column, return_inverse=True)
            plane = self.plane[used[used >= 0]].T
            table = np.concatenate([plane[:3], plane[4:] - plane[3:4]]) / plane[4]
            found.append((row.reshape(-1) + (used[0] >= 0 if len(used) else 0), np.pad(table, [(0, 0), (1, 0)])))
        return found

    @cached_property
    def holds_back(self) -> np.ndarray | None:
        """(n,) float32 what each voxel holds back of what fills up, or None where all hold back nothing."""
        return 1 - self.fill if (self.fill < 1).any() else None

    @cached_property
    def first_level(self) -> np.ndarray:
        """(f,) int64 rows of the valid voxels of the first level."""
        return np.flatnonzero((self.level == 0) & self.valid)

    def stand_in(self, rows: np.ndarray) -> np.ndarray:
        """Return data points that stand in for voxels of the first level: their own, or the nearest one.

        Parameters
        ----------
        rows : (n,) int
            Voxels of the first level, valid or not; there is a valid one.

        Returns
        -------
        (n,) int64
            Valid ones, nearest by the voxels' centres; of equals the first one.
        """
        unknown = np.unique(rows[self._stand_ins[rows] < 0])
        step = max(1, PAIRS // len(self.first_level))
        for start in range(0, len(unknown), step):
            part = unknown[start : start + step]
            nearest = _squared(self.coords[part], self.coords[self.first_level]).argmin(axis=1)
            self._stand_ins[part] = self.first_level[nearest]
        return self._stand_ins[rows]

    @cached_property
    def _stand_ins(self) -> np.ndarray:
        """What `stand_in` knows so far; -1 for unknown."""
        return np.where(self.valid, np.arange(len(self.valid)), -1)


def join(
    grid: Grid,
    topologies: Sequence[Topology],
    offset: np.ndarray,
    valid: np.ndarray,
    planes: np.ndarray | None = None,
    plane: np.ndarray | None = None,
    shade: np.ndarray | None = None,
    fill: np.ndarray | None = None,
) -> DataPoints:
    """Join the data points of some cells, which may be one.

    Parameters
    ----------
    grid : Grid
        The lattice.
    topologies : sequence of Topology
        The trees, each cell once.
    offset : (n, 3) int8
        Of all cells, in their order.
    valid : (n,) bool
        Likewise.
    planes : (n, 3) int32, optional
        Rows of `plane`, -1 for none; no planes at all when left out.
    plane : (m, 5) float64, optional
        As in `DataPoints`.
    shade : (cells,) float, optional
        Shade of each cell; 1 when left out.
    fill : (n,) float32, optional
        As in `DataPoints`; 1 when left out.

    Returns
    -------
    DataPoints
        Ready for look-up.
    """
    voxels = [topology.voxels() for topology in topologies]
    level = np.concatenate([np.zeros(0, np.uint8), *(voxel[0] for voxel in voxels)])
    coords = np.concatenate([np.zeros((0, 3), np.int64), *(voxel[1] for voxel in voxels)])
    low = np.array([t.grid_min for t in topologies], np.float64).reshape(-1, 3)
    high = low + np.array([t.grid_shape for t in topologies], np.float64).reshape(-1, 3)
    planes = np.full((len(level), PLANES), -1, np.int32) if planes is None else planes
    plane = np.zeros((0, 5)) if plane is None else plane
    boxes = np.stack([low, high], axis=1) * grid.first_size
    shade = np.repeat(np.ones(len(topologies)) if shade is None else shade, [t.size for t in topologies])
    shade, fill = shade.astype(np.float32), np.ones(len(level), np.float32) if fill is None else fill
    return DataPoints(grid, Atlas(topologies), level, coords, offset, valid, planes, plane, boxes, shade, fill)


def layers(data: DataPoints, points: np.ndarray, normals: np.ndarray, finest: int | None = None) -> Iterator[Taps]:
    """Weigh the taps of a stencil: `Taps.weight` holds the products, which are not normalised.

    Parameters
    ----------
    data : DataPoints
        The bake.
    points : (3, n) float64
        Relative to the origin [m].
    normals : (3, n) float32
        Unit length, or zero where no surface is meant: then all directions count alike.
    finest : int, optional
        Level to start from.

    Yields
    ------
    Taps
        From fine to coarse.

    Notes
    -----
    Source: the talk's rows 9 and 10; occluding planes are ours.
    """
    start = data.grid.levels - 1 if finest is None else finest
    for found in taps(data.grid, data.dual_cells, points, start):
        if data.holds_back is not None:
            found = replace(found, linear=found.weight.copy())
        _trust(data, found, pick(normals, found.point))
        yield found


def last_resort(data: DataPoints, points: np.ndarray) -> Iterator[Taps]:
    """Find what lights points where no data point can be trusted: the first level without cosine and planes.

    Parameters
    ----------
    data : DataPoints
        The bake.
    points : (3, n) float64
        Relative to the origin [m].

    Yields
    ------
    Taps
        At most once, with weights that sum to the shade. The nearest valid data points stand in for voxels that have
        none, so that this is continuous too; without any on the first level all weights are 0.
    """
    for found in taps(data.grid, data.dual_cells, points, 0):
        weight, used = found.weight, found.weight > 0
        if len(data.first_level):
            found.row[used] = data.stand_in(found.row[used])
            weight /= np.where(used.any(axis=0), in_order(weight), 1)
            weight *= data.shade[found.row]
        else:
            weight[:] = 0.0
        yield found


def weigh(data: DataPoints, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the data points that light each point, as far as they are trusted.

    Parameters
    ----------
    data : DataPoints
        The bake.
    points : (n, 3) float64
        Relative to the origin [m].
    normals : (n, 3) float
        Unit length, or zero where no surface is meant.

    Returns
    -------
    row : (n, k) int64
        Rows of data points, 0 where the weight is 0; k is 8 for each level that some point needs, 16 in a bake.
    weight : (n, k) float32
        Not normalised. Where a row sums to less than `blend.ENOUGH`, the value is filled up from coarser levels.
    """
    points, normals = np.ascontiguousarray(points.T), np.ascontiguousarray(normals.T.astype(np.float32))
    used = np.zeros(points.shape[1], np.int64)
    found = list(layers(data, points, normals))
    for part in found:
        used[part.point] += 1
    width = 8 * int(used.max(initial=1))
    row, weight = np.zeros((len(used), width), np.int64), np.zeros((len(used), width), np.float32)
    used[:] = 0
    for part in found:
        columns = used[part.point, None] * 8 + np.arange(8)
        row[part.point[:, None], columns] = np.where(part.weight > 0, part.row, 0).T
        weight[part.point[:, None], columns] = part.weight.T
        used[part.point] += 1
    return row, weight


def _trust(data: DataPoints, found: Taps, normals: np.ndarray) -> None:
    """Multiply weights with the cosine between normal and way to the data point, and with what planes let through."""
    lift = np.where(normals.any(axis=0), np.float32(NEAR), ANY)
    for start in range(0, len(lift), COLUMNS):
        part = slice(start, start + COLUMNS)
        row = np.ascontiguousarray(found.row[:, part])
        way = [data.shift[axis].take(row, mode="clip") for axis in range(3)]
        for axis in range(3):
            way[axis] -= found.place[axis, part]
            way[axis] += CORNERS[:, axis, None].astype(np.float32)
        weight = found.weight[:, part] * data.valid.take(row, mode="clip")
        weight *= _cosine(way, normals[:, part], lift[part])
        _occlude(data, row, weight, found.at[:, part])
        found.weight[:, part] = weight


def _cosine(way: list[np.ndarray], normals: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """(8, m) cosine between normals and ways, 0 behind the surface and about 1 where there is no way."""
    height = normals[0] * way[0]
    height += lift
    squared = way[0] * way[0]
    squared += np.float32(NEAR * NEAR)
    for along, normal in zip(way[1:], normals[1:], strict=True):
        height += normal * along
        squared += along * along
    height /= np.sqrt(squared, out=squared)
    return np.clip(height, 0, 1, out=height)


def _occlude(data: DataPoints, row: np.ndarray, weight: np.ndarray, points: np.ndarray) -> None:
    """Multiply weights with what the data points' planes let through."""
    some = np.flatnonzero(data.has_planes.take(row, mode="clip") & (weight > 0))
    row, point, weight = row.take(some), np.tile(np.arange(weight.shape[1]), 8).take(some), weight.reshape(-1)
    for number, (slot, falloff) in enumerate(data.falloffs):
        column = slot.take(row, mode="clip")
        if number:
            used = np.flatnonzero(column > 0)
            some, row, point, column = (part.take(used, mode="clip") for part in (some, row, point, column))
        if not len(some):
            return
        passed = falloff[3].take(column, mode="clip")
        for along, slope in zip(points, falloff, strict=False):
            passed += along.take(point, mode="clip") * slope.take(column, mode="clip")
        weight[some] *= np.clip(passed, 0, 1, out=passed)


def _squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distances between all rows of two arrays."""
    return sum((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3))
