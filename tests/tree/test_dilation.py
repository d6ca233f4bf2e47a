"""Dilation: every neighbourhood has data of one or two levels, within cells and across their borders."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import boxes, build, first_level, validate
from gi_volumes.tree.dilate import DILATIONS
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.lookup import Atlas
from gi_volumes.tree.outline import Outline, outline

sys.path.insert(0, str(Path(__file__).parent))
import bakes
import meshes
from definition import CORNERS, Definition, one_or_two_levels, probes

STEPS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])


def town():
    """Houses on a ground, around a corner of four cells, one of them tall, one wall on the very border."""
    return np.concatenate(
        [
            meshes.ground(60.0, 0.3),
            meshes.box((-3.0, 2.0, 0.0), (4.0, 9.0, 6.0)),
            meshes.box((5.0, -9.0, 0.0), (11.0, -0.3, 40.0)),
            meshes.box((-9.0, -7.5, 0.0), (-0.1, -0.1, 2.5)),
            meshes.quad((0, 20, 0), (0, 31, 0), (0, 31, 9), (0, 20, 9)),
        ]
    )


FLAT, ALL = 1e-3, -1.0
SCENES = {
    "soup": (lambda: meshes.soup(60, 1, spread=14.0, size=1.5), 3, FLAT),
    "town": (town, 3, FLAT),
    "two levels": (lambda: meshes.soup(60, 2, spread=30.0, size=2.0), 2, FLAT),
    "four levels": (lambda: meshes.soup(14, 3, spread=6.0, size=0.4), 4, FLAT),
    "crumbs of four levels": (lambda: meshes.soup(40, 5, spread=8.0, size=0.02), 4, ALL),
    "crumbs of five levels": (lambda: meshes.soup(12, 4, spread=3.0, size=0.02), 5, ALL),
}
OF_ONE_CELL = {
    "soup of one cell": (lambda: meshes.soup(40, 1, spread=14.0, size=1.5) + np.float32(64), 3, FLAT),
    "crumbs of one cell": (lambda: meshes.soup(5, 5, spread=4.0, size=0.02) + np.float32(64), 4, ALL),
}


def outlines(name, by_light=False):
    """Outlines of all cells, each made alone, and the lattice."""
    triangles, levels, flat = (SCENES | OF_ONE_CELL)[name]
    triangles, grid = triangles(), Grid(levels=levels)
    cells = [tuple(cell) for cell in build.occupied_cells(triangles, grid)]
    return [outline(triangles, grid, cell, flat, by_light=by_light) for cell in cells], grid


def field(points):
    return points @ np.array([0.3, -0.7, 0.2]) + 0.1


def grown(name, dilation="partial", seed=None, by_light=False):
    """Trees of all cells; with a seed each cell subdivides a random half of its candidates."""
    found, grid = outlines(name, by_light)
    trees = []
    for number, one in enumerate(found):
        rng = np.random.default_rng(None if seed is None else [seed, number])
        divided = None if seed is None else [rng.random(len(mask)) < 0.7 for mask in one.wanted]
        trees.append(build.grow(one, divided, dilation))
    return trees, grid


def levels_used(trees, grid):
    """Level bits at the probes that no voxel outside of the dense grids takes part in."""
    points = probes(trees, grid)
    values, bits = Definition(trees, grid, field).at(points)
    inside = np.isfinite(values)
    assert inside.mean() > 0.4
    np.testing.assert_allclose(values[inside], field(points[inside]), atol=1e-12 * (1 + np.abs(points).max()))
    return bits[inside]


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dilation", DILATIONS[1:])
@pytest.mark.parametrize("seed", [None, 0])
def test_every_neighbourhood_has_data_of_one_or_two_levels(name, dilation, seed):
    trees, grid = grown(name, dilation, seed)
    assert all(validate.first_defect(tree) is None for tree in trees)
    bits = levels_used(trees, grid)
    assert one_or_two_levels(bits).all()
    assert (bits >= 1 << (grid.levels - 1)).any()


@pytest.mark.parametrize("name", ["soup", "town", "four levels"])
@pytest.mark.parametrize("seed", [None, 0])
def test_candidates_of_light_have_such_neighbourhoods_too(name, seed):
    trees, grid = grown(name, "partial", seed, by_light=True)
    assert one_or_two_levels(levels_used(trees, grid)).all()


def test_an_open_field_that_light_leaves_whole_costs_its_first_level_alone():
    """Whatever light could ask for: no cell expects its neighbours to subdivide what is flat at their border."""
    triangles, grid = meshes.ground(200.0, 0.3), Grid(levels=4)
    found = outline(triangles, grid, (0, 0), by_light=True)
    assert found.wanted[0].all()
    outermost = ((found.coords[1][:, :2] == 0) | (found.coords[1][:, :2] == 63)).any(axis=1)
    assert len(outermost) > 4000
    np.testing.assert_array_equal(found.wanted[1], ~outermost)
    tree = build.fit(found, [np.zeros(len(mask)) for mask in found.wanted])
    assert tree.size == tree.grid_count


@pytest.mark.parametrize("name", [name for name, (_, levels, _) in SCENES.items() if levels > 2])
def test_without_dilation_neighbourhoods_have_more(name):
    trees, grid = grown(name, "none")
    assert all(tree.dilated == 0 for tree in trees)
    assert not one_or_two_levels(levels_used(trees, grid)).all()


@pytest.mark.parametrize("name", OF_ONE_CELL)
def test_dilation_adds_what_the_rule_asks_for_and_no_more(name):
    """The least sets of voxels, by dictionary: parents, and what surrounds missing neighbours of existing voxels."""
    (tree,), grid = grown(name)
    level, coords = grown(name, "none")[0][0].voxels()
    due = [set(map(tuple, coords[level == depth].tolist())) for depth in range(grid.levels)]
    for depth in range(grid.levels - 1, 1, -1):
        beside = {tuple(np.add(voxel, step).tolist()) for voxel in due[depth] for step in STEPS} - due[depth]
        base = [[(number - 2) // 4 for number in voxel] for voxel in beside]
        due[depth - 1] |= {tuple(np.add(voxel, corner).tolist()) for voxel in base for corner in CORNERS}
        due[depth - 1] |= {tuple(number // 4 for number in voxel) for voxel in due[depth]}
    level, coords = tree.voxels()
    for depth in range(1, grid.levels):
        assert set(map(tuple, coords[level == depth].tolist())) == due[depth]


def test_no_voxel_that_dilation_adds_can_be_left_out(monkeypatch):
    """Without any single one of them, but for the parents of others, some neighbourhood has data of three levels."""
    name = "crumbs of one cell"
    trees, grid = grown(name)
    level, coords = trees[0].voxels()
    exists = set(map(tuple, np.column_stack([level, coords]).tolist()))
    solid = set(map(tuple, np.column_stack(grown(name, "none")[0][0].voxels()).tolist()))
    parents = {(depth - 1, x // 4, y // 4, z // 4) for depth, x, y, z in exists}
    added, rng = sorted(exists - solid - parents), np.random.default_rng(0)
    judge = Definition(trees, grid, field)
    find = judge.atlas.find
    for depth, *voxel in (added[row] for row in rng.permutation(len(added))[:12]):
        size = grid.voxel_size(depth)
        steps = (np.indices([21] * 3).reshape(3, -1).T / 20 * 2.0 - 0.5) * size
        points = np.array(voxel) * size + steps + rng.uniform(0, 1e-3, steps.shape) * size

        def without(at, asked, depth=depth, voxel=voxel):
            gone = (at == depth) & (asked == voxel).all(axis=1)
            return np.where(gone, -1, find(at, asked))

        fine = one_or_two_levels(Definition(trees, grid, field).at(points)[1])
        monkeypatch.setattr(judge.atlas, "find", without)
        assert not one_or_two_levels(judge.at(points)[1][fine]).all()


@pytest.mark.parametrize("name", ["soup", "town", "four levels"])
def test_without_its_neighbours_a_cell_would_not_fit_to_them(name):
    """A planted error: cells that know nothing of each other."""
    found, grid = outlines(name)
    nothing = tuple(coords[:0] for coords in found[0].border)
    alone = [build.grow(replace(one, border=nothing, around=nothing)) for one in found]
    assert not one_or_two_levels(levels_used(alone, grid)).all()


@pytest.mark.parametrize("name", SCENES)
def test_dilated_voxels_are_counted_and_nothing_else_changes(name):
    bare, partial, full = [grown(name, dilation)[0] for dilation in DILATIONS]
    for trees in zip(bare, partial, full, strict=True):
        assert len({tree.size - tree.dilated for tree in trees}) == 1
        voxels = [set(map(tuple, np.column_stack(tree.voxels()).tolist())) for tree in trees]
        assert voxels[0] <= voxels[1] <= voxels[2]


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", [None, 1])
def test_full_dilation_surrounds_solid_voxels_with_data_of_the_finest_level(name, seed):
    trees, grid = grown(name, "full", seed)
    bare, _ = grown(name, "none", seed)
    atlas, finest = Atlas(trees), grid.levels - 1
    solid = np.concatenate([tree.voxels()[1][tree.voxels()[0] == finest] for tree in bare])
    assert len(solid) > 5
    around = (solid[:, None] + STEPS).reshape(-1, 3)
    assert (atlas.find(finest, around) >= 0).all()


@pytest.mark.parametrize("name", ["soup", "town", "two levels", "crumbs of four levels"])
@pytest.mark.parametrize("shift", [(0, 0, 0), (128, 0, 8), (4, 124, 4), (0.5, -60, -0.01)])
def test_all_geometry_is_surrounded_by_data_of_the_first_level(name, shift):
    triangles, grid = SCENES[name][0]() + np.float32(shift), Grid(levels=1)
    atlas = Atlas([build.build(triangles, grid, tuple(cell)) for cell in build.occupied_cells(triangles, grid)])
    rng = np.random.default_rng(0)
    weight = rng.dirichlet([0.5, 0.5, 0.5], (len(triangles), 300))
    weight[:, :3] = np.eye(3)
    points = np.einsum("tsk,tkj->tsj", weight, triangles.astype(np.float64)).reshape(-1, 3)
    around = np.floor(points / grid.first_size - 0.5).astype(np.int64)[:, None] + CORNERS
    assert (atlas.find(0, around.reshape(-1, 3)) >= 0).all()


@pytest.mark.parametrize("dilation", DILATIONS)
@pytest.mark.parametrize("cap", [300, 800, 2000])
def test_the_cap_holds_with_dilation_and_the_rule_with_the_cap(dilation, cap):
    triangles, grid = SCENES["soup"][0](), Grid()
    cells = [tuple(cell) for cell in build.occupied_cells(triangles, grid)]
    trees = [build.build(triangles, grid, cell, cap, dilation=dilation) for cell in cells]
    assert all(tree.size <= cap for tree in trees)
    assert all(validate.first_defect(tree, cap) is None for tree in trees)
    free = [build.build(triangles, grid, cell, dilation=dilation) for cell in cells]
    assert all((tree.left_out > 0) == (whole.size > cap) for tree, whole in zip(trees, free, strict=True))
    assert all(tree.size > 0.6 * cap for tree, whole in zip(trees, free, strict=True) if whole.size > cap)
    if dilation != "none":
        assert one_or_two_levels(levels_used(trees, grid)).all()


def test_where_nothing_else_fits_the_cap_comes_before_dilation():
    """The dense grid leaves two data points; a neighbour's voxels would ask for more."""
    triangles, grid = SCENES["town"][0](), Grid()
    dense = int(np.prod(outline(triangles, grid, (-1, -1)).dense.shape))
    topology = build.build(triangles, grid, (-1, -1), dense + 2)
    assert topology.size == dense
    assert topology.left_out > 0


def test_the_neediest_fit_first_parents_before_children():
    triangles, grid = SCENES["soup"][0](), Grid()
    found, rng = outline(triangles, grid, (0, 0)), np.random.default_rng(0)
    need = [rng.random(len(mask)) for mask in found.wanted]
    whole = build.grow(found).size
    for cap in (whole // 3, 2 * whole // 3):
        topology = build.fit(found, need, max_points=cap)
        assert 0.9 * cap < topology.size <= cap
        parents = set(map(tuple, (topology.voxels()[1][topology.voxels()[0] == 2] // 4).tolist()))
        chosen = np.array([tuple(c) in parents for c in found.coords[1].tolist()])
        least = np.minimum(need[1], need[0][found.parent[1]])
        refused = found.wanted[1] & ~chosen
        assert topology.left_out > 0
        assert least[chosen].min() >= least[refused].max()


def test_voxels_without_need_stay_whole_and_all_need_gives_the_whole_tree():
    triangles, grid = SCENES["soup"][0](), Grid()
    found = outline(triangles, grid, (0, 0))
    nothing = build.fit(found, [np.zeros(len(mask)) for mask in found.wanted], "none")
    assert nothing.size == nothing.grid_count
    assert nothing.left_out == 0
    everything = build.fit(found, [np.ones(len(mask)) for mask in found.wanted])
    np.testing.assert_array_equal(everything.nodes, build.build(triangles, grid, (0, 0)).nodes)


def test_children_of_whole_voxels_are_not_divided():
    found = outline(SCENES["soup"][0](), Grid(), (0, 0))
    divided = [np.zeros(len(found.wanted[0]), bool), np.ones(len(found.wanted[1]), bool)]
    assert build.grow(found, divided, "none").size == int(np.prod(found.dense.shape))


def test_masks_of_another_outline_and_unknown_words_are_refused():
    found = outline(SCENES["soup"][0](), Grid(), (0, 0))
    with pytest.raises(ValueError, match="voxels on its upper levels"):
        build.grow(found, [np.ones(3, bool), np.ones(3, bool)])
    with pytest.raises(ValueError, match="NaN"):
        build.fit(found, [np.full(len(mask), np.nan) for mask in found.wanted])
    with pytest.raises(ValueError, match="use one of none, partial, full"):
        build.grow(found, dilation="some")


def test_an_outline_lists_the_solid_voxels_with_their_parents():
    found = outline(SCENES["soup"][0](), Grid(), (0, 0))
    level, coords = build.grow(found, dilation="none").voxels()
    for depth in (1, 2):
        assert sorted(found.coords[depth].tolist()) == sorted(coords[level == depth].tolist())
        np.testing.assert_array_equal(found.coords[depth - 1][found.parent[depth]], found.coords[depth] // 4)
        assert (np.diff(found.parent[depth]) >= 0).all()
        assert found.wanted[depth - 1][found.parent[depth]].all()
    assert found.cost(0).sum() == len(found.coords[1])


def test_cells_know_all_voxels_that_their_neighbours_have_near_the_border():
    """The outline's border holds every voxel of other cells within reach, whatever they choose."""
    triangles, grid = SCENES["town"][0](), Grid()
    cells = [tuple(cell) for cell in build.occupied_cells(triangles, grid)]
    found = {cell: outline(triangles, grid, cell) for cell in cells}
    for cell, one in found.items():
        start = np.array(cell) * 256
        known = set(map(tuple, one.border[2].tolist()))
        for other in set(cells) - {cell}:
            coords = found[other].coords[2]
            near = ((coords[:, :2] >= start - 4) & (coords[:, :2] < start + 260)).all(axis=1)
            assert set(map(tuple, coords[near].tolist())) <= known


def edge(grid, level, reach):
    """(n, 3) voxels of a level on both sides of the plane x = 0, so many on each, around the origin."""
    size, far = grid.voxel_size(level), 26.0
    y, z = np.arange(-int(far / size), int(far / size)), np.arange(-int(far / size), int(far / size))
    return np.stack(np.meshgrid(np.arange(-reach, reach), y, z, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(("level", "reach"), [(1, 1), (2, 3)])
def test_cells_foresee_just_the_voxels_whose_centres_surround_geometry(level, reach):
    """By brute force: a triangle overlaps the cube between the centres of a voxel's neighbours, touching included."""
    triangles, grid = SCENES["soup"][0](), Grid()
    rng, asked = np.random.default_rng(0), edge(grid, level, reach)
    asked = rng.permutation(asked)[:20_000]
    surrounds, size = np.zeros(len(asked), bool), grid.voxel_size(level)
    for triangle in triangles.astype(np.float64):
        surrounds |= boxes.overlap(np.repeat(triangle[None], len(asked), axis=0), (asked + 0.5) * size, size)
    assert 20 < surrounds.sum() < len(asked) / 2
    for cell in [(-1, -1), (-1, 0), (0, -1), (0, 0)]:
        found, own = outline(triangles, grid, cell, ALL), (asked[:, :2] >= 0) == (np.array(cell) == 0)
        own = own.all(axis=1)
        kept = set(map(tuple, found.foreseen(level, asked[own]).tolist()))
        assert kept == set(map(tuple, asked[own & surrounds].tolist()))
        known = set(map(tuple, found.around[level].tolist()))
        beside = own | ((asked[:, 1] >= 0) == (cell[1] == 0))
        assert set(map(tuple, asked[beside & surrounds].tolist())) <= known


def test_what_surrounds_geometry_does_not_depend_on_how_much_is_looked_at_together(monkeypatch):
    triangles, grid = SCENES["town"][0](), Grid()
    whole = outline(triangles, grid, (0, -1), ALL)
    monkeypatch.setattr(first_level, "PAIRS", 97)
    for one, other in zip(whole.around, outline(triangles, grid, (0, -1), ALL).around, strict=True):
        np.testing.assert_array_equal(one, other)


def test_voxels_far_from_a_border_may_be_asked_for_anywhere():
    triangles, grid = SCENES["soup"][0](), Grid()
    found, deep = outline(triangles, grid, (0, 0)), np.array([[9, 9, 5], [40, 3, 30], [13, 33, -9]])
    np.testing.assert_array_equal(found.foreseen(2, deep), deep)


@pytest.mark.parametrize("name", ["room", "soup"])
def test_voxels_that_other_cells_do_not_foresee_would_not_fit_to_theirs(monkeypatch, name):
    """A planted error: what is asked for near a border is there, whatever the neighbours know."""
    trees, grid = bakes.grown(name)
    assert one_or_two_levels(levels_used(trees, grid)).all()
    monkeypatch.setattr(Outline, "foreseen", lambda outline, level, coords: coords)
    trees, grid = bakes.grown.__wrapped__(name)
    assert not one_or_two_levels(levels_used(trees, grid)).all()


@pytest.mark.parametrize("cap", [500, 800, 2000])
def test_voxels_asked_for_come_with_the_solid_ones_beside_them_and_share_the_cap(cap):
    """However many are asked for: were all of them there first, nothing could be subdivided."""
    triangles, grid = SCENES["soup"][0](), Grid()
    found, rng = outline(triangles, grid, (0, 0)), np.random.default_rng(0)
    need = [rng.random(len(mask)) for mask in found.wanted]
    asked = [np.unique((coords[:, None] + STEPS).reshape(-1, 3), axis=0) for coords in found.coords]
    assert len(asked[2]) > 2000
    tree = build.fit(found, need, max_points=cap, asked=asked)
    assert 0.6 * cap < tree.size <= cap
    level, coords = tree.voxels()
    solid = set(map(tuple, found.coords[2].tolist()))
    finest = set(map(tuple, coords[level == 2].tolist()))
    assert len(finest & solid) > 0.1 * cap
    for voxel in finest - solid:
        assert any(tuple(near) in finest & solid for near in (np.array(voxel) + STEPS).tolist())
