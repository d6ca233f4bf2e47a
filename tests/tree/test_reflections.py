"""Radiance from probes: closed forms, what happens without any, continuity, and every input that must not break it."""

from __future__ import annotations

import functools
from collections.abc import Callable

import build_scenes
import numpy as np
import probe_worlds
import pytest
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.probe_visibility import see
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.tree import folder, ggx
from gi_volumes.tree.build import build
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.interpolate import join
from gi_volumes.tree.probe_maps import ProbeMaps
from gi_volumes.tree.probe_sets import WHOLE, ProbeSets
from gi_volumes.tree.reflections import _joined
from gi_volumes.tree.world import World

GRAY = Material("gray", Channel((0.5,) * 3))
ORIGIN = np.array([1024.0, -2048.0, 0.0])
LOW, HIGH = np.array([0.5, 0.5, 0.3]), np.array([7.0, 6.0, 3.6])
PROBES = np.array([[2.0, 2.0, 1.5], [5.5, 2.0, 2.2], [2.0, 4.7, 2.4], [5.0, 4.5, 1.2], [3.7, 3.1, 3.0]])
COLORS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]])
LIGHT = 2.5
"""Irradiance of the volume, in all directions [W/m2]."""


def walls(place: np.ndarray) -> np.ndarray:
    """The colour of the nearest of the six walls."""
    return COLORS[np.abs(np.concatenate([place - LOW, HIGH - place], axis=1)).argmin(axis=1)]


def constant(place: np.ndarray) -> np.ndarray:
    return np.full(place.shape, 0.75)


def scene_of(*parts: np.ndarray) -> Scene:
    box = build_scenes.box(LOW, HIGH, inward=True)
    return prepare(build_scenes.snapshot([(np.concatenate([box, *parts]), GRAY)]), Model())


def world_of(scene: Scene, shine: Callable, place, probes=PROBES, pitch: int = 64, irradiance: float = LIGHT) -> World:
    """A bake by hand with a volume of the same light everywhere, and traced probes."""
    grid = Grid(origin=tuple(ORIGIN))
    tree = build(scene.soup.corners, grid, (0, 0), flat=-1.0)
    valid = np.ones(tree.size, bool)
    light = np.zeros((tree.size, 1, 9, 3), np.float32)
    light[:, :, 0] = irradiance / 0.28209479177387814
    folder.write_cell(place, tree, {"local": light}, valid, np.zeros((tree.size, 3), np.int8), {"bake": "b"})
    header = folder.assemble(place, {"bake": "b", "grid": grid, "transports": {"local": {}}})
    data = join(grid, [tree], np.zeros((tree.size, 3), np.int8), valid)
    maps, sets = probe_worlds.traced(scene, probes, shine, 0.0, pitch), see(scene, data, probes, Effort(0))
    moved = ProbeMaps(maps.layout, probes + ORIGIN, maps.pinned, maps.radiance, maps.distance, maps.normal, maps.albedo)
    return World(header, [folder.read_cell(place, (0, 0))], moved, [sets])


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> World:
    """A room whose walls shine in six colours."""
    return world_of(scene_of(), walls, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def room_with_pillar(tmp_path_factory) -> World:
    """The same with a pillar that shines in the colours of the walls behind it."""
    pillar = build_scenes.box((4.2, 2.4, 0.3), (4.6, 2.8, 3.6))
    return world_of(scene_of(pillar), walls, tmp_path_factory.mktemp("pillar"))


def rays(count: int, seed: int = 0, margin: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Points in the room, in world space, and directions."""
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(count, 3))
    point = LOW + (HIGH - LOW) * (margin + (1 - 2 * margin) * generator.random((count, 3)))
    return point + ORIGIN, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def hits(point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Where rays meet the room's walls, locally."""
    start = point - ORIGIN
    step = np.where(direction > 0, HIGH - start, LOW - start) / np.where(direction == 0, 1e-30, direction)
    return start + direction * step.min(axis=1, keepdims=True)


def test_a_mirror_in_a_coloured_room_shows_the_right_wall_for_every_direction(room):
    point, direction = rays(20_000)
    hit = hits(point, direction)
    found = room.radiance(point, direction, 0.0)
    edge = np.sort(np.minimum(hit - LOW, HIGH - hit), axis=1)[:, 1]
    clear = edge > 0.35
    off = np.abs(found - walls(hit)).max(axis=1)
    assert clear.mean() > 0.6
    assert off[clear].mean() < 0.005
    assert np.quantile(off[clear], 0.99) < 0.1
    assert ((found > 0.5) == (walls(hit) > 0.5))[clear].all(axis=1).mean() > 0.998


def test_entries_of_many_cells_are_told_apart():
    """Their numbers together do not fit 16 bits."""
    index, weight = np.arange(40_000, dtype=np.uint16), np.full((40_000, 1), WHOLE, np.uint8)
    cells = [ProbeSets(index, np.full((40_000, 1), probe, np.uint16), weight) for probe in (1, 2)]
    row, probe, _ = _joined(cells)
    assert (probe[row, 0] == np.repeat([1, 2], 40_000)).all()


def test_without_parallax_the_wrong_wall_would_be_shown(room, monkeypatch):
    """The planted error: probes are looked up in the rays' own directions."""
    point, direction = rays(2000)
    hit = hits(point, direction)
    near = room._reflections._near
    monkeypatch.setattr(type(near), "at", lambda self, probe, way, level: np.zeros(len(probe), np.float32))
    off = np.abs(room.radiance(point, direction, 0.0) - walls(hit)).max(axis=1)
    assert off.mean() > 0.2


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 0.99, 1.0])
def test_in_an_even_room_all_directions_show_exactly_that_light(tmp_path, roughness):
    world = world_of(scene_of(), constant, tmp_path, pitch=32, irradiance=np.pi * 0.75)
    point, direction = rays(3000)
    np.testing.assert_allclose(world.radiance(point, direction, roughness), 0.75, rtol=1e-3)  # stored as halves


def test_a_rough_surface_sees_what_the_lobe_gathers(room):
    """Against the lobe, integrated over the walls; halfway between probes the lobes' shapes differ a little."""
    point, direction = rays(300, margin=0.2)
    for roughness, bound in ((0.3, 0.05), (0.6, 0.08)):
        found = room.radiance(point, direction, roughness)
        off = np.abs(found - gathered(point, direction, roughness))
        assert off.mean() < bound


def gathered(point: np.ndarray, direction: np.ndarray, roughness: float, count: int = 4096) -> np.ndarray:
    """(n, 3) the lobe about each direction, integrated over the walls of the room."""
    step = (np.arange(count) + 0.5) / count
    z, turn = 1 - 2 * step, np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    weight = ggx.density(direction @ around.T, roughness)
    colors = walls(hits(np.repeat(point, count, axis=0), np.tile(around, (len(point), 1)))).reshape(-1, count, 3)
    return np.einsum("nk,nkc->nc", weight, colors) / weight.sum(axis=1, keepdims=True)


def test_without_probes_it_is_the_volume_s_light(tmp_path):
    world = world_of(scene_of(), walls, tmp_path, np.zeros((0, 3)))
    point, direction = rays(100)
    np.testing.assert_allclose(world.radiance(point, direction, 0.3), LIGHT / np.pi, rtol=0.01)


def test_where_no_probe_sees_what_rays_meet_it_is_the_volume_s_light(tmp_path):
    """A closet that no probe looks into."""
    closet = build_scenes.box((0.6, 0.6, 0.4), (1.6, 5.9, 3.5))
    inner = build_scenes.box((0.7, 0.7, 0.5), (1.5, 5.8, 3.4), inward=True)
    world = world_of(scene_of(closet, inner), walls, tmp_path)
    generator = np.random.default_rng(0)
    point = generator.uniform([0.8, 1, 0.6], [1.4, 5.5, 3.3], (500, 3)) + ORIGIN
    _, direction = rays(500)
    seen = np.abs(world.radiance(point, direction, 0.2) * np.pi / LIGHT - 1).max(axis=1) > 0.02
    assert seen.mean() < 0.05


def test_light_is_linear_in_its_sources():
    """Parts are mixed by the factors of irradiance: sun keys and functions of the sky apart."""
    scene = scene_of()
    maps = probe_worlds.traced(scene, PROBES[:1], constant, 0.0, 16)
    parts = {name: tuple(level * factor for level in maps.radiance["local"]) for name, factor in FACTORS.items()}
    mixed = ProbeMaps(maps.layout, maps.position, maps.pinned, parts, maps.distance, maps.normal, maps.albedo)
    data = join(Grid(), [build(scene.soup.corners, Grid(), (0, 0))], *_still(scene))
    world_probes = probes_of(data, mixed)
    wanted = {"local": np.ones((1, 3)), "sun": np.array([[1.0, 2, 3], [0, 0, 1]]), "sky": np.array([[1.0, 1, 0]] * 2)}
    for level in world_probes.mixed(wanted):
        np.testing.assert_allclose(
            level, np.array([1 + 2 + 1, 1 + 4 + 1, 1 + 6 + 4]) * 0.75 * np.ones_like(level), rtol=2e-3
        )


FACTORS = {"local": 1.0, "sun.0": 2.0, "sun.1": 4.0, "sky.0": 2.0, "sky.1": -1.0}


def _still(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and validity of data points at all centres."""
    size = build(scene.soup.corners, Grid(), (0, 0)).size
    return np.zeros((size, 3), np.int8), np.ones(size, bool)


def probes_of(data, maps: ProbeMaps):
    """Reflections of which every voxel uses the first probe alone."""
    from gi_volumes.tree.reflections import Reflections

    probe, weight = np.zeros((1, 1), np.uint16), np.full((1, 1), 255, np.uint8)
    return Reflections(data, maps, [ProbeSets(np.zeros(len(data.valid), np.uint16), probe, weight)])


def path(kind: str, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, directions and roughness along a path on which one of them changes."""
    count = len(t)
    point = np.tile([1.5, 1.5, 1.0], (count, 1)) + ORIGIN
    direction, roughness = np.tile([0.8, 0.5, 0.33], (count, 1)), np.full(count, 0.3)
    if kind == "point":
        point = point + t[:, None] * [4.5, 3.5, 2.0]
    elif kind == "direction":
        direction = np.column_stack([np.cos(7 * t), np.sin(7 * t), 0.5 * np.sin(13 * t)])
    else:
        roughness = t
    return point, direction, roughness


@functools.cache
def grid_of(count: int) -> np.ndarray:
    return np.linspace(0, 1, count)


@pytest.mark.parametrize("kind", ["point", "direction", "roughness"])
def test_nothing_pops_along_a_path(room_with_pillar, kind):
    """The largest step of 65,536, cut into 64, has no part that holds half of it: it is steep, and no jump."""
    coarse = grid_of(1 << 16)
    jumps = np.abs(np.diff(room_with_pillar.radiance(*path(kind, coarse)), axis=0)).max(axis=1)
    assert np.quantile(jumps, 0.999) < 0.01
    row = int(jumps.argmax())
    fine = np.linspace(coarse[row], coarse[row + 1], 65)
    parts = np.abs(np.diff(room_with_pillar.radiance(*path(kind, fine)), axis=0)).max(axis=1)
    assert parts.max() < max(0.5 * jumps[row], 1e-3)


def test_the_look_up_does_not_depend_on_how_many_rays_there_are(room_with_pillar):
    point, direction = rays(3000)
    together = room_with_pillar.radiance(point, direction, 0.3)
    apart = [room_with_pillar.radiance(point[i : i + 1], direction[i : i + 1], 0.3) for i in range(0, 3000, 100)]
    assert np.array_equal(together[::100], np.concatenate(apart))


def test_no_place_and_no_direction_gives_anything_but_numbers(room_with_pillar):
    point, direction = rays(2000, margin=-3.0)
    point[:5], point[5:9] = PROBES + ORIGIN, 1e30
    direction[::7] = np.eye(3)[np.arange(len(direction[::7])) % 3]
    direction[::11] *= 1e-300
    for roughness in (0.0, 0.5, 1.0):
        found = room_with_pillar.radiance(point, direction, roughness)
        assert np.isfinite(found).all()
        assert (found >= 0).all()


def test_directions_of_any_length_mean_the_same(room):
    point, direction = rays(100)
    usual = room.radiance(point, direction, 0.2)
    np.testing.assert_allclose(room.radiance(point, direction * 1e-200, 0.2), usual, atol=1e-5)


def test_with_normals_a_wall_without_thickness_hides_what_lies_behind(tmp_path):
    """A sheet across the room; on its one side the probes of the other side count where the side is not told."""
    sheet = np.array(
        [[[3.7, 0.5, 0.3], [3.7, 6.0, 0.3], [3.7, 6.0, 3.6]], [[3.7, 0.5, 0.3], [3.7, 6.0, 3.6], [3.7, 0.5, 3.6]]]
    )

    def side(place: np.ndarray) -> np.ndarray:
        return np.eye(3)[np.where(np.abs(place[:, 0] - 3.7) < 0.01, 1, 2 * (place[:, 0] > 3.7))]

    world = world_of(scene_of(sheet.astype(np.float32)), side, tmp_path, PROBES[:4])
    generator = np.random.default_rng(2)
    point = np.column_stack(
        [np.full(500, 3.7 - 1e-4), generator.uniform(1, 5.5, 500), generator.uniform(0.6, 3.3, 500)]
    )
    direction = np.column_stack([-np.ones(500), generator.normal(size=(500, 2))])
    normal = np.tile([-1.0, 0, 0], (500, 1))
    found = world.radiance(point + ORIGIN, direction, 0.0, normals=normal)
    assert found[:, 2].max() < 1e-6
    assert found[:, 0].mean() > 0.95
    assert beyond(world, point, normal) == 0
    assert beyond(world, point, 0 * normal) > 0.1


def beyond(world: World, point: np.ndarray, normal: np.ndarray) -> float:
    """Mean weight of probes on the other side of the sheet."""
    used = world._reflections.used(point, normal)
    return float(used.weight[PROBES[used.probe, 0] > 3.7].sum()) / len(point)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"directions": np.zeros((4, 3))}, "row 0 has no length"),
        ({"directions": np.full((4, 3), np.nan)}, "not finite"),
        ({"directions": np.ones((3, 3))}, "as many are needed"),
        ({"normals": np.ones((3, 3))}, "as many are needed"),
        ({"roughness": 1.5}, "from 0 to 1"),
        ({"roughness": np.nan}, "from 0 to 1"),
        ({"roughness": np.full((4, 1), 0.5)}, "from 0 to 1"),
        ({"roughness": np.full(3, 0.5)}, "as many are needed"),
        ({"points": np.zeros(3)}, "is needed"),
    ],
)
def test_input_that_makes_no_sense_is_refused(room, change, reason):
    usual = {"points": np.ones((4, 3)), "directions": np.ones((4, 3)), "roughness": 0.5, "normals": None}
    with pytest.raises(ValueError, match=reason):
        room.radiance(**(usual | change))


def test_no_rays_are_no_trouble(room):
    assert room.radiance(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).shape == (0, 3)
