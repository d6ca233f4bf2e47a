"""Judges: receivers that occluding planes are fitted to, wherever a cell's data points may light something.

Comes in: a cell's tree. Goes out: receivers, denser than those whose light is traced, as they cost shadow rays alone;
close before walls; and beyond the cell's border, where its data points light the neighbours' surfaces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..tree.dilate import neighbours
from ..tree.dualcells import CORNERS
from ..tree.grid import BRANCH, Grid
from ..tree.topology import Topology
from . import contacts, receivers
from .receivers import Receivers
from .scene import Scene

DENSER = 0.5
"""Distance between judges, in that of receivers whose light is traced."""

GAP = 1 / 256
"""How close before walls some of them lie [finest voxels]: 0.5 mm at 0.125 m."""


def around(scene: Scene, grid: Grid, tree: Topology, threads: int = 0, only: np.ndarray | None = None) -> Receivers:
    """Spread judges over all surfaces that a cell's data points may light.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    grid : Grid
        The lattice.
    tree : Topology
        The cell.
    threads : int
        Worker threads; 0 uses every core.
    only : (size,) bool ndarray, optional
        Voxels that matter; all of them when left out.

    Returns
    -------
    Receivers
        As dense as the voxels that light them.
    """
    gap = GAP * float(grid.voxel_size(grid.levels - 1))
    voxel_level, coords = tree.voxels()
    parts = []
    for level in np.unique(voxel_level):
        size = float(grid.voxel_size(level))
        of = coords[(voxel_level == level) & (True if only is None else only)]
        if not len(of):
            continue
        low, high = (of.min(axis=0) - 0.5) * size, (of.max(axis=0) + 1.5) * size
        spacing = DENSER * receivers.spacing(int(level), size)
        lit, near = _lit_by(grid, voxel_level, coords, int(level)), receivers.touching(neighbours(of), size)
        at = receivers.spread(scene, low, high, spacing, lit, threads, touches=near)
        parts += [at, contacts.find(scene, at, gap)]
    return receivers.join(parts)


def _lit_by(grid: Grid, level: np.ndarray, coords: np.ndarray, number: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function that says which positions have some voxel of a level around them, and not only finer ones."""
    some, _ = _dual_cells(coords[level == number])
    finer, count = _dual_cells(coords[level == number + 1])
    has_some, has_all = receivers.among(some), receivers.among(finer[count == len(CORNERS)])
    sizes = [float(grid.voxel_size(number)), float(grid.voxel_size(number)) / BRANCH]

    def lit(position: np.ndarray) -> np.ndarray:
        coarse, fine = (np.floor(position / size - 0.5).astype(np.int64) for size in sizes)
        return has_some(coarse) & ~has_all(fine)

    return lit


def _dual_cells(coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) lowest corners of the dual cells around some voxels, and (n,) how many of their corners exist."""
    corner = (coords[:, None] - CORNERS).reshape(-1, 3)
    return np.unique(corner, axis=0, return_counts=True)
