"""The shape of a world cell's voxel tree: which voxels exist, and the number of each.

Comes in: a dense grid of first-level voxels and 64-bit child masks. Goes out: one index space, breadth first.

    index    0 ...      grid       grid + inner blocks       size
             | dense grid | child blocks   | blocks of leaves  |
             `-------- node array ---------'   payloads only   |

    node (12 bytes)   0  8  u64 mask: bit x + 4 y + 16 z is set where that child exists
                      8  4  u32 link: index of the first child << 1 | terminal; 0 where the mask is 0

Children are packed: `child = (link >> 1) + popcount(mask below the child's bit)`. The terminal bit says that all
children are leaves, which have an index, and payloads, but no node. Blocks follow in the order of their parents,
inner ones in the node array, terminal ones after it. Grid voxel (x, y, z) has index x + nx (y + ny z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from . import bits
from .grid import BRANCH

__all__ = ["MAX_POINTS", "NODE", "Topology", "child_coords", "link_blocks"]

NODE = np.dtype([("mask", "<u8"), ("link", "<u4")])
"""12 bytes, without padding."""
MAX_POINTS = 65_535
"""Data points of a cell: what 16 bits can number, less the number that says "no data"."""


@dataclass(frozen=True, eq=False)
class Topology:
    """The voxels of one world cell.

    Parameters
    ----------
    cell : (2,) int
        World cell (i, j).
    grid_min : (3,) int
        Global first-level coordinates of the first voxel.
    grid_shape : (3,) int
        Number of first-level voxels along x, y, z.
    nodes : (n,) NODE
        The dense grid's nodes, then those of inner child blocks.
    levels : int
        Number of levels that the grid allows; the tree may be shallower.
    left_out : int
        Voxels that geometry asked to subdivide, or to cover, and the cap on data points did not allow.
    dilated : int
        Voxels that exist only so that neighbourhoods have data of one or two levels.
    """

    cell: tuple[int, int]
    grid_min: tuple[int, int, int]
    grid_shape: tuple[int, int, int]
    nodes: np.ndarray
    levels: int
    left_out: int = 0
    dilated: int = 0

    @property
    def grid_count(self) -> int:
        """Number of first-level voxels."""
        return int(np.prod(self.grid_shape, dtype=np.int64))

    @cached_property
    def size(self) -> int:
        """Number of voxels, leaves included: the length of each payload."""
        return self.grid_count + int(bits.popcount(self.nodes["mask"]).sum())

    @property
    def leaves(self) -> np.ndarray:
        """(size,) bool, which voxels have no children."""
        found = np.ones(self.size, bool)
        found[: len(self.nodes)] = self.nodes["mask"] == 0
        return found

    def voxels(self) -> tuple[np.ndarray, np.ndarray]:
        """List all voxels in the order of their indices.

        Returns
        -------
        level : (size,) uint8
            0 is the first level.
        coords : (size, 3) int64
            Global voxel coordinates of that level.
        """
        return self._voxels

    @cached_property
    def _voxels(self) -> tuple[np.ndarray, np.ndarray]:
        """Walk down from the grid, level by level."""
        level, coords = np.zeros(self.size, np.uint8), np.zeros((self.size, 3), np.int64)
        parents = np.arange(self.grid_count)
        nx, ny, _ = self.grid_shape
        coords[parents] = np.stack([parents % nx, parents // nx % ny, parents // (nx * ny)], axis=-1) + self.grid_min
        for depth in range(1, self.levels):
            row, bit = bits.unpack(self.nodes["mask"][parents])
            node = parents[row]
            children = first_child(self.nodes)[node] + bits.rank(self.nodes["mask"][node], bit)
            level[children], coords[children] = depth, child_coords(coords[node], bit)
            parents = np.sort(children[children < len(self.nodes)])
        level.flags.writeable = coords.flags.writeable = False
        return level, coords


def first_child(nodes: np.ndarray) -> np.ndarray:
    """Return the index of each node's first child.

    Parameters
    ----------
    nodes : (n,) NODE
        Nodes.

    Returns
    -------
    (n,) int64
        0 where a node has no children.
    """
    return nodes["link"].astype(np.int64) >> 1


def is_terminal(nodes: np.ndarray) -> np.ndarray:
    """Say which nodes have leaves for children.

    Parameters
    ----------
    nodes : (n,) NODE
        Nodes.

    Returns
    -------
    (n,) bool
        The terminal bits.
    """
    return (nodes["link"] & 1).astype(bool)


def child_coords(parent: np.ndarray, bit: np.ndarray) -> np.ndarray:
    """Return the coordinates of children.

    Parameters
    ----------
    parent : (n, 3) int64
        Voxel coordinates of the parents.
    bit : (n,) int64
        Which child.

    Returns
    -------
    (n, 3) int64
        Voxel coordinates, one level finer.
    """
    return parent * BRANCH + np.stack([bit & 3, bit >> 2 & 3, bit >> 4], axis=-1)


def link_blocks(mask: np.ndarray, terminal: np.ndarray, grid_count: int) -> np.ndarray:
    """Give every child block its place: links follow from masks and terminal bits alone.

    Parameters
    ----------
    mask : (n,) uint64
        Child masks, in node order.
    terminal : (n,) bool
        Whether the children are leaves.
    grid_count : int
        Number of first-level voxels.

    Returns
    -------
    (n,) NODE
        Nodes.
    """
    count, has_children = bits.popcount(mask), mask != 0
    terminal = terminal & has_children
    inner = np.where(terminal, 0, count)
    leaves = np.where(terminal, count, 0)
    first = np.where(terminal, len(mask) + np.cumsum(leaves) - leaves, grid_count + np.cumsum(inner) - inner)
    nodes = np.zeros(len(mask), NODE)
    nodes["mask"] = mask
    nodes["link"] = np.where(has_children, first << 1 | terminal, 0).astype(np.uint32)
    return nodes
