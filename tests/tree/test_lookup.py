"""Look-up against a dictionary of all voxels of several cells."""

import sys
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import build
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.lookup import Atlas

sys.path.insert(0, str(Path(__file__).parent))
import meshes


@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_find_agrees_with_a_dictionary(levels):
    triangles, grid = meshes.soup(25, 1, spread=40.0 / levels, size=2.0), Grid(levels=levels)
    cells = [(0, 0), (-1, -1), (0, -1), (-1, 0)]
    trees = [build.build(triangles, grid, cell) for cell in cells]
    atlas = Atlas(trees)
    table = {}
    for tree, first in zip(trees, atlas.first, strict=False):
        level, coords = tree.voxels()
        table |= {(int(a), *map(int, c)): first + n for n, (a, c) in enumerate(zip(level, coords, strict=True))}
    assert len(table) == atlas.first[-1]
    rng = np.random.default_rng(1)
    level = rng.integers(0, levels, 20_000)
    known = np.array(list(table))
    near = known[rng.integers(0, len(known), 20_000)] + rng.integers(-1, 2, (20_000, 4)) * [0, 1, 1, 1]
    far = np.concatenate([level[:, None], rng.integers(-100, 100, (20_000, 3))], axis=1)
    queries = np.concatenate([known, near, far])
    expected = [table.get(tuple(query), -1) for query in queries.tolist()]
    np.testing.assert_array_equal(atlas.find(queries[:, 0], queries[:, 1:]), expected)
    assert 0.2 < np.mean(np.array(expected[len(known) : len(known) + 20_000]) >= 0) < 0.98


def test_one_level_for_all_equals_one_level_each():
    tree = build.build(meshes.soup(25, 2), Grid(), (0, 0))
    atlas, coords = Atlas([tree]), np.random.default_rng(0).integers(-5, 40, (500, 3))
    np.testing.assert_array_equal(atlas.find(2, coords), atlas.find(np.full(500, 2), coords))


def test_no_cells_and_no_queries_are_no_error():
    assert Atlas([]).find(1, np.zeros((3, 3), int)).tolist() == [-1, -1, -1]
    tree = build.build(meshes.soup(5, 2), Grid(), (0, 0))
    assert Atlas([tree]).find(2, np.zeros((0, 3), int)).shape == (0,)


def test_cells_far_apart_need_no_table_of_what_lies_between():
    far = meshes.soup(3, 1) + np.array([1e6, -2e6, 0], np.float32)
    grid = Grid()
    cells = [(0, 0), *map(tuple, build.occupied_cells(far, grid)[:2].tolist())]
    triangles = np.concatenate([meshes.soup(10, 1), far])
    trees = [build.build(triangles, grid, cell) for cell in cells]
    atlas = Atlas(trees)
    for tree, first in zip(trees, atlas.first, strict=False):
        level, coords = tree.voxels()
        np.testing.assert_array_equal(atlas.find(level, coords), first + np.arange(tree.size))
