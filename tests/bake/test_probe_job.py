"""A bake's probes: made once, kept when valid, whole or not at all, by the surface cache of each cell."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import build_scenes
import numpy as np
import pytest
from command_line import QUICK, call, stored, succeed
from gi_volumes.bake import cell_job, check, cli, probe_job, radiosity
from gi_volumes.bake.capture import Spending
from gi_volumes.bake.changes import causes
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.job import Manner, bake
from gi_volumes.bake.lit_patches import are_lit
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.patches import Patches
from gi_volumes.bake.probe_job import Job, Made, Wish, probe_bytes, run
from gi_volumes.bake.probes import RequestError
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.settings import Settings, model
from gi_volumes.bake.snapshot import Channel, Material, ProbeEdits, Snapshot
from gi_volumes.bake.survey import Judge
from gi_volumes.tree import container, folder, probe_cells, probe_file, world
from gi_volumes.tree.verify import verify

SETTINGS = Settings(samples=2, bounces=3, error=0.0, finest=2.0, sky="0.5,0.6,0.9")
SPENDING = Spending(error=0.5, most=16, pitch=16)
ORIGIN = np.array([1024.0, -2048.0, 0.0])


def at(*place: float) -> np.ndarray:
    """World coordinates of a place in the hall."""
    return ORIGIN + np.array(place)


def hall(*rooms: float) -> Snapshot:
    """Rooms of 10 x 8 x 4 m, each with a lamp, open above; far from the world's origin."""
    parts, lights = [], []
    for x in rooms:
        walls = build_scenes.box((x, 0.5, 0.1), (x + 10, 8.5, 4.1), inward=True)
        parts.append((np.delete(walls, (2, 3), axis=0), Material("wall", Channel((0.7, 0.6, 0.5)))))
        lights.append({"position": at(x + 3, 4, 3), "strength": (9, 9, 9)})
    return build_scenes.snapshot(parts, build_scenes.lamps(*lights), origin=ORIGIN)


def job_of(target: Path, snapshot: Snapshot, **changes) -> Job:
    """What a bake in the folder leaves to be done."""
    effective, light = model(snapshot, SETTINGS)
    scene, grid = prepare(effective, light), folder.grid_of(folder.load_header(target))
    wish, effort = Wish(3, spending=SPENDING), Effort(0, SETTINGS.bounces, 0, 1)
    return dataclasses.replace(Job(scene, grid, target, np.ones((2, 3)), wish, effort, False), **changes)


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("hall")
    bake(hall(0.2), target, SETTINGS)
    return target


@pytest.fixture
def target(baked, tmp_path) -> Path:
    """A bake to put probes into."""
    return Path(shutil.copytree(baked, tmp_path / "bake"))


def bytes_in(target: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in target.iterdir() if path.is_file()}


def test_probes_are_placed_captured_listed_and_found_sound(target):
    made = run(job_of(target, hall(0.2)))
    maps = probe_file.load(target, folder.load_header(target))
    assert (made.count, made.kept, list(maps.radiance)) == (3, False, ["local", "sky"])
    inside = (maps.position > at(0.2, 0.5, 0.1)) & (maps.position < at(10.2, 8.5, 8))
    assert inside.all()
    assert made.bytes == sum(path.stat().st_size for path in (target / "probes.exr", *target.glob("*.probes")))
    assert made.noise <= 0.5
    assert made.rays == 16
    assert maps.radiance["local"][0].astype(float).mean() > 0.05
    assert verify(target) == []


def test_valid_probes_are_kept_and_others_made_anew(target):
    job = job_of(target, hall(0.2))
    first = run(job)
    before = bytes_in(target)
    stamp = (target / "probes.exr").stat().st_mtime_ns
    assert run(job) == dataclasses.replace(first, kept=True)
    assert bytes_in(target) == before
    assert (target / "probes.exr").stat().st_mtime_ns == stamp
    for changes in (
        {"wish": dataclasses.replace(job.wish, count=2)},
        {"wish": dataclasses.replace(job.wish, pinned=at(1, 2, 3)[None])},
        {"effort": Effort(0, SETTINGS.bounces, 1, 1)},
    ):
        assert not run(dataclasses.replace(job, **changes)).kept
        assert bytes_in(target)["probes.exr"] != before["probes.exr"]
    assert verify(target) == []


def test_a_damaged_file_is_made_again(target):
    job = job_of(target, hall(0.2))
    run(job)
    before = bytes_in(target)
    (target / "probes.exr").write_bytes(before["probes.exr"][:-1])
    assert not run(job).kept
    assert bytes_in(target) == before


def test_any_number_of_threads_gives_the_same_file(target, monkeypatch):
    monkeypatch.setattr(probe_job, "WORTH", 0)
    files = []
    for threads in (1, 2, 3):
        job = job_of(target, hall(0.2), effort=Effort(0, SETTINGS.bounces, 0, threads), cached=True)
        (target / "probes.exr").unlink(missing_ok=True)
        run(job)
        files.append(bytes_in(target)["probes.exr"])
    assert files[1:] == files[:1] * 2


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5])
def test_work_that_is_stopped_leaves_the_folder_as_it_was(target, share):
    before = bytes_in(target)
    with pytest.raises(CancelledError):
        run(job_of(target, hall(0.2)), lambda done: done < share)
    assert bytes_in(target) == before


def test_other_probes_that_are_stopped_leave_a_bake_that_can_be_loaded(target):
    job = job_of(target, hall(0.2))
    run(job)
    for share in (0.05, 0.5, 0.97):
        with pytest.raises(CancelledError):
            run(dataclasses.replace(job, wish=Wish(2, spending=SPENDING)), lambda done, share=share: done < share)
        assert len(world.load(target).irradiance(at(1, 2, 3)[None], [[0, 0, 1]])) == 1
    assert run(dataclasses.replace(job, wish=Wish(2, spending=SPENDING))).count == 2
    assert verify(target) == []


def test_probes_go_and_other_programs_files_stay(target):
    run(job_of(target, hall(0.2)))
    (target / "cell_phone.probes").write_bytes(b"mine")
    probe_job.remove(target)
    assert (target / "cell_phone.probes").read_bytes() == b"mine"
    assert not any(
        path.name == "probes.exr" or (path.name.startswith("cell_0") and path.suffix == ".probes")
        for path in target.iterdir()
    )
    assert verify(target) == []


def test_progress_rises_from_begin_to_end(target, monkeypatch):
    monkeypatch.setattr(probe_job, "WORTH", 0)
    said = []
    run(job_of(target, hall(0.2), cached=True), lambda share: said.append(share) or True)
    assert said == sorted(said)
    assert said[-1] == pytest.approx(1)


def test_pinned_probes_stand_where_they_were_put_and_deleted_boxes_are_empty(target):
    pinned = at(2, 3, 1.5)[None]
    box = np.array([at(0, 0, 0), at(5, 9, 9)])
    wish = Wish(4, spending=SPENDING, pinned=pinned, deleted=box[None])
    run(job_of(target, hall(0.2), wish=wish))
    maps = probe_file.load(target, folder.load_header(target))
    assert maps.pinned.tolist() == [True, False, False, False]
    assert maps.position[0] == pytest.approx(pinned[0])
    assert (maps.position[1:, 0] > box[1, 0]).all()


def test_no_probe_at_all_is_a_file_too(target):
    made = run(job_of(target, hall(0.2), wish=Wish(0, spending=SPENDING)))
    assert made.count == 0
    assert len(probe_file.load(target, folder.load_header(target)).position) == 0
    assert verify(target) == []


def test_a_budget_counts_what_maps_take_in_memory(target):
    size = probe_bytes(16, 2)
    made = run(job_of(target, hall(0.2), wish=Wish(megabytes=2.5 * size / 1e6, spending=SPENDING)))
    maps = probe_file.load(target, folder.load_header(target))
    arrays = [level for part in maps.radiance.values() for level in part] + [maps.distance, maps.normal, maps.albedo]
    assert (made.count, sum(array.nbytes for array in arrays)) == (2, 2 * size)


def test_a_wish_without_sense_is_refused(target):
    with pytest.raises(RequestError, match="probes"):
        run(job_of(target, hall(0.2), wish=Wish(-1, spending=SPENDING)))
    assert not (target / "probes.exr").exists()


def test_another_bake_of_the_folder_removes_its_probes(target):
    run(job_of(target, hall(0.2)))
    bake(hall(0.2), target, dataclasses.replace(SETTINGS, seed=1))
    assert not (target / "probes.exr").exists()
    assert "probes" not in json.loads((target / "world.json").read_bytes())


def test_the_same_bake_again_keeps_its_probes(target):
    run(job_of(target, hall(0.2)))
    before = bytes_in(target)
    manner = Manner(threads=1, probes=job_of(target, hall(0.2)).wish)
    assert bake(hall(0.2), target, SETTINGS, manner=manner).probes["count"] == 3
    assert bytes_in(target) == before


def test_a_closed_dark_room_gets_no_probe(tmp_path, monkeypatch):
    snapshot = hall(0.2)
    cellar = build_scenes.box((14, 0.5, 0.1), (24, 8.5, 4.1), inward=True)
    lights, wall = snapshot.lights, Material("wall", Channel((0.7, 0.6, 0.5)))
    hall_walls = snapshot.geometry.positions.reshape(-1, 3, 3)
    snapshot = build_scenes.snapshot([(hall_walls, wall), (cellar, wall)], lights, origin=ORIGIN)
    bake(snapshot, tmp_path, SETTINGS)
    run(job_of(tmp_path, snapshot, wish=Wish(6, spending=SPENDING)))
    maps = probe_file.load(tmp_path, folder.load_header(tmp_path))
    assert len(maps.position) == 6
    assert not ((maps.position > at(14, 0.5, 0.1)) & (maps.position < at(24, 8.5, 4.1))).all(axis=1).any()
    monkeypatch.setattr(probe_job, "are_lit", lambda scene, effort, seen: np.ones(len(seen.weight), bool))
    run(job_of(tmp_path, snapshot, wish=Wish(5, spending=SPENDING)))
    maps = probe_file.load(tmp_path, folder.load_header(tmp_path))
    assert ((maps.position > at(14, 0.5, 0.1)) & (maps.position < at(24, 8.5, 4.1))).all(axis=1).any()


def test_patches_that_no_light_arrives_at_do_not_count_unless_it_arrives_nowhere():
    boxes = (0, 0, 0), (4, 4, 4), (6, 0, 0), (10, 4, 4)
    walls = [build_scenes.box(*boxes[:2], inward=True), build_scenes.box(*boxes[2:], inward=True)]
    material = Material("wall")
    start = np.float32([[1, 3, 7, 9], [1, 2, 1, 2], [0.001] * 4])
    patches = Patches(start, np.float32([[0] * 4, [0] * 4, [1] * 4]), np.ones(4, np.float32), np.ones(4, np.float32))
    for strength, lit in ((1.0, [True, True, False, False]), (0.0, [True] * 4)):
        lights = build_scenes.lamps({"position": (2, 2, 3), "strength": (strength,) * 3})
        snapshot = build_scenes.snapshot([(np.concatenate(walls), material)], lights, sky=(0, 0, strength))
        scene = prepare(snapshot, Model(sky="fixed"))
        assert are_lit(scene, Effort(0), patches).tolist() == lit


def test_a_large_scene_has_a_cache_for_each_cell(tmp_path, monkeypatch):
    snapshot, boxes = hall(4.2, 134.2), []
    bake(snapshot, tmp_path, SETTINGS)
    monkeypatch.setattr(probe_job, "WORTH", 0)
    around = radiosity.around
    monkeypatch.setattr(radiosity, "around", lambda *a: boxes.append(a[2]) or around(*a))
    outside = at(300, 0, 1)
    run(job_of(tmp_path, snapshot, cached=True, wish=Wish(7, spending=SPENDING, pinned=outside[None])))
    maps = probe_file.load(tmp_path, folder.load_header(tmp_path))
    cells = np.unique(np.floor((maps.position[1:, 0] - ORIGIN[0]) / 128))
    assert cells.tolist() == [0, 1]
    assert sorted(box[0, 0] // 128 for box in boxes) == [0, 1]
    assert maps.radiance["local"][0].astype(float).mean() > 0


def mirrored() -> Snapshot:
    """The hall with a mirror in it."""
    snapshot = hall(0.2)
    chrome = Material("chrome", metallic=Channel((1.0,)), roughness=Channel((0.1,)))
    return dataclasses.replace(snapshot, materials=(*snapshot.materials[:-1], chrome))


def made_by_command(snapshot: Snapshot, target: Path, *words: str) -> dict:
    scene = stored(target, snapshot)
    return succeed("bake", scene, "-o", target / "bake", *QUICK, *words)


def test_the_command_makes_probes_where_surfaces_are_glossy(tmp_path, monkeypatch):
    monkeypatch.setattr(cli.probe_job, "AUTOMATIC", probe_bytes(128, 1) * 1.5e-6)
    said = made_by_command(mirrored(), tmp_path)
    assert said["probes"]["count"] == 1
    files = [tmp_path / "bake/probes.exr", *(tmp_path / "bake").glob("*.probes")]
    assert said["bytes"]["probes"] == sum(path.stat().st_size for path in files)
    assert "probes" in said["modelled"]
    assert succeed("verify", tmp_path / "bake") == {"defects": []}
    again = made_by_command(mirrored(), tmp_path)
    assert again["probes"] == said["probes"]
    late = succeed("bake", tmp_path / "level.giv", "-o", tmp_path / "bake", *QUICK, "--minutes", "1e-9")
    assert late["probes"] == said["probes"]
    none = made_by_command(mirrored(), tmp_path, "--probes", "none")
    assert "probes" not in none["modelled"]
    assert {"what": "probes", "why": "none were asked for"} in none["left_out"]
    assert not (tmp_path / "bake/probes.exr").exists()
    assert succeed("verify", tmp_path / "bake") == {"defects": []}


def test_the_command_says_why_a_dull_scene_has_none_and_makes_them_if_asked(tmp_path):
    said = made_by_command(hall(0.2), tmp_path)
    (why,) = [item["why"] for item in said["left_out"] if item["what"] == "probes"]
    assert why.startswith("0.0 % of all surfaces are smoother than roughness 0.4; --probes N")
    said = call("bake", tmp_path / "level.giv", "-o", tmp_path / "bake", *QUICK, "--probes", "1").out
    assert re.search(r"^1 reflection probes, 0\.\d\d MB, \d+ rays a texel, noise \d+\.\d %$", said, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "reason"), [(["0"], "0 probes are as many as were asked for"), (["5"], "no candidate")]
)
def test_the_command_says_why_there_are_none_or_fewer(tmp_path, words, reason):
    everywhere = (at(-99, -99, -99), at(99, 99, 99))
    said = made_by_command(said_by(hall(0.2), deleted=everywhere), tmp_path, "--probes", *words)
    (why,) = [item["why"] for item in said["left_out"] if item["what"] == "probes"]
    assert reason in why
    assert "probes" not in said["modelled"]
    few = made_by_command(hall(0.2), tmp_path, "--probes", "5", "--probe-megabytes", "1")
    assert few["probes"]["count"] == 2
    assert "5 reflection probes were asked for: 2 probes are as many as 1 MB have room for" in few["warnings"]


def test_no_other_program_s_file_is_replaced(tmp_path):
    (tmp_path / "bake").mkdir()
    (tmp_path / "bake/probes.exr").write_bytes(b"mine")
    said = call("bake", stored(tmp_path, hall(0.2)), "-o", tmp_path / "bake", *QUICK)
    assert said.reason.endswith("another program's file, or a damaged one; move it away, or bake elsewhere")
    assert (tmp_path / "bake/probes.exr").read_bytes() == b"mine"


def test_a_bake_in_parts_makes_the_probes_of_a_bake_in_one_go(tmp_path, monkeypatch):
    monkeypatch.setattr(check.Check, "fails", lambda self, error: True)
    monkeypatch.setattr(cell_job, "WORTH", 0)
    whole = made_by_command(mirrored(), tmp_path, "--probes", "1", "--method", "cache")
    assert any("too far off" in text for text in whole["warnings"])
    first = bytes_in(tmp_path / "bake")
    monkeypatch.undo()
    for path in (tmp_path / "bake").glob("*probes*"):
        path.unlink()
    made_by_command(mirrored(), tmp_path, "--probes", "1", "--method", "cache")
    assert bytes_in(tmp_path / "bake") == first


def said_by(snapshot: Snapshot, *pinned: np.ndarray, deleted: tuple = ()) -> Snapshot:
    """The scene with what an artist says about its probes."""
    edits = ProbeEdits(np.array(pinned).reshape(-1, 3), np.array(deleted, float).reshape(-1, 2, 3))
    return dataclasses.replace(snapshot, probes=edits)


@pytest.mark.parametrize("words", [(), ("--incremental",)])
def test_what_an_artist_says_makes_probes_anew_and_keeps_the_cells_to_the_last_byte(tmp_path, words):
    words = ("--probes", "2", *words)
    made_by_command(hall(0.2), tmp_path, *words)
    first = bytes_in(tmp_path / "bake")
    box = (at(0, 0, 0), at(5, 9, 9))
    again = made_by_command(said_by(hall(0.2), at(8, 4, 2), deleted=box), tmp_path, *words)
    second = bytes_in(tmp_path / "bake")
    assert again["probes"]["rays"] > 0
    changed = {name for name in first if second[name] != first[name]}
    which = {name for name in first if name.endswith(".probes")}
    assert changed - which == {"probes.exr", "scene.giv", "world.json"}
    maps = probe_file.load(tmp_path / "bake", folder.load_header(tmp_path / "bake"))
    assert maps.pinned.tolist() == [True, False]
    assert maps.position[0] == pytest.approx(at(8, 4, 2))
    assert not ((maps.position[1] >= box[0]) & (maps.position[1] <= box[1])).all()
    assert succeed("verify", tmp_path / "bake") == {"defects": []}
    made_by_command(hall(0.2), tmp_path, *words)
    assert bytes_in(tmp_path / "bake") == first


def test_what_an_artist_says_changes_nothing_that_light_depends_on():
    judge = Judge(np.ones((1, 2, 3)), np.ones((2, 3)))
    found = []
    for snapshot in (hall(0.2), said_by(hall(0.2), at(8, 4, 2), deleted=(at(0, 0, 0), at(5, 9, 9)))):
        effective, light = model(snapshot, SETTINGS)
        found.append(causes(effective, prepare(effective, light), judge))
    assert found[0] == found[1]


def test_a_dull_scene_gets_its_pinned_probes_and_no_others(tmp_path):
    assert made_by_command(said_by(hall(0.2), at(8, 4, 2), at(3, 4, 2)), tmp_path)["probes"]["count"] == 2
    said = made_by_command(said_by(hall(0.2), at(8, 4, 2)), tmp_path, "--probes", "none")
    assert {"what": "probes", "why": "none were asked for"} in said["left_out"]


def test_some_cells_alone_have_no_probes_yet(tmp_path):
    scene = stored(tmp_path, hall(4.2, 134.2))
    words = ("bake", scene, "-o", tmp_path / "bake", *QUICK, "--probes", "1")
    (why,) = [item["why"] for item in succeed(*words, "--cells", "0,0")["left_out"] if item["what"] == "probes"]
    assert "of the scene's cells are not baked yet" in why
    assert succeed(*words)["probes"]["count"] == 1


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--probes", "many"), "whole number"),
        (("--probes", "-1"), "whole number"),
        (("--probe-megabytes", "0"), "number of megabytes above 0"),
        (("--probe-megabytes", "nan"), "number of megabytes above 0"),
    ],
)
def test_words_that_make_no_sense_are_wrong_usage(tmp_path, words, why):
    said = call("bake", tmp_path / "scene.giv", "-o", tmp_path / "bake", *words)
    assert said.code == 2
    assert why in said.err


def sets_in(target: Path) -> dict[str, bytes]:
    """Files that say which probes count where."""
    return {path.name: path.read_bytes() for path in target.glob("cell_*.probes")}


def test_each_cell_says_which_probes_count_where(target):
    run(job_of(target, hall(0.2)))
    header = folder.load_header(target)
    assert [entry["files"]["probes"]["name"] for entry in header["cells"]] == sorted(sets_in(target))
    cells = [folder.read_cell(target, tuple(entry["cell"])) for entry in header["cells"]]
    sets = probe_cells.load(target, header, cells)
    assert sum(
        int(part.weight[part.index[cell.valid]].any(axis=1).sum()) for part, cell in zip(sets, cells, strict=True)
    )


def test_a_loaded_bake_reflects_what_its_probes_see(target):
    """A mirror that looks up shows the sky of the bake, at its factor."""
    run(job_of(target, hall(0.2), wish=Wish(6, spending=dataclasses.replace(SPENDING, pitch=64))))
    loaded = world.load(target)
    point = np.array([at(3, 3, 1.5), at(6, 5, 2), at(8, 4, 1)])
    up = loaded.radiance(point, np.tile([0.0, 0, 1], (3, 1)), 0.1)
    np.testing.assert_allclose(up, np.tile([0.5, 0.6, 0.9], (3, 1)), rtol=0.02)
    twice = loaded.radiance(point, np.tile([0.0, 0, 1], (3, 1)), 0.1, sky=2.0)
    np.testing.assert_allclose(twice, 2 * up, rtol=1e-5)


def test_what_is_damaged_or_missing_is_found_and_made_again(target):
    job = job_of(target, hall(0.2))
    run(job)
    before, name = bytes_in(target), sorted(sets_in(target))[0]
    (target / name).write_bytes(before[name][:-1])
    assert [defect.file for defect in verify(target)] == [name]
    (target / name).unlink()
    assert [(defect.file, defect.what) for defect in verify(target)] == [(name, "the file is missing")]
    folder.list_again(target)
    assert ["does not say which probes count" in defect.what for defect in verify(target)] == [True]
    assert run(job).kept
    assert bytes_in(target) == before
    assert verify(target) == []


def test_entries_of_other_probes_are_refused(target):
    job = job_of(target, hall(0.2))
    run(job)
    name, old = next(iter(sets_in(target).items()))
    run(dataclasses.replace(job, wish=dataclasses.replace(job.wish, count=2)))
    (target / name).write_bytes(old)
    header = folder.load_header(target)
    cells = [folder.read_cell(target, tuple(entry["cell"])) for entry in header["cells"]]
    with pytest.raises(container.FileError, match=r"do not belong together|beyond the 2"):
        probe_cells.load(target, header, cells)
    assert name in [defect.file for defect in verify(target)]


def test_without_probes_nothing_is_left_of_them(tmp_path):
    target = tmp_path / "bake"
    bake(hall(0.2), target, SETTINGS, manner=Manner(probes=Wish(2, spending=SPENDING)))
    assert sets_in(target)
    bake(hall(0.2), target, SETTINGS)
    assert not sets_in(target)
    assert not (target / "probes.exr").exists()
    assert verify(target) == []


@pytest.mark.parametrize("fails", [False, True])
def test_surface_caches_that_a_bake_finds_to_be_off_are_not_used_for_probes(tmp_path, monkeypatch, fails):
    jobs = []
    monkeypatch.setattr(cell_job, "WORTH", 0)
    monkeypatch.setattr(cell_job.Check, "fails", lambda check, error: fails)
    monkeypatch.setattr(probe_job, "run", lambda job, show: jobs.append(job) or Made(0, 0))
    settings = dataclasses.replace(SETTINGS, method="cache")
    bake(hall(0.2), tmp_path, settings, manner=Manner(threads=1, probes=Wish(1, spending=SPENDING)))
    assert [job.cached for job in jobs] == [not fails]


@pytest.mark.parametrize(("worth", "caches"), [(2 * 16 * 14 * 14, 1), (2 * 16 * 14 * 14 + 1, 0)])
def test_a_surface_cache_is_made_for_as_many_rays_as_are_worth_it(target, monkeypatch, worth, caches):
    made, around = [], radiosity.around
    monkeypatch.setattr(probe_job, "WORTH", worth)
    monkeypatch.setattr(radiosity, "around", lambda *a: made.append(a[2]) or around(*a))
    run(job_of(target, hall(0.2), cached=True))  # three probes of 16 rays a texel
    assert len(made) == caches


def test_probes_of_a_scene_without_light_are_made_if_asked(tmp_path):
    snapshot = dataclasses.replace(hall(0.2), lights=build_scenes.lamps())
    settings = dataclasses.replace(SETTINGS, sky="0")
    bake(snapshot, tmp_path, settings)
    job = job_of(tmp_path, snapshot, scene=prepare(snapshot, Model()), mixture=np.zeros((0, 3)))
    assert run(job).count == 3
    assert probe_job.why_none(job) == "there is no light to reflect"
    assert verify(tmp_path) == []
