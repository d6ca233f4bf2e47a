"""The benchmark that judges bakes finds planted errors, takes its own noise out, and finds none where there is none."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import job
from gi_volumes.bake.rays import Tracer
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.settings import Settings
from gi_volumes.bake.snapshot import Camera, Channel, Material
from gi_volumes.benchmarks import dense_grid, errors, receivers, reconstruction
from gi_volumes.tree.payload import GOALS

ROOM = ((0.1, 0.1, 0.1), (6.9, 5.9, 4.9))
"""No wall on a border of voxels, where data points come to lie in it."""

PLAN = reconstruction.Plan(points=300, samples=512, data_samples=512)
NOTHING = 0.015
"""Errors of a constant field, relative to it: what is left of its noise."""


def matte(albedo: float, emission: float = 0.0) -> Material:
    """Diffuse, without a specular layer."""
    return Material("matte", Channel((albedo,) * 3), Channel((emission,) * 3), specular_level=0.0)


def noisy(truth: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """(2, n) two independent halves."""
    return truth * (1 + noise * np.random.default_rng(seed).standard_normal((2, len(truth))))


@pytest.fixture(scope="module")
def furnace(tmp_path_factory) -> reconstruction.Bake:
    """A baked room whose walls shine like the sky: the same light at every point in every direction, outside too."""
    room = build_scenes.snapshot([(build_scenes.box(*ROOM, inward=True), matte(0.0, 1.0))], sky=(1, 1, 1))
    folder = tmp_path_factory.mktemp("furnace")
    job.bake(room, folder, Settings(samples=256, bounces=0, error=0.0, fit=False))
    return reconstruction.open_bake(folder, folder / "cache")


@pytest.mark.parametrize("planted", [0.0, 0.05, 0.3])
def test_a_planted_error_is_recovered_and_the_noise_of_the_reference_is_not(planted):
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 1.5, 200_000)
    values = truth + planted * rng.standard_normal(len(truth))
    found = errors.compare(values, noisy(truth, 0.2, 2))
    assert abs(found["rmse"] ** 2 - planted**2) < 4 * 2 * found["rmse_error"] * abs(found["rmse"])
    assert found["rmse"] == pytest.approx(planted, abs=0.02 if planted == 0 else 0.1 * planted)
    assert errors.root(errors.mean_product(*[values - noisy(truth, 0.2, 2)[0]] * 2)[0]) > 0.19
    assert found["noise"] == pytest.approx(0.2 * np.sqrt(np.mean(truth**2) / 2), rel=0.05)
    assert abs(found["bias"]) < 0.02


def test_a_planted_bias_and_planted_leaks_are_counted():
    truth = np.full(1000, 1.0)
    values = truth * 1.1
    values[:30], values[30:50] = 6.0, 0.1
    found = errors.compare(values, noisy(truth, 0.02, 3))
    assert found["bright"] == 0.03
    assert found["dark"] == 0.02
    assert found["bias"] == pytest.approx((values - 1).mean(), abs=0.01)
    assert found["p50"] == pytest.approx(0.1, abs=0.01)
    assert errors.compare(truth, noisy(truth, 0.25, 4))["bright"] == 0


def test_no_light_gives_no_figures():
    assert errors.compare(np.zeros(5), np.zeros((2, 5))) == {}


def test_a_constant_field_has_no_error_at_any_stage_nor_in_a_grid(furnace):
    found = reconstruction.measure(furnace, PLAN)
    row = found["errors"]["all"]
    for stage in ("angular", "spatial", "ideal"):
        assert abs(row[stage]) < NOTHING, (stage, row)
    assert row["compression"] < max(goal.tolerance for goal in GOALS.values())
    assert abs(row["rmse"]) < 0.08
    assert row["rmse"] == pytest.approx(row["transport"], rel=0.3)
    assert row["bright"] == row["dark"] == 0
    assert found["grid"]["grid"]["all"]["rmse"] < 0.08
    assert reconstruction.table(found).count("\n") > 5


def test_an_error_planted_in_what_is_stored_appears_there_alone(furnace, monkeypatch):
    whole = furnace.world.irradiance
    monkeypatch.setattr(furnace.world, "irradiance", lambda *args, **words: 1.25 * whole(*args, **words))
    row = reconstruction.measure(furnace, dataclasses.replace(PLAN, grid=False))["errors"]["all"]
    assert row["compression"] == pytest.approx(0.25, rel=0.05)
    assert row["rmse"] == pytest.approx(0.25, rel=0.2)
    assert row["bias"] == pytest.approx(0.25, rel=0.1)
    assert abs(row["spatial"]) < NOTHING


def test_points_lie_on_both_sides_of_a_sheet_and_not_behind_a_wall_or_far_away():
    sheet = build_scenes.quad((2, 2, 3), (4, 2, 3), (4, 4, 3), (2, 4, 3))
    walls = build_scenes.box(*ROOM, inward=True)
    ground, cellar = build_scenes.plane(100.0), build_scenes.plane(100.0, -3.0)
    scene = prepare(build_scenes.snapshot([(np.concatenate([sheet, walls, ground, cellar]), matte(0.5))]), Model())
    found = receivers.spread(scene, 1000, near=9.0)
    again = receivers.spread(scene, 1000, near=9.0)
    np.testing.assert_array_equal(found.point, again.point)
    on_sheet = np.abs(found.point[:, 2] - 3) < 1e-6
    on_sheet &= (np.abs(found.point[:, :2] - 3) < 1).all(axis=1)
    up = found.normal[:, 2] > 0
    assert 0.3 < up[on_sheet].mean() < 0.7
    assert up[np.abs(found.point[:, 2]) < 0.1].all()
    middle = np.median(scene.soup.corners.mean(axis=1), axis=0)
    assert np.linalg.norm(found.point - middle, axis=1).max() < 10.0


def test_a_camera_s_view_gives_points_that_face_it():
    scene_snapshot = build_scenes.snapshot([(build_scenes.box(*ROOM, inward=True), matte(0.5))])
    camera = Camera("one", (1, 0, 0, 3.0, 0, 1, 0, 3.0, 0, 0, 1, 4.0), 1.0)
    scene_snapshot = dataclasses.replace(scene_snapshot, cameras=(camera,))
    scene = prepare(scene_snapshot, Model())
    found = receivers.seen(scene, scene_snapshot, 400)
    assert 300 < len(found.point) < 500
    assert (np.einsum("nc,nc->n", found.normal, np.array([3.0, 3.0, 4.0]) - found.point) > 0).all()
    assert not len(receivers.seen(scene, dataclasses.replace(scene_snapshot, cameras=()), 400).point)


def test_a_grid_fits_its_probes_and_reproduces_a_linear_field_around_a_wall():
    parts = np.concatenate([build_scenes.box(*ROOM, inward=True), build_scenes.box((3, 3, 1), (4, 4, 2))])
    scene = prepare(build_scenes.snapshot([(parts, matte(0.5))]), Model())
    grid = dense_grid.build(scene, 2000)
    assert 1000 < len(grid.valid) <= 2000
    assert 0 < (~grid.valid).sum() < 30
    rng = np.random.default_rng(0)
    points = rng.uniform(grid.low, grid.low + grid.spacing * (grid.shape - 1), (500, 3))
    row, weight = grid.weigh(points, None)
    np.testing.assert_allclose(weight.sum(axis=1), 1)
    assert grid.valid[row[weight > 0]].all()
    whole = (weight > 0).sum(axis=1) == 8
    linear = np.einsum("nk,nkc->nc", weight, grid.position(row.ravel()).reshape(*row.shape, 3))
    np.testing.assert_allclose(linear[whole], points[whole], atol=1e-6)
    normals = np.tile((0.0, 0.0, 1.0), (500, 1))
    row, weight = grid.weigh(points, normals)
    above = np.einsum("nk,nk->n", weight, grid.position(row.ravel()).reshape(*row.shape, 3)[..., 2])
    assert (above[whole] > points[whole, 2] - 1e-6).all()


def test_judging_needs_no_more_than_triangles():
    box = build_scenes.box(*ROOM, inward=True)
    tracer = Tracer(box.astype(np.float32), np.zeros(len(box), bool))
    point, normal = np.array([(3.0, 3.0, ROOM[0][2] + receivers.LIFT)]), np.array([(0.0, 0.0, 1.0)])
    assert receivers.have_space(tracer, point, normal).all()
    assert not receivers.have_space(tracer, point - 2 * receivers.LIFT * normal, -normal).any()
