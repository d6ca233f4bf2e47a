"""Where probes stand: rooms, doors, corridors, storeys, streets, any scale; and all that can be missing."""

from __future__ import annotations

import functools

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import candidates as candidates_module
from gi_volumes.bake import patches as patches_module
from gi_volumes.bake import receivers, warp
from gi_volumes.bake import views as views_module
from gi_volumes.bake.candidates import candidates
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.patches import Forest, Patches, of_receivers, patches, spread_over
from gi_volumes.bake.probes import Probes, Request, RequestError, place
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.bake.views import views
from gi_volumes.tree.build import build, occupied_cells
from gi_volumes.tree.grid import choose
from gi_volumes.tree.probe_atlas import Layout

GRAY = Material("gray", Channel((0.5,) * 3))
EFFORT = Effort(0)
NOWHERE = np.zeros((0, 2, 3))

ROOM_A = np.array([[0.1, 0.1, 0.1], [4.1, 5.1, 3.1]])
ROOM_B = np.array([[4.4, 0.1, 0.1], [9.9, 5.1, 3.1]])


def room(box) -> np.ndarray:
    return build_scenes.box(*box, inward=True)


def ready(*parts: np.ndarray) -> tuple[Scene, Forest]:
    """A scene and its trees."""
    scene = prepare(build_scenes.snapshot([(np.concatenate(parts), GRAY)]), Model())
    corners = scene.soup.corners
    grid = choose(corners)
    trees = (build(corners, grid, tuple(cell)) for cell in occupied_cells(corners, grid))
    return scene, Forest(grid, tuple(trees))


@functools.cache
def two_rooms() -> tuple[Scene, Forest]:
    return ready(room(ROOM_A), room(ROOM_B))


@functools.cache
def street() -> tuple[Scene, Forest]:
    """A wide ground with two rows of two houses, solid ones."""
    houses = [build_scenes.box((x, y, -0.5), (x + 8, y + 6, 5)) for x in (-10.3, 3.7) for y in (-11.2, 5.3)]
    return ready(build_scenes.plane(60), *houses)


def number_in(box: np.ndarray, position: np.ndarray) -> np.ndarray:
    return ((position >= box[0]) & (position <= box[1])).all(axis=1)


def placed(case: tuple[Scene, Forest], count: int, **wishes) -> Probes:
    return place(*case, Request(count, **wishes), EFFORT)


def test_two_rooms_get_a_probe_each_before_either_gets_a_second_one():
    found = placed(two_rooms(), 8)
    in_a, in_b = (number_in(box, found.position) for box in (ROOM_A, ROOM_B))
    assert (in_a | in_b).all()
    assert sorted([in_a[:2].sum(), in_b[:2].sum()]) == [1, 1]
    assert min(in_a.sum(), in_b.sum()) >= 3
    assert (np.diff(found.gain) <= 0).all()


def test_probes_that_did_not_know_of_walls_would_stand_in_one_room(monkeypatch):
    scene, forest = ready(room(ROOM_A), room(ROOM_B))
    monkeypatch.setattr(scene.tracer, "blocked", lambda start, toward, far: np.zeros(start.shape[1], bool))
    found = place(scene, forest, Request(2), EFFORT)
    assert found.gain[1] < 0.6 * placed(two_rooms(), 2).gain[1]


def test_a_room_has_its_first_probe_in_the_middle_half():
    scene, forest = ready(room([[0, 0, 0], [6, 8, 3]]))
    first = place(scene, forest, Request(1), EFFORT).position[0]
    assert (np.abs(first - [3, 4, 1.5]) <= [1.5, 2, 0.75]).all()


def test_a_door_does_not_make_two_rooms_one():
    around_door = ((4, 0, 0), (4.2, 2, 3)), ((4, 3, 0), (4.2, 5, 3)), ((4, 2, 2.1), (4.2, 3, 3))
    walls = [build_scenes.box(low, high) for low, high in around_door]
    found = placed(ready(room([[0, 0, 0], [9, 5, 3]]), *walls), 6)
    left = found.position[:, 0] < 4
    assert 2 <= left.sum() <= 4


def test_a_corridor_gets_probes_along_its_whole_length():
    found = placed(ready(room([[0, 0, 0], [40, 1.3, 2.4]])), 10)
    along = np.sort(found.position[:, 0])
    gaps = np.diff(np.concatenate([[-along[0]], along, [80 - along[-1]]]))  # mirrored at both ends
    assert len(along) == 10
    assert gaps.max() < 2 * 4
    assert gaps.min() > 0.5


def test_each_storey_gets_its_own():
    lower, upper = np.array([[0, 0, 0], [8, 6, 2.5]]), np.array([[0, 0, 2.8], [8, 6, 5.3]])
    found = placed(ready(room(lower), room(upper)), 6)
    assert number_in(lower, found.position[:2]).sum() == 1
    assert number_in(lower, found.position).sum() == 3
    assert number_in(upper, found.position).sum() == 3


def test_a_street_has_its_probes_between_houses_not_in_them_nor_below_the_ground():
    found = placed(street(), 12)
    x, y, z = found.position.T
    assert len(x) == 12
    assert (z > 0.2).all()
    assert (z < 8).all()
    assert abs(y[0]) < 5
    assert (np.abs(x) < 20).all()
    for corner in ((-10.3, -11.2), (3.7, 5.3)):
        assert not number_in(np.array([[*corner, -1], [corner[0] + 8, corner[1] + 6, 5]]), found.position).any()


@pytest.mark.parametrize("scale", [1 / 256, 1 / 3, 5.0])
def test_scenes_of_any_size_are_treated_alike(scale):
    boxes = ROOM_A * scale, ROOM_B * scale
    found = placed(ready(*map(room, boxes)), 4)
    usual = placed(two_rooms(), 4)
    assert sorted(number_in(box, found.position[:2]).sum() for box in boxes) == [1, 1]
    assert found.gain.sum() / found.total == pytest.approx(usual.gain.sum() / usual.total, abs=0.05)


def test_the_first_of_many_are_the_list_of_few():
    many = placed(two_rooms(), 20, least_gain=0.0)
    assert len(many.position) == 20
    for count in (0, 1, 5):
        few = placed(two_rooms(), count)
        assert np.array_equal(few.position, many.position[:count])
        assert np.array_equal(few.gain, many.gain[:count])
        assert "as many as were asked for" in few.reason


def test_threads_change_nothing_and_another_seed_little():
    scene, forest = two_rooms()
    one, other = (place(scene, forest, Request(9), Effort(0, threads=threads)) for threads in (1, 3))
    for name in ("position", "gain", "pinned"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    again = place(scene, forest, Request(9), Effort(0, seed=5))
    assert again.gain.sum() / again.total == pytest.approx(one.gain.sum() / one.total, abs=0.03)
    assert not np.array_equal(again.gain, one.gain)


def test_pinned_probes_come_first_and_the_others_leave_their_room_to_them():
    pinned = ROOM_B.mean(axis=0)[None]
    found = placed(two_rooms(), 2, pinned=pinned)
    assert found.pinned.tolist() == [True, False]
    assert np.array_equal(found.position[:1], pinned)
    assert number_in(ROOM_A, found.position[1:]).all()
    outside = np.array([[100.0, 0, 0], [4.25, 2, 1]])
    found = placed(two_rooms(), 1, pinned=outside)
    assert np.array_equal(found.position, outside)
    assert found.gain.max() < 1e-3 * found.total


def test_no_candidates_stand_where_they_were_deleted():
    deleted = np.array([[[-1, -1, -1], [4.2, 6, 4]]], float)
    found = placed(two_rooms(), 5, deleted=deleted)
    assert number_in(ROOM_B, found.position).all()
    none = placed(two_rooms(), 5, deleted=np.array([[[-1e3] * 3, [1e3] * 3]]))
    assert len(none.position) == 0
    assert "deleted" in none.reason


def test_a_budget_and_a_least_gain_end_the_list():
    layout = Layout(128, 1, 1)
    probe_bytes = 8 * layout.texels
    found = placed(two_rooms(), 1000, megabytes=3.5 * probe_bytes / 1e6, probe_bytes=probe_bytes)
    assert len(found.position) == 3
    assert placed(two_rooms(), 5, megabytes=0.0, probe_bytes=1).position.shape == (0, 3)
    few = placed(two_rooms(), 1000, least_gain=0.3)
    assert len(few.position) == 2
    assert "too little" in few.reason
    assert (few.gain >= 0.3 * few.gain[0]).all()


@pytest.mark.parametrize(
    ("wishes", "word"),
    [
        ({"count": -1}, "probes"),
        ({"least_gain": 2.0}, "least gain"),
        ({"pinned": np.zeros((2, 2))}, "pinned"),
        ({"pinned": np.full((1, 3), np.nan)}, "pinned"),
        ({"deleted": np.zeros((2, 3))}, "deleted"),
        ({"megabytes": 5.0}, "budget"),
        ({"megabytes": float("nan"), "probe_bytes": 9}, "budget"),
    ],
)
def test_requests_that_make_no_sense_are_refused(wishes, word):
    with pytest.raises(RequestError, match=word):
        place(*two_rooms(), Request(**wishes), EFFORT)


def test_a_lone_ground_has_nothing_to_reflect():
    found = placed(ready(build_scenes.plane(30)), 5)
    assert len(found.position) == 0
    assert found.total == 0
    assert "sky alone" in found.reason


def test_a_room_turned_inside_out_says_that_candidates_see_backs():
    found = placed(ready(build_scenes.box((0, 0, 0), (6, 5, 3))), 5)
    assert len(found.position) == 0
    assert "see the backs of surfaces" in found.reason


def test_no_free_candidate_is_said_and_pinned_probes_stay(monkeypatch):
    monkeypatch.setattr(candidates_module, "BACKFACE_LIMIT", -1.0)
    found = placed(two_rooms(), 5, pinned=np.ones((1, 3)))
    assert found.pinned.tolist() == [True]
    assert "no candidate is free" in found.reason
    assert found.candidates == 0


def test_no_cells_no_probes():
    scene, forest = two_rooms()
    found = place(scene, Forest(forest.grid, ()), Request(3), EFFORT)
    assert len(found.position) == 0


def test_progress_rises_to_one_and_stops_the_work():
    said = []
    place(*two_rooms(), Request(1), EFFORT, lambda share: said.append(share) or True)
    assert said == sorted(said)
    assert said[-1] == 1
    with pytest.raises(CancelledError):
        place(*two_rooms(), Request(1), EFFORT, lambda share: share < 0.2)


def test_candidates_are_free_away_from_surfaces_and_denser_where_it_is_narrow(monkeypatch):
    wide, narrow = np.array([[0, 0, 0], [20, 20, 8.0]]), np.array([[21, 0, 0], [23, 20, 2.5]])
    scene, forest = ready(room(wide), room(narrow))
    monkeypatch.setattr(candidates_module, "MOST", 600)
    found = candidates(scene, forest, NOWHERE, EFFORT)
    assert len(found.position) <= 600
    in_wide, in_narrow = (number_in(box, found.position) for box in (wide, narrow))
    assert (in_wide | in_narrow).all()
    volume = [np.prod(box[1] - box[0]) for box in (wide, narrow)]
    assert in_narrow.sum() / volume[1] > 2 * in_wide.sum() / volume[0]
    gap = np.minimum(found.position[in_wide] - wide[0], wide[1] - found.position[in_wide]).min(axis=1)
    assert gap.min() > 0.2


def test_patches_of_a_closed_room_count_with_all_their_area_and_of_open_ground_with_none():
    box = np.array([[0, 0, 0], [6, 5, 3.0]])
    found = patches(*ready(room(box)), EFFORT)
    assert found.weight.sum() == pytest.approx(2 * (6 * 5 + 6 * 3 + 5 * 3), rel=1e-5)
    assert (found.reach < np.sqrt(36 + 25 + 9)).all()
    found = patches(*street(), EFFORT)
    far = np.abs(found.start[0]) > 45
    assert found.weight[far].sum() < 0.01 * found.weight.sum()


def test_patches_count_by_what_meets_them_as_rays_from_all_surfaces_do():
    # Reciprocity: cosine rays from everywhere, by area, land on a patch as often as its area times its share.
    scene, _ = ready(room([[0, 0, 0], [6, 5, 3]]), build_scenes.box((2, 2, -0.1), (3.5, 3, 2)))
    at = receivers.spread(scene, (-1,) * 3, (7,) * 3, 0.2)
    found = of_receivers(scene, at, EFFORT)
    rng = np.random.default_rng(0)
    rows = rng.choice(len(at.area), 200_000, p=at.area / at.area.sum(dtype=float))
    direction = warp.cosine(*rng.random((2, len(rows)), np.float32), np.ascontiguousarray(at.normal[rows].T))
    hits = scene.tracer.intersect(receivers.lifted(scene, at)[:, rows], direction)
    share = (hits.triangle >= 12).sum() / (hits.triangle >= 0).sum()
    inner = (np.abs(found.start - np.array([[2.75], [2.5], [1]])) < [[0.755], [0.505], [1.005]]).all(axis=0)
    inner &= found.start[2] > 0.005
    expected = found.weight[inner].sum() / found.weight.sum()
    assert share == pytest.approx(expected, rel=0.02)
    assert share != pytest.approx(9 / 126, rel=0.02)


def test_patches_are_thinned_to_equal_weights_and_keep_their_sum(monkeypatch):
    everything = patches(*street(), EFFORT)
    monkeypatch.setattr(patches_module, "MOST", 2000)
    monkeypatch.setattr(patches_module, "SPARE", 16)
    few = patches(*street(), EFFORT)
    assert abs(len(few.weight) - 2000) <= 1
    assert few.weight.sum() == pytest.approx(everything.weight.sum(), rel=0.02)
    assert np.median(few.weight) == pytest.approx(few.weight.max(), rel=0.2)
    near = (np.abs(few.start[:2]) < 15).all(axis=0)
    all_near = (np.abs(everything.start[:2]) < 15).all(axis=0)
    share = everything.weight[all_near].sum() / everything.weight.sum()
    assert few.weight[near].sum() / few.weight.sum() == pytest.approx(share, abs=0.03)


def test_where_much_is_seen_fewer_candidates_are_looked_at(monkeypatch):
    monkeypatch.setattr(views_module, "MOST", 40_000)
    scene, forest = two_rooms()
    some, free = patches(scene, forest, EFFORT), candidates(scene, forest, NOWHERE, EFFORT)
    count = views_module.affordable(scene, free.position, some)
    assert 4 < count < len(free.position)
    thinned = free.thinned(count)
    assert 1 <= len(thinned.position) <= count
    assert len(views(scene, thinned.position, some).patch) < 1.3 * 40_000
    assert min(number_in(box, placed(two_rooms(), 4).position).sum() for box in (ROOM_A, ROOM_B)) >= 1


def test_a_view_straight_from_four_times_as_far_is_worth_a_half_and_walls_hide():
    scene, _ = ready(build_scenes.plane(50), build_scenes.box((2, -1, 0.2), (2.2, 1, 3)))
    ones = np.ones(2, np.float32)
    normal = np.repeat(np.float32([[0], [0], [1]]), 2, axis=1)
    start = np.float32([[0, 5], [0, 0], [1e-4, 1e-4]])
    found = views(scene, np.array([[0, 0, 4.0], [0, 0, -1.0], [0, 0, 1e-3]]), Patches(start, normal, ones, ones))
    assert found.first.tolist() == [0, 1, 1, 2]  # the second patch is behind the wall, the second place below
    assert found.patch.tolist() == [0, 0]
    assert found.worth == pytest.approx([0.5, 1.0], abs=1e-4)


def test_views_are_those_of_a_plain_double_loop():
    scene, forest = two_rooms()
    some = patches(scene, forest, EFFORT)
    place = np.random.default_rng(1).uniform(ROOM_A[0], ROOM_B[1], (40, 3))
    found = views(scene, place, some, threads=2)
    for number, position in enumerate(place.astype(np.float32)):
        toward = position[:, None] - some.start
        squared = (toward**2).sum(axis=0)
        facing = np.maximum((toward * some.normal).sum(axis=0), 0) / np.sqrt(squared) * (4 * some.reach) ** 2
        worth = facing / (facing + squared)
        worth[scene.tracer.blocked(some.start, toward, np.ones(len(squared), np.float32))] = 0
        worth[worth < views_module.LEAST] = 0
        row = found.row(number)
        assert np.array_equal(found.patch[row], np.flatnonzero(worth))
        assert found.worth[row] == pytest.approx(worth[worth > 0], rel=1e-5)


def test_our_probes_see_more_than_as_many_random_ones_or_the_best_by_themselves():
    rooms = [room(np.array([[x, 0, 0], [x + width, 4 + width, 3]])) for x, width in ((0, 3), (3.2, 5), (8.5, 2))]
    scene, forest = ready(*rooms, build_scenes.box((5, 2, 0), (6, 6, 2)))
    ours = place(scene, forest, Request(6), EFFORT)
    judges = of_receivers(scene, spread_over(scene, forest, 0, 1.3), Effort(0, seed=3))
    free = candidates(scene, forest, NOWHERE, EFFORT).position
    rng = np.random.default_rng(2)
    random = [seen(scene, free[rng.permutation(len(free))[:6]], judges) for _ in range(20)]
    everything = views(scene, free, judges)
    alone = np.add.reduceat(everything.worth * judges.weight[everything.patch], everything.first[:-1])
    assert seen(scene, ours.position, judges) > 1.1 * np.mean(random)
    assert seen(scene, ours.position, judges) > max(random)
    assert seen(scene, ours.position, judges) > 1.1 * seen(scene, free[np.argsort(-alone)[:6]], judges)


def seen(scene: Scene, position: np.ndarray, judges: Patches) -> float:
    """The part of what counts that some places see well."""
    found, best = views(scene, position, judges), np.zeros(len(judges.weight))
    np.maximum.at(best, found.patch, found.worth)
    return float(best @ judges.weight / judges.weight.sum(dtype=np.float64))
