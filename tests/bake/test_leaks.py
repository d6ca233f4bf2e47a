"""Light stays where it is: whole bakes of rooms that no light can reach, and of the places where leaks begin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import contacts, job, receivers, reference
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.settings import Settings
from gi_volumes.benchmarks import leak_scenes
from gi_volumes.benchmarks.leak_scenes import Case, Pose
from gi_volumes.tree import world

QUICK = Settings(samples=32, bounces=3, error=0.2)
BAR = 1e-3
"""Irradiance in the dark room, in that of the lit one."""

OBLIQUE = 4
"""Times the bar that single points may reach where walls cut through voxels at an angle."""

POINTS = 3000


def baked(case: Case, folder: Path, settings: Settings = QUICK) -> world.World:
    """The bake of a case."""
    job.bake(case.scene, folder, settings)
    return world.load(folder)


def brightness(case: Case) -> float:
    """Mean irradiance of the lit side."""
    points, normals = leak_scenes.sample(case.lit, 200, 2)
    return float(reference.irradiance(case.scene, points, normals, samples=64, bounces=3, seed=3).mean())


def leak(case: Case, folder: Path, settings: Settings = QUICK) -> np.ndarray:
    """(n,) irradiance of the dark side, in that of the lit one."""
    found = baked(case, folder, settings).irradiance(*leak_scenes.sample(case.dark, POINTS, 1))
    return found.mean(axis=1) / brightness(case)


def test_a_thick_wall_keeps_a_sealed_room_dark(tmp_path):
    assert leak(leak_scenes.two_rooms(0.3), tmp_path).max() < BAR


def test_a_board_of_2_centimetres_keeps_a_sealed_room_dark(tmp_path):
    assert leak(leak_scenes.two_rooms(0.02), tmp_path).max() < BAR


def test_no_light_falls_through_a_floor(tmp_path):
    assert leak(leak_scenes.storeys(0.3, Pose(0.065)), tmp_path).max() < BAR


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [0.3, 0.1, 0.02, 0.0])
@pytest.mark.parametrize(("shift", "turn"), [(0.0, 0.0), (0.065, 0.0), (0.155, 17.0), (0.25, 45.0)])
def test_a_wall_of_any_thickness_keeps_a_sealed_room_dark_wherever_it_stands(thickness, shift, turn, tmp_path, request):
    if (thickness, turn) == (0.0, 45.0):
        reason = "one point of 3,000, half a millimetre beside a sheet, gets 0.6 % of the light"
        request.applymarker(pytest.mark.xfail(strict=True, reason=reason))
    found = leak(leak_scenes.two_rooms(thickness, Pose(shift, turn)), tmp_path)
    assert found.mean() < BAR / 10
    assert np.quantile(found, 0.99) < BAR
    assert found.max() < OBLIQUE * BAR


@pytest.mark.slow
@pytest.mark.parametrize("finest", [2.0, 8.0])
def test_coarse_voxels_alone_keep_a_sealed_room_dark(finest, tmp_path):
    settings = dataclasses.replace(QUICK, finest=finest)
    assert leak(leak_scenes.two_rooms(0.3), tmp_path, settings).max() < BAR


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [0.3, 0.02])
def test_a_lit_storey_does_not_light_the_one_below(thickness, tmp_path):
    assert leak(leak_scenes.storeys(thickness), tmp_path).max() < BAR


@pytest.mark.slow
def test_a_street_in_the_sun_does_not_light_a_cellar(tmp_path):
    assert leak(leak_scenes.cellar(), tmp_path).max() < BAR


def test_contacts_lie_close_before_walls_and_in_corners():
    room = build_scenes.snapshot([(build_scenes.box((0, 0, 0), (3, 3, 3), inward=True), leak_scenes.WHITE)])
    scene = prepare(room, Model())
    start = receivers.spread(scene, np.full(3, -1.0), np.full(3, 4.0), 0.3)
    found = contacts.find(scene, start, 1e-3)
    assert len(found.key) > len(start.key) / 2
    from_edges = np.sort(np.minimum(np.abs(found.position), np.abs(found.position - 3)), axis=1)
    assert np.allclose(from_edges[:, 0], 0, atol=1e-5)
    assert np.quantile(from_edges[:, 1], 0.5) < 3e-3
    assert from_edges[:, 2].min() < 0.03
