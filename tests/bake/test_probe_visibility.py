"""Which probes count where: rooms apart, doors, brute force, and the same bits however the work is split."""

from __future__ import annotations

import functools
import itertools

import build_scenes
import numpy as np
import probe_worlds
import pytest
from gi_volumes.bake import probe_visibility
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.patches import Forest
from gi_volumes.bake.probe_visibility import SLOTS, see
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.tree.build import build, occupied_cells
from gi_volumes.tree.grid import choose
from gi_volumes.tree.interpolate import DataPoints
from gi_volumes.tree.payload import NO_DATA
from gi_volumes.tree.probe_sets import WHOLE, ProbeSets, defect
from gi_volumes.tree.reflections import Rays, Reflections

GRAY = Material("gray", Channel((0.5,) * 3))
ROOM_A, ROOM_B = np.array([[0, 0, 0], [4, 5, 3.0]]), np.array([[4.2, 0, 0], [9, 5, 3.0]])
WALL = ((4, 0, 0), (4.2, 2, 3)), ((4, 3, 0), (4.2, 5, 3)), ((4, 2, 2.1), (4.2, 3, 3))
PROBES = np.array([[1, 1, 1.5], [3, 4, 1.5], [2, 2.5, 2.5], [6, 1, 1.5], [8, 4, 1.5], [5, 2.5, 2.5]])
IN_B = PROBES[:, 0] > 4.1


def within(box: np.ndarray, position: np.ndarray, margin: float = 0.05) -> np.ndarray:
    return ((position > box[0] + margin) & (position < box[1] - margin)).all(axis=1)


def ready(*parts: np.ndarray) -> tuple[Scene, Forest]:
    """A scene and its trees."""
    scene = prepare(build_scenes.snapshot([(np.concatenate(parts), GRAY)]), Model())
    grid = choose(scene.soup.corners)
    cells = occupied_cells(scene.soup.corners, grid)
    return scene, Forest(grid, tuple(build(scene.soup.corners, grid, tuple(cell)) for cell in cells))


def data_of(forest: Forest) -> DataPoints:
    """Data points in the two rooms."""
    valid = lambda place: within(ROOM_A, place) | within(ROOM_B, place)  # noqa: E731
    return probe_worlds.points_of(forest.grid, forest.trees, valid)


@functools.cache
def sealed() -> tuple[Scene, DataPoints]:
    scene, forest = ready(build_scenes.box(*ROOM_A, inward=True), build_scenes.box(*ROOM_B, inward=True))
    return scene, data_of(forest)


@functools.cache
def with_door() -> tuple[Scene, DataPoints]:
    walls = [build_scenes.box(*part) for part in WALL]
    scene, forest = ready(build_scenes.box((0, 0, 0), (9, 5, 3), inward=True), *walls)
    return scene, data_of(forest)


def dense(sets: ProbeSets, probes: int = len(PROBES)) -> np.ndarray:
    """(voxels, probes) weights that sum to 1 or to 0."""
    found = np.zeros((len(sets.index), probes))
    rows = np.flatnonzero(sets.index != NO_DATA)
    for slot in range(sets.probe.shape[1]):
        np.add.at(found, (rows, sets.probe[sets.index[rows], slot]), sets.weight[sets.index[rows], slot] / WHOLE)
    return found


@pytest.mark.parametrize("slots", [1, SLOTS])
def test_no_probe_counts_through_a_wall(monkeypatch, slots):
    monkeypatch.setattr(probe_visibility, "SLOTS", slots)
    scene, data = sealed()
    weight = dense(see(scene, data, PROBES, Effort(0)))
    in_a, in_b = within(ROOM_A, data.position), within(ROOM_B, data.position)
    assert np.abs(weight[in_a | in_b].sum(axis=1) - 1).max() < 1e-9
    assert weight[in_a][:, IN_B].max() == 0
    assert weight[in_b][:, ~IN_B].max() == 0


def test_probes_that_did_not_know_of_walls_would_count(monkeypatch):
    scene, forest = ready(*(build_scenes.box(*room, inward=True) for room in (ROOM_A, ROOM_B)))
    monkeypatch.setattr(scene.tracer, "blocked", lambda start, toward, far: np.zeros(start.shape[1], bool))
    data = data_of(forest)
    weight = dense(see(scene, data, PROBES[IN_B], Effort(0)), IN_B.sum())
    assert weight[within(ROOM_A, data.position)].max() > 0.5


def test_through_a_door_probes_of_the_other_room_count_a_little():
    scene, data = with_door()
    weight = dense(see(scene, data, PROBES, Effort(0)))
    in_a = within(ROOM_A, data.position)
    of_b = weight[in_a][:, IN_B].sum(axis=1)
    before = np.abs(data.position[in_a] - [3.5, 2.5, 1]).max(axis=1) < 0.6
    corner = np.abs(data.position[in_a] - [3.5, 4.6, 1.5]).max(axis=1) < 0.4
    assert of_b.mean() < 0.15
    assert of_b[before].mean() > 0.15
    assert of_b[corner].max() < 0.1


def test_the_few_probes_show_nearly_what_the_best_few_would(monkeypatch):
    """Greedy against all choices: within 1 - 1/e of the best, and a few per cent in the mean."""
    monkeypatch.setattr(probe_visibility, "SLOTS", 2)
    generator = np.random.default_rng(5)
    worth = (generator.random((7, 40, probe_visibility.RAYS)) ** 3).astype(np.float32)
    chosen, _ = probe_visibility._best(worth)
    reached = np.maximum(worth[chosen[:, 0], np.arange(40)], worth[chosen[:, 1], np.arange(40)]).sum(axis=1)
    best = np.max([np.maximum(worth[a], worth[b]).sum(axis=1) for a, b in itertools.combinations(range(7), 2)], axis=0)
    assert (reached >= (1 - 1 / np.e) * best).all()
    assert reached.mean() > 0.95 * best.mean()


def test_a_probe_counts_by_the_rays_that_it_shows_best():
    worth = np.zeros((3, 1, probe_visibility.RAYS), np.float32)
    worth[0, 0, :12], worth[1, 0, 12:20], worth[2, 0, :4] = 0.5, 0.7, 0.4
    chosen, share = probe_visibility._best(worth)
    assert chosen[0, :2].tolist() == [0, 1]
    assert share[0].tolist() == [12, 8, 0, 0]


def test_what_nothing_shows_has_no_probes():
    scene, data = sealed()
    none = see(scene, data, np.zeros((0, 3)), Effort(0))
    inside_wall = see(scene, data, np.array([[4.1, 2, 1]]), Effort(0))
    for sets in (none, inside_wall):
        assert not sets.weight.any()
        assert defect(sets, 1, data.valid) is None


def test_rays_that_leave_are_shown_by_probes_that_see_the_sky():
    """Above a ground, under a roof: the nearer probe is below it and sees no sky overhead."""
    roof = build_scenes.box((-3, -3, 3), (3, 3, 3.2))
    scene, forest = ready(build_scenes.plane(40), roof)
    probes = np.array([[0, 0, 2.5], [0, 0, 9.0]])
    above = lambda place: (place[:, 2] > 3.3) & (np.abs(place[:, :2]) < 3).all(axis=1)  # noqa: E731
    data = probe_worlds.points_of(forest.grid, forest.trees, above)
    weight = dense(see(scene, data, probes, Effort(0)), 2)[data.valid]
    assert len(weight) > 3
    assert weight[:, 1].mean() > 0.85


@pytest.mark.parametrize("effort", [Effort(0, threads=1), Effort(0, threads=3)])
def test_threads_and_tiles_do_not_change_a_bit(monkeypatch, effort):
    scene, data = with_door()
    usual = see(scene, data, PROBES, Effort(0))
    monkeypatch.setattr(probe_visibility, "PAIRS", 17 * probe_visibility.RAYS * len(PROBES))
    other = see(scene, data, PROBES, effort)
    for name in ("index", "probe", "weight"):
        assert np.array_equal(getattr(usual, name), getattr(other, name))


def test_another_seed_chooses_by_other_rays():
    scene, data = with_door()
    one, other = (dense(see(scene, data, PROBES, Effort(0, seed=seed))) for seed in (0, 1))
    assert not np.array_equal(one, other)
    assert np.abs(one - other).sum(axis=1)[data.valid].mean() < 0.5


def test_it_stops_when_asked_to():
    scene, data = with_door()
    with pytest.raises(CancelledError):
        see(scene, data, PROBES, Effort(0), lambda done: False)


def test_reflections_show_their_own_room_and_the_other_one_through_the_door_alone():
    """Room A shines red, room B blue; rays that end well away from the door's frame."""
    scene, data = with_door()

    def shine(place: np.ndarray) -> np.ndarray:
        return np.where(place[:, :1] < 4.1, [[1.0, 0, 0]], [[0, 0, 1.0]])

    maps = probe_worlds.traced(scene, PROBES, shine, 0.0, 64)
    probes = Reflections(data, maps, [see(scene, data, PROBES, Effort(0))])
    generator = np.random.default_rng(1)
    point, direction = (
        generator.uniform(ROOM_A[0] + 0.02, ROOM_A[1] - 0.02, (8000, 3)),
        generator.normal(size=(8000, 3)),
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance, _ = probe_worlds.meet(scene, point, direction, shine, 0.0)
    end = point + direction * distance[:, None]
    rays = Rays(point, direction.astype(np.float32), np.zeros(8000), np.zeros((8000, 3), np.float32))
    light, _ = probes.look(rays, probes.mixed({"local": np.ones((1, 3))}))
    inside, through = end[:, 0] < 3.9, end[:, 0] > 5
    assert light[inside, 2].mean() < 2e-3
    assert (light[inside, 2] > 0.1).mean() < 2e-3
    assert through.sum() > 50
    assert light[through, 2].mean() > 0.5
