"""Irradiance of a bake: identities and closed forms first, then every input that must not break it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import build, folder, harmonics, planes, world
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.interpolate import NEAR, weigh
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
import meshes

ORIGIN = (1024.0, -2048.0, 0.0)
ROOM = np.concatenate([meshes.box((-6.0, -5.0, 0.0), (6.0, 5.0, 4.0)), meshes.box((1, 1, 0), (2, 2.5, 1))])
CELLS = [(-1, -1), (-1, 0), (0, -1), (0, 0)]
KEYS = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
SUN = {"directions": KEYS, "scene": [{"direction": KEYS[1], "irradiance": [4.0, 2.0, 1.0]}]}


def directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def points_in_room(count, seed=0, margin=0.0):
    return np.random.default_rng(seed).uniform([-6, -5, 0], [6, 5, 4], (count, 3)) * (1 - margin) + ORIGIN


def make(place, values, valid=None, origin=ORIGIN, transports=None, offset=None):
    """Bake by hand: `values(name, centers)` gives the payloads of data points at local centres."""
    grid = Grid(origin=origin)
    place.mkdir(exist_ok=True)
    for cell in CELLS:
        topology = build.build(ROOM, grid, cell, flat=-1.0)
        level, coords = topology.voxels()
        centers = grid.centers(level, coords)
        payloads = {name: f(centers).astype(np.float32) for name, f in values.items()}
        flags = np.ones(topology.size, bool) if valid is None else valid(level, centers)
        moved = np.zeros((topology.size, 3), np.int8) if offset is None else offset(centers)
        folder.write_cell(place, topology, payloads, flags, moved, {"bake": "b"})
    transports = transports or {name: {} for name in values}
    folder.assemble(place, {"bake": "b", "grid": grid, "transports": transports})
    return world.load(place)


def test_what_voxels_hold_back_reaches_the_irradiance(tmp_path):
    """Fine data points that a plane hides everywhere leave all light to the first level; the second holds back half."""
    grid, (topology, *_) = Grid(), [build.build(ROOM, Grid(), cell, flat=-1.0) for cell in CELLS]
    size, level = topology.size, topology.voxels()[0]
    rows = np.full((size, 3), planes.NONE, np.uint16)
    rows[level > 0, 0] = 0
    above = np.array([[0, 0, 1, 1000, 0.1]], np.float32)
    light = uniform(2.0)(np.zeros((size, 3))).astype(np.float32)
    found = []
    for fill in (None, np.where(level == 1, 128, 255).astype(np.uint8)):
        hidden = planes.CellPlanes(rows, above, fill=fill)
        still = np.zeros((size, 3), np.int8)
        folder.write_cell(tmp_path, topology, {"local": light}, np.ones(size, bool), still, {"bake": "b"}, hidden)
        folder.assemble(tmp_path, {"bake": "b", "grid": grid, "transports": {"local": {}}})
        found.append(world.load(tmp_path).irradiance(np.array([(-5.0, -4.0, 0.0)]), np.array([(0, 0, 1.0)])))
    np.testing.assert_allclose(found[0], 2.0, rtol=1e-3)
    np.testing.assert_allclose(found[1], 2.0 * 128 / 255, rtol=1e-3)


def uniform(*strengths):
    """Irradiance that is the same for all normals; one function for each strength."""

    def values(centers):
        result = np.zeros((len(centers), len(strengths), 9, 3))
        result[:, :, 0] = np.array(strengths)[:, None] / 0.28209479177387814
        return result

    return values


def linear(centers):
    """Mean irradiance 10 + x / 4, y / 8 + 10, 20 - z."""
    result = np.zeros((len(centers), 1, 9, 3))
    result[:, 0, 0] = plane(centers) / 0.28209479177387814
    return result


def plane(p):
    return np.stack([10 + p[:, 0] / 4, 10 + p[:, 1] / 8, 20 - p[:, 2]], axis=1)


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    values = {"local": uniform(1.0), "sun": uniform(0.1, 0.2, 0.3), "sky": uniform(5.0)}
    return make(tmp_path_factory.mktemp("full"), values, transports={"local": {}, "sun": SUN, "sky": {}})


def test_a_uniform_field_is_the_same_everywhere(full):
    """Inside, on walls, outside, far away, and for every normal."""
    p = np.concatenate([points_in_room(2000), directions(500) * 100 + ORIGIN, directions(500) * 1e9])
    got = full.irradiance(p, directions(3000), transport="local")
    np.testing.assert_allclose(got, 1.0, rtol=2e-3)


def test_transports_add_up(full):
    p, n = points_in_room(300), directions(300)
    parts = {name: full.irradiance(p, n, transport=name) for name in ("local", "sun", "sky")}
    total = parts["local"] + parts["sun"] * full.sun_irradiance + parts["sky"]
    np.testing.assert_allclose(full.irradiance(p, n), total, rtol=1e-5)
    np.testing.assert_allclose(total, np.tile([6.8, 6.4, 6.2], (300, 1)), rtol=2e-3)


def test_sun_alone_is_per_unit_of_irradiance(full):
    p, n = points_in_room(50), directions(50)
    np.testing.assert_allclose(full.irradiance(p, n, transport="sun"), 0.2, rtol=2e-3)
    given_sun = full.irradiance(p, n, sun=(KEYS[2], [9.0, 9.0, 9.0]), transport="sun")
    np.testing.assert_allclose(given_sun, 0.3, rtol=2e-3)


def test_a_sun_between_keys_is_their_mean_and_scales_with_its_irradiance(full):
    p, n = points_in_room(50), directions(50)
    local_and_sky = 6.0
    got = full.irradiance(p, n, sun=([0.0, 1.0, 1.0], 10.0)) - local_and_sky
    np.testing.assert_allclose(got, 10.0 * 0.2, rtol=1e-2)
    got = full.irradiance(p, n, sun=([0.0, 0.0, 3.0], (1.0, 2.0, 0.0))) - local_and_sky
    np.testing.assert_allclose(got, np.tile([0.1, 0.2, 0.0], (50, 1)), atol=1e-2)


def test_a_folded_sky_takes_a_factor_and_nothing_else(full):
    p, n = points_in_room(20), directions(20)
    np.testing.assert_allclose(full.irradiance(p, n, sky=2.0, transport="sky"), 10.0, rtol=2e-3)
    tinted = full.irradiance(p, n, sky=[1.0, 0.0, 2.0], transport="sky")
    np.testing.assert_allclose(tinted, np.tile([5.0, 0.0, 10.0], (20, 1)), rtol=2e-3)
    with pytest.raises(ValueError, match="takes a factor"):
        full.irradiance(p, n, sky=np.ones((9, 3)), transport="sky")


def test_a_sky_basis_takes_the_radiance_of_any_sky(tmp_path):
    own = np.zeros((9, 3))
    own[0] = 2.0
    transports = {"sky": {"radiance": own.tolist()}}
    baked = make(tmp_path, {"sky": uniform(*range(1, 10))}, transports=transports)
    p, n = points_in_room(20), directions(20)
    np.testing.assert_allclose(baked.irradiance(p, n), 2.0, rtol=2e-3)
    np.testing.assert_allclose(baked.irradiance(p, n, sky=0.5), 1.0, rtol=2e-3)
    other = np.zeros((9, 3))
    other[8] = [1.0, 0.0, 3.0]
    np.testing.assert_allclose(baked.irradiance(p, n, sky=other), np.tile([9.0, 0.0, 27.0], (20, 1)), rtol=2e-3)


def test_the_normal_selects_the_lobe(tmp_path):
    """Light from above alone: the closed form of order 2, at every normal."""
    light = np.array([0.0, 0.0, 1.0])
    coefficients = (harmonics.COSINE * harmonics.basis(light))[None, None, :, None]
    baked = make(tmp_path, {"local": lambda c: np.broadcast_to(coefficients, (len(c), 1, 9, 3))})
    n = directions(500)
    z = n[:, 2:]
    expected = np.maximum(0.25 + 0.5 * z + 5 / 32 * (3 * z * z - 1), 0)
    np.testing.assert_allclose(baked.irradiance(points_in_room(500), n), np.tile(expected, 3), atol=1e-3)


def test_linear_fields_are_reproduced_everywhere_within_the_trees(tmp_path):
    """Where data points of two levels meet, too: a fourth of the points or more."""
    baked = make(tmp_path, {"local": linear})
    p = points_in_room(20_000)
    local = p - ORIGIN
    row, weight = weigh(baked._data, local, np.zeros_like(p))
    np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-6)
    level = np.where(weight > 0, baked._data.level[row], 255)
    assert (level.min(axis=1) < np.where(weight > 0, level, 0).max(axis=1)).mean() > 0.25
    np.testing.assert_allclose(baked.irradiance(p, np.zeros_like(p)), plane(local), rtol=1e-3)


def test_data_points_behind_the_surface_do_not_count(full):
    p, n = points_in_room(3000), directions(3000)
    row, weight = weigh(full._data, p - ORIGIN, n)
    arm = full._data.position[row] - (p - ORIGIN)[:, None]
    behind = np.einsum("nci,ni->nc", arm, n) <= -2 * NEAR * full._data.size[row]
    some_in_front = ((weight > 0) & ~behind).any(axis=1)
    assert some_in_front.mean() > 0.99
    assert not weight[some_in_front[:, None] & behind].any()


def test_moved_data_points_are_weighed_where_they_are(tmp_path):
    """All data points half a voxel up: on a horizontal plane just below the moved ones, all four lower ones count."""
    baked = make(
        tmp_path, {"local": uniform(1.0)}, offset=lambda c: np.tile(np.array([0, 0, 127], np.int8), (len(c), 1))
    )
    p = np.array([[-5.9, 0.1, 0.45]])
    _, weight = weigh(baked._data, p, np.array([[0.0, 0.0, 1.0]]))
    still = make(tmp_path / "still", {"local": uniform(1.0)})
    _, other = weigh(still._data, p, np.array([[0.0, 0.0, 1.0]]))
    assert (weight > 0).sum() > (other > 0).sum()


def test_coarse_levels_fill_in_where_fine_data_are_invalid(tmp_path):
    baked = make(tmp_path, {"local": lambda c: uniform(1.0)(c) * 1.0}, valid=lambda level, c: level == 0)
    np.testing.assert_allclose(baked.irradiance(points_in_room(300), directions(300)), 1.0, rtol=2e-3)


def test_the_nearest_valid_data_point_is_the_last_resort(tmp_path):
    """One valid voxel in the whole bake lights every point."""
    baked = make(tmp_path, {"local": uniform(7.0)}, valid=lambda level, c: (level == 0) & (c == [4, 4, 4]).all(axis=1))
    p = np.concatenate([points_in_room(200), directions(200) * 1e4])
    np.testing.assert_allclose(baked.irradiance(p, directions(400)), 7.0, rtol=2e-3)


def test_a_bake_without_any_valid_data_point_is_dark_not_broken(tmp_path):
    baked = make(tmp_path, {"local": uniform(7.0)}, valid=lambda level, c: level < 0)
    assert not baked.irradiance(points_in_room(50), directions(50)).any()


def test_a_bake_without_cells_is_dark_not_broken(tmp_path):
    folder.assemble(tmp_path, {"bake": "b", "grid": Grid(), "transports": {}})
    baked = world.load(tmp_path)
    assert not baked.irradiance(np.zeros((5, 3)), directions(5)).any()
    assert baked.cells.shape == (0, 2)


def test_neighbours_in_another_cell_count(tmp_path):
    """A field that differs from cell to cell is continuous across their border."""
    baked = make(tmp_path, {"local": linear})
    p = points_in_room(2000)
    p[:, 0] = ORIGIN[0]
    n = directions(2000)
    below, above = (baked.irradiance(p + np.array([sign * 1e-7, 0, 0]), n) for sign in (-1, 1))
    np.testing.assert_allclose(below, above, rtol=1e-4)


def test_the_result_does_not_depend_on_how_points_are_grouped(full, monkeypatch):
    p, n = points_in_room(500), directions(500)
    whole = full.irradiance(p, n)
    monkeypatch.setattr(world, "CHUNK", 37)
    np.testing.assert_array_equal(full.irradiance(p, n), whole)


def test_a_bake_far_from_the_world_origin_is_the_same(tmp_path):
    values = {"local": linear}
    far_origin = (500_000_000 * 1024.0, -1024.0, 2048.0)
    near, far = (
        make(tmp_path / "near", values, origin=(0.0, 0.0, 0.0)),
        make(tmp_path / "far", values, origin=far_origin),
    )
    p = np.round(points_in_room(500) - ORIGIN, 2) // 0.125 * 0.125
    n = directions(500)
    np.testing.assert_array_equal(near.irradiance(p, n), far.irradiance(p + far_origin, n))


finite = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=200, deadline=None)
@given(point=st.tuples(finite, finite, finite), normal=st.tuples(finite, finite, finite))
def test_any_finite_input_gives_a_finite_irradiance(full, point, normal):
    got = full.irradiance(np.array([point]), np.array([normal]))
    assert np.isfinite(got).all()
    assert (got >= 0).all()


def test_no_points_give_no_result(full):
    assert full.irradiance(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)


def test_a_normal_without_length_gives_the_mean_over_all_directions(tmp_path):
    coefficients = (harmonics.COSINE * harmonics.basis(np.array([0.0, 0.0, 1.0])))[None, None, :, None]
    baked = make(tmp_path, {"local": lambda c: np.broadcast_to(coefficients, (len(c), 1, 9, 3))})
    got = baked.irradiance(points_in_room(50), np.zeros((50, 3)))
    np.testing.assert_allclose(got, 0.25, rtol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.full((2, 3), np.nan)}, "points: row 0 is not finite"),
        ({"normals": np.array([[0, 0, 1], [0, np.inf, 0]])}, "normals: row 1 is not finite"),
        ({"points": np.zeros((2, 2))}, r"\(n, 3\) is needed"),
        ({"points": np.zeros(3)}, r"\(n, 3\) is needed"),
        ({"normals": np.zeros((3, 3))}, "as many are needed"),
        ({"transport": "moon"}, "transport 'moon'"),
        ({"sun": ([0, 0, np.nan], 1.0)}, "not finite"),
        ({"sun": ([0, 0, 0], 1.0)}, "no length"),
        ({"sun": ([0, 0, 1], -1.0)}, "negative"),
        ({"sun": ([0, 0, 1], np.inf)}, "not finite"),
        ({"sky": np.nan}, "not finite"),
        ({"sky": np.ones(5)}, "takes a factor"),
    ],
)
def test_wrong_input_is_one_clear_line(full, arguments, message):
    usual = {"points": np.zeros((2, 3)), "normals": np.tile([0.0, 0.0, 1.0], (2, 1))}
    with pytest.raises(ValueError, match=message) as caught:
        full.irradiance(**(usual | arguments))
    assert "\n" not in str(caught.value)


def test_a_sun_transport_without_a_sun_has_to_be_told_the_direction(tmp_path):
    transports = {"sun": {"directions": KEYS, "scene": []}}
    baked = make(tmp_path, {"sun": uniform(0.1, 0.2, 0.3)}, transports=transports)
    p, n = points_in_room(5), directions(5)
    assert not baked.irradiance(p, n).any()
    with pytest.raises(ValueError, match="no sun of its own"):
        baked.irradiance(p, n, transport="sun")
    np.testing.assert_allclose(baked.irradiance(p, n, sun=(KEYS[0], 1.0), transport="sun"), 0.1, rtol=2e-3)


def test_cells_of_another_bake_are_not_mixed_in(tmp_path):
    make(tmp_path, {"local": uniform(1.0)})
    topology = build.build(ROOM, Grid(), (0, 0), flat=-1.0)
    values, valid = {"local": np.zeros((topology.size, 1, 9, 3), np.float32)}, np.ones(topology.size, bool)
    folder.write_cell(tmp_path, topology, values, valid, np.zeros((topology.size, 3), np.int8), {"bake": "other"})
    with pytest.raises(world.FileError, match="another bake"):
        world.load(tmp_path)
