"""Occluding planes: rooms stay apart and keep their own light, whatever the wall; nothing is hidden for nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import blockers, datapoints, halfspaces, occluders
from gi_volumes.bake.occluders import Occluders, fit
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.receivers import Receivers, spread
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.bake.separators import separate
from gi_volumes.bake.sight import look
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.tree import build, interpolate
from gi_volumes.tree.grid import Grid

GRAY = Material("gray", Channel((0.5,) * 3))
GLASS = Material("glass", Channel((1.0,) * 3), transmission=Channel((1.0,)))
GRID = Grid(8.0, 3)
FITTED, JUDGED = 0.17, 0.13
"""Spacings of the receivers that planes are fitted to, and of others that judge them [m]."""
EDGE = 1e-3
"""Receivers this close to a wall's edge may be on either side of a plane [m]."""


@dataclass(frozen=True)
class Case:
    """A scene with its data points, their planes, and receivers that the planes were not fitted to."""

    scene: Scene
    data: interpolate.DataPoints
    found: Occluders
    judges: Receivers

    def weights(self, planes: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Data points and weights at the judges, as at run time."""
        data = replace(self.data, planes=self.found.planes, plane=self.found.plane) if planes else self.data
        return interpolate.weigh(data, self.judges.position, self.judges.normal)

    def sides(self) -> np.ndarray:
        """Just off the judges, on the side that they are on."""
        return self.judges.position + EDGE * self.judges.normal


def scene_of(*parts, material: Material = GRAY) -> Scene:
    return prepare(build_scenes.snapshot([(triangles, material) for triangles in parts]), Model())


def data_of(scene: Scene, grid: Grid = GRID) -> interpolate.DataPoints:
    cells = build.occupied_cells(scene.soup.corners, grid)
    trees = [build.build(scene.soup.corners, grid, tuple(cell)) for cell in cells]
    size = sum(tree.size for tree in trees)
    data = interpolate.join(grid, trees, np.zeros((size, 3), np.int8), np.ones(size, bool))
    key = datapoints.keys(data.level, data.coords)
    placed = datapoints.place(scene, grid.centers(data.level.astype(np.int64), data.coords), data.size, key)
    return interpolate.join(grid, trees, placed.offset, placed.valid)


def around(scene: Scene, spacing: float) -> Receivers:
    low, high = scene.soup.bounds
    return spread(scene, low - 1, high + 1, spacing)


def case_of(scene: Scene) -> Case:
    data = data_of(scene)
    return Case(scene, data, fit(scene, data, around(scene, FITTED)), around(scene, JUDGED))


def in_box(points: np.ndarray, low, high) -> np.ndarray:
    return ((points > low) & (points < high)).all(axis=-1)


def check(case: Case) -> None:
    """What holds for every scene."""
    found, data = case.found, case.data
    assert found.planes.dtype == np.int32
    assert found.planes.shape == (len(data.valid), 3)
    assert found.plane.dtype == np.float64
    assert ((found.planes >= -1) & (found.planes < len(found.plane))).all()
    assert ((found.planes[:, :-1] >= 0) | (found.planes[:, 1:] < 0)).all()
    assert np.array_equal(np.unique(found.planes[found.planes >= 0]), np.arange(len(found.plane)))
    assert len(np.unique(found.plane, axis=0)) == len(found.plane)
    if not len(found.plane):
        return
    normal, width = found.plane[:, :3], found.plane[:, 4]
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-12
    assert (width >= data.grid.cell_size * 2.0**-20).all()
    assert (width <= data.grid.voxel_size(data.grid.levels - 1) / 8).all()
    point, slot = np.nonzero(found.planes >= 0)
    plane = found.plane[found.planes[point, slot]]
    assert ((plane[:, :3] * data.position[point]).sum(axis=1) > plane[:, 3]).all()
    assert data.valid[point].all()


def visible_weight(case: Case, receivers: Receivers, planes: bool) -> np.ndarray:
    """(n,) weight of what each receiver sees, by rays, at any level that may light it."""
    pairs = look(case.scene, case.data, receivers)
    passed = np.ones(len(pairs.point))
    for slot in range(3 * planes):
        row = case.found.planes[pairs.point, slot]
        plane = case.found.plane[row]
        height = (plane[:, :3] * receivers.position[pairs.receiver]).sum(axis=1) - plane[:, 3]
        passed *= np.where(row >= 0, np.clip(1 + height / plane[:, 4], 0, 1), 1)
    return np.bincount(pairs.receiver, pairs.weight * pairs.visible * passed, len(receivers.key))


def two_rooms(thickness: float, shift=(0, 0, 0), turn: float = 0.0) -> tuple[list[np.ndarray], callable]:
    """Parts of two rooms in a shell, and a function that says in which of them points are, 0, 1 or -1."""
    rooms = [((-4, -3, 0.1), (-thickness / 2, 3, 2.7)), ((thickness / 2, -3, 0.1), (4, 3, 2.7))]
    parts = [build_scenes.box(*room, inward=True) for room in rooms]
    parts.append(build_scenes.box((-4.3, -3.3, -0.2), (4.3, 3.3, 3.0)))
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    def room_of(points: np.ndarray) -> np.ndarray:
        local = (points - shift) @ rotation
        return np.where(in_box(local, *rooms[0]), 0, np.where(in_box(local, *rooms[1]), 1, -1))

    return [part @ rotation.T + shift for part in parts], room_of


@pytest.mark.parametrize("thickness", [0.3, 0.1, 0.02, 0.004])
@pytest.mark.parametrize(("shift", "turn"), [((0, 0, 0), 0), ((0.13, 0.07, 0.31), 0), ((50.2, -37.1, 3), 0.5)])
def test_a_wall_keeps_two_rooms_apart_and_each_its_own_light(thickness, shift, turn):
    parts, room_of = two_rooms(thickness, shift, turn)
    case = case_of(scene_of(*parts))
    check(case)
    assert not case.found.unseen.any()
    row, weight = case.weights()
    before_row, before = case.weights(planes=False)
    at, of, of_before = room_of(case.sides()), room_of(case.data.position)[row], room_of(case.data.position)[before_row]
    foreign = before[(at >= 0)[:, None] & (of_before == 1 - at[:, None])].sum()
    assert foreign > 1  # the cosine alone does not do it
    for room in (0, 1):
        here, other, own = at == room, of == 1 - room, of == room
        leak = (weight * other)[here].sum(axis=1) / weight[here].sum(axis=1)
        assert (leak > 0.02).mean() < 2e-3  # data points that none of the receivers fitted to showed to light it
        assert leak.mean() < 2e-4
        kept = (weight * own)[here].sum(axis=1) / (before * (of_before == room))[here].sum(axis=1)
        assert kept.mean() > 0.995
        assert kept.min() > 0.5


def test_planes_of_a_sheet_without_thickness_part_what_is_before_and_behind_it():
    room = build_scenes.box((-4, -3, 0), (4, 3, 2.6), inward=True)
    sheet = build_scenes.quad((0.1, -3, 0), (0.1, 3, 0), (0.1, 3, 2.6), (0.1, -3, 2.6))
    case = case_of(scene_of(room, np.concatenate([sheet, sheet[:, ::-1] + 0.0])))
    check(case)
    row, weight = case.weights()
    side, of = case.sides()[:, 0] > 0.1, case.data.position[row][..., 0] > 0.1
    inside = in_box(case.sides(), (-4, -3, 0), (4, 3, 2.6))
    leak = (weight * (of != side[:, None]))[inside].sum(axis=1)
    assert leak.mean() < 3e-3


def test_data_points_light_through_a_door_what_they_see():
    parts = [build_scenes.box((-4, -3, 0), (4, 3, 2.6), inward=True)]
    parts += [build_scenes.box((-0.1, -3, 0), (0.1, -0.6, 2.6)), build_scenes.box((-0.1, 0.6, 0), (0.1, 3, 2.6))]
    case = case_of(scene_of(*parts))
    check(case)
    seen, kept = visible_weight(case, case.judges, False), visible_weight(case, case.judges, True)
    floor = in_box(case.judges.position, (-1, -0.5, -0.1), (1, 0.5, 0.1))
    assert (kept[floor] / seen[floor]).mean() > 0.95
    lit = seen > 0.04
    assert (kept[lit] > 0.02).mean() > 0.999
    assert kept.sum() / seen.sum() > 0.98


def test_what_stands_behind_a_column_or_a_corner_is_hidden_and_little_else():
    floor = build_scenes.plane(6)
    column = build_scenes.box((-0.35, -0.35, 0), (0.35, 0.35, 4))
    corner = [build_scenes.box((2, -3, 0), (2.2, 2, 3)), build_scenes.box((2, 1.8, 0), (5, 2, 3))]
    case = case_of(scene_of(floor, column, *corner))
    check(case)
    assert case.found.visible_kept > 0.985
    assert case.found.invisible_kept < 0.1
    pairs = look(case.scene, case.data, case.judges)
    seen, kept = visible_weight(case, case.judges, False), visible_weight(case, case.judges, True)
    assert kept.sum() / seen.sum() > 0.98
    assert (~pairs.visible).any()


def test_a_slanted_roof_parts_the_attic_from_the_sky():
    west = build_scenes.quad((-4, -5, 0), (0, -5, 3), (0, 5, 3), (-4, 5, 0))
    east = build_scenes.quad((4, 5, 0), (0, 5, 3), (0, -5, 3), (4, -5, 0))
    roof = np.concatenate([west, east])
    shell = np.concatenate([roof[:, ::-1], roof - (0, 0, 0.15)])
    ends = [build_scenes.box((-4, y, -0.2), (4, y + 0.1, 3)) for y in (-5.1, 5)]
    case = case_of(scene_of(shell, build_scenes.plane(6, 0.0), *ends))
    check(case)
    row, weight = case.weights()

    def is_attic(points):
        return points[..., 2] < 3 - 0.15 - 0.75 * np.abs(points[..., 0])

    center = in_box(case.judges.position, (-3, -4, 0.5), (3, 4, 4))
    leak = (weight * (is_attic(case.data.position[row]) != is_attic(case.sides())[:, None]))[center].sum(axis=1)
    assert leak.mean() < 2e-3


def test_a_cellar_sees_nothing_of_the_street():
    cellar = build_scenes.box((-3, -3, -2.6), (3, 3, -0.25), inward=True)
    case = case_of(scene_of(build_scenes.plane(10), cellar, build_scenes.box((-12, -12, -4), (12, 12, -0.0001))))
    check(case)
    row, weight = case.weights()
    below = case.data.position[row][..., 2] < -0.1
    inside = in_box(case.sides(), (-3, -3, -2.6), (3, 3, -0.25))
    street = case.sides()[:, 2] > 0
    assert (weight * ~below)[inside].sum(axis=1).max() < 1e-3
    assert (weight * below)[street].sum(axis=1).max() < 0.02


def test_glass_hides_nothing():
    pane = build_scenes.box((-0.02, -3, 0), (0.02, 3, 2.6))
    room = build_scenes.box((-4, -3, 0), (4, 3, 2.6), inward=True)
    scene = prepare(build_scenes.snapshot([(room, GRAY), (pane, GLASS)]), Model())
    case = case_of(scene)
    # Separators of the room's inside from its outside may lie anywhere; the pane's own two planes are not among them.
    assert not ((np.abs(case.found.plane[:, 0]) > 0.999) & (np.abs(case.found.plane[:, 3]) < 0.1)).any()
    wooden = case_of(scene_of(room, pane))
    assert ((np.abs(wooden.found.plane[:, 0]) > 0.9) & (np.abs(wooden.found.plane[:, 3]) < 1)).any()


def clutter(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-0.5, 0.4, (60, 1, 1))
    triangles = rng.uniform((-5, -5, 0), (5, 5, 4), (60, 1, 3)) + size * rng.normal(0, 1, (60, 3, 3))
    flat = np.repeat(rng.uniform(-4, 4, (3, 1, 3)), 3, axis=1)
    return scene_of(triangles, flat, build_scenes.box((-6, -6, -1), (6, 6, 6), inward=True))


@pytest.mark.parametrize("seed", range(4))
def test_random_triangles_hide_most_of_the_invisible_and_leave_no_receiver_in_the_dark(seed):
    scene = clutter(seed)
    data, receivers = data_of(scene), around(scene, 0.25)
    case = Case(scene, data, fit(scene, data, receivers), receivers)
    check(case)
    seen, kept = visible_weight(case, receivers, False), visible_weight(case, receivers, True)
    assert (kept >= np.minimum(seen / 2, occluders.ENOUGH) * (1 - 1e-6))[seen > occluders.FAINT].all()
    assert np.array_equal(case.found.unseen, seen <= occluders.FAINT)
    assert case.found.visible_kept == pytest.approx(kept.sum() / seen.sum(), rel=1e-6)
    assert case.found.visible_kept > 0.93
    assert case.found.invisible_kept < 0.25


def test_planes_do_not_depend_on_threads():
    scene = clutter(9)
    data, receivers = data_of(scene), around(scene, 0.3)
    once, again = fit(scene, data, receivers, threads=1), fit(scene, data, receivers, threads=5)
    assert np.array_equal(once.planes, again.planes)
    assert np.array_equal(once.plane, again.plane)


def test_tiles_do_not_change_the_planes(monkeypatch):
    scene = clutter(8)
    data, receivers = data_of(scene), around(scene, 0.3)
    whole = fit(scene, data, receivers)
    monkeypatch.setattr(occluders, "CHUNK", 1 << 14)
    monkeypatch.setattr(occluders, "PASSED", 1 << 10)
    monkeypatch.setattr(blockers, "PAIRS", 1 << 8)
    split = fit(scene, data, receivers)
    assert (whole.planes >= 0).sum() == (split.planes >= 0).sum()
    assert split.plane == pytest.approx(whole.plane, abs=1e-9)


def test_no_receivers_and_no_walls_need_no_planes():
    scene = scene_of(build_scenes.plane(3))
    data, receivers = data_of(scene), around(scene, 0.3)
    for some in (receivers, receivers.take(np.zeros(0, np.int64))):
        found = fit(scene, data, some)
        assert found.plane.shape == (0, 5)
        assert (found.planes == -1).all()
        assert len(found.unseen) == len(some.key)


def test_pairs_know_their_blockers_from_either_end():
    wall = build_scenes.box((-0.1, -3, 0), (0.1, 3, 3))
    scene = scene_of(build_scenes.plane(5), wall)
    data, receivers = data_of(scene), around(scene, 0.25)
    pairs = look(scene, data, receivers)
    assert (np.diff(pairs.point) >= 0).all()
    hidden = np.flatnonzero(~pairs.visible)
    assert (pairs.blocker[pairs.visible] == MISS).all()
    assert (pairs.reach[pairs.visible] == 1).all()
    start, end = receivers.position[pairs.receiver[hidden]], data.position[pairs.point[hidden]]
    across = hidden[(start[:, 0] < -0.11) & (end[:, 0] > 0.11) & (end[:, 2] < 2.5)]
    assert len(across) > 10
    middle = scene.soup.corners[pairs.blocker[across]].mean(axis=2)[..., 0]
    faces = (np.abs(middle - [-0.1, 0.1]) < 1e-6).all(axis=1)
    assert faces.mean() > 0.95  # the others pass through the wall's ends
    met = start + pairs.reach[hidden, None] * (end - start)
    assert met[np.isin(hidden, across[faces]), 0] == pytest.approx(-0.1, abs=1e-3)


def test_receivers_that_see_nothing_near_them_have_pairs_with_coarser_levels():
    parts, _ = two_rooms(0.3)
    chest = build_scenes.box((1, 1, 0.1), (1.4, 1.4, 0.5), inward=True)
    scene = scene_of(*parts, chest, build_scenes.box((0.99, 0.99, 0.1), (1.41, 1.41, 0.51)))
    data = data_of(scene)
    data = replace(data, valid=data.valid & ~in_box(data.position, (1, 1, 0.1), (1.4, 1.4, 0.5)))
    receivers = around(scene, 0.1)
    inside = in_box(receivers.position + EDGE * receivers.normal, (1, 1, 0.1), (1.4, 1.4, 0.5))
    found = fit(scene, data, receivers)
    assert inside.sum() > 50
    assert np.array_equal(found.unseen, inside)
    pairs = look(scene, data, receivers)
    levels = data.level[pairs.point[np.isin(pairs.receiver, np.flatnonzero(inside))]]
    assert set(levels) == {0, 1, 2}


def test_a_falloff_is_one_at_the_wall_and_zero_behind_it():
    falloff = halfspaces.Falloff(np.array([0.06, 0.001]), np.array([0.001, 0.0005]))
    height = np.array([1, 0, -0.0005, -0.031, -0.061, -1])
    assert falloff.factor(height, 0) == pytest.approx([1, 1, 1, 0.5, 0, 0])
    assert falloff.factor(height, 1) == pytest.approx([1, 1, 1, 0, 0, 0])
    assert falloff.least == pytest.approx(0.0015)


def test_separators_find_the_plane_between_two_clouds():
    rng = np.random.default_rng(4)
    normal = np.array([[0.6, 0, 0.8], [0, 1, 0]])
    points = rng.uniform(-2, 2, (4000, 3))
    owner = np.repeat([0, 1], 2000)
    height = (points * normal[owner]).sum(axis=1)
    kept = np.abs(height + 0.5) > 0.1
    points, owner, value = points[kept], owner[kept], np.where(height < -0.5, 1.0, -0.5)[kept]
    found = separate(owner, 3, points, value)
    assert found.gain[:2] == pytest.approx(np.bincount(owner, np.maximum(value, 0)), rel=0.05)
    assert (found.normal[:2] * normal).sum(axis=1).min() > 0.98
    assert np.abs(found.distance[:2] + 0.5).max() < 0.15
    assert not found.gain[2]
    assert not found.distance[2]


def test_separators_never_hide_the_data_point_itself():
    rng = np.random.default_rng(5)
    points = rng.normal(0, 1, (3000, 3))
    owner = np.sort(rng.integers(0, 40, 3000))
    found = separate(owner, 40, points, rng.normal(0.5, 1, 3000))
    assert (found.distance[found.gain > 0] < 0).all()
    assert (found.gain > 0).all()
    assert np.abs(np.linalg.norm(found.normal, axis=1) - 1).max() < 1e-9
