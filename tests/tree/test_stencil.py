"""The stencil: linear fields are exact, no neighbourhood has data of more than two levels, dual cells are found."""

import sys
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import dualcells, stencil
from gi_volumes.tree.dualcells import DualCells
from gi_volumes.tree.stencil import taps

sys.path.insert(0, str(Path(__file__).parent))
import bakes
from definition import CORNERS, Definition, one_or_two_levels, surrounded

ROUNDING = 2.0**-24
"""Half a step of float32 at 1."""
POINTS = 65_000
CASES = [(name, dilation) for name in bakes.SCENES for dilation in ("partial", "full")]
assert len(CASES) * POINTS > 1_000_000


def moments(data, points):
    """(n,) sums of weights, (3, n) weighted sums of data points less the point [m], (n,) bits of the levels."""
    points = np.ascontiguousarray(points.T)
    total, first, bits = np.zeros(points.shape[1]), np.zeros(points.shape), np.zeros(points.shape[1], np.int64)
    for part in taps(data.grid, data.dual_cells, points, data.grid.levels - 1):
        level = part.level
        assert (data.level[part.row[part.weight > 0]] == level).all()
        total[part.point] += part.weight.sum(axis=0)
        for axis in range(3):
            arm = data.position[part.row, axis] - points[axis, part.point]
            first[axis, part.point] += (part.weight * arm).sum(axis=0)
        bits[part.point] |= np.where((part.weight > 0).any(axis=0), 1 << level, 0)
    return total, first, bits


@pytest.mark.parametrize(("name", "dilation"), CASES)
def test_linear_fields_are_exact_and_at_most_two_levels_have_data(name, dilation):
    """At a million points: weights sum to 1, their mean data point is the point, one or two adjacent levels count."""
    data = bakes.plain(name, dilation)
    points = bakes.points(data, POINTS)
    whole = surrounded(bakes.grown(name, dilation)[0], data.grid, points)
    total, first, bits = moments(data, points)
    assert whole.mean() > 0.1
    np.testing.assert_allclose(total[whole], 1, atol=16 * ROUNDING)
    coarsest = data.grid.voxel_size(np.round(np.log2(np.maximum(bits & -bits, 1))))
    assert (np.abs(first) / coarsest)[:, whole].max() < 32 * ROUNDING
    assert one_or_two_levels(bits[whole]).all()
    levels = np.bincount(bits[whole])
    assert np.count_nonzero(levels) == 2 * data.grid.levels - 1
    assert (total <= 1 + 16 * ROUNDING).all()


@pytest.mark.parametrize("name", [name for name, (_, levels, _) in bakes.SCENES.items() if levels > 2])
def test_without_dilation_three_levels_have_data(name):
    data = bakes.plain(name, "none")
    bits = moments(data, bakes.points(data, 20_000))[2]
    assert not one_or_two_levels(bits[bits > 0]).all()


@pytest.mark.parametrize(("name", "dilation"), [*CASES, ("soup", "none"), ("five levels", "none")])
def test_taps_are_those_of_the_definition(name, dilation):
    """Also without dilation, where values pass through more levels, and outside of the dense grids."""

    def field(p):
        return np.sin(p @ np.array([1.3, 0.7, -1.1])) + 2.0

    data, (trees, grid) = bakes.plain(name, dilation), bakes.grown(name, dilation)
    points = bakes.points(data, 4000, seed=1)
    expected, bits = Definition(trees, grid, field).at(points)
    found, values = np.zeros(len(points)), field(data.position)
    for part in taps(grid, data.dual_cells, np.ascontiguousarray(points.T), grid.levels - 1):
        found[part.point] += (part.weight * values[part.row]).sum(axis=0)
    whole = np.isfinite(expected)
    assert whole.mean() > 0.3
    np.testing.assert_allclose(found[whole], expected[whole], atol=1e-5)
    np.testing.assert_array_equal(moments(data, points)[2][whole], bits[whole])


def test_a_stencil_that_ignores_the_centroid_is_caught(monkeypatch):
    """A planted error: the coarse level is evaluated half a voxel away from it."""
    missing = stencil._missing

    def planted(corners, base, size):
        some, moved, share = missing(corners, base, size)
        return some, moved + size / 2, share

    monkeypatch.setattr(stencil, "_missing", planted)
    data = bakes.plain("soup")
    points = bakes.points(data, 5000)
    whole = surrounded(bakes.grown("soup")[0], data.grid, points)
    assert np.abs(moments(data, points)[1][:, whole]).max() > 0.01


def test_a_coarser_start_is_the_tree_without_its_finer_levels():
    data = bakes.plain("soup")
    points = np.ascontiguousarray(bakes.points(data, 3000).T)
    assert [part.level for part in taps(data.grid, data.dual_cells, points, 1)] == [1, 0]
    parts = list(taps(data.grid, data.dual_cells, points, 0))
    assert len(parts) == 1
    base = np.floor(points[:, parts[0].point].T / data.grid.first_size - 0.5).astype(np.int64)
    rows = data.atlas.find(0, (base[:, None] + CORNERS[:, ::-1]).reshape(-1, 3)).reshape(-1, 8).T
    np.testing.assert_array_equal(parts[0].row, np.maximum(rows, 0))
    np.testing.assert_array_equal(parts[0].weight > 0, (rows >= 0) & (parts[0].weight > 0))


@pytest.mark.parametrize("far", [0, 1 << 20, -(1 << 40)])
@pytest.mark.parametrize("spread", [1, 9, 3000])
def test_dual_cells_are_those_of_a_dictionary(far, spread):
    """Around the origin and far from it, in crowds and alone, with a second crowd 2^30 voxels away."""
    rng = np.random.default_rng(spread)
    coords = np.unique(rng.integers(-spread, spread + 1, (300, 3)), axis=0)
    coords = np.concatenate([coords, coords[::3] + np.array([1 << 30, -(1 << 30), 7])]) + far
    rows = rng.permutation(len(coords)) + 5
    known = {tuple(c): row for c, row in zip(coords.tolist(), rows.tolist(), strict=True)}
    cells = DualCells(coords, rows)
    asked = np.concatenate([coords[rng.integers(0, len(coords), 3000)] + rng.integers(-2, 3, (3000, 3)), coords * 3])
    found = cells.corners[:, cells.find(np.ascontiguousarray(asked.T))].T
    expected = [[known.get(tuple(c), -1) for c in (base + dualcells.CORNERS).tolist()] for base in asked]
    np.testing.assert_array_equal(found, expected)


def test_a_level_without_voxels_has_no_dual_cells():
    cells = DualCells(np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    assert not cells.find(np.array([[0, 1 << 50], [0, -3], [0, 1]])).any()
    assert (cells.corners == -1).all()


def test_the_table_of_roots_stays_small_for_cells_that_are_far_apart():
    coords = np.array([[0, 0, 0], [1 << 40, 1 << 40, 0], [-(1 << 40), 3, 1 << 20]])
    cells = DualCells(coords, np.arange(3))
    assert cells._root.size <= dualcells.ROOTS
    assert sum(block.size for block in cells._blocks) < 64 * 25 * 24
