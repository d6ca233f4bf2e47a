"""Builds the voxel tree of a world cell: from its outline, a choice of what to subdivide, and dilation.

Comes in: triangles, or an `Outline` with a choice. Goes out: a `Topology` under the cap on data points. Where the
cap binds, candidates are taken in the order of their need, parents before children, as many as fit together with
the voxels that dilation adds for them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import bits
from .dilate import DILATIONS, dilate, neighbours, others, own
from .first_level import occupied_cells
from .grid import BRANCH, Grid
from .need import FLAT
from .outline import Outline, outline
from .region import Region, finder
from .topology import MAX_POINTS, Topology, child_coords, link_blocks

__all__ = ["build", "fit", "grow", "occupied_cells"]

CLOSE = 0.002
"""Part of the cap that may stay unused: bisection ends there."""


def build(
    triangles: np.ndarray,
    grid: Grid,
    cell: tuple[int, int],
    max_points: int = MAX_POINTS,
    flat: float = FLAT,
    dilation: str = "partial",
) -> Topology | None:
    """Build the tree of one world cell from geometry alone.

    Parameters
    ----------
    triangles : (n, 3, 3) float32
        Corners of all triangles of the scene, relative to the grid's origin [m].
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).
    max_points : int
        Cap on the number of data points; more than `MAX_POINTS` is cut to it. Where it binds, coarse levels come
        before fine ones and, within a level, voxels of the most varied geometry before others.
    flat : float
        Voxels whose surroundings are planar within this many sizes are not subdivided; negative: all are.
    dilation : str
        As for `grow`.

    Returns
    -------
    Topology or None
        None for a cell that needs no tree. `left_out` counts the voxels that the cap left whole, or dropped.

    Raises
    ------
    ValueError
        For triangles that are not (n, 3, 3) or not finite; for a cap below the size of one layer of voxels.
    """
    found = outline(triangles, grid, cell, flat, max_points)
    return None if found is None else grow(found, None, dilation, max_points)


def grow(
    outline: Outline,
    divided: Sequence[np.ndarray] | None = None,
    dilation: str = "partial",
    max_points: int = MAX_POINTS,
) -> Topology:
    """Build the tree in which chosen candidates are subdivided.

    Parameters
    ----------
    outline : Outline
        The cell.
    divided : sequence of (m,) bool, optional
        For each level but the finest, which solid voxels to subdivide; those that are no candidates, or whose
        parents are whole, do not count. Without it all candidates are.
    dilation : str
        "partial" adds voxels to the upper levels, so that every neighbourhood has data of one or two levels;
        "full" also surrounds the solid voxels of the finest level, so that those around surfaces have data of that
        level only; "none" adds none.
    max_points : int
        Cap on the number of data points; more than `MAX_POINTS` is cut to it. Where it binds, coarse levels come
        before fine ones and, within a level, voxels of the most varied geometry before others.

    Returns
    -------
    Topology
        The tree. Where the voxels that full dilation adds on account of other cells alone exceed the cap, it has
        partial dilation; where those of partial dilation do, none.

    Raises
    ------
    ValueError
        For masks that do not fit the outline, and for another word for dilation.
    """
    chosen = _descendants(outline, outline.wanted if divided is None else _checked(outline, divided, bool))
    order = _Order(outline, chosen, [np.full(len(mask), -level) for level, mask in enumerate(chosen)], outline.need)
    return _largest(outline, order, dilation, min(max_points, MAX_POINTS))


def fit(
    outline: Outline,
    need: Sequence[np.ndarray],
    dilation: str = "partial",
    max_points: int = MAX_POINTS,
    asked: Sequence[np.ndarray] | None = None,
) -> Topology:
    """Build the tree of the neediest candidates that fit under a cap.

    Parameters
    ----------
    outline : Outline
        The cell.
    need : sequence of (m,) float64
        For each level but the finest, how much each solid voxel needs subdivision, of all levels on one scale; 0 or
        less leaves it whole. No voxel counts for more than its parent, so that parents come first.
    dilation : str
        As for `grow`.
    max_points : int
        Cap on the number of data points, dilation included; more than `MAX_POINTS` is cut to it.
    asked : sequence of (b, 3) int64, optional
        For each level voxels that are wanted by themselves, solid or not: in front of thin surfaces, for example.
        They come with the solid voxels beside them. Those beside none, those outside of the cell, and those that
        `Outline.foreseen` leaves out, do not count; those of the first level are there anyway.

    Returns
    -------
    Topology
        The tree. `left_out` counts the voxels in need that it leaves whole.

    Raises
    ------
    ValueError
        For rows that do not fit the outline or are NaN, and for another word for dilation.
    """
    need = _checked(outline, need, np.float64)
    for level in range(1, len(need)):
        need[level] = np.minimum(need[level], need[level - 1][outline.parent[level]])
    chosen = _descendants(outline, [values > 0 for values in need])
    if asked is not None:
        asked = [outline.foreseen(level, coords) for level, coords in enumerate(asked)]
    order = _Order(outline, chosen, need, [np.zeros(len(values)) for values in need], asked)
    return _largest(outline, order, dilation, min(max_points, MAX_POINTS))


def _checked(outline: Outline, rows: Sequence[np.ndarray], dtype: type) -> list[np.ndarray]:
    """One row of values for each level but the finest, copied."""
    rows = [np.array(values, dtype) for values in rows]
    if [len(values) for values in rows] != [len(values) for values in outline.wanted]:
        found, due = ([len(values) for values in part] for part in (rows, outline.wanted))
        raise ValueError(f"rows of {found} values; the outline has {due} voxels on its upper levels")
    if any(np.isnan(values).any() for values in rows):
        raise ValueError("a voxel's need is NaN")
    return rows


def _descendants(outline: Outline, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The candidates among chosen voxels whose parents are chosen as well."""
    chosen = []
    for level, mask in enumerate(masks):
        mask = mask & outline.wanted[level]
        chosen.append(mask & chosen[-1][outline.parent[level]] if level else mask)
    return chosen


class _Order:
    """Candidates of all levels, first come first served, and what each would add."""

    def __init__(
        self,
        outline: Outline,
        chosen: list[np.ndarray],
        first: list[np.ndarray],
        then: Sequence[np.ndarray],
        asked: Sequence[np.ndarray] | None = None,
    ):
        self.asked = asked
        rows = [np.flatnonzero(mask) for mask in chosen]
        level = np.repeat(np.arange(len(rows)), [len(part) for part in rows])

        def pick(parts):
            return np.concatenate([np.zeros(0), *(part[row] for part, row in zip(parts, rows, strict=True))])

        order = np.lexsort((-pick(then), level, -pick(first)))
        self.outline, self.level = outline, level[order]
        self.row = pick([np.arange(len(mask)) for mask in chosen])[order].astype(np.int64)
        self.cost = pick([outline.cost(number) for number in range(len(rows))])[order].astype(np.int64)
        self.solid = np.concatenate([[0], np.cumsum(self.cost)])
        """Solid voxels that the first 0, 1, ... candidates add."""

    def divided(self, count: int) -> list[np.ndarray]:
        """Masks of the first so many candidates."""
        masks = [np.zeros(len(mask), bool) for mask in self.outline.wanted]
        for level, mask in enumerate(masks):
            mask[self.row[:count][self.level[:count] == level]] = True
        return masks

    def refused(self, count: int) -> int:
        """How many of the others exist and have something to add."""
        divided, total = self.divided(count), 0
        rest = np.arange(len(self.row)) >= count
        for level, parent in enumerate(self.outline.parent[:-1]):
            row = self.row[rest & (self.level == level) & (self.cost > 0)]
            total += int(divided[level - 1][parent[row]].sum()) if level else len(row)
        return total


def _largest(outline: Outline, order: _Order, dilation: str, max_points: int) -> Topology:
    """The tree of the first candidates, as many as the cap allows, by bisection on their number."""
    if dilation not in DILATIONS:
        raise ValueError(f"dilation {dilation!r}; use one of {', '.join(DILATIONS)}")
    room = max_points - int(np.prod(outline.dense.shape))
    many, elsewhere = int(np.searchsorted(order.solid, room, side="right")) - 1, others(outline, dilation)
    found = _voxels(outline, order.divided(many), dilation, elsewhere, order.asked)
    few = many if _count(found) <= room else 0
    if few < many or _count(found) > room:
        dilation, found = _least(order, dilation, elsewhere, room)
    while order.solid[many] - order.solid[few] > CLOSE * max_points and many - few > 1:
        middle = (few + many) // 2
        tried = _voxels(outline, order.divided(middle), dilation, elsewhere, order.asked)
        if _count(tried) <= room:
            few, found = middle, tried
        else:
            many = middle
    plain = _voxels(outline, order.divided(few), "none", elsewhere, order.asked)
    return _to_topology(outline, found, max(_count(found) - _count(plain), 0), order.refused(few))


def _least(order: _Order, dilation: str, elsewhere: list[np.ndarray], room: int) -> tuple[str, list[np.ndarray]]:
    """The best dilation whose voxels fit, where nothing is subdivided and only other cells ask for some."""
    for word in {"full": ("full", "partial"), "partial": ("partial",)}.get(dilation, ()):
        found = _voxels(order.outline, order.divided(0), word, elsewhere)
        if _count(found) <= room:
            return word, found
    return "none", _voxels(order.outline, order.divided(0), "none", elsewhere)


def _voxels(
    outline: Outline,
    divided: list[np.ndarray],
    dilation: str,
    elsewhere: list[np.ndarray],
    asked: Sequence[np.ndarray] | None = None,
) -> list[np.ndarray]:
    """All voxels below the dense grid when some are subdivided."""
    solid = [outline.coords[0]]
    for level, mask in enumerate(divided):
        solid.append(outline.coords[level + 1][mask[outline.parent[level + 1]]])
    for level in range(len(solid) - 1, 0, -1) if asked is not None else ():
        below = solid[level + 1] // BRANCH if level + 1 < len(solid) else solid[level][:0]
        solid[level] = own(outline, level, np.concatenate([solid[level], _beside(solid[level], asked[level]), below]))
    return dilate(outline, solid, dilation, elsewhere)


def _beside(solid: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Those of the voxels asked for that stand next to solid ones, or the cap would be theirs alone."""
    near = neighbours(solid)
    region = Region.around(np.concatenate([near, asked]))
    return asked[np.isin(region.keys(asked), region.keys(near))]


def _count(voxels: list[np.ndarray]) -> int:
    """Data points below the dense grid."""
    return sum(map(len, voxels))


def _to_topology(outline: Outline, voxels: list[np.ndarray], dilated: int, refused: int) -> Topology:
    """Number the voxels: blocks of children in the order of their parents."""
    low, shape = ([int(n) for n in numbers] for numbers in (outline.dense.low, outline.dense.shape))
    grid_count = int(np.prod(shape))
    coords, masks = outline.dense.coords(np.arange(grid_count)), []
    for children in voxels[1:]:
        x, y, z = np.moveaxis(children % BRANCH, -1, 0)
        bit = x + BRANCH * (y + BRANCH * z)
        masks.append(bits.pack(finder(coords)(children // BRANCH), bit, len(coords)))
        parent, bit = bits.unpack(masks[-1])
        coords = child_coords(coords[parent], bit)
    nodes = _to_nodes(masks or [bits.zeros(grid_count)], grid_count)
    left_out = outline.left_out + refused
    return Topology(outline.cell, tuple(low), tuple(shape), nodes, outline.grid.levels, left_out, dilated)


def _to_nodes(masks: list[np.ndarray], grid_count: int) -> np.ndarray:
    """Lay the masks of all levels out as one node array; a block whose voxels have no children needs no nodes."""
    terminals = [_terminal(here, below) for here, below in zip(masks, [*masks[1:], None], strict=True)]
    kept_masks, kept_terminals = [masks[0]], [terminals[0]]
    for level in range(1, len(masks)):
        has_node = np.repeat(~terminals[level - 1], bits.popcount(masks[level - 1]))
        kept_masks.append(masks[level][has_node])
        kept_terminals.append(terminals[level][has_node])
    return link_blocks(np.concatenate(kept_masks), np.concatenate(kept_terminals), grid_count)


def _terminal(here: np.ndarray, below: np.ndarray | None) -> np.ndarray:
    """Whether none of a voxel's children has children itself."""
    if below is None:
        return np.ones(len(here), bool)
    parent = np.repeat(np.arange(len(here)), bits.popcount(here))
    return np.bincount(parent, below != 0, len(here)) == 0
