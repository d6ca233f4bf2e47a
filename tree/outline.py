"""What the tree of a world cell could be, by geometry alone: the candidates for subdivision, and what they would add.

Comes in: triangles in local metres. Goes out: an `Outline`, or None for a cell that needs no tree.

Below the dense first level a voxel is solid where it overlaps a triangle, touching included. Geometry asks to
subdivide a solid voxel unless its surroundings are flat. The same rule holds in a band around the cell, so that a
cell built alone knows which voxels its neighbours may have next to it: what they have is a part of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import bits
from .first_level import around, check, dense_box, solid_pairs, surrounding, without_undersides
from .grid import BRANCH, CELL_VOXELS, Grid
from .need import FLAT, Surfaces, Voxels, assess, bounds, surfaces_of
from .pairs import split
from .region import Region
from .topology import MAX_POINTS, child_coords

__all__ = ["Outline", "outline"]

CANDIDATES = 4
"""An outline lists at most this many times the cap of voxels, so that a choice is left and memory is bounded."""
LEAST = 1e-6
"""Need of a voxel that geometry asks to subdivide, however little it varies."""
SMOOTH = 0.03
"""Need up to which voxels at a border are no candidates of light: it hardly ever asks for them, and a neighbour would
have to surround all that they may have."""
REACH = 4
"""Voxels of a level that lie farther from a voxel of the level above it, in their own size, never ask for it."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The solid voxels of a world cell; all tuples are by level, 0 the first.

    Parameters
    ----------
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).
    dense : Region
        The dense grid of first-level voxels, global coordinates.
    coords : tuple of (m, 3) int64
        Solid voxels: the first level's z slowest, then the children of one after those of another.
    parent : tuple of (m,) int64
        Row of each one's parent in the level before; level 0 has none.
    wanted : tuple of (m,) bool
        Candidates: voxels that geometry, or light, may ask to subdivide; one entry fewer than levels. Their solid
        children are in the next level, those of others are not.
    need : tuple of (m,) float64
        How varied the geometry in and around each voxel is, above 0 to 1.5, or 0 where it is flat; one entry fewer
        than levels.
    border : tuple of (b, 3) int64
        Solid voxels on both sides of the cell's side borders that it or its neighbours may have, however they choose,
        as far as they matter to each other; none on the first level.
    around : tuple of (a, 3) int64
        Voxels whose centres surround the geometry in those of `border`, them included: no others near the border may
        be asked for by themselves.
    left_out : int
        Voxels that geometry asked to subdivide, or to cover, and that are beyond what an outline lists.
    """

    grid: Grid
    cell: tuple[int, int]
    dense: Region
    coords: tuple[np.ndarray, ...]
    parent: tuple[np.ndarray, ...]
    wanted: tuple[np.ndarray, ...]
    need: tuple[np.ndarray, ...]
    border: tuple[np.ndarray, ...]
    around: tuple[np.ndarray, ...]
    left_out: int = 0

    def cost(self, level: int) -> np.ndarray:
        """Return how many solid children each voxel of a level has.

        Parameters
        ----------
        level : int
            Any but the finest.

        Returns
        -------
        (m,) int64
            Data points that its subdivision adds, dilation aside.
        """
        return np.bincount(self.parent[level + 1], minlength=len(self.coords[level]))

    def foreseen(self, level: int, coords: np.ndarray) -> np.ndarray:
        """Leave out voxels of the cell that would surprise its neighbours.

        Parameters
        ----------
        level : int
            Level of the voxels.
        coords : (n, 3) int64
            Voxels that somebody asks for.

        Returns
        -------
        (m, 3) int64
            Those in `around`, and those so far inside that they do not matter to other cells.
        """
        near = _in_band(coords, self.cell, level, _margins(self.grid.levels)[level] - 1)
        known = Region.around(np.concatenate([self.around[level], coords]))
        return coords[~near | np.isin(known.keys(coords), known.keys(self.around[level]))]


@dataclass(frozen=True, eq=False)
class _Level:
    """Solid voxels in and around a cell.

    voxels : Voxels
    own : (m,) bool, whether a voxel belongs to the outline; others only show what neighbours may have
    parent : (m,) int64, row in the level before
    """

    voxels: Voxels
    own: np.ndarray
    parent: np.ndarray


def outline(
    triangles: np.ndarray,
    grid: Grid,
    cell: tuple[int, int],
    flat: float = FLAT,
    max_points: int = MAX_POINTS,
    by_light: bool = False,
) -> Outline | None:
    """Find out what the tree of a world cell could be.

    Parameters
    ----------
    triangles : (n, 3, 3) float32
        Corners of all triangles of the scene, relative to the grid's origin [m].
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).
    flat : float
        Geometry does not ask to subdivide voxels whose surroundings are planar within this many sizes; negative: it
        asks for all. All cells of a bake must use the same.
    max_points : int
        Cap on the number of data points of the cell; it bounds the dense grid and the number of candidates.
    by_light : bool
        List flat voxels among the candidates too, with a need of 0, so that light may subdivide them; those whose
        children are of the finest level excepted. Below the first level leave out those at a side border of the cell
        that are flat, or nearly so.

    Returns
    -------
    Outline or None
        None where no geometry lies in the cell or within half a first-level voxel of it.

    Raises
    ------
    ValueError
        For triangles that are not (n, 3, 3) or not finite; for a cap below the size of one layer of voxels.
    """
    max_points, margins = min(max_points, MAX_POINTS), _margins(grid.levels)
    surfaces = surfaces_of(_near_cell(check(triangles), grid, cell, margins[0]))
    pairs = solid_pairs(surfaces, grid, cell, margins[0])
    covered = surrounding(surfaces, pairs, grid, cell)
    if not len(covered):
        return None
    dense = dense_box(covered, max_points)
    first = _first(surfaces, pairs, grid, dense)
    lost = ~first.own & _in_columns(first.voxels.coords, cell, 0)
    levels, wanted, need, left_out = _descend(surfaces, first, grid, cell, (flat, by_light), CANDIDATES * max_points)
    number = tuple(int(n) for n in cell)
    borders = _borders(surfaces, grid, cell, levels)
    return _collect(grid, number, dense, levels, (wanted, need), borders, left_out + int(lost.sum()))


def _margins(levels: int) -> list[int]:
    """How far around a cell the voxels of each level must be known, in voxels of that level.

    What asks for a voxel lies within REACH of it a level finer, and that may have been asked for in turn; to know
    whether a voxel exists takes its parent with its 26 neighbours. One voxel more shows what surrounds geometry.
    """
    asking = [1, 1, REACH]
    while len(asking) < levels:
        asking.append(BRANCH * asking[-1] + REACH)
    margins = [asking[levels - 1]]
    for level in range(levels - 2, -1, -1):
        margins.insert(0, max(asking[level], -(-margins[0] // BRANCH) + 1))
    return margins


def _near_cell(triangles: np.ndarray, grid: Grid, cell: tuple[int, int], margin: int) -> np.ndarray:
    """Triangles whose bounds touch the cell or the columns around it, in double precision."""
    low, high = bounds(triangles[:, :, :2])
    start = np.asarray(cell, np.float64) * grid.cell_size - margin * grid.first_size
    end = start + grid.cell_size + 2 * margin * grid.first_size
    x, y = ((high >= start) & (low <= end)).T
    return triangles[x & y].astype(np.float64)


def _first(surfaces: Surfaces, pairs: tuple[np.ndarray, np.ndarray], grid: Grid, dense: Region) -> _Level:
    """Number the solid voxels of the first level, z slowest: the order of the dense grid."""
    triangle, coords = without_undersides(surfaces, pairs, grid)
    region = Region.around(coords)
    solid, row = np.unique(region.keys(coords), return_inverse=True)
    order = np.argsort(row, kind="stable")
    solid = region.coords(solid)
    voxels = Voxels(solid, grid.first_size, triangle[order], row.reshape(-1)[order])
    return _Level(voxels, dense.contains(solid), np.zeros(len(solid), np.int64))


def _descend(
    surfaces: Surfaces, first: _Level, grid: Grid, cell: tuple[int, int], rule: tuple[float, bool], budget: int
) -> tuple[list[_Level], list[np.ndarray], list[np.ndarray], int]:
    """All levels, what geometry asks for on each, and how many of these voxels the budget left whole."""
    levels, wanted, need, left_out = [first], [], [], 0
    margins = _margins(grid.levels)
    for level in range(grid.levels - 1):
        here = levels[-1]
        varied, spread = assess(surfaces, here.voxels, rule[0])
        varied_need = np.where(varied, np.maximum(spread, LEAST), 0.0)
        listed = _for_light(here.voxels.coords, varied_need, level, grid) if rule[1] else varied
        band = cell, level + 1, margins[level + 1]
        children, refused = _children(surfaces, here, listed, varied_need, budget, band)
        budget -= int(children.own.sum())
        left_out += int((refused & varied).sum())
        levels.append(children)
        wanted.append(listed & ~refused)
        need.append(varied_need)
    return levels, wanted, need, left_out


def _for_light(coords: np.ndarray, need: np.ndarray, level: int, grid: Grid) -> np.ndarray:
    """Which voxels of a level light may subdivide, by what geometry needs."""
    place, last = coords[:, :2] % (CELL_VOXELS * BRANCH**level), CELL_VOXELS * BRANCH**level - 1
    outermost = ((place == 0) | (place == last)).any(axis=1) & (level > 0)
    return np.where(outermost, need > SMOOTH, (need > 0) | (level < grid.levels - 2))


def _children(
    surfaces: Surfaces, here: _Level, asked: np.ndarray, need: np.ndarray, budget: int, band: tuple
) -> tuple[_Level, np.ndarray]:
    """Solid children of the voxels that geometry asks to subdivide, and those of its own that the budget refuses."""
    voxels = here.voxels
    pair = np.flatnonzero(asked[voxels.row])
    parent, triangle = voxels.row[pair], voxels.triangle[pair]
    item, coords = split(
        surfaces,
        triangle,
        voxels.coords[parent],
        voxels.size,
        BRANCH,
        lambda row, c: here.own[parent[row]] | _in_band(c, *band),
    )
    mask, rows = _masks(parent[item], coords, len(voxels.coords))
    refused = _refused(np.where(here.own & asked, bits.popcount(mask), 0), need, budget)
    own_parent = here.own & ~refused
    return _gather(voxels, mask, (triangle[item], *rows), own_parent, band), refused


def _masks(parent: np.ndarray, coords: np.ndarray, count: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Child masks of all voxels, and the parent's row and the bit of each pair."""
    x, y, z = np.moveaxis(coords & (BRANCH - 1), -1, 0)
    bit = x + BRANCH * (y + BRANCH * z)
    return bits.pack(parent, bit, count), (parent, bit)


def _refused(cost: np.ndarray, need: np.ndarray, budget: int) -> np.ndarray:
    """Which voxels stay whole because others, with more need, take all of the budget."""
    refused = np.zeros(len(cost), bool)
    if cost.sum() > budget:
        order = np.argsort(-need, kind="stable")
        refused[order] = np.cumsum(cost[order]) > budget
    return refused & (cost > 0)


def _gather(voxels: Voxels, mask: np.ndarray, pairs: tuple, own_parent: np.ndarray, band: tuple) -> _Level:
    """The children in the order of their indices, with their pairs, less those that matter to nobody."""
    triangle, row, bit = pairs
    parent, child_bit = bits.unpack(mask)
    coords = child_coords(voxels.coords[parent], child_bit)
    kept = np.flatnonzero(own_parent[parent] | _in_band(coords, *band))
    parent, child_bit, coords = parent[kept], child_bit[kept], coords[kept]
    key = parent * 64 + child_bit
    number = np.minimum(np.searchsorted(key, row * 64 + bit), max(len(key) - 1, 0))
    known = np.flatnonzero(key[number] == row * 64 + bit) if len(key) else np.zeros(0, np.int64)
    known = known[np.argsort(number[known], kind="stable")]
    return _Level(Voxels(coords, voxels.size / BRANCH, triangle[known], number[known]), own_parent[parent], parent)


def _in_band(coords: np.ndarray, cell: tuple[int, int], level: int, margin: int) -> np.ndarray:
    """Whether voxels lie close to the cell's side borders, within or without."""
    outer = _in_columns(coords, cell, level, margin)
    return outer & ~_in_columns(coords, cell, level, -margin)


def _in_columns(coords: np.ndarray, cell: tuple[int, int], level: int, margin: int = 0) -> np.ndarray:
    """Whether voxels lie in the cell's own columns, with some more around."""
    width = CELL_VOXELS * BRANCH**level
    start = np.asarray(cell, np.int64) * width
    x, y = ((coords[:, :2] >= start - margin) & (coords[:, :2] < start + width + margin)).T
    return x & y


def _borders(
    surfaces: Surfaces, grid: Grid, cell: tuple[int, int], levels: list[_Level]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Solid voxels near the cell's side borders, and the voxels around the geometry in them."""
    border, near = [], []
    for number, (level, margin) in enumerate(zip(levels, _margins(grid.levels), strict=True)):
        voxels = level.voxels
        kept = _in_band(voxels.coords, cell, number, margin) & (number > 0)
        pair = np.flatnonzero(kept[voxels.row])
        border.append(voxels.coords[kept])
        near.append(around(surfaces, voxels.triangle[pair], voxels.coords[voxels.row[pair]], voxels.size))
    return border, near


def _collect(
    grid: Grid,
    cell: tuple[int, int],
    dense: Region,
    levels: list[_Level],
    asking: tuple[list[np.ndarray], list[np.ndarray]],
    borders: tuple[list[np.ndarray], list[np.ndarray]],
    left_out: int,
) -> Outline:
    """Keep the cell's own voxels, and of others what is near its borders."""
    coords, parent = [], []
    rank = np.zeros(0, np.int64)
    for number, level in enumerate(levels):
        coords.append(level.voxels.coords[level.own])
        parent.append(rank[level.parent[level.own]] if number else level.parent[level.own])
        rank = np.cumsum(level.own) - 1
    own = [level.own for level in levels]
    wanted, need = (tuple(values[rows] for values, rows in zip(part, own[:-1], strict=True)) for part in asking)
    return Outline(grid, cell, dense, tuple(coords), tuple(parent), wanted, need, *map(tuple, borders), left_out)
