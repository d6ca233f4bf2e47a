"""A bake's folder: the same bytes however the work is split or stopped, and never two bakes in one."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import build_scenes
import numpy as np
import pytest
from command_line import QUICK, Points, call, cells_only, content, ground_points, stored, succeed, yard
from gi_volumes.bake import job
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, SettingsError, model
from gi_volumes.bake.snapshot import Material
from gi_volumes.tree import container
from statistics_checks import standard_error

CELLS = 3
FEW_BYTES = 5500
"""What a cell of the row may take: less than its early look, which has 6,300."""


@pytest.fixture(scope="module")
def row(tmp_path_factory) -> Path:
    """A scene of three world cells."""
    return stored(tmp_path_factory.mktemp("row"), yard(CELLS))


@pytest.fixture(scope="module")
def row_baked(row) -> dict[str, bytes]:
    """All files of its bake, made at once by one thread."""
    succeed("bake", row, "-o", row.parent / "whole", *QUICK)
    return content(row.parent / "whole")


def listed(folder: Path) -> list[list[int]]:
    return [entry["cell"] for entry in json.loads((folder / "world.json").read_bytes())["cells"]]


def identity(path: Path) -> tuple[int, int, int]:
    """What changes when a file is written anew."""
    state = path.stat()
    return state.st_ino, state.st_mtime_ns, state.st_size


def values(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Every array of every cell's file."""
    return {path.name: container.read(path).arrays for path in sorted(folder.glob("cell_*"))}


def equal(one: dict, two: dict) -> bool:
    if one.keys() != two.keys():
        return False
    return all(
        one[file].keys() == two[file].keys() and all(np.array_equal(one[file][k], two[file][k]) for k in one[file])
        for file in one
    )


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_number_of_threads_changes_no_byte(row, row_baked, tmp_path, threads):
    succeed("bake", row, "-o", tmp_path, *QUICK[:4], "--threads", threads)
    assert content(tmp_path) == row_baked


@pytest.mark.parametrize("parts", [["2,0", "0,0", "1,0"], ["1,0/0,0", "2,0"], ["2,0/1,0/0,0/1,0"]])
def test_cells_baked_one_by_one_in_any_order_are_the_cells_baked_at_once(row, row_baked, tmp_path, parts):
    for number, part in enumerate(parts):
        warnings = succeed("bake", row, "-o", tmp_path, *QUICK, "--cells", part)["warnings"]
        missing = CELLS - len({cell for done in parts[: number + 1] for cell in done.split("/")})
        assert warnings == ([f"{missing} of the scene's 3 cells are not baked yet"] if missing else [])
        defects = call("verify", tmp_path, "--json").object["defects"]
        assert len(defects) == missing
        assert all("is missing: not baked yet" in defect["what"] for defect in defects)
    assert content(tmp_path) == row_baked


def test_a_second_run_bakes_nothing_and_touches_no_cell(row, row_baked, tmp_path):
    first = succeed("bake", row, "-o", tmp_path, *QUICK)
    before = {path.name: identity(path) for path in tmp_path.glob("cell_*")}
    second = succeed("bake", row, "-o", tmp_path, *QUICK)
    assert {path.name: identity(path) for path in tmp_path.glob("cell_*")} == before
    assert content(tmp_path) == row_baked
    assert (first["rays"] > 0, second["rays"]) == (True, 0)
    for key in ("triangles", "cells", "data_points", "bytes", "modelled", "left_out"):
        assert first[key] == second[key]


def test_a_damaged_cell_is_baked_again_and_its_neighbours_are_not(row, row_baked, tmp_path):
    succeed("bake", row, "-o", tmp_path, *QUICK)
    before = {path.name: identity(path) for path in tmp_path.glob("cell_[02]_0.*")}
    damaged = bytearray((tmp_path / "cell_1_0.sky").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "cell_1_0.sky").write_bytes(damaged)
    (tmp_path / "cell_1_0.sun").unlink()
    succeed("bake", row, "-o", tmp_path, *QUICK)
    assert content(tmp_path) == row_baked
    assert {path.name: identity(path) for path in tmp_path.glob("cell_[02]_0.*")} == before


@pytest.mark.parametrize("seed", [1, 2**32 - 1, 2**40 + 1])
def test_another_seed_gives_other_values_on_the_same_tree(row, row_baked, tmp_path, seed):
    succeed("bake", row, "-o", tmp_path, *QUICK, "--cells", "0,0", "--seed", seed)
    for name in ("local", "sun", "sky"):
        here, there = (
            container.read(folder / f"cell_0_0.{name}").arrays for folder in (tmp_path, row.parent / "whole")
        )
        assert not np.array_equal(here["coefficient"], there["coefficient"])
    assert np.array_equal(
        container.read(tmp_path / "cell_0_0.tree").arrays["mask"],
        container.read(row.parent / "whole" / "cell_0_0.tree").arrays["mask"],
    )


def test_a_scene_moved_by_whole_steps_of_the_origin_has_the_same_values(row, row_baked, tmp_path):
    shift = np.array([1024.0 * 500, -1024.0 * 500, 0])
    succeed("bake", stored(tmp_path, yard(CELLS, place=shift)), "-o", tmp_path / "out", *QUICK)
    assert equal(values(tmp_path / "out"), values(row.parent / "whole"))
    asked = Points(tmp_path, *ground_points())
    here = asked.ask("query", row.parent / "whole")
    there = Points(tmp_path, *ground_points(place=shift)).ask("query", tmp_path / "out")
    assert here.any()
    assert np.array_equal(here, there)


def test_a_scene_far_away_agrees_with_the_one_at_the_origin_within_the_noise(tmp_path):
    place = np.array([500_000.0, -500_008.0, 0.0])
    scenes = [stored(tmp_path, yard(), "near.giv"), tmp_path / "far.giv"]
    origin = np.round(place / 1024) * 1024
    stored(tmp_path, dataclasses.replace(yard(place=place), origin=origin), "far.giv")
    assert (place - origin)[:2].all()
    found = []
    for scene, there in zip(scenes, (np.zeros(3), place), strict=True):
        asked = Points(tmp_path, *ground_points(200, there))
        for seed in range(6):
            words = ("--samples", "64", "--finest", "2", "--seed", seed)
            succeed("bake", scene, "-o", tmp_path / f"{scene.stem}{seed}", *words)
        found.append([asked.ask("query", tmp_path / f"{scene.stem}{seed}").mean() for seed in range(6)])
    near, far = np.array(found, float)
    noise = np.hypot(standard_error(near), standard_error(far))
    assert (near != far).all()
    assert abs(near.mean() - far.mean()) < 4 * noise
    assert abs(1.05 * near.mean() - far.mean()) > 4 * noise


def test_the_reference_far_away_is_the_one_at_the_origin(tmp_path):
    place = np.array([503_217.375, 498_711.625, 12.5])
    far = dataclasses.replace(yard(place=place), origin=np.round(place / 1024) * 1024)
    words = ("--samples", "64", "--threads", "1")
    here = Points(tmp_path, *ground_points()).ask("reference", stored(tmp_path, yard(), "near.giv"), *words)
    there = Points(tmp_path, *ground_points(place=place)).ask("reference", stored(tmp_path, far, "far.giv"), *words)
    assert (np.abs(here - there) < 0.02 * here).mean() > 0.9
    assert abs(here.mean() - there.mean()) < 0.005 * here.mean()


def start(*words: object) -> subprocess.Popen:
    """A command that is going to be interrupted."""
    command = [sys.executable, "-m", "gi_volumes", *map(str, words), "--progress", "json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


SLOW = ("--samples", "4096", "--finest", "2", "--threads", "1")


@pytest.fixture(scope="module")
def row_slow(row) -> dict[str, bytes]:
    """All files of a bake that takes a while, not interrupted."""
    succeed("bake", row, "-o", row.parent / "slow", *SLOW)
    return content(row.parent / "slow")


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_bake_keeps_its_finished_cells_and_the_next_run_completes_it(row, row_slow, tmp_path, number):
    process = start("bake", row, "-o", tmp_path, *SLOW)
    while not (tmp_path / "cell_0_0.tree").exists():
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "interrupted\n")
    assert json.loads(out.splitlines()[-1]) == {"error": "interrupted"}
    done = listed(tmp_path)
    assert [0, 0] in done
    assert len(done) < CELLS, "the bake was over before it was interrupted"
    defects = call("verify", tmp_path, "--json").object["defects"]
    assert [defect["file"] for defect in defects] == [f"cell_{i}_0.tree" for i in range(CELLS) if [i, 0] not in done]
    assert {path.name for path in tmp_path.iterdir()} == {"scene.giv", "world.json"} | {
        f"cell_{i}_0.{kind}" for i, _ in done for kind in ("tree", "points", "local", "sun", "sky")
    }
    finished = {path.name: identity(path) for path in tmp_path.glob("cell_*")}
    succeed("bake", row, "-o", tmp_path, *SLOW)
    assert {name: identity(tmp_path / name) for name in finished} == finished
    assert content(tmp_path) == row_slow


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
def test_a_bake_that_is_killed_is_completed_by_the_next_run(row, row_slow, tmp_path):
    process = start("bake", row, "-o", tmp_path, *SLOW)
    while not (tmp_path / "cell_0_0.tree").exists():
        assert process.poll() is None
        time.sleep(0.005)
    process.kill()
    process.communicate(timeout=60)
    assert listed(tmp_path) == []
    finished = {path.name: identity(path) for path in tmp_path.glob("cell_0_0.*")}
    succeed("bake", row, "-o", tmp_path, *SLOW)
    assert {name: identity(tmp_path / name) for name in finished} == finished
    assert cells_only(tmp_path) == {name: data for name, data in row_slow.items() if name.startswith("cell_")}


def stop(*_):
    raise KeyboardInterrupt


def looked_early(row: Path, target: Path) -> None:
    """A bake that is stopped after its early look."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "_bake_cells", stop)
        with pytest.raises(KeyboardInterrupt):
            call("bake", row, "-o", target, *QUICK, "--early")


def test_an_early_look_shows_every_cell_and_counts_as_not_baked(row, row_baked, tmp_path):
    looked_early(row, tmp_path / "early")
    assert len(listed(tmp_path / "early")) == CELLS
    defects = call("verify", tmp_path / "early", "--json").object["defects"]
    assert [defect["file"] for defect in defects] == [f"cell_{i}_0.tree" for i in range(CELLS)]
    assert all("early look" in defect["what"] for defect in defects)
    asked = Points(tmp_path, *ground_points(100))
    early, final = (asked.ask("query", tmp_path / "early"), asked.ask("query", row.parent / "whole"))
    assert np.median(np.abs(early / final - 1)) < 0.3
    said = call("query", tmp_path / "early", *asked.words)
    assert said.err == f"warning: {CELLS} of {CELLS} cells are an early look, not baked to their end\n"


def test_a_bake_that_goes_on_after_an_early_look_is_the_same(row, row_baked, tmp_path):
    looked_early(row, tmp_path)
    succeed("bake", row, "-o", tmp_path, *QUICK, "--early")
    assert content(tmp_path) == row_baked


def test_cells_with_an_early_look_alone_are_named_as_not_baked(row, tmp_path):
    looked_early(row, tmp_path)
    result = succeed("bake", row, "-o", tmp_path, *QUICK, "--cells", "0,0")
    assert [text for text in result["warnings"] if "not baked" in text] == [
        "2 of the scene's 3 cells are not baked yet"
    ]
    assert [defect["file"] for defect in call("verify", tmp_path, "--json").object["defects"]] == [
        "cell_1_0.tree",
        "cell_2_0.tree",
    ]


def test_the_list_of_cells_is_right_as_soon_as_a_cell_takes_the_place_of_its_early_look(row, tmp_path, monkeypatch):
    looked_early(row, tmp_path)
    write, defects = job.Place.write_cell, []

    def watched(self, *given):
        size = write(self, *given)
        defects.append(len(call("verify", tmp_path, "--json").object["defects"]))
        return size

    monkeypatch.setattr(job.Place, "write_cell", watched)
    succeed("bake", row, "-o", tmp_path, *QUICK)
    assert defects == [2, 1, 0]


def test_nothing_is_written_once_the_folder_is_closed(row, tmp_path, monkeypatch):
    made, init = [], job.Place.__init__
    monkeypatch.setattr(job.Place, "__init__", lambda self, *given: made.append(self) or init(self, *given))
    succeed("bake", row, "-o", tmp_path, *QUICK)
    before = content(tmp_path)
    with pytest.raises(CancelledError):
        made[0].write_cell(None, {}, None, None)
    assert content(tmp_path) == before


def test_lamps_inside_closed_meshes_are_named(tmp_path):
    lit = yard()
    shade = build_scenes.box((12.8, 12.8, 2.8), (13.2, 13.2, 3.2))
    ground = build_scenes.plane(6.0) + np.array([12, 12, 0])
    parts = [(ground, Material("white")), (shade, Material("shade"))]
    dark = build_scenes.snapshot(parts, lit.lights, (0.2, 0.3, 0.5), (0.0, 0.0, 0.0))
    said = [succeed("bake", stored(tmp_path, made), "-o", tmp_path / "out", *QUICK)["warnings"] for made in (lit, dark)]
    assert [[text for text in texts if "closed meshes" in text] for texts in said] == [
        [],
        ["local: no light arrives at any data point; are all lamps inside closed meshes?"],
    ]


def test_a_black_sky_of_functions_is_judged_as_a_white_one():
    snapshot, settings = yard(sky=(0.0, 0.0, 0.0)), Settings(sky="harmonics")
    snapshot, light = model(snapshot, settings)
    judge = job._judge(snapshot, settings, prepare(snapshot, light))
    assert judge.mean[-9:, 0].tolist() == pytest.approx([np.sqrt(4 * np.pi)] + [0] * 8)


def test_without_time_every_cell_is_an_early_look_and_the_next_bake_goes_on(row, row_baked, tmp_path):
    result = succeed("bake", row, "-o", tmp_path, *QUICK, "--minutes", "1e-9")
    assert f"time was too short for {CELLS} of {CELLS} cells (0,0/1,0/2,0)" in result["warnings"][0]
    assert (
        0 < result["data_points"] <= sum(cell["data_points"] for cell in succeed("info", row.parent / "whole")["cells"])
    )
    assert not any("not baked yet" in text for text in result["warnings"])
    assert len(call("verify", tmp_path, "--json").object["defects"]) == CELLS
    succeed("bake", row, "-o", tmp_path, *QUICK)
    assert content(tmp_path) == row_baked


def test_with_time_enough_a_limit_changes_nothing(row, row_baked, tmp_path):
    result = succeed("bake", row, "-o", tmp_path, *QUICK, "--minutes", "60")
    assert not any("time" in text for text in result["warnings"])
    assert content(tmp_path) == row_baked


def test_no_early_look_takes_the_place_of_another_bake(row, tmp_path):
    succeed("bake", row, "-o", tmp_path, *QUICK, "--seed", "9")
    before = content(tmp_path)
    looked_early(row, tmp_path)
    assert content(tmp_path) == before


def test_cells_close_to_the_camera_are_baked_first(row, tmp_path, monkeypatch):
    order, write = [], job.Place.write_cell

    def watched(self, tree, *given):
        order.append(tree.cell)
        return write(self, tree, *given)

    monkeypatch.setattr(job.Place, "write_cell", watched)
    there = yard(CELLS)
    frame = np.array(there.cameras[0].world_from_camera).reshape(3, 4)
    frame[0, 3] = 128 * CELLS
    camera = dataclasses.replace(there.cameras[0], world_from_camera=tuple(frame.ravel().tolist()))
    succeed("bake", stored(tmp_path, dataclasses.replace(there, cameras=(camera,))), "-o", tmp_path / "out", *QUICK)
    assert order == [(i, 0) for i in reversed(range(CELLS))]


def test_an_interruption_before_the_first_cell_leaves_another_bake_as_it_was(row, tmp_path, monkeypatch):
    succeed("bake", row, "-o", tmp_path, *QUICK)
    before = content(tmp_path)
    monkeypatch.setattr("gi_volumes.bake.measured.gather", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        call("bake", row, "-o", tmp_path, *QUICK, "--seed", "9")
    assert content(tmp_path) == before


def test_an_interruption_before_the_first_cell_leaves_an_empty_bake_in_a_new_folder(row, tmp_path, monkeypatch):
    monkeypatch.setattr("gi_volumes.bake.measured.gather", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        call("bake", row, "-o", tmp_path / "out", *QUICK)
    assert set(content(tmp_path / "out")) == {"scene.giv", "world.json"}
    assert len(call("verify", tmp_path / "out", "--json").object["defects"]) == CELLS
    asked = Points(tmp_path, *ground_points(3))
    assert not asked.ask("query", tmp_path / "out").any()


def test_a_bake_replaces_another_one_and_leaves_none_of_its_files(row, tmp_path):
    other = stored(tmp_path, yard(sun=False), "other.giv")
    succeed("bake", other, "-o", tmp_path / "clean", *QUICK)
    succeed("bake", row, "-o", tmp_path / "out", *QUICK, "--sky", "harmonics")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    (tmp_path / "out" / "cell_7_7.sky").write_bytes(b"the rest of something")
    succeed("bake", other, "-o", tmp_path / "out", *QUICK)
    assert content(tmp_path / "out") == content(tmp_path / "clean") | {"notes.txt": b"mine"}
    assert succeed("verify", tmp_path / "out") == {"defects": []}


def test_some_cells_of_another_bake_are_not_kept_beside_some_of_this_one(row, tmp_path):
    succeed("bake", row, "-o", tmp_path, *QUICK)
    succeed("bake", row, "-o", tmp_path, *QUICK, "--seed", "1", "--cells", "1,0")
    assert listed(tmp_path) == [[1, 0]]
    assert {name.split(".")[0] for name in cells_only(tmp_path)} == {"cell_1_0"}


def test_an_interruption_while_the_other_bake_s_files_go_does_not_keep_them(row, tmp_path, monkeypatch):
    succeed("bake", row, "-o", tmp_path, *QUICK)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            call("bake", row, "-o", tmp_path, *QUICK, "--seed", "1", "--cells", "1,0")
    succeed("bake", row, "-o", tmp_path, *QUICK, "--seed", "1", "--cells", "1,0")
    assert {name.split(".")[0] for name in cells_only(tmp_path)} == {"cell_1_0"}


def test_an_interruption_while_files_are_put_away_leaves_none_of_them(row, tmp_path, monkeypatch):
    remove = shutil.rmtree
    calls = []

    def interrupted(path, **options):
        calls.append(path)
        if len(calls) == 3:
            raise KeyboardInterrupt
        remove(path, **options)

    monkeypatch.setattr(shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        call("bake", row, "-o", tmp_path, *QUICK)
    assert len(calls) > 3
    assert listed(tmp_path) == [[0, 0]]
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_the_files_of_another_bake_go_also_when_its_list_is_lost(row, tmp_path):
    succeed("bake", row, "-o", tmp_path, *QUICK)
    (tmp_path / "world.json").write_bytes(b"{damaged")
    succeed("bake", row, "-o", tmp_path, *QUICK, "--seed", "1", "--cells", "1,0")
    assert {name.split(".")[0] for name in cells_only(tmp_path)} == {"cell_1_0"}


@pytest.mark.parametrize(
    "text", ["{}", "[1]", "my notes on the world", "", '{"format": "a game\'s world", "cells": []}']
)
def test_another_program_s_world_is_not_replaced(row, tmp_path, text):
    (tmp_path / "world.json").write_text(text)
    assert "another program's file" in call("bake", row, "-o", tmp_path, *QUICK).reason
    assert content(tmp_path) == {"world.json": text.encode()}


class Disk:
    """A disk that is full when the n-th file is written to it."""

    def __init__(self, monkeypatch, room: int) -> None:
        self.room = room
        self.sync = os.fsync
        monkeypatch.setattr(os, "fsync", self)

    def __call__(self, descriptor: int) -> None:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            if self.room == 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.room -= 1
        self.sync(descriptor)


FILES = 2 + 2 + 5 * CELLS
"""Files that a bake writes: the scene and the list twice at most, five for each cell."""


@pytest.mark.parametrize("room", range(FILES))
@pytest.mark.parametrize("occupied", [False, True])
def test_wherever_a_disk_fills_up_the_folder_holds_one_bake(row, row_baked, tmp_path, monkeypatch, room, occupied):
    target = tmp_path / "out"
    if occupied:
        succeed("bake", stored(tmp_path, yard(sun=False), "other.giv"), "-o", target, *QUICK)
    before = content(target)
    with monkeypatch.context() as patch:
        disk = Disk(patch, room)
        said = call("bake", row, "-o", target, *QUICK)
    if disk.room > 0:
        assert (said.code, content(target)) == (0, row_baked)
        return
    if said.code == 0:
        return
    assert said.reason.endswith("cannot write: No space left on device")
    after = content(target)
    if after == before:
        assert target.exists() == occupied
        assert room < 7
        return
    assert set(after) <= set(row_baked)
    defects = call("verify", target, "--json").object["defects"]
    assert defects
    assert all(defect["what"].endswith("missing: not baked yet") for defect in defects)
    succeed("bake", row, "-o", target, *QUICK)
    assert content(target) == row_baked


@pytest.mark.parametrize("occupied", [False, True])
def test_a_folder_that_cannot_be_written_is_refused_before_the_light_is_gathered(row, tmp_path, monkeypatch, occupied):
    target = tmp_path / "out"
    if occupied:
        succeed("bake", row, "-o", target, *QUICK, "--seed", "1")
    before = content(target)

    def refused(path, *_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))

    monkeypatch.setattr("gi_volumes.bake.measured.gather", lambda *_: pytest.fail("worked in vain"))
    monkeypatch.setattr(os, "mkdir", refused)
    said = call("bake", row, "-o", target, *QUICK)
    monkeypatch.undo()
    assert said.reason == f"{target}: " + "cannot write: " * occupied + "Permission denied"
    assert content(target) == before


@pytest.mark.parametrize("moved", range(6))
def test_a_cell_counts_only_when_all_of_its_files_are_there(row, row_baked, tmp_path, monkeypatch, moved):
    target, left = tmp_path / "out", [1 + moved]
    replace = Path.replace

    def stop(path: Path, goal: Path) -> Path:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        return replace(path, goal)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            call("bake", row, "-o", target, *QUICK)
    assert len(cells_only(target)) == moved
    assert listed(target) == ([[0, 0]] if moved >= 5 else [])
    defects = call("verify", target, "--json").object["defects"]
    assert len(defects) == CELLS - len(listed(target))
    assert all(defect["what"].endswith("missing: not baked yet") for defect in defects)
    succeed("bake", row, "-o", target, *QUICK)
    assert content(target) == row_baked


def test_a_bake_without_the_command_line_refuses_the_same_folders(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SettingsError, match="a bake needs a folder"):
        job.bake(yard(), tmp_path / "file", Settings(1, 1, finest=8))
    (tmp_path / "world.json").write_text("[]")
    with pytest.raises(SettingsError, match="another program's file"):
        job.bake(yard(), tmp_path, Settings(1, 1, finest=8))


def test_cells_that_time_was_too_short_for_keep_to_their_bytes(row, tmp_path):
    def sizes(*limits: str) -> list[int]:
        succeed("bake", row, "-o", tmp_path, *QUICK, *limits)
        return [sum(path.stat().st_size for path in tmp_path.glob(f"cell_{i}_0.*")) for i in range(CELLS)]

    assert min(sizes("--minutes", "1e-9")) > FEW_BYTES
    assert max(sizes("--max-bytes", str(FEW_BYTES), "--minutes", "1e-9")) <= FEW_BYTES
    assert len(call("verify", tmp_path, "--json").object["defects"]) == CELLS
    assert max(sizes("--max-bytes", str(FEW_BYTES))) <= FEW_BYTES
    assert call("verify", tmp_path, "--json").object["defects"] == []
