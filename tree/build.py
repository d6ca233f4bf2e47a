"""Builds the voxel tree of a world cell from triangles, level by level, in bulk.

Comes in: triangles in local metres. Goes out: a `Topology`, or None where the cell has no geometry.

The dense first level covers the geometry's extent within the cell, in whole voxels: from the one that holds the
lowest coordinate to the one that holds the highest, on each axis, and one more at the sides and the top where
geometry comes close to the border. Below it a voxel exists where it overlaps a
triangle, touching included, and its parent is subdivided. Pairs of triangle and voxel go from level to level: the
children of a pair are tested only against its own triangle.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from . import bits, boxes
from .grid import BRANCH, CELL_VOXELS, Grid, cell_range
from .need import FLAT, Surfaces, Voxels, assess, surfaces_of
from .topology import MAX_POINTS, Topology, child_coords, link_blocks

__all__ = ["build", "occupied_cells"]

ROOM = 0.5
"""Free space that the dense grid keeps between geometry and its sides and top [first-level voxels]."""
CHUNK = 1 << 18
"""Pairs tested at a time: about 100 MB of temporaries."""


def build(
    triangles: np.ndarray, grid: Grid, cell: tuple[int, int], max_points: int = MAX_POINTS, flat: float = FLAT
) -> Topology | None:
    """Build the tree of one world cell.

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

    Returns
    -------
    Topology or None
        None where no triangle lies in the cell. `left_out` counts the voxels that the cap left whole, or dropped.

    Raises
    ------
    ValueError
        For triangles that are not (n, 3, 3) or not finite; for a cap below the size of one layer of voxels.
    """
    surfaces = surfaces_of(_in_cell(_check(triangles), grid, cell))
    triangle, coords, proper = _first_pairs(surfaces, grid, cell)
    if not proper.any():
        return None
    low, high, left_out = _first_bounds(coords[proper], min(max_points, MAX_POINTS))
    low, high = _with_room(surfaces, triangle[proper], coords[proper], (low, high), grid, cell, max_points)
    inside = ((coords >= low) & (coords <= high)).all(axis=1)
    shape = high - low + 1
    voxels = _number_first(triangle[inside], coords[inside] - low, low, shape, grid.first_size)
    dense = np.ravel_multi_index((voxels.coords - low)[:, ::-1].T, shape[::-1])
    budget = min(max_points, MAX_POINTS) - int(np.prod(shape))
    masks, blocked = _subdivide(surfaces, voxels, grid, budget, flat)
    nodes = _to_nodes(masks, dense, int(np.prod(shape)))
    to_ints = [tuple(int(n) for n in numbers) for numbers in (cell, low, shape)]
    return Topology(*to_ints, nodes, grid.levels, left_out + blocked)


def occupied_cells(triangles: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the world cells that have geometry, those for which `build` returns a tree.

    Parameters
    ----------
    triangles : (n, 3, 3) float32
        Corners, relative to the grid's origin [m].
    grid : Grid
        The lattice.

    Returns
    -------
    (m, 2) int64
        Cells (i, j), sorted.

    Raises
    ------
    ValueError
        For triangles that are not (n, 3, 3) or not finite.
    """
    triangles = _check(triangles)
    first, last = cell_range(grid, *(_bounds(triangles)[:, :, :2]))
    found = [np.zeros((0, 2), np.int64)]
    tallest = np.abs(triangles[:, :, 2]).max(initial=0.0) + grid.cell_size
    half = np.array([0.5 * grid.cell_size, 0.5 * grid.cell_size, tallest])
    for item, coords in _enumerate(first, last):
        centers = np.concatenate([(coords + 0.5) * grid.cell_size, np.zeros((len(coords), 1))], axis=1)
        simple = (first[item] == last[item]).all(axis=1)
        simple[~simple] = boxes.overlap(triangles[item[~simple]], centers[~simple], half)
        found.append(np.unique(coords[simple], axis=0))
    return np.unique(np.concatenate(found), axis=0)


def _check(triangles: np.ndarray) -> np.ndarray:
    """Refuse what cannot be voxelised, at the border."""
    triangles = np.asarray(triangles)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise ValueError(f"triangles have shape {triangles.shape}; (n, 3, 3) is needed")
    if not np.isfinite(triangles).all():
        raise ValueError("a triangle's corner is not finite; remove NaN and infinite vertices before the bake")
    return triangles


def _bounds(triangles: np.ndarray) -> np.ndarray:
    """(2, n, 3) float64 lowest and highest corner of each triangle."""
    return np.stack([triangles.min(axis=1), triangles.max(axis=1)]).astype(np.float64)


def _in_cell(triangles: np.ndarray, grid: Grid, cell: tuple[int, int]) -> np.ndarray:
    """Triangles whose bounds touch the cell, in double precision."""
    low, high = triangles[:, :, :2].min(axis=1), triangles[:, :, :2].max(axis=1)
    start = np.asarray(cell, np.float64) * grid.cell_size
    touches = ((high >= start) & (low <= start + grid.cell_size)).all(axis=1)
    return triangles[touches].astype(np.float64)


def _enumerate(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """List the integer points of many boxes in chunks of bounded size: box number, coordinates."""
    extent = np.maximum(last - first + 1, 0)
    ends = np.cumsum(np.prod(extent, axis=1))
    total = int(ends[-1]) if len(ends) else 0
    for start in range(0, total, CHUNK):
        flat = np.arange(start, min(start + CHUNK, total))
        item = np.searchsorted(ends, flat, side="right")
        rest = flat - (ends[item] - np.prod(extent[item], axis=1))
        coords = np.empty((len(flat), first.shape[1]), np.int64)
        for axis in range(first.shape[1]):
            coords[:, axis] = first[item, axis] + rest % extent[item, axis]
            rest = rest // extent[item, axis]
        yield item, coords


def _overlapping(corners: np.ndarray, coords: np.ndarray, size: float) -> np.ndarray:
    """Whether each triangle overlaps its voxel; one that lies inside needs no test of axes."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    result = ((low >= coords * size) & (high <= (coords + 1) * size)).all(axis=1)
    rest = np.flatnonzero(~result)
    result[rest] = boxes.overlap(corners[rest], (coords[rest] + 0.5) * size, 0.5 * size)
    return result


def _first_pairs(surfaces: Surfaces, grid: Grid, cell: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of the first level; a pair is proper when it counts for the extent of the dense grid."""
    low, high = _bounds(surfaces.corners)
    first, last = np.ceil(low / grid.first_size).astype(np.int64) - 1, np.floor(high / grid.first_size).astype(np.int64)
    columns = np.asarray(cell) * CELL_VOXELS
    first[:, :2], last[:, :2] = np.maximum(first[:, :2], columns), np.minimum(last[:, :2], columns + CELL_VOXELS - 1)
    lowest, highest = cell_range(grid, low[:, :2], high[:, :2])
    owned = ((lowest <= cell) & (highest >= cell)).all(axis=1)
    found = [(np.zeros(0, np.int64), np.zeros((0, 3), np.int64))]
    for item, coords in _enumerate(first, last):
        keep = _overlapping(surfaces.corners[item], coords, grid.first_size)
        found.append((item[keep], coords[keep]))
    triangle, coords = (np.concatenate(parts) for parts in zip(*found, strict=True))
    proper = owned[triangle] & (coords >= np.floor(low / grid.first_size)[triangle]).all(axis=1)
    return triangle, coords, proper


def _first_bounds(coords: np.ndarray, max_points: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Extent of the dense grid, and how many solid voxels it drops: a stray object far above must not blow it up."""
    low, high = coords.min(axis=0), coords.max(axis=0)
    layer = int(np.prod((high - low + 1)[:2]))
    if layer > max_points:
        raise ValueError(f"{max_points} data points cannot hold one layer of {layer} first-level voxels; raise the cap")
    if layer * int(high[2] - low[2] + 1) <= max_points:
        return low, high, 0
    layers = max(1, max_points // 2 // layer)
    z = np.sort(np.unique(coords, axis=0)[:, 2])
    held = np.searchsorted(z, z + layers) - np.searchsorted(z, z)
    low[2] = z[np.argmax(held)]
    high[2] = min(low[2] + layers - 1, high[2])
    return low, high, len(z) - int(held.max())


def _with_room(
    surfaces: Surfaces,
    triangle: np.ndarray,
    coords: np.ndarray,
    extent: tuple[np.ndarray, np.ndarray],
    grid: Grid,
    cell: tuple[int, int],
    max_points: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Grow the dense grid at the sides and the top where geometry comes close: what faces outwards there, or stands
    on a ground just below a layer's border, needs data points in the open. The cell's own columns are the limit."""
    size, room = grid.first_size, ROOM * grid.first_size
    lowest, highest = _bounds(surfaces.corners)
    inside_low = np.maximum(lowest[triangle], coords * size).min(axis=0)
    inside_high = np.minimum(highest[triangle], (coords + 1) * size).max(axis=0)
    columns = np.asarray(cell) * CELL_VOXELS
    low, high = (values.copy() for values in extent)
    low[:2] -= (inside_low - extent[0] * size < room)[:2] & (low[:2] > columns)
    high[:2] += ((extent[1] + 1) * size - inside_high < room)[:2] & (high[:2] < columns + CELL_VOXELS - 1)
    high[2] += (extent[1][2] + 1) * size - inside_high[2] < room
    fits = np.prod(high - low + 1) <= min(max_points, MAX_POINTS) // 2
    return (low, high) if fits else extent


def _number_first(triangle: np.ndarray, place: np.ndarray, low: np.ndarray, shape: np.ndarray, size: float) -> Voxels:
    """Number the solid voxels of the first level in the order of the dense grid."""
    key = np.ravel_multi_index(place[:, ::-1].T, shape[::-1])
    solid, row = np.unique(key, return_inverse=True)
    order = np.argsort(row, kind="stable")
    coords = np.stack(np.unravel_index(solid, shape[::-1])[::-1], axis=-1) + low
    return Voxels(coords, size, triangle[order], row.reshape(-1)[order])


def _subdivide(
    surfaces: Surfaces, voxels: Voxels, grid: Grid, budget: int, flat: float
) -> tuple[list[np.ndarray], int]:
    """Child masks of the solid voxels of each level but the last, and how many voxels the cap left whole."""
    masks, left_out = [], 0
    for level in range(grid.levels - 1):
        if not len(voxels.coords):
            break
        wanted, need = assess(surfaces, voxels, flat)
        mask, pairs = _children(surfaces, voxels, wanted)
        cost = bits.popcount(mask)
        order = np.lexsort((np.arange(len(need)), -need, ~wanted))
        refused = order[np.cumsum(cost[order]) > budget]
        left_out += int((cost[refused] > 0).sum())
        mask[refused] = 0
        budget -= int(bits.popcount(mask).sum())
        masks.append(mask)
        if level < grid.levels - 2:
            voxels = _next_voxels(voxels, mask, pairs)
    return masks, left_out


def _children(
    surfaces: Surfaces, voxels: Voxels, wanted: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Masks of all voxels, and pairs (triangle, parent's row, bit), for the wanted voxels only."""
    pair = np.flatnonzero(wanted[voxels.row])
    size, base = voxels.size / BRANCH, voxels.coords[voxels.row[pair]] * BRANCH
    low, high = _bounds(surfaces.corners)
    first = np.maximum(np.ceil(low / size).astype(np.int64)[voxels.triangle[pair]] - 1, base)
    last = np.minimum(np.floor(high / size).astype(np.int64)[voxels.triangle[pair]], base + BRANCH - 1)
    found = [(np.zeros(0, np.int64),) * 3]
    for item, coords in _enumerate(first, last):
        triangle = voxels.triangle[pair[item]]
        keep = np.flatnonzero(_overlapping(surfaces.corners[triangle], coords, size))
        x, y, z = np.moveaxis(coords[keep] - base[item[keep]], -1, 0)
        found.append((triangle[keep], voxels.row[pair[item[keep]]], x + BRANCH * (y + BRANCH * z)))
    pairs = tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
    return bits.pack(pairs[1], pairs[2], len(voxels.coords)), pairs


def _next_voxels(voxels: Voxels, mask: np.ndarray, pairs: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Voxels:
    """The children that exist, in the order of their indices, with their pairs."""
    triangle, row, bit = pairs
    kept = np.flatnonzero(bits.contains(mask[row], bit))
    parent, child_bit = bits.unpack(mask)
    number = np.searchsorted(parent * 64 + child_bit, row[kept] * 64 + bit[kept])
    order = np.argsort(number, kind="stable")
    coords = child_coords(voxels.coords[parent], child_bit)
    return Voxels(coords, voxels.size / BRANCH, triangle[kept][order], number[order])


def _to_nodes(masks: list[np.ndarray], dense: np.ndarray, grid_count: int) -> np.ndarray:
    """Lay the masks of all levels out as one node array; a block whose voxels have no children needs no nodes."""
    mask, terminal = bits.zeros(grid_count), np.ones(grid_count, bool)
    if not masks:
        return link_blocks(mask, terminal, grid_count)
    terminals = [_terminal(here, below) for here, below in zip(masks, [*masks[1:], None], strict=True)]
    mask[dense], terminal[dense] = masks[0], terminals[0]
    kept_masks, kept_terminals = [mask], [terminal]
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
