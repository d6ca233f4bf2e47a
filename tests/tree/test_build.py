"""Building trees: brute force over all voxels, the cap, planar ground, crooked input."""

import itertools
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import boxes, build, validate
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.topology import MAX_POINTS

sys.path.insert(0, str(Path(__file__).parent))
import meshes

ALL = -1.0


def overlaps_any(triangles, coords, size):
    """Whether each voxel overlaps a triangle, by testing every pair."""
    result = np.zeros(len(coords), bool)
    for triangle in triangles.astype(np.float64):
        tiled = np.broadcast_to(triangle, (len(coords), 3, 3))
        result |= boxes.overlap(tiled, (coords + 0.5) * size, 0.5 * size)
    return result


def expected_voxels(triangles, grid, topology):
    """Coordinates of all voxels of each level, from the definition alone."""
    shape, low = topology.grid_shape, np.array(topology.grid_min)
    levels = [low + np.array(list(itertools.product(*map(range, shape))))]
    for level in range(1, grid.levels):
        parents = levels[-1][overlaps_any(triangles, levels[-1], grid.voxel_size(level - 1))]
        steps = np.array(list(itertools.product(range(4), repeat=3)))
        children = (parents[:, None] * 4 + steps).reshape(-1, 3)
        levels.append(children[overlaps_any(triangles, children, grid.voxel_size(level))])
    return levels


def as_sets(topology):
    level, coords = topology.voxels()
    return [set(map(tuple, coords[level == depth].tolist())) for depth in range(topology.levels)]


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("cell", [(0, 0), (-1, 0), (-1, -1)])
def test_voxels_are_those_that_overlap_a_triangle(seed, cell):
    triangles, grid = meshes.soup(8, seed, size=4.0), Grid()
    topology = build.build(triangles, grid, cell, flat=ALL, dilation="none")
    expected = expected_voxels(triangles, grid, topology)
    assert as_sets(topology) == [set(map(tuple, coords.tolist())) for coords in expected]
    assert topology.size == sum(map(len, expected))
    assert topology.dilated == 0
    assert validate.first_defect(topology) is None


def test_touching_counts_below_the_first_level():
    """A ground at z = 2 lies on a face of the second level: the voxels above and below it exist."""
    topology = build.build(meshes.ground(6.0, 2.0), Grid(levels=2), (0, 0), flat=ALL)
    level, coords = topology.voxels()
    assert set(coords[level == 1][:, 2].tolist()) == {0, 1}


def test_the_dense_level_has_the_voxels_whose_centres_surround_the_geometry():
    """From 5 to 27 m: centres at 4 to 28 m, voxels 0 to 3; from 13 to 19: 12 to 20; from 1 to 15: -4 to 20."""
    topology = build.build(meshes.box((5.0, 13.0, 1.0), (27.0, 19.0, 15.0)), Grid(), (0, 0))
    assert (topology.grid_min, topology.grid_shape) == ((0, 1, -1), (4, 2, 4))
    assert (topology.voxels()[0] == 0).sum() == 32


@pytest.mark.parametrize(
    ("height", "low", "layers"), [(0.0, -1, 2), (-0.2, -1, 2), (7.98, 0, 2), (5.0, 0, 2), (4.0, -1, 3)]
)
def test_ground_has_data_points_above_and_below_it(height, low, layers):
    """At 4 m the ground lies in the data points, and counts as touching both neighbours."""
    topology = build.build(meshes.ground(60.0) + np.float32([0, 0, height]), Grid(), (0, 0))
    assert (topology.grid_min[2], topology.grid_shape[2]) == (low, layers)


def test_a_cell_without_geometry_supplies_the_data_points_in_front_of_a_facade():
    """From -125 to 121.5 m: the next centres are at -132 and 124 m, so that only the cell on the left has to help."""
    house, grid = meshes.box((-125.0, 10.0, 1.0), (121.5, 30.0, 3.0)), Grid()
    assert build.occupied_cells(house, grid)[:, 0].tolist() == [-2, -1, 0]
    topology = build.build(house, grid, (-2, 0), dilation="none")
    assert (topology.grid_min, topology.grid_shape) == ((-17, 0, -1), (1, 5, 2))
    assert topology.size == topology.grid_count
    assert build.build(house, grid, (1, 0)) is None


def test_ground_at_a_layer_s_border_is_not_refined_below():
    """The second sheet lies in the voxels above z = 0, and no more than touches those below."""
    sheets = np.concatenate([meshes.ground(60.0, 0.0), meshes.ground(60.0, 0.3)])
    level, coords = build.build(sheets, Grid(), (0, 0), dilation="none").voxels()
    assert coords[level == 0][:, 2].min() == -1
    assert coords[level == 2][:, 2].min() == 0


def test_order_of_triangles_does_not_matter():
    triangles, grid = meshes.soup(40, 3), Grid()
    one = build.build(triangles, grid, (0, 0))
    other = build.build(triangles[::-1], grid, (0, 0))
    np.testing.assert_array_equal(one.nodes, other.nodes)


def test_open_ground_stays_whole_and_a_box_on_it_is_refined():
    grid = Grid()
    assert build.build(meshes.ground(60.0), grid, (0, 0)).size == 9 * 9 * 2
    assert build.build(meshes.ground(60.0), grid, (0, 0), flat=ALL).size > 10_000
    with_box = np.concatenate([meshes.ground(60.0), meshes.box((40, 40, 0.0), (42, 42, 1.5))])
    level, coords = build.build(with_box, grid, (0, 0)).voxels()
    fine = (coords[level == 2] + 0.5) * 0.5
    assert len(fine) > 50
    assert (np.abs(fine[:, :2] - 41).max(axis=1) < 5.1).all()


def test_a_tilted_plane_in_pieces_is_still_one_plane():
    """Four hundred triangles of one plane, rounded to float32, stay whole; one corner lifted does not."""
    x, y = np.meshgrid(np.linspace(1, 100, 15), np.linspace(1, 100, 15), indexing="ij")
    z = 0.31 * x - 0.17 * y + 20
    grid = Grid()

    def tiles():
        p = np.stack([x, y, z], axis=-1).astype(np.float32)
        parts = [p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]]
        return np.concatenate(
            [np.stack([parts[i] for i in order], axis=2).reshape(-1, 3, 3) for order in ([0, 1, 2], [0, 2, 3])]
        )

    whole = build.build(tiles(), grid, (0, 0))
    assert whole.size == whole.grid_count
    z[7, 7] += 0.2
    assert build.build(tiles(), grid, (0, 0)).size > whole.size


def test_two_parallel_sheets_are_not_one_plane():
    sheets = np.concatenate([meshes.ground(60.0, 1.0), meshes.ground(60.0, 1.3)])
    topology = build.build(sheets, Grid(), (0, 0))
    assert topology.size > 10_000


def test_triangles_without_area_are_solid_but_ask_for_nothing():
    point, segment = np.full((1, 3, 3), 3.0), np.array([[[1, 1, 1], [5, 5, 5], [3, 3, 3]]])
    degenerate = np.concatenate([point, segment]).astype(np.float32)
    assert (build.build(degenerate, Grid(), (0, 0)).nodes["mask"] == 0).all()
    topology = build.build(degenerate, Grid(), (0, 0), flat=ALL, dilation="none")
    expected = expected_voxels(degenerate, Grid(), topology)
    assert as_sets(topology) == [set(map(tuple, coords.tolist())) for coords in expected]


@pytest.mark.parametrize("cap", [400, 1000, 3000])
def test_the_cap_holds_and_what_it_left_out_is_counted(cap):
    triangles, grid = meshes.soup(300, 5, spread=30.0), Grid()
    free = build.build(triangles, grid, (0, 0))
    capped = build.build(triangles, grid, (0, 0), max_points=cap)
    assert free.left_out == 0
    assert free.size > 3000
    assert capped.size <= cap
    assert capped.left_out > 0
    assert validate.first_defect(capped, cap) is None
    assert as_sets(capped)[1] <= as_sets(free)[1]


def test_under_the_cap_the_most_varied_geometry_comes_first():
    """A gentle fold and a cluttered corner, eight metres of ground apart: the clutter wins."""
    fold = np.concatenate(
        [
            meshes.quad((0, 0, 0), (20, 0, 0), (20, 8, 0), (0, 8, 0)),
            meshes.quad((20, 0, 0), (40, 0, 1), (40, 8, 1), (20, 8, 0)),
        ]
    )
    clutter = meshes.soup(30, 1, spread=3.0, size=1.0) + np.array([100, 4, 4], np.float32)
    topology = build.build(np.concatenate([fold, clutter]), Grid(), (0, 0), max_points=500)
    level, coords = topology.voxels()
    assert topology.left_out > 0
    assert ((coords[level == 2] + 0.5)[:, 0] * 0.5 > 80).all()
    assert (level == 2).any()


def test_a_stray_object_far_above_does_not_blow_the_cell_up():
    town = np.concatenate([meshes.soup(200, 2), meshes.soup(2, 3) + np.array([30, 30, 343_582], np.float32)])
    topology = build.build(town, Grid(), (0, 0))
    assert topology.size <= MAX_POINTS
    assert topology.left_out > 0
    assert topology.grid_min[2] <= 0 < topology.grid_min[2] + topology.grid_shape[2]
    assert validate.first_defect(topology) is None


def test_a_cap_below_one_layer_is_refused():
    with pytest.raises(ValueError, match="one layer of 81"):
        build.build(meshes.ground(60.0), Grid(), (0, 0), max_points=80)


def test_cells_without_geometry_have_no_tree():
    triangles = meshes.soup(20, 1)
    assert build.build(triangles, Grid(), (5, 0)) is None
    assert build.build(triangles[:0], Grid(), (0, 0)) is None


def test_occupied_cells_are_those_with_a_tree():
    """A long diagonal strip: its bounds overlap 81 cells, it passes through a third of them."""
    strip = meshes.quad((5, 5, 0), (1100, 1100, 40), (1100, 1101, 40), (5, 6, 0))
    triangles, grid = np.concatenate([strip, meshes.soup(10, 1)]), Grid()
    cells = set(map(tuple, build.occupied_cells(triangles, grid).tolist()))
    rectangle = itertools.product(range(-2, 11), repeat=2)
    assert cells == {cell for cell in rectangle if build.build(triangles, grid, cell) is not None}
    assert 10 < len(cells) < 30


def test_ground_of_two_kilometres_has_256_cells_and_a_rim_of_cells_around_them():
    triangles, grid = meshes.ground(1024.0), Grid()
    assert len(build.occupied_cells(triangles, grid)) == 18 * 18
    assert len(build.occupied_cells(triangles * np.float32(0.995), grid)) == 16 * 16
    assert build.build(triangles, grid, (9, 0)) is None
    assert build.build(triangles, grid, (8, 0)).grid_shape == (1, 16, 2)
    assert build.build(triangles, grid, (7, -8)).grid_shape == (16, 16, 2)


def test_a_wall_on_the_border_of_two_cells_is_solid_in_both():
    wall = meshes.quad((128, 10, 0), (128, 30, 0), (128, 30, 4), (128, 10, 4))
    triangles = np.concatenate([wall, meshes.ground(200.0)])
    for cell, column in (((0, 0), 15), ((1, 0), 16)):
        level, coords = build.build(triangles, Grid(), cell).voxels()
        assert (level == 2).any()
        assert set((coords[level == 2][:, 0] // 16).tolist()) == {column}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_corners_that_are_not_finite_are_refused(bad):
    triangles = meshes.ground()
    triangles[1, 2, 0] = bad
    with pytest.raises(ValueError, match="not finite"):
        build.build(triangles, Grid(), (0, 0))


def test_twenty_thousand_triangles_stay_in_bounded_memory():
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 120, (20_000, 1, 3)) * [1, 1, 0.1] + rng.normal(size=(20_000, 3, 3))
    tracemalloc.start()
    topology = build.build(corners.astype(np.float32), Grid(), (0, 0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 30_000 < topology.size <= MAX_POINTS
    assert topology.left_out > 0
    assert peak < 400_000_000
