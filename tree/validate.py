"""Checks every invariant of a tree and names, in words, the first one that is broken.

Comes in: a `Topology`, perhaps read from a file. Goes out: None or one sentence. Nothing here trusts a number of
the tree before it has been checked, and nothing is allocated on its word.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from . import bits
from .grid import CELL_VOXELS
from .topology import MAX_POINTS, NODE, Topology, first_child, is_terminal, link_blocks

__all__ = ["MAX_COORDINATE", "first_defect"]

MAX_COORDINATE = 1 << 40
"""First-level coordinates stay below this, so that those of eight levels fit into int64."""


def first_defect(topology: Topology, max_points: int = MAX_POINTS) -> str | None:
    """Name the first broken invariant of a tree.

    Parameters
    ----------
    topology : Topology
        The tree.
    max_points : int
        Cap on the number of data points.

    Returns
    -------
    str or None
        A sentence that says which rule is broken and where; None for a sound tree.
    """
    return next(_defects(topology, max_points), None)


def _defects(t: Topology, max_points: int) -> Iterator[str]:
    """Check from the outside in; each rule relies on the earlier ones."""
    yield from _grid_defects(t, max_points)
    if t.nodes.dtype != NODE or t.nodes.ndim != 1:
        yield "the nodes are not one row of (u64 mask, u32 link) records"
    if len(t.nodes) < t.grid_count:
        yield f"the node array has {len(t.nodes)} nodes, fewer than the {t.grid_count} voxels of the dense grid"
    if t.size > max_points:
        yield f"the tree has {t.size} data points, more than the cap of {max_points}"
    yield from _link_defects(t)
    yield from _depth_defects(t)


def _grid_defects(t: Topology, max_points: int) -> Iterator[str]:
    """The dense grid lies in its cell and is not empty."""
    if not 1 <= t.levels <= 8:
        yield f"the tree has {t.levels} levels; 1 to 8 are possible"
    if any(size < 1 for size in t.grid_shape):
        yield f"the dense grid of shape {t.grid_shape} is empty"
    if t.grid_shape[0] * t.grid_shape[1] * t.grid_shape[2] > max_points:
        yield f"the dense grid of shape {t.grid_shape} has more voxels than the cap of {max_points}"
    if any(abs(number) > MAX_COORDINATE for number in (*t.grid_min, *t.cell)):
        yield f"the dense grid starts at {t.grid_min}, beyond the coordinates that a tree can number"
    for axis in range(2):
        first = t.cell[axis] * CELL_VOXELS
        if not first <= t.grid_min[axis] <= t.grid_min[axis] + t.grid_shape[axis] - 1 < first + CELL_VOXELS:
            yield f"the dense grid leaves its world cell {t.cell} along {'xy'[axis]}"


def _link_defects(t: Topology) -> Iterator[str]:
    """Offsets follow from masks and terminal bits; a difference is described by what it breaks."""
    mask, child, terminal = t.nodes["mask"], first_child(t.nodes), is_terminal(t.nodes)
    empty = mask == 0
    yield from _at(empty & terminal, "has no children and a terminal bit")
    yield from _at(empty & (child != 0), "has no children and a child block offset")
    inner, leaf = ~empty & ~terminal, ~empty & terminal
    end = child + bits.popcount(mask)
    yield from _at(leaf & (child < len(t.nodes)), "is terminal and its block of leaves starts within the node array")
    yield from _at(inner & (end > len(t.nodes)), "is not terminal and its child block reaches past the node array")
    yield from _at(inner & (child < t.grid_count), "has a child block within the dense grid")
    yield from _at(inner & (child <= np.arange(len(child))), "has a child block at or before itself")
    yield from _at(end > t.size, "has a child block that reaches past the index space")
    inner_count = t.grid_count + int(bits.popcount(mask[inner]).sum())
    if inner_count != len(t.nodes):
        yield f"the node array has {len(t.nodes)} nodes, the grid and the inner child blocks need {inner_count}"
    expected = first_child(link_blocks(mask, terminal, t.grid_count))
    yield from _at(child != expected, "has a child block that does not follow the block before it")


def _depth_defects(t: Topology) -> Iterator[str]:
    """Terminal bits say the truth, and no voxel is deeper than the levels allow."""
    nodes = np.arange(t.grid_count)
    for level in range(t.levels):
        mask = t.nodes["mask"][nodes]
        if level == t.levels - 1:
            yield from _at(mask != 0, "has children below the last level", nodes)
            return
        inner = nodes[(mask != 0) & ~is_terminal(t.nodes[nodes])]
        counts = bits.popcount(t.nodes["mask"][inner])
        starts = np.cumsum(counts) - counts
        nodes = np.repeat(first_child(t.nodes)[inner] - starts, counts) + np.arange(counts.sum())
        if len(inner):
            bare = np.add.reduceat((t.nodes["mask"][nodes] != 0).astype(np.int64), starts) == 0
            yield from _at(bare, "is not terminal, but none of its children has children", inner)


def _at(broken: np.ndarray, what: str, numbers: np.ndarray | None = None) -> Iterator[str]:
    """Name the first node that breaks a rule."""
    if broken.any():
        first = int(np.argmax(broken))
        yield f"node {first if numbers is None else int(numbers[first])} {what}"
