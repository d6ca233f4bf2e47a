"""Trees of random bakes for the tests of interpolation, with data points that may be moved, invalid or occluded."""

import functools
import sys
from pathlib import Path

import numpy as np
from gi_volumes.tree import build
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.interpolate import join
from gi_volumes.tree.outline import outline

sys.path.insert(0, str(Path(__file__).parent))
import meshes

FLAT, ALL = 1e-3, -1.0


def room():
    """A room with a table around a corner of four cells, 2 km from the origin."""
    parts = [meshes.box((-6.0, -5.0, 0.0), (6.0, 5.0, 4.0)), meshes.box((1, 1, 0), (2, 2.5, 1))]
    return np.concatenate(parts) + np.float32((-2048, 128, 0))


def slab():
    """A thin slab and the ground under it, across two cells."""
    return np.concatenate([meshes.ground(12.0, 0.3), meshes.box((-9, 3, 2.2), (8, 9, 2.3))])


SCENES = {
    "one level": (lambda: meshes.soup(20, 7, spread=20.0), 1, FLAT),
    "two levels": (lambda: meshes.soup(30, 2, spread=20.0, size=2.0), 2, FLAT),
    "soup": (lambda: meshes.soup(40, 1, spread=14.0, size=1.5), 3, FLAT),
    "room": (room, 3, ALL),
    "slab": (slab, 3, FLAT),
    "four levels": (lambda: meshes.soup(14, 3, spread=6.0, size=0.4), 4, FLAT),
    "crumbs of four levels": (lambda: meshes.soup(40, 5, spread=8.0, size=0.02), 4, ALL),
    "five levels": (lambda: meshes.soup(16, 4, spread=9.0, size=0.1), 5, ALL),
}


@functools.cache
def grown(name, dilation="partial", seed=0):
    """Trees of all cells and the lattice: each cell subdivides by a need of its own, and asks for voxels besides."""
    triangles, levels, flat = SCENES[name]
    triangles, grid = triangles(), Grid(levels=levels)
    trees = []
    for cell in build.occupied_cells(triangles, grid):
        found = outline(triangles, grid, tuple(cell), flat)
        rng = np.random.default_rng([seed, *np.abs(cell)])
        need = [rng.uniform(-0.4, 1, len(mask)) for mask in found.wanted]
        trees.append(build.fit(found, need, dilation, asked=_asked(found, rng)))
    return trees, grid


def _asked(found, rng):
    """Voxels next to solid ones: a few anywhere, most of those at the borders of cells."""
    asked = []
    for level, coords in enumerate(found.coords):
        coords = np.concatenate([coords, found.border[level]])
        width = 16 * 4**level
        near = np.minimum(coords[:, :2] % width, width - 1 - coords[:, :2] % width).min(axis=1) < 2
        coords = coords[rng.random(len(coords)) < np.where(near, 0.7, 0.1)]
        asked.append(coords + rng.integers(-1, 2, coords.shape))
    return asked


def plain(name, dilation="partial"):
    """Data points at all voxel centres, without planes."""
    trees, grid = grown(name, dilation)
    count = sum(tree.size for tree in trees)
    return join(grid, trees, np.zeros((count, 3), np.int8), np.ones(count, bool))


def rough(name, dilation="partial", seed=0, dims=False):
    """Data points that are moved by up to half a voxel, a quarter invalid, half of them with up to three planes; half
    of them hold back any part of what fills up, if wanted."""
    trees, grid = grown(name, dilation)
    count, rng = sum(tree.size for tree in trees), np.random.default_rng(seed)
    offset, valid = rng.integers(-127, 128, (count, 3)).astype(np.int8), rng.random(count) < 0.75
    offset[rng.random(count) < 0.5] = 0
    bare = join(grid, trees, offset, valid)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    before, width = bare.size * rng.uniform(0.02, 0.5, count), bare.size * rng.uniform(0.005, 0.2, count)
    plane = np.column_stack([normal, (normal * bare.position).sum(axis=1) - before, width])
    planes = rng.integers(0, count, (count, 3)).astype(np.int32)
    planes[:, 0] = np.arange(count)
    near = np.abs((normal[planes] * bare.position[:, None]).sum(axis=2) - plane[planes, 3]) < bare.size[:, None]
    planes[~near | (rng.random((count, 3)) < 0.5)] = -1
    fill = np.where(rng.random(count) < 0.5, rng.random(count), 1).astype(np.float32) if dims else None
    return join(grid, trees, offset, valid, planes, plane, fill=fill)


def points(data, count, seed=0):
    """Points around data points of all levels, some exactly on faces of dual cells and on borders of cells."""
    rng, grid = np.random.default_rng(seed), data.grid
    rows = [np.flatnonzero(data.level == level) for level in range(grid.levels)]
    some = np.concatenate([rng.choice(row, count // len(rows) + 1) for row in rows if len(row)])
    some = rng.permutation(some)[:count]
    count = len(some)
    found = (data.coords[some] + 0.5 + rng.uniform(-1.6, 1.6, (count, 3))) * data.size[some, None]
    on_face = np.flatnonzero(rng.random(count) < 0.1)
    size, axis = data.size[some[on_face]], rng.integers(0, 3, len(on_face))
    found[on_face, axis] = (np.floor(found[on_face, axis] / size) + 0.5) * size
    border = np.flatnonzero(rng.random(count) < 0.05)
    axis = rng.integers(0, 2, len(border))
    at_border = np.round(found[border, axis] / grid.cell_size) * grid.cell_size
    close = np.abs(at_border - found[border, axis]) < grid.first_size
    found[border[close], axis[close]] = at_border[close]
    return found
