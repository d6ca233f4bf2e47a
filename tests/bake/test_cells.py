"""World cells: baked apart or at once they hold the same bytes, meet without a seam, and light each other."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import build_scenes
import numpy as np
import pytest
from command_line import cells_only, stored
from gi_volumes.bake import job, reference
from gi_volumes.bake.settings import Settings, hemisphere
from gi_volumes.bake.snapshot import Channel, Material, Snapshot
from gi_volumes.tree import folder, interpolate, verify, world
from gi_volumes.tree.blend import ENOUGH
from scipy import stats
from statistics_checks import SIGNIFICANCE, standard_error

CELLS = [(-1, -1), (-1, 0), (0, -1), (0, 0)]
QUICK = Settings(samples=16, bounces=2, error=0.15)
WORDS = ("--samples", "16", "--bounces", "2", "--error", "0.15", "--threads", "1", "--method", "paths")
"""QUICK, as the command line says it."""

STEP = 1e-4
"""Distance of neighbouring samples [m]."""
CLOSE = 1e-9
"""Distance that suspicious jumps are bisected down to [m]: far below the least width of a plane, 1e-4 m."""
SUSPECTS = 8
"""Jumps of a segment that are bisected: those that exceed their neighbours most."""
GRAIN = 2.0**-23 / ENOUGH
"""Largest jump over CLOSE that is no step, in the brightest value of its segment.

A cosine is the difference of float32 places up to 2 voxels away, right to 2^-23; it counts relative to the sum
of weights, which is ENOUGH at least.
"""
SCALED = 1.05
"""A planted error: what one cell's light is multiplied with."""


def matte(*color: float, emission: float = 0.0) -> Material:
    return Material("matte", Channel(color), Channel((emission,) * 3), specular_level=0.0)


GRAY, GLOW = matte(0.6, 0.5, 0.4), matte(0.0, 0.0, 0.0, emission=12.0)
LAMP = {"position": (-0.6, 0.8, 1.0), "strength": (20, 18, 15), "size": (0.05, 0)}
PANEL = build_scenes.quad((-0.5, -0.6, 0.3), (-0.5, -0.2, 0.3), (-0.1, -0.2, 0.3), (-0.1, -0.6, 0.3))


def corner() -> Snapshot:
    """Two walls on a floor, a lamp and a panel low above it and a block beside them, where four world cells meet."""
    solids = [((-4, 1.3, 0), (4, 1.5, 2.2)), ((-2.1, -4, 0), (-1.9, 1.3, 2.2)), ((0.2, -1.1, 0), (0.8, 0.4, 0.7))]
    parts = [(build_scenes.plane(4.0), GRAY), *((build_scenes.box(*solid), GRAY) for solid in solids), (PANEL, GLOW)]
    return build_scenes.snapshot(parts, build_scenes.lamps(LAMP), (0.1, 0.15, 0.2))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """All cells, baked at once."""
    target = tmp_path_factory.mktemp("whole")
    job.bake(corner(), target, QUICK, manner=job.Manner(1))
    return target


def look_around(target: Path) -> np.ndarray:
    """Irradiance near, far and very far from a bake, for normals in all directions and for none."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(3000, 3)) * np.repeat([2.0, 100.0, 1e6], 1000)[:, None]
    normals = rng.normal(size=points.shape) * (rng.random((len(points), 1)) < 0.9)
    return world.load(target).irradiance(points, normals)


@pytest.fixture(scope="module")
def apart(tmp_path_factory) -> tuple[Path, list]:
    """The cells one by one in reversed order, every other one in a process of its own; after each one what is wrong
    and what is seen."""
    place = tmp_path_factory.mktemp("apart")
    scene, target, steps = stored(place, corner()), place / "out", []
    for number, cell in enumerate(reversed(CELLS)):
        if number % 2:
            words = (scene, "-o", target, f"--cells={cell[0]},{cell[1]}", *WORDS)
            subprocess.run([sys.executable, "-m", "gi_volumes", "bake", *map(str, words)], check=True)
        else:
            job.bake(corner(), target, QUICK, [cell], job.Manner(1))
        steps.append((verify.verify(target), look_around(target)))
    return target, steps


def test_cells_baked_one_by_one_in_reversed_order_by_several_processes_are_those_baked_at_once(whole, apart):
    assert len(cells_only(whole)) == 4 * len(CELLS)
    assert cells_only(apart[0]) == cells_only(whole)


def test_missing_cells_are_named_until_all_are_baked_and_those_there_answer_everywhere(apart):
    for number, (defects, seen) in enumerate(apart[1]):
        expected = [(f"cell_{i}_{j}.tree", f"cell {i},{j} is missing: not baked yet") for i, j in CELLS[: 3 - number]]
        assert [(defect.file, defect.what) for defect in defects] == expected
        assert np.isfinite(seen).all()
        assert seen.min() >= 0
        assert seen.any(axis=1).mean() > 0.9


def crossings() -> tuple[np.ndarray, ...]:
    """(n, 3) starts, ends and normals of segments on the floor and on both walls with a border in their middle."""
    across_x, across_y, up = np.array([0.35, 0.05, 0]), np.array([0.05, 0.35, 0]), np.array([0, 0, 1.0])
    along = np.linspace(-1.4, 1.2, 7)
    rows = [((0, y, 0), across_x, up) for y in along] + [((x, 0, 0), across_y, up) for x in along if not 0 < x < 0.9]
    for z in (0.1, 0.5, 0.9, 1.4):
        rows += [((0, 1.3, z), across_x * (1, 0, 0), (0, -1, 0)), ((-1.9, 0, z), across_y * (0, 1, 0), (1, 0, 0))]
    middle, half, normal = (np.array(part, float) for part in zip(*rows, strict=True))
    return middle - half, middle + half, normal


FACES = np.array(
    [
        [(-1.9, -3, 0), (3, 1.3, 0), (0, 0, 1)],
        [(-1.9, 1.3, 0), (2, 1.3, 2.2), (0, -1, 0)],
        [(-1.9, -3, 0), (-1.9, 1.3, 2.2), (1, 0, 0)],
        [(-2, 1.5, 0), (2, 1.5, 2.2), (0, 1, 0)],
        [(0.2, -1.1, 0), (0.2, 0.4, 0.7), (-1, 0, 0)],
        [(0.2, -1.1, 0.7), (0.8, 0.4, 0.7), (0, 0, 1)],
    ]
)
"""Lowest and highest corners, and normals: floor, walls, block."""


def along_faces(count: int) -> tuple[np.ndarray, ...]:
    """(n, 3) starts, ends and normals of segments of half a metre in any direction on the surfaces."""
    rng = np.random.default_rng(2)
    low, high, normal = FACES[rng.integers(0, len(FACES), count)].transpose(1, 0, 2)
    start, way = rng.uniform(low, high), rng.normal(size=(count, 3)) * (normal == 0)
    return start, start + 0.5 * way / np.linalg.norm(way, axis=1, keepdims=True), normal


def largest_steps(value, segments) -> np.ndarray:
    """(n,) what is left within CLOSE of the jumps that exceed their neighbours most, in each segment's brightest value.

    A gradient, or a crease, makes no jump exceed both of its neighbours; a ramp narrower than STEP does, but dissolves.
    """
    low, high, normals, brightest = [], [], [], []
    for start, end, normal in zip(*segments, strict=True):
        at = start + (end - start) * np.linspace(0, 1, round(np.linalg.norm(end - start) / STEP) + 1)[:, None]
        found = value(at, np.broadcast_to(normal, at.shape))
        change = np.abs(np.diff(found, axis=0)).max(axis=1)
        beyond = change[1:-1] - np.maximum(change[:-2], change[2:])
        chosen = np.argsort(-beyond)[:SUSPECTS] + 1
        low.append(at[chosen]), high.append(at[chosen + 1]), normals.append(np.tile(normal, (SUSPECTS, 1)))
        brightest.append(found.max())
    left = narrowed(value, np.concatenate(low), np.concatenate(high), np.concatenate(normals))
    return left.reshape(-1, SUSPECTS).max(axis=1) / brightest


def narrowed(value, low: np.ndarray, high: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) jumps between pairs of points, after they moved together to where most of it is."""
    for _ in range(int(np.ceil(np.log2(STEP / CLOSE)))):
        middle = (low + high) / 2
        below, here, above = (value(at, normals) for at in (low, middle, high))
        first = np.abs(here - below).max(axis=1, keepdims=True) >= np.abs(above - here).max(axis=1, keepdims=True)
        low, high = np.where(first, low, middle), np.where(first, middle, high)
    return np.abs(value(high, normals) - value(low, normals)).max(axis=1)


def light_of(baked: world.World):
    """Irradiance of a bake, as a function of points and normals."""
    return lambda at, normals: baked.irradiance(at, normals).astype(np.float64)


def finest(baked: world.World, at: np.ndarray) -> np.ndarray:
    """(n,) level of the finest voxel that holds each point."""
    level = np.full(len(at), -1)
    for number in range(baked.grid.levels):
        voxel = np.floor(at / float(baked.grid.voxel_size(number))).astype(np.int64)
        level = np.where(baked._data.atlas.find(number, voxel) >= 0, number, level)
    return level


def test_light_has_no_step_where_cells_meet(whole):
    baked, segments = world.load(whole), crossings()
    sides = [finest(baked, (segments[0] + segments[1]) / 2 + shift) for shift in ((-CLOSE,) * 3, (CLOSE,) * 3)]
    assert (sides[0] != sides[1]).mean() > 0.1
    assert largest_steps(light_of(baked), segments).max() < GRAIN


def test_the_jump_over_a_border_is_no_larger_than_those_beside_it(whole):
    """There the field is smooth: faces of dual cells, where it has creases, lie half a voxel beside."""
    start, end, normal = crossings()
    way = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    at = (start + end) / 2 + way * STEP * np.arange(-1.5, 2)[:, None, None]
    found = light_of(world.load(whole))(at.reshape(-1, 3), np.tile(normal, (4, 1))).reshape(at.shape)
    before, over, after = np.abs(np.diff(found, axis=0))
    assert (over < np.maximum(before, after) + GRAIN * found.max(axis=(0, 2))[:, None]).all()


def test_a_side_that_is_brighter_or_does_not_know_the_other_is_caught(whole):
    """Planted errors: light 5 % brighter in every other cell, and each cell looked up alone."""
    header, segments = folder.load_header(whole), tuple(part[::3] for part in crossings())
    light = light_of(world.load(whole))
    alone = {cell: light_of(world.World(header, [folder.read_cell(whole, cell)])) for cell in CELLS}

    def brighter(at, normals):
        return light(at, normals) * np.where((at[:, :1] < 0) == (at[:, 1:2] < 0), SCALED, 1)

    def apart(at, normals):
        inside = [(np.floor(at[:, :2] / 128) == cell).all(axis=1, keepdims=True) for cell in CELLS]
        return sum(inside * alone[cell](at, normals) for cell, inside in zip(CELLS, inside, strict=True))

    for planted in (brighter, apart):
        assert largest_steps(planted, segments).min() > 4 * GRAIN


def test_light_has_no_step_along_surfaces(whole):
    """Through changes of level, edges of planes, and past data points that have moved."""
    baked, segments = world.load(whole), along_faces(60)
    data, (start, end, normal) = baked._data, segments
    at = start + (end - start) * np.linspace(0, 1, 200)[:, None, None]
    assert (np.ptp(finest(baked, at.reshape(-1, 3)).reshape(at.shape[:2]), axis=0) > 0).mean() > 0.2
    row, weight = interpolate.weigh(data, at.reshape(-1, 3), np.tile(normal, (200, 1)))
    used = np.unique(row[weight > 0])
    assert (data.has_planes[used].sum() > 20) & (data.offset[used].any(axis=1).sum() > 20)
    assert largest_steps(light_of(baked), segments).max() < GRAIN


def test_a_plane_without_a_ramp_is_caught_along_surfaces(whole):
    baked = world.load(whole)
    sharp = np.where(np.arange(5) == 4, 1e-12, baked._data.plane)
    baked._data = dataclasses.replace(baked._data, plane=sharp)
    assert (largest_steps(light_of(baked), along_faces(60)) > 4 * GRAIN).sum() > 5


TOP = 1.0
EVEN = build_scenes.snapshot([(build_scenes.box((-2.5, -2.5, 0.2), (2.5, 2.5, TOP)), GRAY)], sky=(1, 1, 1))
"""A block that an even sky lights alike everywhere, as it is convex."""
SEEDS = 4
FAR_OUT = stats.t.isf(SIGNIFICANCE / 2 / len(CELLS), (SEEDS - 1) * (len(CELLS) - 1))
"""Standard errors by which one of the cells differs from their mean by chance once in a thousand times."""


def on_top(cell: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points of the block that lie in a cell, and their normals."""
    sides = np.where(np.array(cell) < 0, -1, 1) * np.random.default_rng(3).uniform(0, 2.4, (200, 2))
    return np.column_stack([sides, np.full(200, TOP)]), np.tile([0, 0, 1.0], (200, 1))


def scale_cell(baked: world.World, number: int, scale: float) -> None:
    """Multiply the payloads of one cell of a loaded world."""
    values, first = baked._folded(baked._sources.factors(None, None, "all")), baked._data.atlas.first
    values[first[number] : first[number + 1]] *= scale


def differences(means) -> np.ndarray:
    """(cells,) how far each cell's mean lies from that of all, in standard errors, which are alike in all cells."""
    beside = np.array(means) - np.mean(means, axis=1, keepdims=True)
    return beside.mean(axis=0) / np.sqrt((standard_error(beside) ** 2).mean())


def test_all_cells_of_an_even_scene_are_equally_bright_and_a_scaled_one_is_caught(tmp_path):
    found, planted = [], []
    for seed in range(SEEDS):
        job.bake(EVEN, tmp_path, Settings(samples=64, bounces=2, seed=seed, finest=0.5), manner=job.Manner(1))
        for scale, means in ((1.0, found), (SCALED, planted)):
            baked = world.load(tmp_path)
            scale_cell(baked, 2, scale)
            means.append([baked.irradiance(*on_top(cell)).mean(dtype=float) for cell in CELLS])
    assert np.abs(differences(found)).max() < FAR_OUT
    assert differences(planted)[2] > FAR_OUT


def test_a_scaled_cell_makes_a_ramp_and_no_step(whole):
    """Interpolation spreads it over a voxel, so only a known value, as above, can tell."""
    baked = world.load(whole)
    scale_cell(baked, 2, SCALED)
    assert largest_steps(light_of(baked), tuple(part[::3] for part in crossings())).max() < GRAIN


SLOPE = build_scenes.quad((-0.9, 0.6, 0.9), (-0.5, 0.6, 1.3), (-0.5, 1.2, 1.3), (-0.9, 1.2, 0.9))
ACROSS = {"lamp": ([], build_scenes.lamps(LAMP)), "panel": ([(SLOPE, GLOW)], None)}
"""All that shines, in the cell (-1, 0)."""


def lit_from_across(name: str) -> Snapshot:
    """A floor and a wall in two cells, of which one holds all light."""
    parts, lights = ACROSS[name]
    return build_scenes.snapshot(
        [(build_scenes.plane(4.0), GRAY), (build_scenes.box((-4, 2.6, 0), (4, 2.8, 2.5)), GRAY), *parts], lights
    )


def own_points(baked: world.World) -> np.ndarray:
    """(n, 3) data points before the wall and above the floor that nothing is blended with where they are."""
    data = baked._data
    row, weight = interpolate.weigh(data, data.position, np.zeros_like(data.position))
    own = np.where(row == np.arange(len(row))[:, None], weight, 0).sum(axis=1)
    x, y, z = data.position.T
    return data.position[data.valid & (own > 0.999 * weight.sum(axis=1)) & (np.abs(x) < 4) & (y < 2.6) & (z > 0)]


def mean_over_normals(scene: Snapshot, points: np.ndarray) -> np.ndarray:
    """(n,) traced irradiance in the mean over all normals: even ones, turned at random for each point."""
    even = np.concatenate([hemisphere(32), -hemisphere(32)])
    turned = even @ np.linalg.qr(np.random.default_rng(6).normal(size=(len(points), 3, 3)))[0]
    at = np.repeat(points, len(even), axis=0)
    found = reference.irradiance(scene, at, turned.reshape(-1, 3), samples=64, bounces=3, seed=1, threads=1)
    return found.reshape(len(points), -1).mean(axis=1, dtype=float)


@pytest.mark.parametrize("name", ACROSS)
def test_light_reaches_data_points_of_a_neighbour_that_is_baked_alone(name, tmp_path):
    """As traced, so that their noise is independent, and without a normal, so that it takes no harmonics."""
    scene = lit_from_across(name)
    job.bake(scene, tmp_path, Settings(512, 3, finest=0.5, error=0.0, fit=False), [(0, 0)], job.Manner(1))
    baked = world.load(tmp_path)
    points = own_points(baked)
    ratio = baked.irradiance(points, np.zeros_like(points)).mean(axis=1, dtype=float) / mean_over_normals(scene, points)
    limit = stats.t.isf(SIGNIFICANCE / 2, len(points) - 1) * standard_error(ratio)
    assert len(points) > 50
    assert abs(ratio.mean() - 1) < limit
    assert abs(ratio.mean() / SCALED - 1) > limit


BARE = 1.5
"""What surfaces may differ by in the target error: the finest voxels stay as they are."""


@pytest.mark.parametrize("name", ACROSS)
def test_surfaces_of_a_neighbour_that_is_baked_alone_are_lit_as_exactly_as_was_asked_for(name, tmp_path):
    """From a metre on: nearer to the border half of what surrounds a point is missing."""
    scene, settings = lit_from_across(name), Settings(samples=512, bounces=3, error=0.1, finest=0.5)
    job.bake(scene, tmp_path, settings, [(0, 0)], job.Manner(1))
    xy = np.random.default_rng(4).uniform((1.2, 0.2), (3.5, 2.4), (300, 2))
    points, normals = np.column_stack([xy, np.zeros(300)]), np.tile([0, 0, 1.0], (300, 1))
    truth = reference.irradiance(scene, points, normals, samples=512, bounces=3, seed=5, threads=1).mean(axis=1)
    found = world.load(tmp_path).irradiance(points, normals).mean(axis=1)
    assert np.sqrt(np.mean((found / truth - 1) ** 2)) < BARE * settings.error
