"""Lamps close to surfaces: the spots that they light, found from the lamps' side and by chance alike."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import lit_spots
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from scipy import integrate

HEIGHT, GAP, ALBEDO = 2.0, 0.05, 0.8
FARTHER = 0.25  # [m] under the ceiling: paths find spots of that size well enough to be compared with
AT = np.array([-0.6, 0.4, 0.5])
STANDARD_ERRORS = 3.5  # once in 2,000 seeds, and the seeds are fixed
WHITE = Material("white", Channel((ALBEDO,) * 3), specular_level=0.0)
BLACK = Material("black", Channel((0.0,) * 3), specular_level=0.0)
GLASS = Material("glass", Channel((0.5,) * 3), alpha=Channel((0.5,)), alpha_mode="blend", specular_level=0.0)
LAMPS = {
    "point": {"strength": (5, 4, 3)},
    "soft point": {"size": (0.04, 0), "strength": (5, 4, 3)},
    "sphere": {"size": (0.04, 1), "strength": (5, 4, 3)},
    "spot": {"kind": LightKind.SPOT, "spot": (0.9, 0.3), "strength": (9, 9, 9), "frame": np.diag([1, -1, -1])},
    "panel": {"kind": LightKind.RECTANGLE, "size": (0.1, 0.1), "strength": (90,) * 3, "frame": np.diag([1, -1, -1])},
    "disk": {"kind": LightKind.ELLIPSE, "size": (0.1, 0.2), "strength": (90,) * 3, "frame": np.diag([1, -1, -1])},
}


def room(lamp: dict, *parts, gap: float = GAP) -> Scene:
    """A lamp under the ceiling of a room of 4 x 4 x 2 m."""
    walls = build_scenes.box((-2, -2, 0), (2, 2, HEIGHT), inward=True)
    lights = build_scenes.lamps({"position": (0.3, 0.2, HEIGHT - gap), **lamp})
    return prepare(build_scenes.snapshot([(walls, WHITE), *parts], lights), Model())


def by_chance(scene: Scene) -> Scene:
    """The same scene, whose lit spots are found by paths alone."""
    scene = dataclasses.replace(scene, lit_spots=type(scene.lit_spots)(scene.lamps, scene.tracer, scene.surfaces))
    scene.lit_spots.count = 0
    return scene


def measured(scene: Scene, sensor, points: int, samples: int, bounces: int, seed: int = 0) -> np.ndarray:
    """(points,) luminance-free sum of what independent points at one place measure."""
    position = np.repeat(AT.astype(np.float32)[:, None], points, axis=1)
    keys = np.arange(points, dtype=np.uint32) + np.uint32(1000 * seed)
    return gather(scene, sensor, position, keys, Effort(samples, bounces, seed)).local[:, 0].sum(axis=1)


def up(points: int) -> SurfaceSensor:
    return SurfaceSensor(np.repeat(np.array([[0.0], [0.0], [1.0]], np.float32), points, axis=1))


def z_score(a: np.ndarray, b: np.ndarray | float) -> float:
    """How many standard errors means are apart."""
    variance = a.var(ddof=1) / len(a) + (b.var(ddof=1) / len(b) if np.ndim(b) else 0)
    return float((a.mean() - np.mean(b)) / np.sqrt(variance))


def reflected_by_ceiling() -> float:
    """Irradiance on a plane that faces the ceiling, of a lamp of intensity 1 close under it, by quadrature."""
    below = HEIGHT - 0.5

    def integrand(y: float, x: float) -> float:
        lit = GAP / (x * x + y * y + GAP * GAP) ** 1.5
        away = (x + 0.9) ** 2 + (y - 0.2) ** 2 + below**2
        return lit * (ALBEDO / np.pi) * (below / away) ** 2

    inner = integrate.dblquad(integrand, -0.5, 0.5, -0.5, 0.5, epsabs=1e-7)[0]
    outer = integrate.dblquad(integrand, -2.3, 1.7, -2.2, 1.8, epsabs=1e-7)[0]
    assert outer > inner
    return outer


def test_the_light_of_a_spot_on_the_ceiling_is_that_of_its_integral_and_two_per_cent_more_is_caught():
    ceiling = build_scenes.quad((-2, -2, HEIGHT), (-2, 2, HEIGHT), (2, 2, HEIGHT), (2, -2, HEIGHT))
    lights = build_scenes.lamps({"position": (0.3, 0.2, HEIGHT - GAP)})
    floor = build_scenes.plane(20)
    scene = prepare(build_scenes.snapshot([(ceiling, WHITE), (floor, BLACK)], lights), Model())
    assert scene.lit_spots.count == 1
    found = measured(scene, up(2048), 2048, 256, 1) / 3
    truth = reflected_by_ceiling()
    assert abs(z_score(found, truth)) < STANDARD_ERRORS
    assert abs(z_score(found, 1.02 * truth)) > STANDARD_ERRORS


@pytest.mark.parametrize("lamp", LAMPS.values(), ids=LAMPS)
@pytest.mark.parametrize("sensor", ["surface", "harmonics"])
def test_spots_found_from_the_lamp_and_by_chance_give_the_same_light(lamp, sensor, monkeypatch):
    monkeypatch.setattr(lit_spots, "CONCENTRATED", 0.0)
    points = 512
    cover = build_scenes.quad((-0.2, -0.3, 1.9), (0.8, -0.3, 1.9), (0.8, 0.7, 1.95), (-0.2, 0.7, 1.95))
    scene = room(lamp, (cover, GLASS), gap=FARTHER)
    assert scene.lit_spots.count == 1
    sensors = {"surface": up(points), "harmonics": HarmonicsSensor()}
    both = measured(scene, sensors[sensor], points, 256, 3)
    chance = measured(by_chance(scene), sensors[sensor], points, 512, 3, seed=1)
    assert abs(z_score(both, chance)) < STANDARD_ERRORS
    assert abs(z_score(both, 1.2 * chance)) > STANDARD_ERRORS


TILT = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
TILT = TILT * np.sign(np.linalg.det(TILT))
MASK = Material("mask", Channel((0.5,) * 3), alpha=Channel((1.0,)), alpha_mode="mask", specular_level=0.0)


def tilted_room(lamp: dict, gap: float) -> Scene:
    """A lamp that shines down in a room that is turned about the point that is measured: no number is round there."""
    walls = (build_scenes.box((-2, -2, 0), (2, 2, HEIGHT), inward=True) - AT) @ TILT.T + AT
    position = (np.array([0.3, 0.2, HEIGHT - gap]) - AT) @ TILT.T + AT
    lights = build_scenes.lamps({**lamp, "position": position, "frame": TILT})
    return prepare(build_scenes.snapshot([(walls, WHITE)], lights), Model())


@pytest.mark.parametrize("gap", [0.0, -5e-5, 1e-4, 0.02])
@pytest.mark.parametrize("name", ["point", "panel", "sphere"])
def test_lamps_on_surfaces_and_just_behind_them_lose_and_win_no_light(name, gap):
    if name == "point" and gap == 1e-4:
        pytest.skip("chance never finds a spot of a tenth of a millimetre, which holds half of the light")
    scene = tilted_room(LAMPS[name], gap)
    both = measured(scene, HarmonicsSensor(), 256, 256, 3)
    chance = measured(by_chance(scene), HarmonicsSensor(), 256, 256, 3, seed=1)
    assert np.isfinite(both).all()
    assert abs(z_score(both, chance)) < STANDARD_ERRORS or np.allclose(both, chance)


def test_a_leaf_cut_out_before_a_soft_lamp_hides_it_alike_from_either_side():
    leaf = build_scenes.quad((0.2, 0.1, 1.72), (0.32, 0.1, 1.72), (0.32, 0.3, 1.72), (0.2, 0.3, 1.72))
    scene = room({"size": (0.1, 0), "strength": (5, 4, 3)}, (leaf, MASK), gap=0.2)
    assert scene.lit_spots.count == 1
    assert scene.tracer.has_transparent
    both = measured(scene, up(512), 512, 256, 3)
    chance = measured(by_chance(scene), up(512), 512, 512, 3, seed=1)
    assert abs(z_score(both, chance)) < STANDARD_ERRORS
    assert abs(z_score(both, 1.1 * chance)) > STANDARD_ERRORS


def test_many_lamps_of_which_some_light_spots_and_some_cast_no_shadow_are_all_there():
    rng, walls = np.random.default_rng(3), build_scenes.box((-2, -2, 0), (2, 2, HEIGHT), inward=True)
    rows = [{"position": (*rng.uniform(-1.9, 1.9, 2), z), "strength": (1, 1, 1)} for z in rng.uniform(0.3, 1.95, 12)]
    rows[3]["shadow"] = rows[7]["shadow"] = False
    scene = prepare(build_scenes.snapshot([(walls, WHITE)], build_scenes.lamps(*rows)), Model())
    assert 0 < scene.lit_spots.count < 12
    both = measured(scene, up(512), 512, 256, 4)
    chance = measured(by_chance(scene), up(512), 512, 1024, 4, seed=1)
    assert abs(z_score(both, chance)) < STANDARD_ERRORS
    assert abs(z_score(both, 1.1 * chance)) > STANDARD_ERRORS


def test_a_path_that_meets_a_spot_is_not_blinded():
    scene = room(LAMPS["point"])
    noise = [measured(some, up(256), 256, 64, 3).std() for some in (scene, by_chance(scene))]
    assert noise[0] < noise[1] / 2


@pytest.mark.parametrize("lamp", LAMPS.values(), ids=LAMPS)
def test_lamps_close_to_the_ceiling_light_spots(lamp):
    assert room(lamp).lit_spots.count == 1


def test_lamps_far_from_everything_light_no_spots():
    lights = build_scenes.lamps({"position": (0, 0, 1.5)}, {"position": (0, 0, 2.9), "shadow": False})
    box = build_scenes.box((-2, -2, 0), (2, 2, 3), inward=True)
    assert prepare(build_scenes.snapshot([(box, WHITE)], lights), Model()).lit_spots.count == 0


def test_a_scene_without_lamps_has_no_lit_spots():
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(1), WHITE)]), Model())
    assert scene.lit_spots.count == 0
