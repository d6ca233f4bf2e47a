"""The lattice: sizes, coordinates, and the automatic choice of scale."""

import sys
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import grid as lattice
from gi_volumes.tree.grid import Grid

sys.path.insert(0, str(Path(__file__).parent))
import meshes


def room(size=5.0):
    return meshes.box((0, 0, 0), (size, size, 0.6 * size))


def test_default_sizes_are_8_2_and_half_a_metre():
    assert [Grid().voxel_size(level) for level in range(3)] == [8.0, 2.0, 0.5]
    assert Grid().cell_size == 128.0


@pytest.mark.parametrize("bad", [{"first_size": 3.0}, {"first_size": 0}, {"levels": 0}, {"levels": 9}])
def test_impossible_lattices_are_refused(bad):
    with pytest.raises(ValueError, match=r"levels|first_size"):
        Grid(**bad)


def test_an_origin_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="origin"):
        Grid(origin=(0.0, np.nan, 0.0))


def test_centers_and_origin_are_exact_in_double_precision():
    grid = Grid(origin=(500_000 * 1024.0, 0.0, -1024.0))
    np.testing.assert_array_equal(grid.to_local([[500_000 * 1024.0 + 0.125, 1.0, 2.0]]), [[0.125, 1.0, 1026.0]])
    centers = grid.centers(np.array([0, 2]), np.array([[0, 0, -1], [-1, 3, 5]]))
    np.testing.assert_array_equal(centers, [[4.0, 4.0, -4.0], [-0.25, 1.75, 2.75]])


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ([[1, 1, 0], [2, 2, 0]], [[0, 0]]),
        ([[-1, 1, 0], [129, 2, 0]], [[-1, 0], [0, 0], [1, 0]]),
        ([[0, 0, 0], [128, 256, 0]], [[0, 0], [0, 1]]),
        ([[128, 0, 0], [128, 0, 0]], [[1, 0]]),
    ],
)
def test_cells_of_a_box(bounds, expected):
    assert Grid().cells_of(np.array(bounds, float)).tolist() == expected


@pytest.mark.parametrize(
    ("scene", "first_size"),
    [
        (room(), 8.0),
        (room(30.0), 8.0),
        (room(1000.0), 8.0),
        (room(0.5), 1.0),
        (room(0.005), 2.0**-7),
        (room(100_000.0), 256.0),
        (meshes.ground(1024.0), 8.0),
        (meshes.ground(20_000.0), 128.0),
        (np.concatenate([meshes.soup(5000, 1, 60.0, 1.0), meshes.ground(1024.0)]), 8.0),
        (np.concatenate([meshes.soup(5000, 1, 0.1, 0.01), meshes.ground(50.0)]), 8.0),
        (np.concatenate([meshes.soup(500, 1), meshes.soup(2, 2) + np.float32(400_000)]), 8.0),
    ],
    ids=[
        "room", "house", "district", "table top", "jewel", "mountain range", "plain", "wide plain",
        "town on a plain", "ornament on a floor", "house and a stray",
    ],
)  # fmt: skip
def test_scale_is_chosen_by_the_bulk_of_the_scene(scene, first_size):
    assert lattice.choose(scene).first_size == first_size


def test_a_scaled_scene_gets_a_scaled_lattice():
    scene = meshes.soup(200, 3, 0.4, 0.1)
    assert lattice.choose(scene * np.float32(0.25)).first_size == lattice.choose(scene).first_size / 4


@pytest.mark.parametrize("bad", [np.zeros((0, 3, 3)), np.zeros((3, 3)), np.full((1, 3, 3), np.nan)])
def test_what_is_no_scene_is_refused(bad):
    with pytest.raises(ValueError, match="triangle"):
        lattice.choose(bad)
