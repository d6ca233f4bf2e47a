"""Light whose value is known: furnaces, open and half-open skies, planes lit by suns and lamps."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.scene import Model, SunDirections, prepare
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from gi_volumes.tree import harmonics

SEEDS = 24
STANDARD_ERRORS = 3.0
"""Bound of each test; a correct program exceeds it once in 370 trials, and the seeds are fixed."""


def material(albedo=0.5, emission=0.0) -> Material:
    """Diffuse, without a specular layer."""
    return Material("plain", base_color=Channel((albedo,) * 3), emission=Channel((emission,) * 3), specular_level=0.0)


def columns(*points) -> np.ndarray:
    """(3, n) float32 points."""
    return np.ascontiguousarray(np.array(points, np.float32).T)


def repeats(scene, sensor, position, samples, bounces, name):
    """(seeds, points, ...) independent estimates of one transport."""
    keys = np.arange(position.shape[1], dtype=np.uint32)
    efforts = [Effort(samples, bounces, seed) for seed in range(SEEDS)]
    return np.stack([getattr(gather(scene, sensor, position, keys, e), name) for e in efforts])


def z_scores(estimates: np.ndarray, truth) -> np.ndarray:
    """How many standard errors the mean over seeds is from the truth, per value."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    return (estimates.mean(axis=0) - truth) / np.maximum(error, 1e-6 * np.abs(truth) + 1e-12)


def irradiance(coefficients, normals):
    """(..., n) irradiance of harmonics (..., 9) without the clamp."""
    return coefficients @ harmonics.basis(np.asarray(normals, float)).T


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
def test_every_data_point_in_a_furnace_gets_the_analytic_value_and_a_planted_percent_is_caught(albedo):
    emission, bounces = 1.3, 6
    room = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    scene = prepare(build_scenes.snapshot([(room, material(albedo, emission))]), Model())
    rng = np.random.default_rng(1)
    position = (rng.uniform(0.1, 0.9, (20, 3)) * (4, 3, 2.5)).T.astype(np.float32)
    found = repeats(scene, HarmonicsSensor(), np.ascontiguousarray(position), 256, bounces, "local")[..., 0, 1]
    truth = np.pi * emission * sum(albedo**k for k in range(bounces + 1)) * np.sqrt(4 * np.pi)
    z = z_scores(found, truth)
    assert np.sqrt(np.mean(z**2)) < 1.6
    pooled = found.mean(axis=1)
    assert abs(z_scores(pooled, truth)) < STANDARD_ERRORS
    assert abs(z_scores(pooled * 1.01, truth)) > STANDARD_ERRORS


def test_a_furnace_without_end_converges_to_emission_over_one_minus_albedo():
    room = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    scene = prepare(build_scenes.snapshot([(room, material(0.6, 1.0))]), Model())
    found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((1, 1, 1e-4)), 512, 64, "local")[:, 0, 0, 0]
    assert abs(z_scores(found, np.pi / 0.4)) < STANDARD_ERRORS
    assert found.std() / found.mean() < 0.05


def test_an_open_sky_gives_pi_times_its_radiance_in_every_direction():
    speck = build_scenes.plane(1e-3, -50.0)
    scene = prepare(build_scenes.snapshot([(speck, material())], sky=(0.2, 0.5, 2.0)), Model(sky="fixed"))
    found = repeats(scene, HarmonicsSensor(), columns((0, 0, 0)), 256, 0, "sky")[:, 0, 0]
    values = irradiance(found.mean(axis=0).T, [(0, 0, 1), (0, 0, -1), (0.6, 0.8, 0)])
    assert np.allclose(values, np.pi * np.array([0.2, 0.5, 2.0])[:, None], rtol=0.02)
    assert abs(z_scores(found[:, 0, 0], np.pi * 0.2 * np.sqrt(4 * np.pi))) < STANDARD_ERRORS


def test_a_half_space_of_sky_gives_pi_on_the_ground_and_the_half_sphere_s_harmonics_above_it():
    ground = build_scenes.plane(1e4)
    scene = prepare(build_scenes.snapshot([(ground, material(0.0))], sky=(1, 1, 1)), Model(sky="fixed"))
    flat = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0.3, 0.2, 1e-2)), 64, 2, "sky")
    assert np.allclose(flat, np.pi, rtol=1e-5)
    found = repeats(scene, HarmonicsSensor(), columns((0, 0, 1.0)), 256, 2, "sky")[:, 0, 0, :, 0]
    a, b = np.sqrt(1 / (4 * np.pi)), np.sqrt(3 / (4 * np.pi))
    truth = np.zeros(9)
    truth[0], truth[2] = np.pi * 2 * np.pi * a, 2 * np.pi / 3 * np.pi * b
    z = z_scores(found, truth)
    assert np.abs(z).max() < 4.0
    assert abs(z_scores(found[:, 0] * 1.01, truth[0])) > STANDARD_ERRORS


def test_the_floor_of_a_slit_sees_the_sine_of_its_half_opening():
    half, depth, length = 0.5, 2.0, 4000.0
    walls = [
        build_scenes.plane(length),
        build_scenes.quad((-half, -length, 0), (-half, length, 0), (-half, length, depth), (-half, -length, depth)),
        build_scenes.quad((half, -length, 0), (half, -length, depth), (half, length, depth), (half, length, 0)),
    ]
    scene = prepare(build_scenes.snapshot([(np.concatenate(walls), material(0.0))], sky=(1, 1, 1)), Model(sky="fixed"))
    found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 1e-2)), 4096, 0, "sky")[:, 0, 0, 0, 0]
    truth = np.pi * half / np.hypot(half, depth - 1e-2)
    assert abs(z_scores(found, truth)) < STANDARD_ERRORS
    assert abs(z_scores(found * 1.01, truth)) > STANDARD_ERRORS


@pytest.mark.parametrize("toward", [(0, 0, 1), (0.6, 0, 0.8)])
def test_the_sun_s_bounce_off_an_infinite_plane_is_albedo_times_cosine(toward):
    suns = SunDirections(np.array([toward], np.float32), np.zeros(1, np.float32))
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(1e4), material(0.4))]), Model(suns=suns))
    below = repeats(scene, SurfaceSensor(columns((0, 0, -1))), columns((0, 0, 1.0)), 64, 3, "sun")
    assert np.allclose(below, 0.4 * toward[2], rtol=1e-4)
    around = repeats(scene, HarmonicsSensor(), columns((0, 0, 1.0)), 256, 3, "sun")[:, 0, 0, :, 0].mean(axis=0)
    radiance = 0.4 * toward[2] / np.pi
    assert around[0] == pytest.approx(np.pi * radiance * 2 * np.pi * np.sqrt(1 / (4 * np.pi)), rel=0.01)
    assert around[2] == pytest.approx(-2 * np.pi / 3 * radiance * np.pi * np.sqrt(3 / (4 * np.pi)), rel=0.01)


def test_the_sun_s_own_light_is_not_in_the_indirect_transport():
    suns = SunDirections(np.array([(0, 0, 1)], np.float32), np.zeros(1, np.float32))
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(1e3), material(0.5))]), Model(suns=suns))
    found = gather(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 1e-2)), np.zeros(1, np.uint32), Effort(64))
    assert np.all(found.sun == 0)


def bounce_off_plane(lamp_height, point_height, albedo, cone=lambda cosine: 1.0):
    """Irradiance from below of a plane lit by a lamp of 1 W/sr above the same spot, by quadrature."""
    radius = np.linspace(0, 200, 2_000_001)
    lamp = lamp_height / (radius**2 + lamp_height**2) ** 1.5
    cosine = lamp_height / np.sqrt(radius**2 + lamp_height**2)
    seen = point_height**2 / (radius**2 + point_height**2) ** 2
    return np.trapezoid(albedo / np.pi * lamp * cone(cosine) * seen * 2 * np.pi * radius, radius)


if not hasattr(np, "trapezoid"):  # numpy 1.26
    np.trapezoid = np.trapz  # noqa: NPY201


def lamp_bounce(lamp: dict, reflector=False):
    """(seeds,) irradiance at (0, 0, 1) looking down at a plane of albedo 0.5 that a lamp lights."""
    ground = build_scenes.plane(200)
    lights = build_scenes.lamps({**lamp, "reflector": reflector})
    scene = prepare(build_scenes.snapshot([(ground, material(0.5))], lights), Model())
    return repeats(scene, SurfaceSensor(columns((0, 0, -1))), columns((0, 0, 1.0)), 1024, 1, "local")[:, 0, 0, 0]


def test_a_point_lamp_s_bounce_off_a_plane_matches_quadrature():
    found = lamp_bounce({"position": (0, 0, 2.0), "strength": (1, 1, 1)})
    truth = bounce_off_plane(2.0, 1.0, 0.5)
    assert abs(z_scores(found, truth)) < STANDARD_ERRORS
    assert abs(z_scores(found * 1.01, truth)) > STANDARD_ERRORS


def test_a_spot_s_bounce_off_a_plane_matches_quadrature():
    cos_half, blend = np.cos(np.radians(35)), 0.4

    def cone(cosine):
        t = np.clip((cosine - cos_half) / ((1 - cos_half) * blend), 0, 1)
        return t * t * (3 - 2 * t)

    lamp = {"kind": LightKind.SPOT, "position": (0, 0, 2.0), "spot": (cos_half, blend)}
    found = lamp_bounce(lamp)
    assert abs(z_scores(found, bounce_off_plane(2.0, 1.0, 0.5, cone))) < STANDARD_ERRORS


@pytest.mark.parametrize(("kind", "area"), [(LightKind.RECTANGLE, 0.02), (LightKind.ELLIPSE, 0.02 * np.pi / 4)])
def test_a_small_area_lamp_shines_like_a_point_with_a_cosine(kind, area):
    lamp = {"kind": kind, "position": (0, 0, 2.0), "size": (0.2, 0.1), "strength": (1 / area,) * 3}
    truth = bounce_off_plane(2.0, 1.0, 0.5, lambda cosine: cosine)
    assert lamp_bounce(lamp).mean() == pytest.approx(truth, rel=0.01)


def test_a_reflector_s_direct_light_is_local_light_and_another_lamp_s_is_not():
    speck = build_scenes.plane(1e-3, -50.0)
    lamp = {"position": (0, 0, 3.0), "strength": (9, 9, 9)}
    for reflector, truth in ((True, 1.0), (False, 0.0)):
        lights = build_scenes.lamps({**lamp, "reflector": reflector})
        scene = prepare(build_scenes.snapshot([(speck, material())], lights), Model())
        sensor = SurfaceSensor(columns((0, 0, 1)))
        found = gather(scene, sensor, columns((0, 0, 0)), np.zeros(1, np.uint32), Effort(64)).local[0, 0, 0]
        assert found == pytest.approx(truth, rel=1e-4)


@pytest.mark.parametrize(("sphere", "power"), [(0, lambda d, r: d * d + r * r), (1, lambda d, r: d * d)])
def test_a_lamp_with_a_radius_falls_off_softly_or_like_a_sphere(sphere, power):
    distance, radius = 0.5, 0.2
    lamp = {"position": (0, 0, distance), "size": (radius, sphere), "reflector": True}
    speck = build_scenes.plane(1e-3, -50.0)
    scene = prepare(build_scenes.snapshot([(speck, material())], build_scenes.lamps(lamp)), Model())
    found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 0)), 1024, 0, "local")[:, 0, 0, 0]
    truth = 1 / power(distance, radius)
    assert abs(z_scores(found, truth)) < STANDARD_ERRORS
    assert abs(z_scores(found * 1.01, truth)) > STANDARD_ERRORS


def test_many_lamps_drawn_by_power_bring_the_same_light_as_weighing_them_all():
    rng = np.random.default_rng(3)
    rows = [
        {"position": (*rng.uniform(-3, 3, 2), rng.uniform(1, 4)), "strength": rng.uniform(0, 2, 3)} for _ in range(40)
    ]
    ground = build_scenes.plane(50)
    each = []
    for first in range(0, 40, 8):
        lights = build_scenes.lamps(*rows[first : first + 8])
        scene = prepare(build_scenes.snapshot([(ground, material(0.5))], lights), Model())
        each.append(repeats(scene, SurfaceSensor(columns((0, 0, -1))), columns((0, 0, 1.0)), 512, 1, "local"))
    scene = prepare(build_scenes.snapshot([(ground, material(0.5))], build_scenes.lamps(*rows)), Model())
    together = repeats(scene, SurfaceSensor(columns((0, 0, -1))), columns((0, 0, 1.0)), 512, 1, "local")[:, 0, 0]
    apart = sum(each)[:, 0, 0]
    error = np.sqrt((together.var(axis=0, ddof=1) + apart.var(axis=0, ddof=1)) / SEEDS)
    assert (np.abs(together.mean(axis=0) - apart.mean(axis=0)) < 3.5 * error).all()


def test_an_emissive_panel_s_direct_light_matches_its_form_factor():
    side, height = 0.5, 1.5
    panel = build_scenes.plane(side, height)[:, ::-1]
    scene = prepare(build_scenes.snapshot([(panel, material(0.0, 2.0))]), Model())
    found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 0)), 256, 2, "local")[:, 0, 0, 0]
    x = side / height
    quarter = 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x)) / (2 * np.pi)
    truth = np.pi * 2.0 * 4 * quarter
    assert abs(z_scores(found, truth)) < STANDARD_ERRORS
    assert abs(z_scores(found * 1.01, truth)) > STANDARD_ERRORS


def test_a_sky_with_one_bright_texel_brings_that_texel_s_energy():
    sky = np.full((64, 128, 3), 0.1, np.float32)
    sky[50, 30] = 5000.0
    ground = build_scenes.plane(1e4)
    scene = prepare(build_scenes.snapshot([(ground, material(0.0))], sky=sky), Model(sky="fixed"))
    assert scene.sky.uneven
    found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 1e-2)), 256, 1, "sky")[:, 0, 0, 0, 0]
    low, high = (np.pi * (row / 64 - 0.5) for row in (50, 51))
    texel = 2 * np.pi / 128 * (np.sin(high) ** 2 - np.sin(low) ** 2) / 2
    truth = 0.1 * np.pi + 4999.9 * texel
    assert found.mean() == pytest.approx(truth, rel=0.005)
    assert abs(z_scores(found, truth)) < STANDARD_ERRORS


def test_the_responses_to_the_sky_s_harmonics_add_up_to_the_response_to_the_sky():
    ground = build_scenes.plane(1e4)
    parts = [(ground, material(0.6)), (build_scenes.box((1, -1, 0), (2, 1, 2)), material(0.3))]
    radiance = 0.7
    fixed = prepare(build_scenes.snapshot(parts, sky=(radiance,) * 3), Model(sky="fixed"))
    basis = prepare(build_scenes.snapshot(parts), Model(sky="harmonics"))
    position, key, effort = columns((0, 0, 0.5)), np.zeros(1, np.uint32), Effort(256, 4)
    one = gather(fixed, HarmonicsSensor(), position, key, effort).sky[0, 0]
    nine = gather(basis, HarmonicsSensor(), position, key, effort).sky[0]
    assert nine.shape == (9, 9, 3)
    assert np.allclose(nine[0] * radiance * np.sqrt(4 * np.pi), one, rtol=1e-4, atol=1e-5)


def test_glass_and_cut_out_surfaces_let_the_sky_through_by_their_share():
    pane = build_scenes.plane(1e3, 2.0)
    ground = (build_scenes.plane(1e3), material(0.0))
    black = Channel((0.0, 0.0, 0.0))
    cases = {
        "blend": (Material("b", black, alpha=Channel((0.3,)), alpha_mode="blend", specular_level=0.0), 0.7),
        "cut": (Material("c", black, alpha=Channel((0.4,)), alpha_mode="mask", specular_level=0.0), 1.0),
        "solid": (Material("s", black, alpha=Channel((0.4,)), alpha_mode="opaque", specular_level=0.0), 0.0),
        "glass": (Material("g", Channel((0.5,) * 3), transmission=Channel((1.0,)), specular_level=0.0), 0.5),
    }
    for name, (pane_material, share) in cases.items():
        scene = prepare(build_scenes.snapshot([ground, (pane, pane_material)], sky=(1, 1, 1)), Model(sky="fixed"))
        found = repeats(scene, SurfaceSensor(columns((0, 0, 1))), columns((0, 0, 1e-2)), 256, 2, "sky")
        assert found.mean() == pytest.approx(np.pi * share, rel=0.01, abs=1e-6), name


def test_a_sun_through_panes_is_tinted_by_each():
    suns = SunDirections(np.array([(0, 0, 1)], np.float32), np.zeros(1, np.float32))
    glass = Material("g", Channel((0.5, 0.8, 1.0)), transmission=Channel((1.0,)), specular_level=0.0)
    parts = [(build_scenes.plane(1e3), material(0.5)), (build_scenes.plane(20, 2.0), glass)]
    parts.append((build_scenes.plane(20, 2.5), glass))
    scene = prepare(build_scenes.snapshot(parts), Model(suns=suns))
    sensor = SurfaceSensor(columns((0, 0, -1)))
    found = gather(scene, sensor, columns((0, 0, 0.01)), np.zeros(1, np.uint32), Effort(256, 1)).sun[0, 0, 0]
    assert np.allclose(found, 0.5 * np.array([0.25, 0.64, 1.0]), rtol=2e-3)
