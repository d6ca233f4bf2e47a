"""The surface cache against what is known, and against paths that are followed to their end."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from command_line import cells_only
from gi_volumes.bake import cell_job, discovery, job, parallel, radiosity, reference
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.scene import Model, Scene, SunDirections, prepare
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import Settings
from gi_volumes.bake.snapshot import Channel, Image, LightKind, Material, Texture
from gi_volumes.benchmarks import leak_scenes
from gi_volumes.tree import world
from gi_volumes.tree.grid import Grid
from statistics_checks import standard_error

EFFORT = Effort(64, 32, 1)
SEEDS = 6
BIAS = 0.01
"""What the mean of a transport may be off by."""

STANDARD_ERRORS = 4.0
GRID = Grid(levels=4)


def matte(albedo, **other) -> Material:
    """Diffuse, without a specular layer."""
    return Material("matte", Channel(tuple(np.broadcast_to(albedo, 3).tolist())), specular_level=0.0, **other)


def with_cache(scene: Scene, effort: Effort = EFFORT, show=None) -> Scene:
    """A cache for the whole scene."""
    low, high = scene.soup.bounds
    return radiosity.around(scene, GRID, np.stack([low, high + 1e-3]), effort, show)


def room(sky: str = "fixed") -> Scene:
    """A room without a roof: furniture, a curtain, textures, lamps and a panel."""
    rng = np.random.default_rng(2)
    image = Image("stripes", np.repeat(rng.integers(60, 256, (1, 32, 4), dtype=np.uint8), 32, axis=0))
    wall = build_scenes.box((0, 0, 0), (6, 5, 3), inward=True)
    parts = [
        (wall[4:], Material("walls", Channel((0.8, 0.7, 0.6), Texture(0)), specular_level=0.0)),
        (build_scenes.quad((0, 0, 0), (6, 0, 0), (6, 5, 0), (0, 5, 0)), matte(0.5)),
        (build_scenes.box((1, 1, 0), (1.8, 2.5, 0.7)), matte((0.7, 0.3, 0.2))),
        (build_scenes.quad((4, 1, 0.2), (4.3, 3, 0.2), (4.3, 3, 2.4), (4, 1, 2.4)), matte(0.6, alpha=Channel((0.5,)))),
        (build_scenes.box((4.8, 4, 0), (5.4, 4.6, 0.1)), matte(0, emission=Channel((2.0, 1.5, 1.0)))),
    ]
    parts[3] = (parts[3][0], dataclasses.replace(parts[3][1], alpha_mode="blend"))
    uvs = rng.uniform(0, 1, (sum(len(triangles) for triangles, _ in parts), 3, 2))
    lights = build_scenes.lamps(
        {"kind": LightKind.POINT, "position": (3, 2.5, 2.2), "strength": (4, 4, 4), "size": (0.05, 0)},
        {"kind": LightKind.SPOT, "position": (1, 4, 2.5), "strength": (9, 6, 3), "spot": (0.6, 0.3)},
    )
    toward = np.array([[0.3, 0.2, 0.93], [0.1, -0.5, 0.86]], np.float32)
    suns = SunDirections(toward / np.linalg.norm(toward, axis=1, keepdims=True), np.array([0.02, 0.0], np.float32))
    snapshot = build_scenes.snapshot(parts, lights, (0.7, 0.8, 1.0), uvs=uvs, images=(image,))
    return prepare(snapshot, Model(suns=suns, sky=sky))


def measured(scene: Scene, position: np.ndarray, seed: int) -> np.ndarray:
    """(points, functions * 3) mean irradiance around points."""
    keys = np.arange(position.shape[1], dtype=np.uint32)
    found = gather(scene, HarmonicsSensor(), position, keys, dataclasses.replace(EFFORT, seed=seed))
    parts = [part for part in (found.local[:, None], found.sun, found.sky) if len(part)]
    return np.concatenate(parts, axis=1)[:, :, 0].reshape(position.shape[1], -1)


def free_points(count: int) -> np.ndarray:
    """(3, n) points in the room, also close to its walls and furniture."""
    rng = np.random.default_rng(5)
    inside = rng.uniform((0.02, 0.02, 0.02), (5.98, 4.98, 2.98), (4 * count, 3))
    furniture = (inside > (0.98, 0.98, 0)).all(axis=1) & (inside < (1.82, 2.52, 0.72)).all(axis=1)
    furniture |= (inside > (4.78, 3.98, 0)).all(axis=1) & (inside < (5.42, 4.62, 0.12)).all(axis=1)
    return np.ascontiguousarray(inside[~furniture][:count].T.astype(np.float32))


def test_white_surfaces_under_an_even_sky_all_get_what_the_sky_gives():
    """Whatever rays meet, they bring 1: no noise is left, and nothing is lost or counted twice."""
    parts = [(build_scenes.box((0, 0, 0), (2, 2, 1.2))[4:], matte(1.0)), (build_scenes.plane(4.0), matte(1.0))]
    scene = prepare(build_scenes.snapshot(parts, sky=(1, 1, 1)), Model(local=False, sky="fixed"))
    cache = with_cache(scene, Effort(64, 200, 1)).cache
    assert len(cache.light) > 500
    assert cache.light[:, 1] == pytest.approx(np.pi, rel=2e-3)
    assert (cache.light[:, 0] == 0).all()
    assert cache.indirect[:, 1] == pytest.approx(np.pi, rel=2e-3)


@pytest.mark.parametrize("bounces", [1, 2, 5])
def test_a_furnace_has_as_many_bounces_as_were_asked_for(bounces):
    albedo, emission = 0.6, 1.3
    walls = build_scenes.box((0, 0, 0), (4, 3, 2.5), inward=True)
    scene = prepare(build_scenes.snapshot([(walls, matte(albedo, emission=Channel((emission,) * 3)))]), Model())
    light = with_cache(scene, Effort(64, bounces, 1)).cache.light[:, 0]
    truth = np.pi * emission * sum(albedo**k for k in range(bounces))
    assert light.mean() == pytest.approx(truth, rel=BIAS)


@pytest.mark.parametrize("sky", ["fixed", "harmonics"])
def test_means_of_all_transports_are_those_of_paths(sky):
    scene, position = room(sky), free_points(160)
    paths = np.array([measured(scene, position, seed) for seed in range(SEEDS)])
    cached = [with_cache(scene, dataclasses.replace(EFFORT, seed=seed)) for seed in range(SEEDS)]
    cache = np.array([measured(one, position, seed + 100) for seed, one in enumerate(cached)])
    assert (np.array([len(one.cache.light) for one in cached]) > 500).all()
    means = [found.mean(axis=1) for found in (paths, cache)]
    bright = np.abs(means[0].mean(axis=0)).max()
    noise = np.hypot(*(standard_error(found) for found in means))
    off = np.abs(means[1].mean(axis=0) - means[0].mean(axis=0))
    counts = np.abs(means[0].mean(axis=0)) > 0.05 * bright
    assert counts.sum() >= 9
    assert (off < BIAS * np.abs(means[0].mean(axis=0)) + STANDARD_ERRORS * noise)[counts].all()
    swapped = means[1].mean(axis=0).reshape(-1, 3)[:, ::-1].reshape(-1)
    planted = np.abs(swapped - means[0].mean(axis=0))
    assert (planted > BIAS * np.abs(means[0].mean(axis=0)) + STANDARD_ERRORS * noise)[counts].sum() >= 4


def test_spots_that_lamps_light_from_close_by_are_counted_once():
    walls = build_scenes.box((0, 0, 0), (3, 3, 2.5), inward=True)
    lamp = {"kind": LightKind.POINT, "position": (0.04, 1.5, 1.2), "strength": (4, 4, 4), "size": (0.01, 0)}
    scene = prepare(build_scenes.snapshot([(walls, matte(0.5))], build_scenes.lamps(lamp)), Model())
    assert scene.lit_spots.count == 1
    rng = np.random.default_rng(5)
    position = np.ascontiguousarray(rng.uniform(0.02, (2.98, 2.98, 2.48), (200, 3)).T.astype(np.float32))
    paths, cache = ([], [])
    for seed in range(2 * SEEDS):
        cached = with_cache(scene, dataclasses.replace(EFFORT, seed=seed))
        paths.append(measured(scene, position, seed)[:, 0].mean())
        cache.append(measured(cached, position, seed + 100)[:, 0].mean())
    assert cached.cache.known.uneven.any()
    noise = np.hypot(standard_error(np.array(paths)), standard_error(np.array(cache)))
    assert noise < 2 * BIAS * np.mean(paths)
    assert abs(np.mean(cache) - np.mean(paths)) < BIAS * np.mean(paths) + STANDARD_ERRORS * noise


def test_a_dim_room_beside_bright_ground_gets_all_its_bounces(monkeypatch):
    box = build_scenes.box((0, 0, 0.05), (3, 3, 2.5), inward=True)
    wall = (box[:, :, 0] == 0).all(axis=1)
    sides = [((0, y, 0.05), (0, y, 2.5), (0, z, 2.5), (0, z, 0.05)) for y, z in ((0, 1.35), (1.65, 3))]
    closed = np.concatenate([box[~wall], *(build_scenes.quad(*side) for side in sides)])
    parts = [(build_scenes.plane(12.0), matte(0.5)), (closed, matte(0.85))]
    scene = prepare(build_scenes.snapshot(parts, sky=(1, 1, 1)), Model(local=False, sky="fixed"))
    inside = np.random.default_rng(5).uniform(0.2, 2.3, (100, 3)).T
    position, found = np.ascontiguousarray(inside.astype(np.float32)), []
    for left in (radiosity.LEFT, 0):
        monkeypatch.setattr(radiosity, "LEFT", left)
        found.append(measured(with_cache(scene, dataclasses.replace(EFFORT, bounces=64)), position, 1).mean())
    assert found[0] == pytest.approx(found[1], rel=1e-3)


def test_the_cache_is_less_noisy_than_paths():
    scene, position = room(), free_points(100)
    cached = with_cache(scene)
    spread = [
        np.array([measured(one, position, seed) for seed in range(SEEDS)]).std(axis=0).mean(axis=0)
        for one in (scene, cached)
    ]
    assert (spread[1] < spread[0]).all()


@pytest.mark.parametrize("finders", [(16, 16), discovery.EACH])
@pytest.mark.parametrize("thickness", [0.3, 0.02, 0.0])
def test_no_light_comes_through_a_wall_that_cuts_through_cubes(thickness, finders, monkeypatch):
    monkeypatch.setattr(discovery, "EACH", finders)
    case = leak_scenes.two_rooms(thickness, leak_scenes.Pose(0.065, 17.0))
    scene = with_cache(prepare(case.scene, Model()))
    points, normals = leak_scenes.sample(case.dark, 400, 1)
    found = reference.at(scene, points, normals, EFFORT).local
    assert found.max() == 0
    points, normals = leak_scenes.sample(case.lit, 400, 1)
    assert reference.at(scene, points, normals, EFFORT).local.min() > 0


def test_the_cache_is_the_same_for_any_number_of_threads_and_any_tiles(monkeypatch):
    one = with_cache(room(), dataclasses.replace(EFFORT, threads=1)).cache
    monkeypatch.setattr(parallel, "LANES", 1 << 13)
    two = with_cache(room(), dataclasses.replace(EFFORT, threads=3)).cache
    assert len(one.light) > 3 * ((1 << 13) // radiosity.Spending().rays)
    assert one.light.tobytes() == two.light.tobytes()
    assert one.indirect.tobytes() == two.indirect.tobytes()


def test_a_scene_of_more_surfels_than_are_allowed_gets_larger_cubes(monkeypatch):
    scene = room()
    fine = with_cache(scene).cache
    few = radiosity.Spending(surfels=len(fine.light) // 3)
    monkeypatch.setattr(radiosity, "Spending", lambda: few)
    coarse = with_cache(scene).cache
    assert len(coarse.light) <= few.surfels
    assert coarse.known.lattice.size >= 2 * fine.known.lattice.size


def test_a_scene_that_nobody_sees_has_no_surfels_and_its_paths_go_on():
    scene, position = room(), free_points(20)
    low = np.array([50.0, 50.0, 50.0])
    cached = radiosity.around(scene, GRID, np.stack([low, low + 1]), EFFORT)
    assert len(cached.cache.light) == 0
    scene = dataclasses.replace(scene, lit_spots=cached.lit_spots)
    assert (measured(cached, position, 1) == measured(scene, position, 1)).all()


def test_filling_a_cache_can_be_stopped_at_any_time(monkeypatch):
    calls = []
    monkeypatch.setattr(parallel, "LANES", 1 << 13)

    def show(share: float) -> bool:
        calls.append(share)
        return len(calls) < stop

    for stop in (1, 5, 12, 1 << 30):
        calls.clear()
        if stop < 1 << 30:
            with pytest.raises(CancelledError):
                with_cache(room(), EFFORT, show)
            assert len(calls) == stop
        else:
            with_cache(room(), EFFORT, show)
            assert calls == sorted(calls)
            assert len(calls) > 12
            assert calls[-1] == pytest.approx(1)


BLOCKS = [(build_scenes.plane(6.0), matte(0.6)), (build_scenes.box((1, -1, 0), (2, 2, 1.5)), matte((0.5, 0.6, 0.9)))]
LAMP = {"kind": LightKind.POINT, "position": (-1, 0, 1.5), "strength": (4, 4, 4), "size": (0.1, 0)}
WORLD = build_scenes.snapshot(BLOCKS, build_scenes.lamps(LAMP), (0.7, 0.8, 1.0))
QUICK = Settings(samples=64, bounces=16, error=0.3, method="cache")


@pytest.fixture
def always(monkeypatch):
    """Caches also in small bakes."""
    monkeypatch.setattr(cell_job, "WORTH", 0)


@pytest.mark.usefixtures("always")
def test_a_bake_by_the_cache_sees_what_paths_see(tmp_path):
    job.bake(WORLD, tmp_path, QUICK)
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-4, 0.5, (300, 2)), np.zeros(300)])
    normals = np.tile([0.0, 0, 1], (300, 1))
    truth = reference.irradiance(WORLD, points, normals, samples=512, bounces=16)
    found = world.load(tmp_path).irradiance(points, normals)
    assert found.mean() == pytest.approx(truth.mean(), rel=0.02)
    assert np.sqrt(((found - truth) ** 2).mean()) < 0.1 * truth.mean()


@pytest.mark.usefixtures("always")
def test_cells_baked_one_by_one_by_the_cache_are_those_baked_together(tmp_path):
    whole = job.bake(WORLD, tmp_path / "whole", QUICK, manner=job.Manner(1))
    cells = [(i, j) for i in (-1, 0) for j in (-1, 0)]
    assert whole.cells == len(cells)
    for cell in reversed(cells):
        job.bake(WORLD, tmp_path / "parts", QUICK, [cell], job.Manner(2))
    assert cells_only(tmp_path / "parts") == cells_only(tmp_path / "whole")


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("thickness", [0.3, 0.02])
def test_a_bake_by_the_cache_keeps_a_sealed_room_dark(thickness, tmp_path):
    case = leak_scenes.two_rooms(thickness)
    job.bake(case.scene, tmp_path, Settings(samples=32, bounces=8, error=0.2, method="cache"))
    baked = world.load(tmp_path)
    assert baked.irradiance(*leak_scenes.sample(case.dark, 3000, 1)).max() == 0
    assert baked.irradiance(*leak_scenes.sample(case.lit, 300, 2)).min() > 0


@pytest.mark.usefixtures("always")
def test_a_cell_of_a_large_scene_does_not_depend_on_the_others(tmp_path):
    """Larger than a cell, so that each cell has a cache of its own."""
    large = build_scenes.snapshot([(build_scenes.plane(90.0), matte(0.6)), *BLOCKS[1:]], WORLD.lights, (0.7, 0.8, 1.0))
    settings = dataclasses.replace(QUICK, samples=8, finest=2.0)
    job.bake(large, tmp_path / "both", settings, [(-1, 0), (0, 0)], job.Manner(2))
    job.bake(large, tmp_path / "one", settings, [(0, 0)], job.Manner(1))
    one, both = cells_only(tmp_path / "one"), cells_only(tmp_path / "both")
    assert one
    assert one == {name: both[name] for name in one}


def test_lamps_that_light_a_spot_within_a_surfel_are_not_missed():
    walls = build_scenes.box((0, 0, 0), (3, 3, 2.5), inward=True)
    place = {"position": (1.5, 1.5, 2.0), "strength": (4, 4, 4), "size": (0.001, 0)}
    lamp = place | {"kind": LightKind.SPOT, "spot": (float(np.cos(0.015)), 0.1)}
    scene = prepare(build_scenes.snapshot([(walls, matte(0.7))], build_scenes.lamps(lamp)), Model())
    position = np.ascontiguousarray(np.random.default_rng(5).uniform(0.1, 2.4, (150, 3)).T.astype(np.float32))
    paths = np.mean([measured(scene, position, seed) for seed in range(8)])
    for seed in range(3):
        cached = with_cache(scene, dataclasses.replace(EFFORT, seed=seed))
        assert measured(cached, position, seed + 50).mean() == pytest.approx(paths, rel=0.1)


def test_cells_that_take_few_paths_have_no_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(radiosity, "around", None)
    job.bake(WORLD, tmp_path, dataclasses.replace(QUICK, samples=2), [(0, 0)])
    with pytest.raises(TypeError):
        job.bake(WORLD, tmp_path, dataclasses.replace(QUICK, samples=1 << 16), [(0, 0)])


def test_another_method_is_another_bake(tmp_path):
    job.bake(WORLD, tmp_path, QUICK, [(0, 0)])
    first = cells_only(tmp_path)
    job.bake(WORLD, tmp_path, dataclasses.replace(QUICK, method="paths"), [(0, 0)])
    assert cells_only(tmp_path) != first
