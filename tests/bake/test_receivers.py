"""Receivers: how evenly they cover surfaces, which sides they keep, and what they do not depend on."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import parallel
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.receivers import Receivers, lifted, spread
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.snapshot import Channel, Material

GRAY = Material("gray", Channel((0.5,) * 3))
LEAF = Material("leaf", Channel((0.5,) * 3), alpha=Channel((0.5,)), alpha_mode="blend")


REACH = 25.0
"""Half of the box that most tests look into; the room around it is twice as wide [m]."""


def scene_of(*parts, material: Material = GRAY) -> Scene:
    """Parts in a large room, whose walls are outside of the box that `everywhere` looks into."""
    room = build_scenes.box((-2 * REACH,) * 3, (2 * REACH,) * 3, inward=True)
    return prepare(build_scenes.snapshot([(room, GRAY), *((triangles, material) for triangles in parts)]), Model())


def everywhere(scene: Scene, spacing: float, **others) -> Receivers:
    return spread(scene, (-REACH,) * 3, (REACH,) * 3, spacing, **others)


def clutter(seed: int, count: int = 300) -> np.ndarray:
    """Random triangles over a floor, of sizes from a tenth of the spacing to many times it."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2, 0.5, (count, 1, 1))
    triangles = rng.uniform((-8, -8, 0.5), (8, 8, 6), (count, 1, 3)) + size * rng.normal(0, 1, (count, 3, 3))
    return np.concatenate([triangles, build_scenes.plane(12)])


def rows(found: Receivers) -> set[tuple]:
    return set(map(tuple, np.column_stack([found.position, found.normal, found.area, found.key]).tolist()))


def test_a_square_has_one_receiver_for_each_spacing_squared_of_both_sides():
    scene = scene_of(build_scenes.plane(4))
    found = everywhere(scene, 0.2)
    up = found.normal[:, 2] > 0
    for side in (up, ~up):
        assert abs(side.sum() - 64 / 0.04) <= 40  # one for each of the few pieces that a triangle is cut into
        assert found.area[side].sum() == pytest.approx(64, rel=1e-5)
    assert np.abs(found.normal) == pytest.approx(np.broadcast_to([0, 0, 1.0], found.normal.shape))
    assert (np.abs(found.position) <= 4).all()
    assert not found.position[:, 2].any()
    assert len(np.unique(found.key)) == len(found.key)


def test_receivers_are_spread_more_evenly_than_random_points():
    found = everywhere(scene_of(build_scenes.plane(4)), 0.1)
    some = found.position[found.normal[:, 2] > 0]
    count = np.histogram2d(some[:, 0], some[:, 1], bins=16, range=[[-4, 4], [-4, 4]])[0]
    assert count.mean() == pytest.approx(25, rel=0.02)
    assert count.var() < 0.25 * count.mean()  # Poisson's variance is the mean


def test_small_triangles_are_covered_by_their_area():
    rng = np.random.default_rng(3)
    corner = np.concatenate([rng.uniform(-20, 20, (20_000, 1, 2)), np.zeros((20_000, 1, 1))], axis=2)
    size = rng.uniform(0.02, 0.3, (20_000, 1, 1))
    scene = scene_of(corner + size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    found = everywhere(scene, 0.5)
    area = (size**2).sum() / 2
    share = found.area.sum() / (2 * area)
    assert abs(share - 1) < 6 * np.sqrt(0.25 / (2 * area))  # each side of a triangle is drawn or not
    large = size[:, 0, 0] > 0.15
    expected = (size[large] ** 2).sum() / (size**2).sum()
    distance = np.abs(found.position[:, None, :2] - corner[None, large, 0, :2])
    inside = ((distance < 0.3).all(axis=2)).any(axis=1).mean()
    assert inside >= expected - 0.1


def test_points_of_a_triangle_lie_on_it():
    triangle = np.array([[[0.3, -1, 2], [5, 1, -2], [1, 6, 3.5]]])
    found = everywhere(scene_of(triangle), 0.3)
    cross = np.cross(triangle[0, 1] - triangle[0, 0], triangle[0, 2] - triangle[0, 0])
    unit = cross / np.linalg.norm(cross)
    assert np.abs((found.position - triangle[0, 0]) @ unit).max() < 1e-6
    assert np.abs(np.abs(found.normal @ unit) - 1).max() < 1e-6
    edges = np.roll(triangle[0], -1, axis=0) - triangle[0]
    inward = np.cross(unit, edges)
    assert min(((found.position - a) @ n).min() for a, n in zip(triangle[0], inward, strict=True)) > -1e-6


@pytest.mark.parametrize("seed", [0, 1])
def test_boxes_share_the_receivers_of_the_box_around_them(seed):
    scene = scene_of(clutter(seed))
    low, high = np.array([-13.0, -13, -4]), np.array([13.0, 13, 9])
    whole = spread(scene, low, high, 0.3)
    cut = np.random.default_rng(seed).uniform(-3, 3, 3)
    parts = []
    for octant in range(8):
        upper = np.array([octant & 1, octant >> 1 & 1, octant >> 2 & 1], bool)
        parts.append(spread(scene, np.where(upper, cut, low), np.where(upper, high, cut), 0.3))
    assert sum(len(part.key) for part in parts) == len(whole.key) > 5000
    assert set().union(*map(rows, parts)) == rows(whole)
    inside = ((whole.position >= low) & (whole.position < np.where([1, 0, 0], cut, high))).all(axis=1)
    half = spread(scene, low, np.where([1, 0, 0], cut, high), 0.3)
    assert np.array_equal(half.position, whole.position[inside])  # the same order, too


def test_receivers_do_not_depend_on_threads_or_on_tiles(monkeypatch):
    scene = scene_of(clutter(5))
    once = everywhere(scene, 0.2, threads=1)
    again = everywhere(scene, 0.2, threads=4)
    monkeypatch.setattr(parallel, "LANES", 4096)
    split = everywhere(scene, 0.2, threads=2)
    for other in (again, split):
        for name in ("position", "normal", "area", "key"):
            assert np.array_equal(getattr(once, name), getattr(other, name))


def test_a_wanted_region_is_all_that_is_traced():
    scene = scene_of(clutter(2))
    whole, rays = everywhere(scene, 0.3), scene.tracer.rays
    some = everywhere(scene, 0.3, wanted=lambda position: position[:, 0] > 7)
    assert np.array_equal(some.key, whole.take(whole.position[:, 0] > 7).key)
    assert scene.tracer.rays - rays < 0.3 * rays


def test_only_outer_sides_of_a_solid_have_receivers():
    found = everywhere(scene_of(build_scenes.box((-1, -1, -1), (1, 1, 1))), 0.1)
    assert (np.einsum("nc,nc->n", found.position, found.normal) > 0).all()
    assert found.area.sum() == pytest.approx(24, rel=1e-5)


def test_both_sides_of_leaves_have_receivers():
    found = everywhere(scene_of(build_scenes.plane(1), material=LEAF), 0.1)
    assert found.area.sum() == pytest.approx(8, rel=1e-5)


def test_a_ground_has_no_receivers_below_but_a_bridge_has():
    ground, bridge = build_scenes.plane(6), build_scenes.plane(1, 2.0)
    scene = prepare(build_scenes.snapshot([(ground, GRAY), (bridge, GRAY)]), Model())
    found = everywhere(scene, 0.2)
    below = found.normal[:, 2] < 0
    assert (found.position[below, 2] == 2).all()
    assert found.area[below].sum() == pytest.approx(4, rel=1e-5)
    assert found.area[~below].sum() == pytest.approx(144 + 4, abs=0.2)  # a few see much of the back of the bridge


def test_a_block_that_floats_has_receivers_on_all_of_its_sides():
    """Also where it leans down and sees nothing: only backs that face down are undersides."""
    turn, block = np.radians(3.0), build_scenes.box((-1, -1, -1), (1, 1, 1))
    tilt = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    found = everywhere(prepare(build_scenes.snapshot([(block @ tilt, GRAY)]), Model()), 0.1)
    assert found.area.sum() == pytest.approx(24, rel=1e-5)
    assert found.front.all()


def test_glass_before_a_wall_squeezes_nothing():
    glass = Material("glass", Channel((1.0,) * 3), transmission=Channel((1.0,)))
    room = build_scenes.box((-2 * REACH,) * 3, (2 * REACH,) * 3, inward=True)
    parts = [(room, GRAY), (build_scenes.plane(1), GRAY), (build_scenes.plane(1, 0.0005), glass)]
    found = everywhere(prepare(build_scenes.snapshot(parts), Model()), 0.1)
    assert found.area.sum() == pytest.approx(12, rel=1e-5)  # all but the glass that faces the wall


def test_faces_that_touch_have_no_receivers_between_them():
    wall, chest = build_scenes.box((0, -2, 0), (1, 2, 3)), build_scenes.box((1, -1, 0), (2, 1, 1))
    found = everywhere(scene_of(wall, chest), 0.05)
    between = (np.abs(found.position[:, 0] - 1) < 1e-6) & (np.abs(found.position[:, 1]) < 1)
    assert not (between & (found.position[:, 2] < 1)).any()
    assert (between & (found.position[:, 2] > 1)).any()
    sheets = everywhere(scene_of(build_scenes.plane(1), build_scenes.plane(1, 0.003)), 0.1)
    assert not ((sheets.normal[:, 2] > 0) & (sheets.position[:, 2] < 0.001)).any()


def test_copies_and_triangles_without_area_count_once_or_not_at_all():
    square = build_scenes.plane(1)
    mirrored = square[:, ::-1].copy()
    point, line = np.ones((1, 3, 3)), np.array([[[0, 0, 1], [1, 1, 1], [2.0, 2, 1]]])
    shaken = square + np.random.default_rng(0).uniform(0, 1e-6, square.shape) + 1e-5
    found = everywhere(scene_of(square + 1e-5, mirrored + 1e-5, point, line, shaken), 0.1)
    assert found.area.sum() == pytest.approx(8, rel=1e-4)
    assert np.isfinite(found.position).all()
    assert np.linalg.norm(found.normal, axis=1) == pytest.approx(1, abs=1e-6)


def test_tiny_triangles_that_share_a_voxel_are_no_copies():
    rng = np.random.default_rng(1)
    corner = np.concatenate([rng.uniform(-1, 1, (100_000, 1, 2)), np.zeros((100_000, 1, 1))], axis=2)
    found = everywhere(scene_of(corner + 0.002 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])), 0.05)
    area = 2 * 100_000 * 0.002**2 / 2
    assert found.area.sum() == pytest.approx(area, abs=6 * np.sqrt(area * 0.05**2))


def test_a_large_ground_costs_what_lies_in_the_box():
    scene = scene_of(build_scenes.plane(5000))
    found = spread(scene, (100, 100, -1), (104, 104, 1), 0.1, threads=1)
    assert abs((found.normal[:, 2] > 0).sum() - 1600) < 60
    assert scene.tracer.rays < 2e5


def test_rays_start_off_the_surface_on_the_side_that_is_meant():
    scene = scene_of(build_scenes.plane(4, 3.0))
    found = everywhere(scene, 0.5)
    start = lifted(scene, found)
    assert start.dtype == np.float32
    assert ((start[2] - 3) * found.normal[:, 2] > 0).all()
    assert np.abs(start[2] - 3).max() < 1e-3


def test_no_surface_in_the_box_has_no_receivers():
    scene = scene_of(build_scenes.plane(1))
    found = spread(scene, (5, 5, 5), (6, 6, 6), 0.1)
    assert found.position.shape == (0, 3)
    assert found.normal.shape == (0, 3)


@pytest.mark.parametrize("spacing", [0.0, -1.0, float("nan")])
def test_a_spacing_that_is_not_positive_is_refused(spacing):
    with pytest.raises(ValueError, match="spacing"):
        everywhere(scene_of(build_scenes.plane(1)), spacing)


def test_spreading_can_be_stopped():
    with pytest.raises(CancelledError):
        everywhere(scene_of(clutter(1)), 0.2, progress=lambda done: False)
