"""Captured probes: closed forms, plain path tracing through the same texels, noise as it is said, the same bits."""

from __future__ import annotations

import dataclasses
import functools

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import capture as module
from gi_volumes.bake import radiosity, reference, warp
from gi_volumes.bake.capture import Spending, Studio, capture
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Model, Scene, SunDirections, prepare
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from gi_volumes.tree import octahedral, probe_maps
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.probe_atlas import fetch
from statistics_checks import standard_error

ROUNDING = 2.0**-9 + 1e-5
"""Of radiance (`probe_maps.rounded`), and of sums in single precision."""

HALF = 2.0**-11 + 1e-5
"""Of distances, to half precision."""

BOX = np.array([[-1.0, -2.0, -0.5], [3.0, 1.5, 2.0]])
COLORS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [4, 2, 0], [0, 3, 5], [7, 0, 9]], np.float32)
"""Of the walls at -x, +x, -y, +y, -z, +z."""

SEEDS = 6
STANDARD_ERRORS = 4.0


def matte(albedo=0.0, emission=0.0, **other) -> Material:
    """Diffuse, without a specular layer."""
    base, shine = (Channel(tuple(np.broadcast_to(value, 3).tolist())) for value in (albedo, emission))
    return Material("matte", base, shine, specular_level=0.0, **other)


def taken(scene: Scene, *places, error=0.0, most=16, pitch=32, bounces=0, seed=0, threads=1, **other) -> Studio:
    parts = int(scene.has_local) + len(scene.model.suns.toward) + scene.model.sky_count
    spending, effort = Spending(error, most, pitch), Effort(0, bounces, seed, threads)
    return capture(scene, np.array(places, float).reshape(-1, 3), np.ones((parts, 3)), spending, effort, **other)


def map_of(studio: Studio, atlas: np.ndarray, level: int = 0, probe: int = 0) -> np.ndarray:
    """A probe's map without its border."""
    layout = studio.maps.layout
    (row,), (column,) = layout.corner(np.array([probe]), level)
    size = layout.sizes[level]
    return atlas[row + 1 : row + 1 + size, column + 1 : column + 1 + size].astype(np.float64)


def within_texels(size: int, parts: int = 9) -> np.ndarray:
    """(size, size, parts**2, 3) directions all over each texel, its edges among them."""
    number, step = np.arange(size), np.linspace(0, 1, parts)
    row, column, v, u = np.broadcast_arrays(number[:, None, None, None], number[:, None, None], step[:, None], step)
    return octahedral.decode(np.stack([column + u, row + v], axis=-1).reshape(size, size, -1, 2) / size)


def coloured_box() -> Scene:
    parts = []
    for axis in range(3):
        for side in range(2):
            low, high = BOX.copy()
            low[axis] = high[axis] = BOX[side, axis]
            a, b = [(axis + turn) % 3 for turn in (1, 2)]
            corners = np.repeat(low[None], 4, axis=0)
            corners[1:3, a], corners[2:, b] = high[a], high[b]
            parts.append((build_scenes.quad(*corners), matte(0, COLORS[2 * axis + side])))
    return prepare(build_scenes.snapshot(parts), Model())


def wall_of(direction: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which wall of the box a direction meets, and how far away it is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (np.where(direction > 0, BOX[1], BOX[0]) - place) / direction
    far = np.where(direction == 0, np.inf, far)
    axis = far.argmin(axis=-1)
    positive = np.take_along_axis(direction, axis[..., None], axis=-1)[..., 0] > 0
    return 2 * axis + positive, far.min(axis=-1)


def test_a_mirror_in_a_box_shows_the_right_wall_in_every_direction_and_how_far_it_is():
    place = np.array([0.31, -0.72, 0.43])
    studio = taken(coloured_box(), place, pitch=64)
    size = studio.maps.layout.sizes[0]
    walls, _ = wall_of(within_texels(size), place)
    whole = (walls == walls[..., :1]).all(axis=-1)
    shown = map_of(studio, studio.maps.radiance["local"][0])
    assert whole.mean() > 0.8
    assert shown[whole] == pytest.approx(COLORS[walls[..., 0]][whole], rel=ROUNDING)
    wall, far = wall_of(octahedral.centers(size), place)
    assert map_of(studio, studio.maps.distance) == pytest.approx(far, rel=HALF)
    normal = map_of(studio, studio.maps.normal)
    assert np.array_equal(normal, np.eye(3)[wall // 2] * (1 - 2 * (wall % 2))[..., None])
    assert not studio.maps.albedo.any()


def test_look_ups_in_the_box_show_the_right_wall_too():
    place = np.array([0.31, -0.72, 0.43])
    studio = taken(coloured_box(), place, pitch=64)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    around = direction[:, None] + 0.09 * rng.normal(size=(2000, 64, 3))  # two texels wide
    walls, _ = wall_of(around, place)
    sure = (walls == walls[:, :1]).all(axis=1)
    found = fetch(studio.maps.radiance["local"][0], studio.maps.layout, 0, np.zeros(2000, int), direction)
    assert sure.mean() > 0.5
    assert found[sure] == pytest.approx(COLORS[walls[sure, 0]], rel=ROUNDING)


def furnace(albedo: float, emission: float) -> Scene:
    room = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    return prepare(build_scenes.snapshot([(room, matte(albedo, emission))]), Model())


@pytest.mark.parametrize("is_cached", [False, True])
def test_a_furnace_is_the_same_in_every_direction_and_on_every_level(is_cached):
    albedo, emission, bounces = 0.5, 1.3, 12
    scene = furnace(albedo, emission)
    scene = with_cache(scene, bounces) if is_cached else scene
    studio = taken(scene, (1.2, 2.0, 1.1), most=256, bounces=bounces, pitch=16)
    truth = emission * (1 - albedo ** (bounces + 1)) / (1 - albedo)
    for level, atlas in enumerate(studio.maps.radiance["local"]):
        off = map_of(studio, atlas, level) / truth - 1
        assert np.sqrt((off**2).mean()) < 3 * studio.noise[0] / 2**level + ROUNDING
        assert abs(off.mean()) < 0.004
    assert 0 < studio.noise[0] < 0.01


def with_cache(scene: Scene, bounces: int, seed: int = 0) -> Scene:
    low, high = scene.soup.bounds
    return radiosity.around(scene, Grid(levels=4), np.stack([low, high + 1e-3]), Effort(64, bounces, seed, 1))


SHADOW = np.array([-2 * 0.6 / 0.8, 0.0])
"""Where the middle of the plate's shadow lies."""


def lit_floor() -> Scene:
    """A floor under the sun, and a black plate above a part of it."""
    suns = SunDirections(np.array([[0.6, 0.0, 0.8]], np.float32), np.zeros(1, np.float32))
    parts = [(build_scenes.plane(50), matte((0.2, 0.5, 0.8))), (build_scenes.plane(1.0, 2.0), matte(0))]
    return prepare(build_scenes.snapshot(parts), Model(local=False, suns=suns))


def test_a_floor_in_the_sun_sends_back_its_albedo_and_a_shadow_nothing():
    place = np.array([-2.0, 0.5, 1.5])
    studio = taken(lit_floor(), place, bounces=1, pitch=64)
    size = studio.maps.layout.sizes[0]
    toward = within_texels(size)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = (place + toward * (-place[2] / toward[..., 2:]))[..., :2]
    on_floor = (toward[..., 2] < 0) & (np.abs(floor) < 50).all(axis=-1)
    in_shadow = on_floor & (np.abs(floor - SHADOW) < 1).all(axis=-1)
    above = (toward[..., 2] > 0).all(axis=-1)
    lit, dark = ((on_floor & ~in_shadow).all(axis=-1), in_shadow.all(axis=-1))
    shown = map_of(studio, studio.maps.radiance["sun.0"][0])
    assert lit.sum() > 1000
    assert dark.sum() > 100
    assert shown[lit] == pytest.approx(np.broadcast_to([0.2, 0.5, 0.8], shown[lit].shape) * 0.8 / np.pi, rel=ROUNDING)
    assert not shown[dark].any()
    assert not shown[above].any()


def test_blurred_levels_keep_the_energy():
    studio = taken(lit_floor(), (-2.0, 0.5, 1.5), bounces=1, pitch=64)
    energy = []
    for level, atlas in enumerate(studio.maps.radiance["sun.0"]):
        area = octahedral.solid_angles(studio.maps.layout.sizes[level])
        energy.append(np.einsum("yx,yxc->c", area, map_of(studio, atlas, level)))
    assert np.array(energy) == pytest.approx(np.repeat(energy[:1], len(energy), axis=0), rel=2 * ROUNDING)
    assert energy[0].min() > 0.1


def test_the_sky_is_seen_itself_and_has_no_distance():
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(50), matte(0))], sky=(1, 2, 3)), Model(sky="fixed"))
    studio = taken(scene, (0, 0, 1.0))
    up = octahedral.centers(30)[..., 2] > 0.1
    assert np.array_equal(map_of(studio, studio.maps.radiance["sky"][0])[up], np.broadcast_to([1, 2, 3], (up.sum(), 3)))
    assert np.isinf(map_of(studio, studio.maps.distance)[up]).all()
    assert not map_of(studio, studio.maps.normal)[up].any()
    assert not map_of(studio, studio.maps.albedo)[up].any()


def test_functions_of_the_sky_are_parts_of_their_own_and_may_be_negative():
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(1e-3, -50), matte(0))]), Model(sky="harmonics"))
    studio = taken(scene, (0, 0, 0))
    assert list(studio.maps.radiance) == [f"sky.{number}" for number in range(9)]
    assert map_of(studio, studio.maps.radiance["sky.1"][0]).min() < -0.1


def test_a_point_lamp_is_not_seen_itself():
    room = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    scene = prepare(build_scenes.snapshot([(room, matte(0))], build_scenes.lamps({"position": (1, 1, 1)})), Model())
    studio = taken(scene, (2, 2, 2), bounces=4)
    assert not np.any(studio.maps.radiance["local"][0])
    assert studio.noise[0] == 0


@pytest.mark.parametrize(("reflector", "seen"), [(True, 5.0), (False, 0.0)])
def test_a_lamp_is_seen_if_it_is_baked_only_and_nothing_hides_it(reflector, seen):
    room = build_scenes.box((0, 0, 0), (4, 4, 4), inward=True)
    screen = build_scenes.box((1, 1, 2.9), (2, 3, 3))
    panel = {"kind": LightKind.RECTANGLE, "position": (2, 2, 3.5), "size": (2, 2), "strength": (5, 5, 5)}
    lights = build_scenes.lamps(panel | {"reflector": reflector})
    scene = prepare(build_scenes.snapshot([(room, matte(0)), (screen, matte(0))], lights), Model())
    place = np.array([2.0, 2.0, 1.0])
    studio = taken(scene, place)
    toward = within_texels(30)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = place + toward * (2.5 / toward[..., 2:])
    up, shown = toward[..., 2] > 0, map_of(studio, studio.maps.radiance["local"][0])[..., 0]
    met = up & (np.abs(at[..., :2] - 2) < 1).all(axis=-1)
    free, hidden = met & (at[..., 0] > 2.01), met & (at[..., 0] < 1.9)
    assert min(free.all(axis=-1).sum(), hidden.all(axis=-1).sum()) > 10
    assert shown[free.all(axis=-1)] == pytest.approx(seen, rel=ROUNDING)
    assert not shown[hidden.all(axis=-1)].any()
    assert not shown[~met.any(axis=-1)].any()


@pytest.mark.parametrize("alpha", [0.25, 0.75])
def test_a_pane_is_mixed_with_what_lies_behind_it_which_has_the_distance_if_more_of_it_is_seen(alpha):
    place = np.array([0.0, 0.0, 0.5])
    pane = build_scenes.quad((1, -0.5, 0), (1, 0.5, 0), (1, 0.5, 1), (1, -0.5, 1))
    glass = matte(0, 2.0, alpha=Channel((alpha,)), alpha_mode="blend")
    parts = [(build_scenes.box(*BOX, inward=True), matte(0, 10.0)), (pane, glass)]
    studio = taken(prepare(build_scenes.snapshot(parts), Model()), place, most=512)
    toward = within_texels(30)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = place + toward / toward[..., :1]
    through = ((np.abs(at[..., 1:] - [0, 0.5]) < 0.5).all(axis=-1) & (toward[..., 0] > 0)).all(axis=-1)
    shown = map_of(studio, studio.maps.radiance["local"][0])[through]
    assert len(shown) > 10
    assert shown.mean() == pytest.approx(2 * alpha + 10 * (1 - alpha), rel=0.02)
    toward = octahedral.centers(30)[through]
    expected = 1 / toward[:, 0] if alpha > 0.5 else wall_of(toward, place)[1]
    assert map_of(studio, studio.maps.distance)[through] == pytest.approx(expected, rel=HALF)


@functools.cache
def furnished() -> Scene:
    """A room without a roof, lit by a lamp, a panel, a sun and the sky."""
    parts = [
        (np.delete(build_scenes.box((0, 0, 0), (6, 5, 3), inward=True), (2, 3), axis=0), matte((0.5, 0.4, 0.3))),
        (build_scenes.box((1, 1, 0), (1.8, 2.5, 0.7)), matte((0.5, 0.3, 0.2))),
        (build_scenes.quad((4, 1, 0.2), (4.3, 3, 0.2), (4.3, 3, 2.4), (4, 1, 2.4)), matte(0.5)),
        (build_scenes.box((4.8, 4, 0), (5.4, 4.6, 0.1)), matte(0.1, (2.0, 1.5, 1.0))),
    ]
    suns = SunDirections(np.array([[0.36, 0.48, 0.8]], np.float32), np.zeros(1, np.float32))
    lights = build_scenes.lamps({"position": (3, 2.5, 2.2), "strength": (4, 4, 4)})
    return prepare(build_scenes.snapshot(parts, lights, (0.7, 0.8, 1.0)), Model(suns=suns, sky="fixed"))


PLACE, BOUNCES, TEXELS = np.array([2.6, 3.5, 1.3]), 12, 14
"""So many bounces that a cache, which has as many beyond the path's own, has no more light."""


@functools.cache
def traced() -> np.ndarray:
    """(seeds, texels, 3 parts, 3) radiance: what surfaces emit, and reflect of the irradiance that `reference` finds
    there and of lamp and sun straight."""
    scene, found = furnished(), []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        row, column, _ = np.indices((TEXELS, TEXELS, 12))
        uv = np.stack([column + rng.random(row.shape), row + rng.random(row.shape)], axis=-1) / TEXELS
        direction = np.ascontiguousarray(octahedral.decode(uv).reshape(-1, 3).T.astype(np.float32))
        light = along(scene, np.repeat(np.float32(PLACE)[:, None], direction.shape[1], axis=1), direction, seed)
        found.append(light.reshape(TEXELS * TEXELS, 12, 3, 3).mean(axis=1))
    return np.array(found)


def along(scene: Scene, start: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
    """(n, 3 parts, 3) radiance along rays."""
    hits = scene.tracer.intersect(start, direction)
    met = np.flatnonzero(hits.triangle != MISS)
    hits, light = hits.take(met), np.zeros((start.shape[1], 3, 3))
    light[:, 2] = np.where((np.isin(np.arange(len(light)), met))[:, None], 0, np.array([0.7, 0.8, 1.0]))
    normal = hits.facing(direction[:, met])
    at = start[:, met] + direction[:, met] * hits.distance + 1e-4 * normal
    here = reference.at(scene, at.T, normal.T, Effort(32, BOUNCES - 1, seed, 1))
    arriving = np.stack([here.local[:, 0], here.sun[:, 0, 0], here.sky[:, 0, 0]], axis=1)
    for part, toward, strength in ((0, np.float32([[3], [2.5], [2.2]]) - at, 4), (1, 99 * suns(len(met)), 0)):
        squared, cosine = warp.dot(toward, toward), np.maximum(warp.dot(toward, normal), 0)
        irradiance = strength * cosine / squared**1.5 if strength else cosine / np.sqrt(squared)
        free = ~scene.tracer.blocked(at, np.ascontiguousarray(toward), np.ones(len(met), np.float32))
        arriving[:, part] += np.where(free, irradiance, 0)[:, None]
    light[met] = arriving * (scene.surfaces.reflectance(hits.triangle, hits.u, hits.v).T / np.pi)[:, None]
    light[met, 0] += scene.surfaces.emission(hits.triangle, hits.u, hits.v).T
    return light


def suns(count: int) -> np.ndarray:
    """(3, n) the direction to the sun."""
    return np.repeat(furnished().model.suns.toward.T, count, axis=1)


def captured(spoil: float = 1.0, is_cached: bool = False) -> np.ndarray:
    """(seeds, texels, 3 parts, 3) the same by probes."""
    found = []
    for seed in range(SEEDS):
        scene = furnished()
        if is_cached:
            scene = with_cache(scene, BOUNCES, seed)
            light, indirect = scene.cache.light * np.float32(spoil), scene.cache.indirect * np.float32(spoil)
            scene = dataclasses.replace(scene, cache=dataclasses.replace(scene.cache, light=light, indirect=indirect))
        studio = taken(scene, PLACE, most=64, bounces=BOUNCES, pitch=16, seed=seed)
        parts = [map_of(studio, levels[0]).reshape(-1, 3) for levels in studio.maps.radiance.values()]
        found.append(np.stack(parts, axis=1))
    return np.array(found)


def off(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How many standard errors two means over seeds are apart."""
    noise = np.hypot(standard_error(found), standard_error(truth))
    noise = np.hypot(noise, ROUNDING * np.abs(truth.mean(axis=0)))
    return (found.mean(axis=0) - truth.mean(axis=0)) / np.maximum(noise, 1e-9)


@pytest.mark.parametrize("is_cached", [False, True])
def test_texels_are_those_of_plain_path_tracing_one_by_one_and_on_the_whole(is_cached):
    found = captured(is_cached=is_cached)
    some = traced().reshape(SEEDS, 49, 4, 9).mean(axis=2)
    z = off(found.reshape(SEEDS, 49, 4, 9).mean(axis=2), some)
    assert np.sqrt((z**2).mean()) < 1.6
    assert np.abs(off(found.mean(axis=1), traced().mean(axis=1))).max() < STANDARD_ERRORS


def test_a_cache_that_is_off_is_caught():
    found = captured(1.2, is_cached=True)
    assert np.abs(off(found.mean(axis=1), traced().mean(axis=1))).max() > 2 * STANDARD_ERRORS


def test_noise_is_what_it_is_said_to_be():
    scene, said, true = furnished(), [], []
    best = taken(scene, PLACE, most=4096, bounces=BOUNCES, pitch=16, seed=99)
    light = sum(map_of(best, levels[0]) for levels in best.maps.radiance.values()) @ module.LUMINANCE
    area = octahedral.solid_angles(TEXELS) / (4 * np.pi)
    for seed in range(8):
        studio = taken(scene, PLACE, most=32, bounces=BOUNCES, pitch=16, seed=seed)
        found = sum(map_of(studio, levels[0]) for levels in studio.maps.radiance.values()) @ module.LUMINANCE
        true.append((area * ((found - light) / (light + (area * light).sum())) ** 2).sum())
        said.append(studio.noise[0] ** 2)
    assert np.mean(said) == pytest.approx(np.mean(true), rel=0.25)
    assert studio.rays[0] == 32


def test_rays_go_on_until_the_noise_is_small_enough_or_there_are_too_many():
    noisy, quiet = PLACE, (100.0, 100.0, 100.0)
    studio = taken(furnished(), noisy, quiet, error=0.02, most=4096, bounces=BOUNCES, pitch=16)
    assert (studio.noise <= 0.02).all()
    assert studio.rays[0] > studio.rays[1] == module.HALVES * module.FIRST_RAYS
    assert taken(furnished(), noisy, error=0.01, most=40, bounces=1, pitch=16).rays.tolist() == [32]


def bytes_of(studio: Studio) -> list[bytes]:
    maps = studio.maps
    levels = [level for part in maps.radiance.values() for level in part]
    return [array.tobytes() for array in (*levels, maps.distance, maps.normal, maps.albedo, studio.noise)]


def test_any_number_of_threads_gives_the_same_bits():
    scene = with_cache(furnished(), BOUNCES)
    places = [PLACE, PLACE + 0.1, PLACE - 0.5, PLACE - 1]
    one, *others = (bytes_of(taken(scene, *places, pitch=16, bounces=4, threads=n, error=0.1)) for n in (1, 2, 3))
    assert all(other == one for other in others)


def test_a_probe_does_not_depend_on_the_others():
    alone = taken(furnished(), PLACE, pitch=16, bounces=2)
    third = taken(furnished(), PLACE + 1, PLACE - 1, PLACE, pitch=16, bounces=2)
    for level, (one, other) in enumerate(zip(alone.maps.radiance["local"], third.maps.radiance["local"], strict=True)):
        assert np.array_equal(map_of(alone, one, level), map_of(third, other, level, 2))


def test_another_seed_gives_other_noise():
    one, other = (taken(furnished(), PLACE, pitch=16, bounces=2, seed=seed) for seed in (0, 1))
    assert bytes_of(one) != bytes_of(other)


def test_no_probes_are_no_work():
    studio = taken(furnished())
    assert (len(studio.maps.position), studio.maps.layout.rows, studio.maps.layout.columns) == (0, 1, 1)
    assert np.isinf(studio.maps.distance).all()


def test_without_light_probes_still_see_surfaces():
    room = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    studio = taken(prepare(build_scenes.snapshot([(room, matte(0.5))]), Model()), (1, 1, 1))
    assert studio.maps.radiance == {}
    assert map_of(studio, studio.maps.albedo) == pytest.approx(0.5)
    assert map_of(studio, studio.maps.distance).min() == pytest.approx(1, rel=0.01)


def test_progress_counts_probes_and_stops_the_work():
    said = []
    taken(furnished(), PLACE, PLACE, pitch=16, progress=lambda done: said.append(done) or True)
    assert said == [1, 2]
    with pytest.raises(CancelledError):
        taken(furnished(), PLACE, PLACE, pitch=16, progress=lambda done: False)


def test_light_beyond_half_precision_is_held_and_far_is_infinite():
    scene = prepare(build_scenes.snapshot([(build_scenes.plane(1e7), matte(0, 1e6))]), Model())
    studio = taken(scene, (0, 0, 1e5), pitch=16)
    assert map_of(studio, studio.maps.radiance["local"][0]).max() == probe_maps.LARGEST
    assert np.isinf(map_of(studio, studio.maps.distance)).all()
    assert map_of(studio, studio.maps.normal)[0, 0].tolist() == [0, 0, 1]
