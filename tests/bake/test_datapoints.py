"""Data points: which are inside something, where they move, and their random keys."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import datapoints
from gi_volumes.bake.datapoints import BACKFACE_LIMIT, OFFSET_STEPS, keys, place
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.snapshot import Channel, Material

GRAY = Material("gray", Channel((0.5,) * 3))


def scene_of(*parts) -> Scene:
    return prepare(build_scenes.snapshot([(triangles, GRAY) for triangles in parts]), Model())


def placed(scene: Scene, centers, size, threads: int = 1):
    centers = np.array(centers, float).reshape(-1, 3)
    sizes = np.full(len(centers), size, float)
    key = keys(np.zeros(len(centers), np.uint8), np.round(centers * 64).astype(np.int64))
    return place(scene, centers, sizes, key, threads)


def grid(low, high, count: int) -> np.ndarray:
    axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def in_box(points: np.ndarray, low, high) -> np.ndarray:
    return ((points > low) & (points < high)).all(axis=1)


def test_points_deep_in_a_closed_box_are_invalid_and_stay_where_they_are():
    scene = scene_of(build_scenes.box((-5, -5, -5), (5, 5, 5)))
    found = placed(scene, grid((-4, -4, -4), (4, 4, 4), 4), 0.5)
    assert not found.valid.any()
    assert not found.offset.any()


def test_points_in_free_space_are_untouched():
    scene = scene_of(build_scenes.box((-1, -1, -1), (1, 1, 1)), build_scenes.plane(50, -2))
    centers = grid((1.3, -3, -1.8), (6, 3, 5), 5)
    found = placed(scene, centers, 0.5)
    assert found.valid.all()
    assert not found.offset.any()
    assert np.allclose(found.position.T, centers, atol=1e-6)
    assert found.position.dtype == np.float32


def test_points_of_a_room_with_inward_faces_are_valid_and_those_outside_it_are_not():
    room = scene_of(build_scenes.box((-3, -3, -3), (3, 3, 3), inward=True))
    found = placed(room, [(0, 0, 0), (2, -2, 1), (9, 9, 9), (20, 0, 0)], 0.5)
    assert found.valid.tolist() == [True, True, True, True]
    shell = scene_of(
        build_scenes.box((-3, -3, -3), (3, 3, 3), inward=True), build_scenes.box((-3.4, -3.4, -3.4), (3.4, 3.4, 3.4))
    )
    found = placed(shell, [(0, 0, 0), (2, -2, 1), (9, 9, 9), (3.2, 0, 0)], 0.125)
    assert found.valid.tolist() == [True, True, True, False]


@pytest.mark.parametrize("size", [0.5, 2.0, 8.0])
def test_points_inside_a_thin_wall_move_out_by_at_most_half_a_voxel_into_free_space(size):
    thickness = 0.3 * size
    low, high = np.array([-20 * size, -thickness / 2, -20 * size]), np.array([20 * size, thickness / 2, 20 * size])
    scene = scene_of(build_scenes.box(low, high))
    centers = grid((-3 * size, -0.4 * thickness, -3 * size), (3 * size, 0.4 * thickness, 3 * size), 5)
    found = placed(scene, centers, size)
    assert found.valid.all()
    assert in_box(centers, low, high).all()
    moved = found.position.T.astype(float)
    assert not in_box(moved, low, high).any()
    assert np.abs(moved - centers).max() <= size / 2 * (1 + 1e-6)
    assert (np.abs(moved - centers).max(axis=1) > 0).all()
    assert np.allclose(moved, centers + found.offset * (size / OFFSET_STEPS), atol=1e-5 * size)
    sides = np.sign(moved[:, 1]) == np.sign(centers[:, 1])
    off_center = np.abs(centers[:, 1]) > 0.1 * thickness
    assert sides[off_center].mean() > 0.9


def test_offsets_stay_within_half_a_voxel_where_a_wall_is_nearly_as_thick_as_their_reach():
    size = 1.0
    for thickness in (0.88, 0.92, 0.96, 1.0):
        low, high = np.array([-20, -thickness / 2, -20]), np.array([20, thickness / 2, 20])
        centers = grid((-3, -0.1, -3), (3, 0.1, 3), 7)
        found = placed(scene_of(build_scenes.box(low, high)), centers, size)
        moved = found.position.T.astype(float)
        assert np.abs(found.offset.astype(int)).max() <= OFFSET_STEPS // 2
        assert not in_box(moved[found.valid], low, high).any()
        assert np.array_equal(found.offset.any(axis=1), found.valid)


def test_a_wall_thicker_than_the_voxel_s_reach_leaves_its_middle_invalid_and_its_skin_valid():
    size = 1.0
    scene = scene_of(build_scenes.box((-40, -1, -40), (40, 1, 40)))
    found = placed(scene, [(0, 0, 0), (3, 0.2, 1), (0, 0.7, 0), (2, -0.7, 2), (0, 1.2, 0)], size)
    assert found.valid.tolist() == [False, False, True, True, True]
    assert found.offset[4].tolist() == [0, 0, 0]
    assert found.position[1, 2] > 1
    assert found.position[1, 3] < -1


def test_points_move_to_the_nearest_side_and_never_into_a_second_wall():
    parts = [build_scenes.box((-30, -0.1, -30), (30, 0.1, 30)), build_scenes.box((-30, 0.12, -30), (30, 3, 30))]
    scene = scene_of(*parts)
    centers = grid((-5, 0.02, -5), (5, 0.09, 5), 6)
    found = placed(scene, centers, 0.5)
    moved = found.position.T[found.valid].astype(float)
    assert len(moved) > 0.8 * len(centers)
    for low, high in (((-30, -0.1, -30), (30, 0.1, 30)), ((-30, 0.12, -30), (30, 3, 30))):
        assert not in_box(moved, low, high).any()


def test_a_closed_box_of_glass_is_free_space():
    glass = Material("glass", Channel((1.0,) * 3), transmission=Channel((1.0,)))
    snapshot = build_scenes.snapshot([(build_scenes.box((-1, -1, -1), (1, 1, 1)), glass)])
    found = placed(prepare(snapshot, Model()), [(0, 0, 0), (0.4, 0.3, -0.2)], 0.5)
    assert found.valid.all()
    assert not found.offset.any()


def test_moved_points_see_fewer_backs_than_the_limit():
    scene = scene_of(build_scenes.box((-10, -0.1, -10), (10, 0.1, 10)))
    centers = grid((-4, -0.09, -4), (4, 0.09, 4), 4)
    found = placed(scene, centers, 0.5)
    back = datapoints._probe(scene, found.position.T.astype(float), np.arange(len(centers), dtype=np.uint32))[2]
    assert (back.mean(axis=1) <= BACKFACE_LIMIT).all()
    before = datapoints._probe(scene, centers, np.arange(len(centers), dtype=np.uint32))[2]
    assert (before.mean(axis=1) > BACKFACE_LIMIT).all()


def test_placing_does_not_depend_on_order_on_neighbours_or_on_threads():
    scene = scene_of(build_scenes.box((-2, -0.2, -2), (2, 0.2, 2)), build_scenes.plane(20, -1))
    centers = grid((-3, -0.5, -1.5), (3, 0.5, 1), 14)
    whole = placed(scene, centers, 0.5)
    assert 0 < (~whole.valid).sum() + np.count_nonzero(whole.offset.any(axis=1)) < len(centers)
    order = np.random.default_rng(1).permutation(len(centers))
    shuffled, some = placed(scene, centers[order], 0.5, threads=3), placed(scene, centers[order[:77]], 0.5)
    for part, rows in ((shuffled, order), (some, order[:77])):
        assert np.array_equal(part.position, whole.position[:, rows])
        assert np.array_equal(part.offset, whole.offset[rows])
        assert np.array_equal(part.valid, whole.valid[rows])


def test_no_voxels_need_no_data_points():
    found = placed(scene_of(build_scenes.plane(1.0)), np.zeros((0, 3)), 1.0)
    assert found.position.shape == (3, 0)


def test_keys_of_neighbouring_voxels_and_of_levels_differ():
    coords = grid((-20, -20, -20), (19, 19, 19), 40).round().astype(np.int64)
    key = keys(np.zeros(len(coords), np.uint8), coords).reshape(40, 40, 40)
    for axis in range(3):
        assert (np.diff(key.astype(np.int64), axis=axis) != 0).all()
    finer = keys(np.ones(len(coords), np.uint8), coords)
    assert (finer != key.ravel()).mean() > 0.9999
    collisions = key.size - len(np.unique(key))
    assert collisions <= 5  # 64,000 random 32-bit numbers collide 0.5 times; six or more once in 70,000 sets


def test_a_key_depends_on_its_own_voxel_alone():
    coords = np.random.default_rng(2).integers(-(2**40), 2**40, (1000, 3))
    level = np.random.default_rng(3).integers(0, 5, 1000).astype(np.uint8)
    key = keys(level, coords)
    order = np.random.default_rng(4).permutation(1000)[:300]
    assert np.array_equal(keys(level[order], coords[order]), key[order])
    assert key.dtype == np.uint32


def test_keys_mix_coordinates_that_mirror_or_permute_each_other():
    cases = np.array([(1, 2, 3), (3, 2, 1), (2, 1, 3), (-1, 2, 3), (1, -2, 3), (0, 0, 0), (-1, -1, -1), (1, 2, 4)])
    assert len(np.unique(keys(np.zeros(len(cases), np.uint8), cases))) == len(cases)
