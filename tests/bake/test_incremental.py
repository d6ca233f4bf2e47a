"""Incremental bakes: what has changed is found, what has not is kept, and the result is that of a full bake."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from command_line import cells_only
from gi_volumes.bake import cell_job, changes, job, memory
from gi_volumes.bake.again import Again, remember, settled
from gi_volumes.bake.blocks import Blocks
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.hidden import rows_in
from gi_volumes.bake.refine import Refinement, Target
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, choose_grid, model
from gi_volumes.bake.snapshot import Channel, LightKind, Material
from gi_volumes.tree import container, folder, world
from gi_volumes.tree.outline import outline

SETTINGS = Settings(samples=64, bounces=4, finest=0.5, error=0.1)
CELLS = [(0, 0), (1, 0)]
CHEST = ((2.0, 2.0, 0.2), (3.0, 3.0, 1.0))


def house(chest=CHEST, lamp=1.0, other=1.0, colour=0.6, extra=()):
    """Two closed rooms in two world cells; in the first a chest and a lamp, in the second another lamp."""
    parts = [
        (build_scenes.box((0.5, 0.5, 0.1), (7.5, 6.0, 3.1), inward=True), Material("room", Channel((colour,) * 3))),
        (build_scenes.box((129.0, 0.5, 0.1), (134.0, 6.0, 3.1), inward=True), Material("other room")),
        (build_scenes.box(*chest), Material("chest", Channel((0.2, 0.5, 0.3)))),
        *extra,
    ]
    lamps = build_scenes.lamps(
        {"position": (5.0, 4.0, 2.4), "strength": np.array([30, 20, 10]) * lamp},
        {"position": (132.0, 3.0, 2.4), "strength": np.array([9, 9, 9]) * other},
        {"kind": LightKind.SUN, "frame": build_scenes.sun_frame((0.3, 0.4, 0.8)), "strength": (3, 3, 3)},
    )
    return build_scenes.snapshot(parts, lamps, (0.5, 0.7, 1))


def moved(by: float):
    return tuple(tuple(np.add(corner, (by, 0, 0))) for corner in CHEST)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A bake that remembers."""
    target = tmp_path_factory.mktemp("first")
    job.bake(house(), target, SETTINGS, manner=job.Manner(1, incremental=True))
    return target


@pytest.fixture
def again(first, tmp_path):
    """Bakes a changed house over a copy of that bake."""

    def bake(snapshot, threads=1, settings=SETTINGS):
        target = tmp_path / "again"
        if not target.exists():
            copy(first, target)
        return target, job.bake(snapshot, target, settings, manner=job.Manner(threads, incremental=True))

    return bake


def copy(source, target):
    for path in source.rglob("*.*"):
        if path.is_file():
            (target / path.relative_to(source)).parent.mkdir(parents=True, exist_ok=True)
            (target / path.relative_to(source)).write_bytes(path.read_bytes())


def full(snapshot, target):
    job.bake(snapshot, target, SETTINGS, manner=job.Manner(2))
    return target


def arrays(target, cell) -> list[np.ndarray]:
    found = folder.read_cell(target, cell)
    return [found.topology.nodes, found.offset, found.valid] + [
        found.payloads[name].values() for name in sorted(found.payloads)
    ]


def equal(one, other) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def seen(target, transport: str, low, high) -> np.ndarray:
    """Irradiance on the floor and walls of a room."""
    rng = np.random.default_rng(5)
    points = rng.uniform(low, high, (3000, 3))
    axis, side = rng.integers(3, size=3000), rng.integers(2, size=3000)
    points[np.arange(3000), axis] = np.where(side, np.array(high)[axis], np.array(low)[axis])
    normals = np.zeros((3000, 3))
    normals[np.arange(3000), axis] = np.where(side, -1.0, 1.0)
    return world.load(target).irradiance(points, normals, transport=transport).mean(axis=1)


def differences(one, other, transport="local") -> np.ndarray:
    """Relative differences in the room, sorted."""
    room = (0.5, 0.5, 0.1), (7.5, 6.0, 3.1)
    a, b = (seen(target, transport, *room) for target in (one, other))
    return np.sort(np.abs(a - b) / np.maximum(b, 0.1 * b.mean()))


def assert_within_what_storing_changes(target, whole) -> None:
    """Two trees may differ by voxels whose error is close to the target; light in the room must not."""
    off, room = differences(target, whole), ((0.5, 0.5, 0.1), (7.5, 6.0, 3.1))
    bound = memory.load(target, (0, 0), grid_of(target), rules_of(target)).bounds["local"]
    assert off[int(0.99 * len(off))] < bound
    found, truth = (seen(part, "local", *room).mean() for part in (target, whole))
    assert found == pytest.approx(truth, rel=0.01)


def test_a_bake_that_remembers_is_the_bake_that_does_not(first, tmp_path):
    full(house(), tmp_path)
    assert all(equal(arrays(first, cell), arrays(tmp_path, cell)) for cell in CELLS)


def test_what_is_the_same_is_copied(first, again, monkeypatch):
    monkeypatch.setattr(cell_job, "_write", None)
    target, outcome = again(house(lamp=1 + 1e-6))
    assert outcome.kept == outcome.data_points
    assert all(equal(arrays(first, cell), arrays(target, cell)) for cell in CELLS)
    header = folder.load_header(target)
    assert header["bake"] != folder.load_header(first)["bake"]
    assert [entry["cell"] for entry in header["cells"]] == header["expected_cells"]


def test_a_moved_chest_changes_its_room_as_a_full_bake_would(first, again, tmp_path):
    there = house(moved(2.0))
    target, outcome = again(there)
    assert equal(arrays(first, (1, 0)), arrays(target, (1, 0)))
    assert 0 < outcome.kept < outcome.data_points
    whole = full(there, tmp_path / "full")
    found, truth = (folder.read_cell(part, (0, 0)) for part in (target, whole))
    assert abs(found.topology.size - truth.topology.size) < 0.05 * truth.topology.size
    off, before = (np.sqrt((differences(part, whole) ** 2).mean()) for part in (target, first))
    assert off < 0.25 * before
    assert off < SETTINGS.error / 2
    light = [seen(part, "local", *CHEST).mean() for part in (target, whole)]
    assert light[0] == pytest.approx(light[1], rel=0.05)


def test_a_dimmed_lamp_changes_local_light_alone(first, again, tmp_path):
    dimmed = house(lamp=0.85)
    target, outcome = again(dimmed)
    assert equal(arrays(first, (1, 0)), arrays(target, (1, 0)))
    old, new = (memory.load(part, (0, 0), grid_of(part), rules_of(part)) for part in (first, target))
    assert np.array_equal(old.measured.light[:, 1:], new.measured.light[:, 1:])
    assert_within_what_storing_changes(target, full(dimmed, tmp_path / "full"))
    assert outcome.kept < outcome.data_points


def test_much_less_light_decides_on_the_tree_anew(again, tmp_path):
    dimmed = house(lamp=0.4)
    target, whole = again(dimmed)[0], full(dimmed, tmp_path / "full")
    found, truth = (folder.read_cell(part, (0, 0)).topology for part in (target, whole))
    assert abs(found.size - truth.size) < 0.02 * truth.size
    assert_within_what_storing_changes(target, whole)


def grid_of(target):
    return folder.grid_of(folder.load_header(target))


def rules_of(target) -> str:
    snapshot, light = model(house(), SETTINGS)
    return job._rules(SETTINGS, prepare(snapshot, light), grid_of(target))


def test_small_changes_do_not_add_up_unseen(again, tmp_path):
    for step in range(1, 9):
        target, _ = again(house(lamp=1.02**step))
    assert_within_what_storing_changes(target, full(house(lamp=1.02**8), tmp_path / "full"))


def test_the_number_of_threads_changes_no_byte(first, tmp_path):
    made = []
    for threads in (1, 3):
        target = tmp_path / str(threads)
        copy(first, target)
        job.bake(house(moved(2.0), other=0.5), target, SETTINGS, manner=job.Manner(threads, incremental=True))
        made.append(cells_only(target) | {path.name: path.read_bytes() for path in memory.files(target)})
    assert made[0] == made[1]


def test_a_new_wall_in_another_cell_is_found(first, again, tmp_path):
    wall = (build_scenes.box((131.0, 0.6, 0.2), (131.3, 5.9, 3.0)), Material("wall"))
    target, _ = again(house(extra=(wall,)))
    whole = full(house(extra=(wall,)), tmp_path / "full")
    for low, high in (((129.0, 0.5, 0.1), (131.0, 6.0, 3.1)), ((131.3, 0.5, 0.1), (134.0, 6.0, 3.1))):
        found, truth = (seen(part, "local", low, high).mean() for part in (target, whole))
        assert found == pytest.approx(truth, rel=0.05)
    assert seen(target, "local", (129.1, 0.6, 0.2), (130.9, 5.9, 3.0)).mean() < 0.3 * truth


def test_other_settings_or_a_damaged_memory_mean_a_whole_bake(first, again, tmp_path):
    _, outcome = again(house(), settings=dataclasses.replace(SETTINGS, samples=32))
    assert outcome.kept == 0
    grid, rules = grid_of(first), rules_of(first)
    assert memory.load(first, (0, 0), grid, rules) is not None
    assert memory.load(first, (0, 0), grid, "others") is None
    assert memory.load(first, (5, 5), grid, rules) is None
    place = tmp_path / "damaged"
    copy(first, place)
    path = memory.memory_path(place, (0, 0))
    path.write_bytes(path.read_bytes()[:-1])
    assert memory.load(place, (0, 0), grid, rules) is None
    outcome = job.bake(house(lamp=1 + 1e-6), place, SETTINGS, manner=job.Manner(2, incremental=True))
    assert outcome.kept == outcome.data_points - folder.read_cell(first, (0, 0)).topology.size


def test_a_cell_that_the_scene_no_longer_has_is_forgotten(again):
    snapshot = house()
    rows = np.arange(len(snapshot.geometry.triangles))
    kept = ~((rows >= 12) & (rows < 24))
    geometry = dataclasses.replace(
        snapshot.geometry,
        triangles=snapshot.geometry.triangles[kept],
        corner_normals=snapshot.geometry.corner_normals[kept],
        materials=snapshot.geometry.materials[kept],
        mesh_first_triangle=np.array([0, kept.sum()], np.int64),
    )
    target, _ = again(dataclasses.replace(snapshot, geometry=geometry))
    assert memory.memory_path(target, (0, 0)) in memory.files(target)
    assert memory.memory_path(target, (1, 0)) not in memory.files(target)
    assert not list(target.glob("cell_1_0.*"))


def test_a_settled_cell_is_the_cell_that_was_refined(first):
    grid, rules = grid_of(first), rules_of(first)
    known = memory.load(first, (0, 0), grid, rules)
    snapshot, light = model(house(), SETTINGS)
    scene = prepare(snapshot, light)
    causes = changes.causes(snapshot, scene, job._judge(snapshot, SETTINGS, scene))
    past = changes.compare(known, scene, grid, causes, Effort(64, 4, 0, 1), 32)
    assert not past.changed
    assert not past.decide
    state = settled(past, scene, grid)
    cell = folder.read_cell(first, (0, 0))
    assert np.array_equal(state.measured.offset[cell.valid], cell.offset[cell.valid])
    assert np.array_equal(state.tree.nodes, cell.topology.nodes)
    assert ((state.data.planes >= 0).sum(axis=1) == (cell.planes.planes != 65535).sum(axis=1)).all()


@pytest.mark.parametrize("error", [0.1, 0.0])
def test_deciding_anew_where_nothing_has_changed_gives_the_same_state(error):
    """Every decision is open, and every data point known: the tree and what receivers see stay as they are."""
    snapshot, light = model(house(), SETTINGS)
    scene = prepare(snapshot, light)
    grid = choose_grid(scene.soup.corners, snapshot.origin, SETTINGS.finest)
    cell = outline(scene.soup.corners, grid, (0, 0), by_light=True)
    judge, effort = job._judge(snapshot, SETTINGS, scene), Effort(64, 4, 0, 1)
    target = Target(error, 65535, "partial", effort, 32)
    made = Refinement(scene, cell, judge, target, None)
    truth = made.run()
    causes = changes.causes(snapshot, scene, judge)
    known = remember(made, causes, "rules", None)
    past = changes.compare(known, scene, grid, causes, effort, 32)
    everything = Blocks([(0, truth.tree.voxels()[1][: truth.tree.grid_count])])
    past = dataclasses.replace(past, decide=everything)
    found = Again(scene, cell, judge, target, None, past).run()
    assert np.array_equal(found.tree.nodes, truth.tree.nodes)
    assert np.array_equal(found.measured.light, truth.measured.light)
    assert np.array_equal(found.measured.offset, truth.measured.offset)
    assert np.array_equal(np.sort(found.seen.at.key), np.sort(truth.seen.at.key))
    assert np.array_equal(found.data.plane[found.data.planes], truth.data.plane[truth.data.planes])


def simple(lamp=(30, 0, 0), suns=((1, 0, 1), (-1, 0, 1)), strength=(3.0, 3.0), walls=(), low=0.5):
    """A hall with a slit in its roof."""
    parts = [
        (build_scenes.box((low, 0.5, 0.1), (low + 31.0, 6.0, 4.1), inward=True)[:10], Material("hall")),
        (
            build_scenes.quad((low, 0.5, 4.1), (low, 5.0, 4.1), (low + 31, 5.0, 4.1), (low + 31, 0.5, 4.1)),
            Material("lid"),
        ),
        *walls,
    ]
    rows = [{"position": (low + 7.5, 4.0, 2.4), "strength": np.array(lamp)}]
    for direction, irradiance in zip(suns, strength, strict=True):
        frame = build_scenes.sun_frame(direction)
        rows.append({"kind": LightKind.SUN, "frame": frame, "strength": (irradiance,) * 3})
    return build_scenes.snapshot(parts, build_scenes.lamps(*rows), (0.1, 0.1, 0.1))


def both(before, after, tmp_path, settings=SETTINGS):
    """A bake again, and a whole one."""
    job.bake(before, tmp_path / "again", settings, manner=job.Manner(2, incremental=True))
    outcome = job.bake(after, tmp_path / "again", settings, manner=job.Manner(2, incremental=True))
    job.bake(after, tmp_path / "whole", settings, manner=job.Manner(2))
    return tmp_path / "again", tmp_path / "whole", outcome


def test_another_hue_of_the_same_luminance_is_seen(tmp_path):
    green = (0, 30 * 0.2126 / 0.7152, 0)
    again, whole, _ = both(simple(), simple(lamp=green), tmp_path)
    at = np.array([[8.0, 3.0, 0.1]]), np.array([[0.0, 0.0, 1.0]])
    found, truth = (world.load(target).irradiance(*at, transport="local")[0] for target in (again, whole))
    assert found[0] < 0.01 * found[1]
    assert found == pytest.approx(truth, rel=0.05, abs=1e-3)


def test_suns_that_change_places_are_seen(tmp_path):
    again, whole, _ = both(simple(), simple(suns=((-1, 0, 1), (1, 0, 1))), tmp_path)
    cells = [folder.read_cell(target, (0, 0)) for target in (again, whole)]
    row = rows_in(*(cell.topology for cell in cells))
    assert (row >= 0).mean() > 0.95
    for number in range(2):
        found, truth = (cell.payloads["sun"].values()[:, number] for cell in cells)
        found, truth = found[row >= 0], truth[row[row >= 0]]
        assert np.sqrt(((found - truth) ** 2).mean()) < 0.2 * np.sqrt((truth**2).mean())


def test_another_strength_of_the_sun_decides_on_the_tree_anew(tmp_path):
    again, whole, _ = both(simple(strength=(1e-4, 1e-4)), simple(strength=(100.0, 100.0)), tmp_path)
    found, truth = (folder.read_cell(target, (0, 0)) for target in (again, whole))
    assert abs(found.topology.size - truth.topology.size) < 0.05 * truth.topology.size
    assert found.planes.shade == pytest.approx(truth.planes.shade, abs=0.05)


def test_a_wall_just_beyond_the_border_hides_light(tmp_path):
    wall = (build_scenes.box((129.3, 0.4, 0.0), (129.6, 6.1, 4.2)), Material("wall"))
    settings = dataclasses.replace(SETTINGS, error=0.2)
    lit, dark = simple(low=112.5), simple(low=112.5, walls=(wall,))
    again, whole, _ = both(lit, dark, tmp_path, settings)
    x, y = np.meshgrid(np.linspace(129.65, 131.0, 20), np.linspace(1.0, 5.5, 20))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.1)])
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    found, truth = (world.load(target).irradiance(points, up, transport="local").mean() for target in (again, whole))
    before = world.load(whole).irradiance([[120.0, 3.0, 0.1]], [[0.0, 0.0, 1.0]], transport="local").mean()
    assert abs(found - truth) < 0.003 * before


def test_the_cache_of_a_cell_is_used_again(tmp_path, monkeypatch):
    monkeypatch.setattr(cell_job, "WORTH", 0)
    settings = dataclasses.replace(SETTINGS, method="cache", bounces=32)
    again, whole, outcome = both(house(), house(moved(2.0), other=0.5), tmp_path, settings)
    off = np.sqrt((differences(again, whole) ** 2).mean())
    assert off < settings.error / 2
    assert 0 < outcome.kept < outcome.data_points
    assert outcome.checked[0]["places"] > 0


def spoiled(file, what: str) -> tuple[dict, dict]:
    """Arrays and header of a memory that another program has written."""
    arrays, meta = dict(file.arrays), dict(file.meta)
    if what == "cell":
        meta["cell"] = [1, 0]
    elif what == "pilot":
        arrays["pilot"] = np.full_like(arrays["pilot"], np.nan)
    elif what == "short":
        arrays["measured/light"] = arrays["measured/light"][:-1]
    elif what == "planes":
        arrays["planes"] = np.full_like(arrays["planes"], 1000)
    elif what == "huge":
        meta["grid_shape"] = [100_000, 100_000, 10]
    elif what == "negative":
        meta["grid_shape"] = [-1, -1, meta["grid_shape"][2]]
    elif what == "causes":
        meta["causes"] = [1]
    return arrays, meta


@pytest.mark.parametrize("what", ["cell", "pilot", "short", "planes", "huge", "negative", "causes"])
def test_a_memory_that_does_not_fit_is_not_used(first, tmp_path, what):
    copy(first, tmp_path)
    path = memory.memory_path(tmp_path, (0, 0))
    arrays, meta = spoiled(container.read(path), what)
    container.write(path, "memory", arrays, meta)
    assert memory.load(tmp_path, (0, 0), grid_of(first), rules_of(first)) is None
    outcome = job.bake(house(lamp=1 + 1e-6), tmp_path, SETTINGS, manner=job.Manner(2, incremental=True))
    assert outcome.kept == outcome.data_points - folder.read_cell(first, (0, 0)).topology.size


def test_a_re_bake_that_was_stopped_goes_on(first, tmp_path, monkeypatch):
    copy(first, tmp_path)
    there = house(moved(2.0), other=0.5)
    job.bake(there, tmp_path, SETTINGS, [(1, 0)], job.Manner(1, incremental=True))
    assert memory.memory_path(tmp_path, (0, 0)).exists()
    outcome = job.bake(there, tmp_path, SETTINGS, manner=job.Manner(1, incremental=True))
    assert outcome.kept > 0
    job.bake(there, tmp_path / "at once", SETTINGS, manner=job.Manner(1, incremental=True))
    copy(first, tmp_path / "other")
    job.bake(there, tmp_path / "other", SETTINGS, manner=job.Manner(1, incremental=True))
    assert cells_only(tmp_path) == cells_only(tmp_path / "other")


def naive(marks, level, coords) -> list[bool]:
    """Boxes of voxels that overlap, in units of the finest level."""
    found = []
    for voxel in coords:
        low, size = voxel * 4 ** (3 - level), 4 ** (3 - level)
        hit = False
        for own, marked in marks:
            lows, width = marked * 4 ** (3 - own), 4 ** (3 - own)
            hit |= bool(((lows < low + size) & (low < lows + width)).all(axis=1).any())
        found.append(hit)
    return found


@pytest.mark.parametrize("level", range(4))
def test_blocks_know_what_touches_them(level):
    rng = np.random.default_rng(level)
    marks = [(own, rng.integers(-(4**own), 4**own, (3, 3))) for own in (1, 2)]
    coords = rng.integers(-(4**level), 4**level, (300, 3))
    blocks = Blocks(marks)
    assert blocks.touch(level, coords).tolist() == naive(marks, level, coords)
    steps = np.array(list(np.ndindex(3, 3, 3))) - 1
    around = np.array([naive(marks, level, coords + step) for step in steps]).any(axis=0)
    assert blocks.around(level, coords).tolist() == around.tolist()
    own = [mark for mark in marks if mark[0] == level]
    beside = np.array([naive(own, level, coords + step) for step in steps]).any(axis=0)
    assert blocks.beside(level, coords).tolist() == beside.tolist()
    assert not Blocks([(1, np.zeros((0, 3), np.int64))])
