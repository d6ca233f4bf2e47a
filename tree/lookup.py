"""Finds the index of voxels in the trees of many world cells at once.

Comes in: level and global coordinates. Goes out: one index space over all cells, -1 where a voxel does not exist.
The cells' arrays are concatenated; a walk starts in the dense grid and takes one child per level.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import bits
from .grid import CELL_VOXELS
from .topology import NODE, Topology, first_child, is_terminal

__all__ = ["Atlas"]


class Atlas:
    """The trees of a bake, ready for look-up.

    Parameters
    ----------
    topologies : sequence of Topology
        At most one for each world cell, in any order; voxel n of cell k has the global index `first[k] + n`.

    Attributes
    ----------
    first : (cells + 1,) int64
        Global index of each cell's first voxel, and the total.
    """

    def __init__(self, topologies: Sequence[Topology]):
        self.cells = np.array([t.cell for t in topologies], np.int64).reshape(-1, 2)
        self.first = np.concatenate([[0], np.cumsum([t.size for t in topologies], dtype=np.int64)]).astype(np.int64)
        self._grid_min = np.array([t.grid_min for t in topologies], np.int64).reshape(-1, 3)
        self._grid_shape = np.array([t.grid_shape for t in topologies], np.int64).reshape(-1, 3)
        counts = np.array([len(t.nodes) for t in topologies], np.int64)
        self._node_count, self._first_node = counts, np.cumsum(counts) - counts
        nodes = np.concatenate([np.zeros(0, NODE), *(t.nodes for t in topologies)])
        self._mask, self._child, self._terminal = nodes["mask"].copy(), first_child(nodes), is_terminal(nodes)
        self._order = np.lexsort((self.cells[:, 1], self.cells[:, 0]))
        self._columns, rank = np.unique(self.cells[:, 0], return_inverse=True)
        self._rows, row_rank = np.unique(self.cells[:, 1], return_inverse=True)
        self._keys = (rank.reshape(-1) * len(self._rows) + row_rank.reshape(-1))[self._order]

    def find(self, level: int | np.ndarray, coords: np.ndarray) -> np.ndarray:
        """Return the global index of voxels.

        Parameters
        ----------
        level : int or (n,) int
            0 is the first level.
        coords : (n, 3) int64
            Global voxel coordinates of that level.

        Returns
        -------
        (n,) int64
            -1 where there is no such voxel.
        """
        coords = np.asarray(coords, np.int64)
        level = np.broadcast_to(np.asarray(level, np.int64), coords.shape[:1])
        cell, index = self._find_first(coords >> (2 * level[:, None]))
        found = np.where(index >= 0, self.first[cell] + index, -1)
        active = np.flatnonzero((index >= 0) & (level > 0))
        node, cell = self._first_node[cell[active]] + index[active], cell[active]
        for depth in range(1, int(level.max(initial=0)) + 1):
            steps = coords[active] >> (2 * (level[active] - depth))[:, None] & 3
            bit = steps[:, 0] | steps[:, 1] << 2 | steps[:, 2] << 4
            exists = bits.contains(self._mask[node], bit)
            found[active[~exists]] = -1
            active, node, bit, cell = active[exists], node[exists], bit[exists], cell[exists]
            child = self._child[node] + bits.rank(self._mask[node], bit)
            arrived = level[active] == depth
            found[active[arrived]] = self.first[cell[arrived]] + child[arrived]
            stuck = ~arrived & self._terminal[node]
            found[active[stuck]] = -1
            on = ~arrived & ~stuck
            active, cell = active[on], cell[on]
            node = self._first_node[cell] + child[on]
        return found

    def _find_first(self, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cell row and index within the cell of first-level voxels; the index is -1 where there is none."""
        if not len(self.cells):
            return np.zeros(len(coords), np.int64), np.full(len(coords), -1)
        cell, known = self._find_cells(coords[:, :2] // CELL_VOXELS)
        place, shape = coords - self._grid_min[cell], self._grid_shape[cell]
        inside = known & ((place >= 0) & (place < shape)).all(axis=1)
        index = place[:, 0] + shape[:, 0] * (place[:, 1] + shape[:, 1] * place[:, 2])
        return cell, np.where(inside, index, -1)

    def _find_cells(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row of each world cell, and whether it exists."""
        i = np.minimum(np.searchsorted(self._columns, cells[:, 0]), len(self._columns) - 1)
        j = np.minimum(np.searchsorted(self._rows, cells[:, 1]), len(self._rows) - 1)
        known = (self._columns[i] == cells[:, 0]) & (self._rows[j] == cells[:, 1])
        place = np.minimum(np.searchsorted(self._keys, i * len(self._rows) + j), len(self._keys) - 1)
        known &= self._keys[place] == i * len(self._rows) + j
        return self._order[place], known
