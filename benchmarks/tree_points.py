"""Data points of a scene's tree as geometry alone wants it: where a bake would measure light, without baking.

Comes in: a scene. Goes out: valid data points, moved out of walls, in the order in which a bake measures them. Light
would ask for fewer of the finest voxels, and for others.
"""

from __future__ import annotations

import numpy as np
from gi_volumes.bake import datapoints
from gi_volumes.bake.refine import FINER, GEOMETRY
from gi_volumes.bake.scene import Scene
from gi_volumes.bake.settings import LEVELS, choose_grid
from gi_volumes.tree import build
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.outline import outline
from gi_volumes.tree.topology import MAX_POINTS


def tree_points(scene: Scene, count: int) -> tuple[Grid, np.ndarray, np.ndarray]:
    """Choose data points.

    Parameters
    ----------
    scene : Scene
        What there is.
    count : int
        How many at most; a random part of a larger tree, all of a smaller one.

    Returns
    -------
    grid : Grid
        The lattice, with as many levels as it takes for `count` data points, if there are so many.
    position : (3, n) float32 ndarray
        Relative to the scene's origin [m], in Morton order.
    key : (n,) uint32 ndarray
        Random keys.
    """
    whole = choose_grid(scene.soup.corners, scene.origin, 0, LEVELS)
    for levels in range(1, LEVELS + 1):
        grid = Grid(whole.first_size, levels, whole.origin)
        level, coords = _voxels(scene, grid)
        if len(level) >= count or levels == LEVELS:
            position, key = _some_valid(scene, grid, level, coords, count)
            if len(key) == count or levels == LEVELS:
                break
    order = datapoints.morton_order(position)
    return grid, np.ascontiguousarray(position[:, order]), key[order]


def _voxels(scene: Scene, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """(n,) levels and (n, 3) coordinates of the tree's voxels."""
    corners, parts = scene.soup.corners, []
    for cell in build.occupied_cells(corners, grid):
        found = outline(corners, grid, tuple(int(v) for v in cell))
        need = [np.where(part > 0, GEOMETRY * FINER**level * (1 + part), 0.0) for level, part in enumerate(found.need)]
        asked = [np.zeros((0, 3), np.int64)] * grid.levels
        parts.append(build.fit(found, need, "partial", MAX_POINTS, asked).voxels())
    level, coords = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return level, coords


def _some_valid(scene: Scene, grid: Grid, level, coords, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(3, n) positions and (n,) keys of randomly chosen data points that are not inside something, `count` at most."""
    order, positions, keys = np.random.default_rng(0).permutation(len(level)), [], []
    for first in range(0, len(level), count):
        rows = order[first : first + count]
        size = np.array([float(grid.voxel_size(k)) for k in range(grid.levels)])[level[rows]]
        key = datapoints.keys(level[rows], coords[rows])
        placed = datapoints.place(scene, (coords[rows] + 0.5) * size[:, None], size, key)
        positions.append(placed.position[:, placed.valid])
        keys.append(key[placed.valid])
        if sum(map(len, keys)) >= count:
            break
    return np.concatenate(positions, axis=1)[:, :count], np.concatenate(keys)[:count]
