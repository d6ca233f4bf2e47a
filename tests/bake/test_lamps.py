"""Lamps one by one: cones, sides, shadows, and lamps that touch surfaces."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import warp
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.lamps import NEAREST, Lamps
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.sensors import SurfaceSensor
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from statistics_checks import SIGNIFICANCE, chi_square, standard_error

SAMPLES = 100_000
STANDARD_ERRORS = 3.5
ORIGIN = np.zeros(3)
SIZE = 100.0  # of the scene [m]: lamps are held within NEAREST


def made(*rows: dict) -> Lamps:
    lights = build_scenes.lamps(*rows)
    return Lamps(lights, np.arange(len(rows)), ORIGIN, SIZE)


def uniform(count: int = SAMPLES, seed: int = 1) -> tuple[np.ndarray, ...]:
    return tuple(np.random.default_rng(seed).random((4, count), np.float32))


def columns(*points) -> np.ndarray:
    return np.ascontiguousarray(np.array(points, np.float32).T)


def on_surface(lamps: Lamps, position, normal, count: int = SAMPLES) -> np.ndarray:
    """(n, 3) irradiance of each sample on a surface, without shadows."""
    at = np.repeat(columns(position), count, axis=1)
    facing = np.repeat(columns(normal), count, axis=1)
    sample = lamps.sample(at, facing, uniform(count))
    length = np.linalg.norm(sample.toward, axis=0)
    cosine = np.maximum((sample.toward * facing).sum(axis=0), 0) / np.maximum(length, 1e-30)
    return (sample.irradiance * cosine * sample.lit).T.astype(float)


def test_a_spot_is_full_inside_dark_outside_and_half_in_the_middle_of_its_blend():
    cos_half, blend = 0.6, 0.5
    spot = {"kind": LightKind.SPOT, "position": (0, 0, 2.0), "spot": (cos_half, blend), "strength": (4, 4, 4)}
    inner = cos_half + (1 - cos_half) * blend
    for cosine, share in ((1.0, 1), (inner + 1e-4, 1), ((cos_half + inner) / 2, 0.5), (cos_half - 1e-4, 0), (-0.5, 0)):
        sine = np.sqrt(1 - cosine**2)
        sample = made(spot).sample(columns((3 * sine, 0, 2 - 3 * cosine)), None, uniform(1))
        assert sample.irradiance[0, 0] == pytest.approx(share * 4 / 9, rel=2e-3, abs=1e-7), cosine


@pytest.mark.parametrize("blend", [0.0, 1.0])
def test_a_spot_without_blend_ends_sharply_and_one_with_full_blend_falls_from_its_axis(blend):
    spot = {"kind": LightKind.SPOT, "position": (0, 0, 0), "spot": (0.5, blend)}
    cosine = np.array([1.0, 0.9, 0.75, 0.501, 0.499], np.float32)
    position = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, -cosine]).astype(np.float32)
    found = made(spot).sample(position, None, uniform(5)).irradiance[0]
    t = np.clip((cosine - 0.5) / 0.5, 0, 1)
    truth = (cosine > 0.5).astype(float) if blend == 0 else t * t * (3 - 2 * t)
    assert np.allclose(found, truth, atol=1e-5)


def test_a_half_space_behind_an_area_lamp_gets_nothing():
    for kind in (LightKind.RECTANGLE, LightKind.ELLIPSE):
        lamp = made({"kind": kind, "position": (0, 0, 1.0), "size": (0.5, 0.5), "strength": (9, 9, 9)})
        for position in ((0, 0, 1.5), (3, 0, 1.0001), (0, -2, 1.2)):
            assert not on_surface(lamp, position, (0, 0, -1), 1000).any()
        assert on_surface(lamp, (0, 0, 0.5), (0, 0, 1), 1000).all()


def rectangle_irradiance(half: float, height: float) -> float:
    """On a parallel surface under the centre of a square of radiance one."""
    x = half / height
    return np.pi * 4 * 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x)) / (2 * np.pi)


@pytest.mark.parametrize("kind", [LightKind.RECTANGLE, LightKind.ELLIPSE])
def test_a_large_area_lamp_brings_the_irradiance_of_its_form_factor_and_one_per_cent_more_is_caught(kind):
    lamp = made({"kind": kind, "position": (0, 0, 1.0), "size": (2.0, 2.0), "strength": (3, 3, 3)})
    found = on_surface(lamp, (0, 0, 0), (0, 0, 1))[:, 0]
    disk = np.pi / (1 + 1.0)
    truth = 3 * (rectangle_irradiance(1.0, 1.0) if kind == LightKind.RECTANGLE else disk)
    bound = STANDARD_ERRORS * standard_error(found)
    assert abs(found.mean() - truth) < bound
    assert abs(found.mean() - 1.01 * truth) > bound


def test_an_oblong_lamp_is_wide_along_its_x_and_high_along_its_y():
    lamp = made({"kind": LightKind.RECTANGLE, "position": (0, 0, 1.0), "size": (4.0, 0.5)})
    toward = lamp.sample(np.zeros((3, SAMPLES), np.float32), None, uniform()).toward
    assert toward[0].min() == pytest.approx(-2, abs=1e-3)
    assert toward[0].max() == pytest.approx(2, abs=1e-3)
    assert toward[1].max() == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("radius", [0.0, 0.3])
def test_a_point_lamp_far_away_brings_its_intensity_over_the_squared_distance_whatever_its_radius(radius):
    lamp = made({"position": (0, 0, 30.0), "size": (radius, 0), "strength": (900, 1800, 90)})
    found = on_surface(lamp, (0, 0, 0), (0, 0, 1)).mean(axis=0)
    assert np.allclose(found, [1.0, 2.0, 0.1], rtol=3e-4)


@pytest.mark.parametrize("kind", list(LightKind)[:4])
@pytest.mark.parametrize("radius", [0.0, 0.5])
@pytest.mark.parametrize("gap", [0.0, 1e-30, 1e-6, 1e-3, 0.1])
def test_a_lamp_that_touches_the_surface_it_lights_stays_finite(kind, radius, gap):
    size = (radius, 0) if kind <= LightKind.SPOT else (radius, radius)
    spot = (0.5, 0.1) if kind == LightKind.SPOT else (-1, 0)
    lamp = made({"kind": kind, "position": (0, 0, gap), "size": size, "spot": spot})
    for normal in ((0, 0, 1), (0, 0, -1), (1, 0, 0)):
        found = on_surface(lamp, (0, 0, 0), normal, 1000)
        assert np.isfinite(found).all()
        assert found.min() >= 0
        assert found.max() <= 1.01 / NEAREST**2
    sample = lamp.sample(np.zeros((3, 1000), np.float32), None, uniform(1000))
    assert np.isfinite(sample.irradiance).all()
    assert np.isfinite(sample.toward).all()


def under_a_roof(*rows: dict) -> np.ndarray:
    """(3,) light of lamps above a roof that comes back from the ground below it."""
    black = Material("roof", Channel((0.0,) * 3), specular_level=0.0)
    gray = Material("ground", Channel((0.5,) * 3), specular_level=0.0)
    parts = [(build_scenes.plane(50.0), gray), (build_scenes.plane(50.0, 2.0), black)]
    scene = prepare(build_scenes.snapshot(parts, build_scenes.lamps(*rows)), Model())
    sensor = SurfaceSensor(columns((0, 0, -1)))
    found = gather(scene, sensor, columns((0, 0, 1.0)), np.zeros(1, np.uint32), Effort(1024, 1, 0, 1))
    return found.local[0, 0]


def test_only_a_lamp_without_shadows_shines_through_a_roof():
    lamp = {"position": (0, 0, 4.0), "strength": (10, 0, 0)}
    other = {"position": (0, 0, 4.0), "strength": (0, 10, 0)}
    assert not under_a_roof(lamp).any()
    assert under_a_roof({**lamp, "shadow": False})[0] > 0.01
    mixed = under_a_roof({**lamp, "shadow": False}, other)
    assert mixed[1] == 0
    assert mixed[0] == pytest.approx(under_a_roof({**lamp, "shadow": False})[0], rel=0.1)


def test_a_reflector_s_own_light_needs_a_free_way_only_when_it_casts_shadows():
    roof = build_scenes.plane(50.0, 2.0)
    for shadow, truth in ((True, 0.0), (False, 10 / 16)):
        lights = build_scenes.lamps(
            {"position": (0, 0, 4.0), "strength": (10, 10, 10), "reflector": True, "shadow": shadow}
        )
        black = Material("roof", Channel((0.0,) * 3), specular_level=0.0)
        scene = prepare(build_scenes.snapshot([(roof, black)], lights), Model())
        sensor = SurfaceSensor(columns((0, 0, 1)))
        found = gather(scene, sensor, columns((0, 0, 0)), np.zeros(1, np.uint32), Effort(64, 1, 0, 1)).local[0, 0]
        assert np.allclose(found, truth, rtol=1e-4)


@pytest.mark.parametrize("count", [3, 30])
def test_a_lamp_is_chosen_by_what_it_would_bring_and_its_colour_tells_which_it_was(count):
    rng = np.random.default_rng(2)
    power = rng.uniform(0.5, 4, count)
    rows = [{"position": (0, 0, 2.0), "strength": (p, p, p)} for p in power]
    lamps = made(*rows)
    at = np.zeros((3, SAMPLES), np.float32)
    sample = lamps.sample(at, None, uniform())
    assert np.allclose(sample.irradiance, power.sum() / 4, rtol=1e-3)
    if count == 3:
        distances = [{"position": (0, 0, 2.0 + k), "strength": (1, 1, 1)} for k in range(3)]
        toward = made(*distances).sample(at, None, uniform(seed=3)).toward[2]
        counts = [(np.abs(toward - 2 - k) < 1e-3).sum() for k in range(3)]
        weights = np.array([1 / 4, 1 / 9, 1 / 16])
        assert chi_square(counts, SAMPLES * weights / weights.sum()) > SIGNIFICANCE
        assert chi_square(counts, np.full(3, SAMPLES / 3)) < SIGNIFICANCE


def test_lamps_that_bring_nothing_are_never_lit():
    dark = {"kind": LightKind.RECTANGLE, "position": (0, 0, -1.0), "size": (1, 1)}
    sample = made(dark, dark).sample(np.zeros((3, 100), np.float32), None, uniform(100))
    assert not sample.lit.any()
    assert not sample.shadow.any()
    assert not sample.irradiance.any()
    flat = made({**dark, "position": (0, 0, 1.0), "size": (0, 1)})
    assert not flat.sample(np.zeros((3, 100), np.float32), None, uniform(100)).lit.any()


def test_a_scene_a_tenth_of_a_millimetre_wide_is_lit_like_the_same_scene_a_metre_wide():
    lamp = {"position": (0, 0, 0.5), "strength": (1, 1, 1)}
    scale = 1e-4
    large = build_scenes.lamps(lamp)
    small = build_scenes.lamps({**lamp, "position": (0, 0, 0.5 * scale)})
    point, up = np.zeros((3, 1), np.float32), np.array([[0], [0], [1]], np.float32)
    u = tuple(np.full(1, 0.5, np.float32) for _ in range(4))
    found = [
        Lamps(lights, np.arange(1), ORIGIN, size).sample(point, up, u).irradiance[0, 0]
        for lights, size in ((large, 1.0), (small, scale))
    ]
    assert found[1] * scale**2 == pytest.approx(found[0], rel=1e-5)


SHAPES = {
    "soft point": {"size": (0.5, 0)},
    "sphere": {"size": (0.5, 1)},
    "spot": {
        "kind": LightKind.SPOT,
        "size": (0.4, 0),
        "spot": (0.7, 0.6),
        "frame": build_scenes.sun_frame((0.3, 0.1, 1)),
    },
    "rectangle": {"kind": LightKind.RECTANGLE, "size": (1.0, 2.0), "frame": build_scenes.sun_frame((0.2, -0.3, 1))},
    "ellipse": {"kind": LightKind.ELLIPSE, "size": (2.0, 0.8), "frame": build_scenes.sun_frame((-0.4, 0.2, 1))},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_rays_that_meet_a_lamp_bring_the_light_that_it_is_sampled_for(shape):
    lamps = made(SHAPES[shape] | {"position": (0.4, 0.3, 1.6), "strength": (3, 2, 1)})
    truth = on_surface(lamps, (0, 0, 0), (0, 0, 1))
    direction = warp.cosine(*uniform(4 * SAMPLES)[:2], np.repeat(columns((0, 0, 1)), 4 * SAMPLES, axis=1))
    distance, radiance = lamps.along(0, np.zeros_like(direction), direction)
    found = np.pi * radiance.T.astype(float)
    assert ((distance > 0) == (radiance[0] > 0)).all()
    noise = np.hypot(standard_error(truth), standard_error(found))
    assert (np.abs(found.mean(axis=0) - truth.mean(axis=0)) < STANDARD_ERRORS * noise + 1e-4).all()
    assert (np.abs(1.05 * found.mean(axis=0) - truth.mean(axis=0)) > STANDARD_ERRORS * noise).all()
    assert distance[distance > 0].min() > 0.7


def test_lamps_of_no_size_and_backs_of_area_lamps_are_not_met():
    up = columns((0, 0, 1))
    point = {"position": (0, 0, 1.0)}
    back = {"kind": LightKind.RECTANGLE, "position": (0, 0, 1.0), "size": (1, 1), "frame": np.diag([1.0, -1.0, -1.0])}
    front = back | {"frame": np.eye(3)}
    for lamp, met in ((point, 0), (back, 0), (front, 1)):
        assert made(lamp).along(0, np.zeros_like(up), up)[0].tolist() == [met]
