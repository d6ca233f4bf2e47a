"""Whole bakes against what is known: scene to files to look-up."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import job, reference
from gi_volumes.bake.settings import Settings
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.tree import folder, world
from gi_volumes.tree.cells import OFFSET_STEPS

SHARE_BEYOND_3, FARTHEST = 0.02, 9.0
"""Student's t of 16 seeds: 0.9 % of values lie beyond 3 standard errors; of some ten thousand none beyond 9."""


ROOM = ((0.2, 0.2, 0.2), (7.0, 6.0, 5.0))


def inside(cell, low, high) -> np.ndarray:
    """(size,) whether a data point is valid and between two corners."""
    level, coords = cell.topology.voxels()
    size = 8.0 / 4.0 ** level[:, None]
    position = (coords + 0.5 + cell.offset / OFFSET_STEPS) * size
    return cell.valid & ((position > low) & (position < high)).all(axis=1)


def matte(albedo: float, emission: float = 0.0) -> Material:
    """Diffuse, without a specular layer."""
    return Material("matte", Channel((albedo,) * 3), Channel((emission,) * 3), specular_level=0.0)


ALBEDO, BOUNCES, SEEDS = 0.5, 6, 16
FURNACE = build_scenes.snapshot([(build_scenes.box(*ROOM, inward=True), matte(ALBEDO, 1.0))])
TRUTH = np.pi * sum(ALBEDO**k for k in range(BOUNCES + 1))


def test_every_data_point_of_a_baked_furnace_holds_the_analytic_value_and_no_direction(tmp_path):
    """As traced, on a tree that noise has no say in, so that values are independent and all seeds have the same."""
    values = []
    for seed in range(SEEDS):
        settings = Settings(samples=64, bounces=BOUNCES, seed=seed, error=0.0, fit=False)
        job.bake(FURNACE, tmp_path / str(seed), settings)
        cell = folder.read_cell(tmp_path / str(seed), (0, 0))
        values.append(cell.payloads["local"].values()[inside(cell, *ROOM)][:, 0])
    found = np.stack(values)
    assert found.shape[1] > 300
    truth = TRUTH * np.sqrt(4 * np.pi)
    expected = np.zeros(9)
    expected[0] = truth
    error = found.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    z = (found.mean(axis=0) - expected[:, None]) / error
    assert (np.abs(z) > 3).mean() < SHARE_BEYOND_3
    assert np.abs(z).max() < FARTHEST
    pooled = found[:, :, 0, 0].mean(axis=1)
    pooled_error = pooled.std(ddof=1) / np.sqrt(SEEDS)
    assert abs(pooled.mean() - truth) < 3 * pooled_error
    assert abs(pooled.mean() * 1.01 - truth) > 3 * pooled_error
    baked = world.load(tmp_path / "0")
    points = np.array([(3.0, 3.0, 0.2), (0.2, 3.0, 2.0), (5.0, 5.9, 4.9)])
    normals = np.array([(0, 0, 1.0), (1.0, 0, 0), (0, -1.0, 0)])
    assert np.allclose(baked.irradiance(points, normals), TRUTH, rtol=0.1)


def on_walls(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the faces of the room, and their normals."""
    rng = np.random.default_rng(9)
    low, high = np.array(ROOM)
    points, normals = rng.uniform(low, high, (count, 3)), np.zeros((count, 3))
    axis, upper, row = rng.integers(0, 3, count), rng.integers(0, 2, count), np.arange(count)
    points[row, axis], normals[row, axis] = np.where(upper, high[axis], low[axis]), np.where(upper, -1, 1)
    return points, normals


def test_the_walls_of_a_baked_furnace_are_lit_by_the_analytic_value(tmp_path):
    """Subdivided by error, and fitted: neighbours share their noise, so the seeds are what is independent."""
    points, normals = on_walls(500)
    found = []
    for seed in range(SEEDS):
        job.bake(FURNACE, tmp_path / str(seed), Settings(samples=32, bounces=BOUNCES, seed=seed, finest=0.5))
        found.append(world.load(tmp_path / str(seed)).irradiance(points, normals)[:, 0])
    found = np.array(found, float)
    error = found.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    z = (found.mean(axis=0) - TRUTH) / error
    assert (np.abs(z) > 3).mean() < SHARE_BEYOND_3
    assert np.abs(z).max() < FARTHEST
    pooled = found.mean(axis=1)
    pooled_error = pooled.std(ddof=1) / np.sqrt(SEEDS)
    assert abs(pooled.mean() - TRUTH) < 3 * pooled_error
    assert abs(pooled.mean() * 1.01 - TRUTH) > 3 * pooled_error


@pytest.mark.parametrize("height", [0.0, -0.02, -0.2, 0.3, 3.9, 4.1, 7.99])
@pytest.mark.parametrize("solid", [True, False])
def test_open_ground_sees_the_whole_sky_at_any_height(height, solid, tmp_path):
    ground = build_scenes.plane(20.0, height)
    if solid:
        ground = build_scenes.box((-20, -20, height - 1), (20, 20, height))
    scene = build_scenes.snapshot([(ground, matte(0.5))], sky=(1, 1, 1))
    job.bake(scene, tmp_path, Settings(samples=64, bounces=2))
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-16, 16, (200, 2)), np.full((200, 1), height)], axis=1)
    found = world.load(tmp_path).irradiance(points, np.tile([0, 0, 1.0], (200, 1)))
    assert found.mean() == pytest.approx(np.pi, rel=0.03)
    assert np.abs(found - np.pi).max() < 0.2 * np.pi


@pytest.mark.parametrize("height", [0.0, 0.1])
def test_a_sealed_room_under_a_bright_sky_stays_dark(height, tmp_path):
    outer = build_scenes.box((1, 1, height - 0.3), (9, 8, height + 3.3))
    inner = build_scenes.box((1.3, 1.3, height), (8.7, 7.7, height + 3), inward=True)
    scene = build_scenes.snapshot([(np.concatenate([outer, inner]), matte(0.6))], sky=(10, 10, 10))
    job.bake(scene, tmp_path, Settings(samples=64, bounces=2))
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.uniform((1.6, 1.6), (8.4, 7.4), (300, 2)), np.full((300, 1), height)], axis=1)
    found = world.load(tmp_path).irradiance(points, np.tile([0, 0, 1.0], (300, 1)))
    assert (found > 0.01 * 10 * np.pi).mean() < 0.02


def test_a_box_on_the_ground_is_lit_like_the_reference_says(tmp_path):
    parts = [(build_scenes.plane(20.0, -0.02), matte(0.5)), (build_scenes.box((2, 2, -0.5), (5, 5, 2)), matte(0.6))]
    scene = build_scenes.snapshot(parts, sky=(1, 1, 1))
    job.bake(scene, tmp_path, Settings(samples=256, bounces=4))
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-3, 10, (400, 2)), np.full((400, 1), -0.02)], axis=1)
    points = points[((points[:, :2] < 1.95) | (points[:, :2] > 5.05)).any(axis=1)]
    normals = np.tile([0, 0, 1.0], (len(points), 1))
    truth = reference.irradiance(scene, points, normals, samples=512, bounces=4, seed=1)
    found = world.load(tmp_path).irradiance(points, normals)
    assert np.sqrt(np.mean((found - truth) ** 2)) / truth.mean() < 0.08
