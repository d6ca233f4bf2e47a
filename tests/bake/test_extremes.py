"""Scenes at the edge of what light can do: everything stays finite and not negative."""

from __future__ import annotations

import itertools
import warnings

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.gather import Effort, Gathered, gather
from gi_volumes.bake.scene import Model, SunDirections, prepare
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.settings import hemisphere
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from statistics_checks import standard_error

UP = np.array([[0], [0], [1]], np.float32)
STANDARD_ERRORS = 3.5
ROUNDING = 1e-5
"""Sums of many float32 values of like size: well below the noise, well above what one loses."""


def material(albedo=0.5, emission=0.0, **rest) -> Material:
    return Material("m", Channel((albedo,) * 3), emission=Channel((emission,) * 3), specular_level=0.0, **rest)


def moved(triangles: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return triangles + np.array([x, y, z], float)


def columns(*points) -> np.ndarray:
    return np.ascontiguousarray(np.array(points, np.float32).T)


def light(snapshot, position, model=None, sensor=None, samples=128, bounces=4, seed=0) -> Gathered:
    """Gather with numpy's complaints turned into errors, and check every value."""
    model = model or Model(sky="fixed" if snapshot.sky.any() else "none")
    sensor = sensor or SurfaceSensor(np.repeat(UP, position.shape[1], axis=1))
    keys = np.arange(position.shape[1], dtype=np.uint32)
    found = gather(prepare(snapshot, model), sensor, position, keys, Effort(samples, bounces, seed, 1))
    for values in (found.local, found.sun, found.sky):
        assert np.isfinite(values).all()
        assert isinstance(sensor, HarmonicsSensor) or values.min(initial=0) >= 0
    return found


@pytest.mark.parametrize("albedo", [0.0, 0.999, 1.0])
def test_a_furnace_of_any_albedo_stays_finite_and_reaches_the_sum_of_its_bounces(albedo):
    room = build_scenes.box((0, 0, 0), (3, 3, 3), inward=True)
    snapshot = build_scenes.snapshot([(room, material(albedo, 1.0))])
    for bounces in (0, 7, 40):
        found = [light(snapshot, columns((1, 1, 0.01)), bounces=bounces, seed=s).local[0, 0, 0] for s in range(12)]
        truth = np.pi * sum(albedo**k for k in range(bounces + 1))
        found = np.array(found, float)
        assert abs(found.mean() - truth) < STANDARD_ERRORS * standard_error(found) + ROUNDING * truth


def test_emitters_of_a_millionth_and_a_million_watts_bring_the_light_of_each():
    panel = build_scenes.plane(0.5, 1.0)
    for other in (1e-6, 1e6):
        snapshot = build_scenes.snapshot([(panel, material(0.0, 1e6)), (moved(panel, 0, 0, 8), material(0.0, other))])
        alone = build_scenes.snapshot([(panel, material(0.0, 1e6))])
        both, one = (light(s, columns((0, 0, 0)), samples=2048).local[0, 0, 0] for s in (snapshot, alone))
        assert both == pytest.approx(one, rel=0.02)
    dim = build_scenes.snapshot([(panel, material(0.0, 1e-6)), (moved(panel, 900, 0, 8), material(0.0, 1e6))])
    found = np.array([light(dim, columns((0, 0, 0.9)), samples=2048, seed=s).local[0, 0, 0] for s in range(8)])
    x = 0.5 / 0.1
    factor = 4 * 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x)) / (2 * np.pi)
    above = 1 + 8 - 0.9
    far = 1e6 * above**2 / (900**2 + above**2) ** 2
    assert abs(found.mean() - np.pi * 1e-6 * factor - far) < STANDARD_ERRORS * standard_error(found) + 0.01 * far


@pytest.mark.parametrize("radiance", [1e-30, 1e-6, 1e6, 1e18])
def test_light_scales_with_its_source_over_the_range_of_float32(radiance):
    room = build_scenes.box((0, 0, 0), (3, 3, 3), inward=True)
    panel = moved(build_scenes.plane(0.5, 2.0), 1.5, 1.5, 0)
    unit, scaled = (
        light(build_scenes.snapshot([(room, material(0.7)), (panel, material(0.2, e))]), columns((1, 1, 0.01))).local
        for e in (1.0, radiance)
    )
    assert np.allclose(scaled / np.float32(radiance), unit, rtol=1e-3)


def test_a_scene_of_one_triangle_bakes_in_every_transport():
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    snapshot = build_scenes.snapshot([(triangle, material(0.8, 1.0))], sky=(1, 1, 1))
    model = Model(suns=SunDirections(columns((0, 0, 1)).T, np.zeros(1, np.float32)), sky="fixed")
    found = light(snapshot, columns((0.2, 0.2, 0.5), (0.2, 0.2, -0.5)), model, HarmonicsSensor())
    assert found.local.any()
    assert found.sky.any()
    assert found.sun[0].any()


def test_faces_without_area_and_faces_twice_change_nothing():
    room = build_scenes.box((0, 0, 0), (3, 3, 3), inward=True)
    panel = moved(build_scenes.plane(0.5, 2.0), 1.5, 1.5, 0)
    point = np.full((1, 3, 3), 1.0)
    line = np.array([[[1, 1, 1], [1, 2, 1], [1, 3, 1]]], float)
    tiny = np.array([[[1, 1, 1], [1 + 1e-20, 1, 1], [1, 1 + 1e-20, 1]]], float)
    junk = np.concatenate([point, line, tiny])
    plain = [(room, material(0.6)), (panel, material(0.0, 2.0))]
    position = columns((1, 1, 0.01), (2, 2, 1))
    clean = light(build_scenes.snapshot(plain), position).local
    for extra in ([(junk, material(0.5))], [(junk, material(0.5, 9.0))], [(room, material(0.6))]):
        dirty = light(build_scenes.snapshot(plain + extra), position).local
        assert np.allclose(dirty, clean, rtol=1e-4)


def test_planes_that_coincide_neither_leak_nor_lose_light():
    floors = [(build_scenes.plane(40.0), material(0.5)), (build_scenes.plane(40.0), material(0.5))]
    snapshot = build_scenes.snapshot(floors, sky=(1, 1, 1))
    found = light(
        snapshot, columns((0, 0, -1.0), (0, 0, 1.0)), sensor=SurfaceSensor(np.repeat(-UP, 2, axis=1)), bounces=1
    )
    assert found.sky[1, 0, 0, 0] == pytest.approx(np.pi * 0.5, rel=0.02)
    below = SurfaceSensor(np.repeat(UP, 1, axis=1))
    under = light(snapshot, columns((0, 0, -1.0)), sensor=below, bounces=1).sky[0, 0, 0, 0]
    assert under == pytest.approx(np.pi * 0.5, rel=0.02)
    sheets = [
        (build_scenes.plane(40.0, k * 1e-7), material(0.5, alpha=Channel((0.5,)), alpha_mode="blend")) for k in range(6)
    ]
    light(build_scenes.snapshot(sheets, sky=(1, 1, 1)), columns((0, 0, -1.0)))


def test_emissive_planes_that_coincide_shine_at_least_once_and_at_most_twice():
    panel = build_scenes.plane(0.5, 1.0)
    one = light(build_scenes.snapshot([(panel, material(0.0, 2.0))]), columns((0, 0, 0)), samples=1024)
    two = light(build_scenes.snapshot([(panel, material(0.0, 2.0))] * 2), columns((0, 0, 0)), samples=1024)
    assert 0.98 < two.local[0, 0, 0] / one.local[0, 0, 0] < 2.02


@pytest.mark.parametrize(("kind", "radius"), list(itertools.product(list(LightKind)[:4], (0.0, 0.2))))
@pytest.mark.parametrize("height", [0.0, 1e-7, 1e-5, -1e-3, -0.5])
def test_a_lamp_on_in_or_behind_a_wall_stays_finite(kind, radius, height):
    size = (radius, 0) if kind <= LightKind.SPOT else (max(radius, 1e-9), radius)
    lamp = {"kind": kind, "size": size, "position": (0.1, 0.2, height), "spot": (0.2, 0.5), "strength": (5, 5, 5)}
    lamp["spot"] = lamp["spot"] if kind == LightKind.SPOT else (-1, 0)
    lights = build_scenes.lamps(lamp, {**lamp, "reflector": True, "shadow": False})
    parts = [(build_scenes.plane(5.0), material(0.9)), (build_scenes.box((-1, -1, -1), (1, 1, 0)), material(0.9))]
    snapshot = build_scenes.snapshot(parts, lights)
    light(snapshot, columns((0.1, 0.2, height), (0.1, 0.2, 1e-4), (3, 3, 1)), samples=64)
    light(snapshot, columns((0.1, 0.2, height), (0.1, 0.2, 1.0)), sensor=HarmonicsSensor(), samples=64)


def test_a_lamp_inside_a_closed_wall_lights_nothing_outside_it():
    wall = build_scenes.box((-1, -1, -1), (1, 1, 1))
    parts = [(wall, material(0.9)), (build_scenes.plane(20.0, -3.0), material(0.9))]
    snapshot = build_scenes.snapshot(parts, build_scenes.lamps({"strength": (1e4,) * 3}))
    assert not light(snapshot, columns((3, 0, 0), (0, 2, -2.9)), sensor=HarmonicsSensor()).local.any()


def test_a_sun_below_the_horizon_lights_only_what_is_below():
    toward = np.array([[0, 0.6, -0.8], [1, 0, 0], [0, 0, 1]], np.float32)
    model = Model(suns=SunDirections(toward, np.array([0.1, 0.5, 0.0], np.float32)))
    snapshot = build_scenes.snapshot([(build_scenes.plane(1e3), material(0.5))])
    sensor = SurfaceSensor(np.repeat(-UP, 1, axis=1))
    above = light(snapshot, columns((0, 0, 1.0)), model, sensor, bounces=1).sun[0, :, 0, 0]
    assert above[0] == 0
    assert above[1] < 0.05
    assert above[2] == pytest.approx(0.5, rel=1e-3)
    below = light(snapshot, columns((0, 0, -1.0)), model, SurfaceSensor(UP), bounces=1).sun[0, :, 0, 0]
    assert below[0] == pytest.approx(0.4, rel=0.01)
    assert below[2] == 0


def test_suns_all_around_add_up_to_a_white_sky():
    count = 64
    model = Model(suns=SunDirections(hemisphere(count).astype(np.float32), np.zeros(count, np.float32)), sky="fixed")
    parts = [(build_scenes.plane(1e3), material(0.5)), (build_scenes.box((1, -1, 0), (2, 1, 1)), material(0.5))]
    found = light(build_scenes.snapshot(parts, sky=(1, 1, 1)), columns((0, 0, 0.5)), model, SurfaceSensor(-UP), 256, 3)
    by_suns = found.sun[0, :, 0, 0].sum() * 2 * np.pi / count
    assert by_suns == pytest.approx(found.sky[0, 0, 0, 0], rel=0.03)


def test_ninety_panes_of_glass_end_paths_and_shadow_rays_without_an_error():
    glass = material(1.0, transmission=Channel((0.97,)))
    panes = [(build_scenes.plane(50.0, 0.1 * k), glass) for k in range(1, 91)]
    lights = build_scenes.lamps({"position": (0, 0, 12.0), "strength": (100,) * 3})
    snapshot = build_scenes.snapshot([(build_scenes.plane(50.0), material(0.5)), *panes], lights, (1, 1, 1))
    model = Model(suns=SunDirections(UP.T, np.zeros(1, np.float32)), sky="fixed")
    light(snapshot, columns((0, 0, 0.05)), model, samples=32, bounces=2)


@pytest.mark.parametrize("scale", [1e-3, 1e3, 1e5])
def test_light_does_not_depend_on_the_scene_s_scale(scale):
    def room(size: float):
        walls = build_scenes.box((0, 0, 0), (3 * size, 2 * size, size), inward=True)
        panel = moved(build_scenes.plane(0.3, 0.9), 1, 1, 0) * size
        return build_scenes.snapshot([(walls, material(0.6)), (panel, material(0.0, 5.0))])

    points = np.array([(0.5, 0.5, 0.1), (2.5, 1.5, 0.5), (1, 1, 0.3)])
    plain = light(room(1.0), columns(*points), samples=512).local
    scaled = light(room(scale), columns(*(points * scale)), samples=512).local
    assert np.allclose(scaled, plain, rtol=0.02)


def test_nothing_is_said_on_the_way():
    room = build_scenes.box((0, 0, 0), (3, 3, 3), inward=True)
    lights = build_scenes.lamps({"position": (1, 1, 1)}, {"kind": LightKind.RECTANGLE, "size": (0, 0)})
    snapshot = build_scenes.snapshot([(room, material(1.0, 0.0)), (room + 1, material(0.0, 1e-6))], lights)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        light(snapshot, columns((1, 1, 1), (0, 0, 0), (2, 2, 2)), sensor=HarmonicsSensor())
