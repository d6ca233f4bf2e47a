"""The words of the command line: what each command answers, in which form, and which words it refuses."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import QUICK, SUN, Points, call, cells_only, ground_points, stored, succeed, yard
from gi_volumes.bake import snapshot_file
from gi_volumes.bake.job import STEPS
from gi_volumes.tree import world
from gi_volumes.tree.folder import load_header
from gi_volumes.tree.suns import SunKeys

RESULT = {"triangles", "cells", "data_points", "bytes", "seconds", "rays", "modelled", "left_out", "warnings"}


@pytest.fixture(scope="module")
def level(tmp_path_factory) -> Path:
    return stored(tmp_path_factory.mktemp("level"), yard())


@pytest.fixture(scope="module")
def baked(level) -> Path:
    succeed("bake", level, "-o", level.parent / "baked", "--samples", "32", "--finest", "2")
    return level.parent / "baked"


@pytest.fixture(scope="module")
def baked_hemisphere(level) -> Path:
    folder = level.parent / "hemisphere"
    succeed("bake", level, "-o", folder, "--samples", "32", "--finest", "2", "--sun", "hemisphere")
    return folder


@pytest.fixture
def points(tmp_path) -> Points:
    return Points(tmp_path, *ground_points())


def python(*words: object, **options) -> subprocess.CompletedProcess:
    """The command line in a process of its own."""
    command = [sys.executable, "-m", "gi_volumes", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120, **options)


@pytest.mark.parametrize("words", [["--sky", "blue"], ["--sun", "up"], ["--sun", "arc:no.txt"], ["--finest", "0.3"]])
@pytest.mark.parametrize("command", ["bake", "reference"])
def test_words_that_no_scene_makes_right_are_refused_before_one_is_read(command, words, tmp_path):
    if command == "reference" and words[0] == "--finest":
        pytest.skip("the reference has no voxels")
    np.save(tmp_path / "p.npy", np.zeros((1, 3)))
    np.save(tmp_path / "n.npy", np.eye(3)[:1])
    points = ["--points", tmp_path / "p.npy", "--normals", tmp_path / "n.npy"] if command == "reference" else []
    said = call(command, "no_such_scene.blend", "-o", tmp_path / "out", *points, *words)
    assert said.code == 1
    assert said.reason.startswith(words[0])


def test_a_limit_on_time_and_what_is_kept_for_later_exclude_each_other(tmp_path):
    said = call("bake", "level.giv", "-o", tmp_path / "out", "--minutes", "1", "--incremental")
    assert said.reason.startswith("--minutes and --incremental: one or the other")
    assert not (tmp_path / "out").exists()


def test_bake_prints_one_object_with_the_keys_that_programs_rely_on(level, tmp_path):
    done = python("bake", level, "-o", tmp_path / "out", *QUICK, "--json")
    result = json.loads(done.stdout)
    assert (done.returncode, done.stdout.count("\n")) == (0, 1)
    assert set(result) >= RESULT
    assert set(result["bytes"]) >= {"tree", "local", "sun", "sky", "probes"}
    assert (result["triangles"], result["cells"], result["warnings"]) == (14, 1, [])
    assert result["modelled"] == ["local", "sun", "sky"]
    assert [set(item) for item in result["left_out"]] == [{"what", "why"}]
    assert result["rays"] > result["data_points"] > 0
    assert all(seconds >= 0 for seconds in result["seconds"].values())
    sizes = {name.split(".")[-1]: len(data) for name, data in cells_only(tmp_path / "out").items()}
    assert {name: size for name, size in result["bytes"].items() if size} == sizes
    assert "Baking: 100 %" in done.stderr
    assert "Traceback" not in done.stderr


def test_bake_tells_people_what_it_did_and_what_it_left_out(level, tmp_path):
    said = call("bake", level, "-o", tmp_path, *QUICK, "--sun", "none")
    assert said.code == 0
    assert "data points in 1 cell(s) from 14 triangles" in said.out
    assert "modelled: local, sky" in said.out
    assert "left out: sun: " in said.out
    assert said.err.splitlines() == ["Preparing", "Baking: 100 %"]


def test_progress_for_programs_is_one_object_per_line_and_the_last_one_is_the_result(level, tmp_path):
    done = python("bake", level, "-o", tmp_path / "out", *QUICK, "--progress", "json", "--json")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert set(lines[-1]) == {"result"}
    assert set(lines[-1]["result"]) >= RESULT
    assert all(set(line) == {"stage", "done", "total", "seconds_left"} for line in lines[:-1])
    assert [line["stage"] for line in lines[:2]] == ["Preparing", "Baking"]
    bakes = [line for line in lines[:-1] if line["stage"] == "Baking"]
    assert bakes[-1]["done"] == bakes[-1]["total"] == STEPS * lines[-1]["result"]["cells"]
    assert [line["done"] for line in bakes] == sorted({line["done"] for line in bakes})
    assert bakes[-1]["seconds_left"] == 0
    assert done.stderr == ""


def test_the_last_line_for_programs_is_the_error_when_there_is_one(tmp_path):
    said = call("bake", tmp_path / "missing.giv", "-o", tmp_path / "out", "--progress", "json")
    assert json.loads(said.out) == {"error": said.reason}
    assert said.reason == f"{tmp_path / 'missing.giv'}: there is no such file"


def test_a_scene_of_blender_is_read_first_and_gives_the_same_bake_as_its_snapshot(level, baked, tmp_path):
    def extract(scene: Path, snapshot: Path) -> None:
        assert scene == tmp_path / "level.BLEND"
        snapshot_file.save(yard(), snapshot)

    (tmp_path / "level.BLEND").touch()
    words = ("bake", tmp_path / "level.BLEND", "-o", tmp_path / "out", "--samples", "32", "--finest", "2")
    said = call(*words, extract=extract)
    assert said.code == 0
    assert said.err.splitlines()[0] == "Reading the scene"
    assert cells_only(tmp_path / "out") == cells_only(baked)


def test_a_bake_can_be_made_again_from_the_snapshot_in_its_own_folder(level, tmp_path):
    succeed("bake", level, "-o", tmp_path, *QUICK, "--sky", "7.0")
    before = (tmp_path / "scene.giv").read_bytes()
    assert before == level.read_bytes()
    succeed("bake", tmp_path / "scene.giv", "-o", tmp_path, *QUICK)
    assert (tmp_path / "scene.giv").read_bytes() == before


def test_info_says_what_is_in_a_bake(baked, level):
    header = succeed("info", baked)
    assert [entry["cell"] for entry in header["cells"]] == header["expected_cells"] == [[0, 0]]
    assert header["settings"]["samples"] == 32
    assert header["snapshot"] == snapshot_file.digest(snapshot_file.load(level))
    assert set(header["transports"]) == {"local", "sun", "sky"}
    assert json.loads(call("info", baked).out) == header


def test_verify_finds_nothing_in_a_sound_bake(baked):
    assert succeed("verify", baked) == {"defects": []}
    assert call("verify", baked).out == "no defects\n"


def test_verify_lists_defects_as_json_and_fails(level, tmp_path):
    succeed("bake", level, "-o", tmp_path, *QUICK)
    (tmp_path / "cell_0_0.sky").unlink()
    (tmp_path / "scene.giv").unlink()
    said = call("verify", tmp_path, "--json")
    missing = [{"file": name, "what": "the file is missing"} for name in ("cell_0_0.sky", "scene.giv")]
    assert (said.code, said.object, said.err) == (1, {"defects": missing}, "")
    assert call("verify", tmp_path).out == "cell_0_0.sky: the file is missing\nscene.giv: the file is missing\n"


def test_verify_notices_the_snapshot_of_another_scene(level, tmp_path):
    succeed("bake", level, "-o", tmp_path, *QUICK)
    stored(tmp_path, yard(lamp=False), "scene.giv")
    defects = call("verify", tmp_path, "--json").object["defects"]
    assert defects == [{"file": "scene.giv", "what": "the snapshot is of another scene than the bake"}]
    assert "of another scene" in call("compare", tmp_path, "-o", tmp_path / "seen.png").reason


def test_query_is_finite_and_not_negative_at_a_hundred_thousand_points_near_and_far(baked, baked_hemisphere, tmp_path):
    rng = np.random.default_rng(1)
    scale = 10.0 ** rng.uniform(-2, 12, (100_000, 1))
    asked = Points(tmp_path, rng.normal(size=(100_000, 3)) * scale, rng.normal(size=(100_000, 3)))
    for folder in (baked, baked_hemisphere):
        found = asked.ask("query", folder)
        assert (found.shape, found.dtype) == ((100_000, 3), np.float32)
        assert np.isfinite(found).all()
        assert (found >= 0).all()
        assert found.any()


def test_query_s_transports_add_up_to_all_of_them(baked, points):
    header = succeed("info", baked)
    strength = np.array([sun["irradiance"] for sun in header["transports"]["sun"]["scene"]]).sum(axis=0)
    one = {name: points.ask("query", baked, "--transport", name) for name in ("local", "sun", "sky", "all")}
    assert all(values.any() for values in one.values())
    np.testing.assert_allclose(one["local"] + one["sun"] * strength + one["sky"], one["all"], rtol=1e-5, atol=1e-6)


def test_the_scene_s_own_sun_may_be_named_and_another_one_gives_another_value(baked_hemisphere, points):
    words = ",".join(map(str, SUN))
    own = points.ask("query", baked_hemisphere)
    longer = ",".join(str(1e200 * value) for value in SUN)
    for same in (words, longer):
        np.testing.assert_allclose(points.ask("query", baked_hemisphere, "--sun", same), own, rtol=1e-5, atol=1e-6)
    other = points.ask("query", baked_hemisphere, "--sun", "-0.9,0.1,0.2")
    assert (np.abs(other - own) > 1e-3).any()


def test_a_direction_may_begin_with_a_minus(level, tmp_path):
    succeed("bake", level, "-o", tmp_path, *QUICK, "--sun", "-0.3,.4,0.8")
    np.testing.assert_allclose(succeed("info", tmp_path)["transports"]["sun"]["directions"][0][0], -0.318, atol=1e-3)


def test_output_that_cannot_be_written_is_refused_before_any_work(baked, level, points, tmp_path, monkeypatch):
    for name in ("irradiance", "at"):
        monkeypatch.setattr(f"gi_volumes.bake.reference.{name}", lambda *_: pytest.fail("worked in vain"))
    words = points.words[:-1]
    for command, source in (("query", baked), ("reference", level)):
        assert "is a folder" in call(command, source, *words, tmp_path).reason
        assert "there is no folder" in call(command, source, *words, tmp_path / "no" / "found.npy").reason
    assert "as .png or .exr" in call("compare", baked, "-o", tmp_path / "seen.jpg").reason
    assert "there is no folder" in call("compare", baked, "-o", tmp_path / "no" / "seen.exr").reason


def test_reference_agrees_with_the_bake_of_the_open_ground(tmp_path):
    ground = stored(tmp_path, yard(lamp=False, sun=False))
    asked = Points(tmp_path, np.array([[13.5, 13.5, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
    succeed("bake", ground, "-o", tmp_path / "out", "--samples", "256", "--finest", "2")
    truth = asked.ask("reference", ground)
    np.testing.assert_allclose(asked.ask("query", tmp_path / "out"), truth, rtol=0.05)
    np.testing.assert_allclose(truth, np.pi * np.array([[0.2, 0.3, 0.5]]), rtol=0.02)


def test_reference_sees_the_scene_s_own_sky_whatever_else_is_baked_and_asks_for_one_sun(level, points):
    few = ("--samples", "16")
    plain = points.ask("reference", level, *few)
    assert plain.any()
    assert np.array_equal(points.ask("reference", level, *few, "--sky", "harmonics"), plain)
    assert not np.array_equal(points.ask("reference", level, *few, "--sun", "0,0,1"), plain)
    assert "hemisphere" in call("reference", level, *points.words, *few, "--sun", "hemisphere").reason


def test_a_sun_that_the_scene_does_not_have_shines_with_one_watt_in_bake_and_reference(tmp_path):
    dark = stored(tmp_path, yard(lamp=False, sun=False, sky=(0, 0, 0)))
    asked = Points(tmp_path, *ground_points(200))
    succeed("bake", dark, "-o", tmp_path / "out", "--samples", "64", "--finest", "0.5", "--sun", "0.3,0.4,0.8")
    found = asked.ask("query", tmp_path / "out")
    assert np.array_equal(asked.ask("query", tmp_path / "out", "--transport", "sun"), found)
    truth = asked.ask("reference", dark, "--sun", "0.3,0.4,0.8", "--samples", "256")
    assert 0.5 < found.mean() / truth.mean() < 2


@pytest.mark.parametrize("suffix", [".png", ".EXR"])
def test_compare_writes_a_picture_and_figures(baked, baked_hemisphere, tmp_path, suffix):
    for folder in (baked, baked_hemisphere):
        words = ("-o", tmp_path / f"seen{suffix}", "--size", "24x16", "--samples", "64")
        figures = succeed("compare", folder, *words)
        assert set(figures) == {"pixels", "mean_baked", "mean_reference", "relative_rmse"}
        assert figures["pixels"] > 100
        assert figures["mean_baked"] == pytest.approx(figures["mean_reference"], rel=0.3)
    assert [path.name for path in tmp_path.iterdir()] == [f"seen{suffix}"]
    assert (tmp_path / f"seen{suffix}").stat().st_size > 500


def test_compare_needs_no_file_of_sun_directions(level, tmp_path):
    (tmp_path / "arc.txt").write_text("1 0 0.2\n0 0 1\n\n-1,0,0.2\n")
    succeed("bake", level, "-o", tmp_path / "out", *QUICK, "--sun", f"arc:{tmp_path / 'arc.txt'}")
    (tmp_path / "arc.txt").unlink()
    succeed("compare", tmp_path / "out", "-o", tmp_path / "seen.png", "--size", "4x4", "--samples", "4")


def test_compare_shows_a_scene_in_the_dark(tmp_path):
    dark = stored(tmp_path, yard(lamp=False, sun=False, sky=(0, 0, 0)))
    succeed("bake", dark, "-o", tmp_path / "out", *QUICK)
    figures = succeed("compare", tmp_path / "out", "-o", tmp_path / "seen.png", "--size", "4x4", "--samples", "4")
    assert figures == {"pixels": 4, "mean_baked": 0.0, "mean_reference": 0.0, "relative_rmse": None}


def test_compare_names_the_cameras_that_there_are(baked, tmp_path):
    said = call("compare", baked, "-o", tmp_path / "seen.png", "--camera", "below")
    assert said.reason == "--camera below: the scene has no such camera; cameras: 'above'"


def test_compare_looks_from_anywhere_into_a_scene_without_a_camera(tmp_path):
    blind = stored(tmp_path, dataclasses.replace(yard(), cameras=()))
    succeed("bake", blind, "-o", tmp_path / "out", *QUICK)
    words = ("compare", tmp_path / "out", "-o", tmp_path / "seen.png", "--size", "6x4", "--samples", "4")
    assert call(*words).reason.endswith("say where from with --eye and --target")
    assert succeed(*words, "--eye", "-30,12,20", "--target", "12,12,0", "--fov", "5")["pixels"] == 24
    assert succeed(*words, "--eye", "12,12,20", "--target", "-30,12,20")["pixels"] == 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--eye", "1,2,3"], "--eye and --target: give both, or neither"),
        (["--target", "1,2,3"], "--eye and --target: give both, or neither"),
        (["--fov", "60"], "--fov: only together with --eye and --target; cameras of the scene have their own"),
        (["--eye", "1,2,3", "--target", "1,2,3.0"], "--eye and --target: they are one point, which gives no direction"),
        (["--eye", "1,2,3", "--target", "0,0,0", "--camera", "above"], "--camera: not together with --eye"),
        (["--eye", "1,2,3", "--target", "0,0,1e30"], "--eye and --target: at most 1e+09 m from the origin"),
        (["--eye", "1,2", "--target", "0,0,0"], "argument --eye: '1,2' is not a place: write three numbers as x,y,z"),
        (["--eye", "1,2,3", "--target", "0,nan,0"], "argument --target: '0,nan,0' is not a place"),
        (["--eye", "1,2,3", "--target", "0,0,0", "--fov", "180"], "argument --fov: '180' is not an angle above 0"),
        (["--eye", "1,2,3", "--target", "0,0,0", "--fov", "wide"], "argument --fov: 'wide' is not an angle above 0"),
    ],
)
def test_compare_says_what_is_wrong_with_a_place_to_look_from(tmp_path, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    said = call("compare", "out", "-o", "seen.png", *words)
    assert (said.code, said.out) == (2, "")
    assert said.err.splitlines()[-1].startswith(f"gi_volumes compare: error: {reason}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "modelled", "functions"),
    [
        (["--sky", "1.0"], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
        (["--sky", "0.1,0.2,3"], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
        (["--sky", "harmonics"], ["local", "sun", "sky"], {"sun": 1, "sky": 9}),
        (["--sky", "0"], ["local", "sun"], {"sun": 1}),
        (["--sun", "none"], ["local", "sky"], {"sky": 1}),
        (["--sun", "0,0,-2"], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
        (["--sun", "hemisphere"], ["local", "sun", "sky"], {"sun": 16, "sky": 1}),
        (["--bounces", "0"], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
        (["--bounces", "1000"], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
        (["--seed", str(2**70)], ["local", "sun", "sky"], {"sun": 1, "sky": 1}),
    ],
)
def test_only_the_light_that_is_asked_for_is_modelled(level, tmp_path, words, modelled, functions):
    from gi_volumes.tree import payload

    result = succeed("bake", level, "-o", tmp_path, *QUICK, *words)
    assert result["modelled"] == modelled
    assert [item["what"] for item in result["left_out"]] == [
        name for name in ("local", "sun", "sky", "probes") if name not in modelled
    ]
    there = {name.split(".")[-1] for name in cells_only(tmp_path)}
    assert there == {"tree", "points", *modelled}
    for name, count in functions.items():
        assert payload.read_payload(tmp_path / f"cell_0_0.{name}")[0].functions == count
    assert all((result["bytes"][name] > 0) == (name in modelled) for name in ("local", "sun", "sky"))
    assert succeed("verify", tmp_path) == {"defects": []}


def test_a_scene_in_the_dark_has_a_tree_and_no_light(tmp_path):
    dark = stored(tmp_path, yard(lamp=False, sun=False, sky=(0, 0, 0)))
    result = succeed("bake", dark, "-o", tmp_path / "out", *QUICK)
    assert result["modelled"] == []
    assert [item["what"] for item in result["left_out"]] == ["local", "sun", "sky", "probes"]
    assert all(item["why"] for item in result["left_out"])
    asked = Points(tmp_path, *ground_points(5))
    assert not asked.ask("query", tmp_path / "out").any()
    assert not asked.ask("reference", dark, "--samples", "4").any()


@pytest.mark.parametrize("finest", [0.25, 0.5, 1, 2, 16])
def test_the_finest_voxels_have_the_size_that_was_asked_for(level, tmp_path, finest):
    succeed("bake", level, "-o", tmp_path, "--samples", "1", "--finest", finest)
    grid = succeed("info", tmp_path)["grid"]
    assert grid["first_size"] / 4 ** (grid["levels"] - 1) == finest


REFUSED = [
    ("--finest", "0.3", "use a power of two"),
    ("--finest", "nan", "use a power of two"),
    ("--finest", "-1", "use a power of two"),
    ("--finest", "0.00390625", "too fine for a scene"),
    ("--finest", str(2.0**1000), "too coarse for a scene"),
    ("--sky", "blue", "use scene, harmonics, or 1 or 3 numbers"),
    ("--sky", "1,2", "use scene, harmonics, or 1 or 3 numbers"),
    ("--sky", "inf", "use scene, harmonics, or 1 or 3 numbers"),
    ("--sky", "-1", "cannot be negative"),
    ("--sky", "1e39", "single precision"),
    ("--sun", "up", "use scene, none, hemisphere, arc:FILE, or 3 numbers"),
    ("--sun", "1,2", "use scene, none, hemisphere, arc:FILE, or 3 numbers"),
    ("--sun", "nan,0,1", "use scene, none, hemisphere, arc:FILE, or 3 numbers"),
    ("--sun", "0,0,0", "points nowhere"),
    ("--sun", "arc:missing", "cannot be read"),
    ("--sun", "arc:.", "cannot be read"),
    ("--cells", "9,9", "no geometry there; this scene has cells 0,0"),
    ("--cells", "-1,0", "no geometry there; this scene has cells 0,0"),
]


@pytest.mark.parametrize(("option", "value", "reason"), REFUSED)
def test_a_value_that_cannot_be_baked_is_named_with_its_option(level, tmp_path, option, value, reason):
    said = call("bake", level, "-o", tmp_path / "out", *(word for word in QUICK if option != "--finest"), option, value)
    assert said.reason.startswith(f"{option} {float(value) if option == '--finest' else value}")
    assert reason in said.reason
    assert list(tmp_path.iterdir()) == []


def test_a_cap_below_the_first_level_of_voxels_is_refused_in_one_line(tmp_path):
    said = call("bake", stored(tmp_path, yard()), "-o", tmp_path / "out", *QUICK, "--max-points", "3")
    assert said.reason == "--max-points 3: cell 0,0 has 18 first-level voxels; allow as many data points at least"
    assert not cells_only(tmp_path / "out")


def test_limits_are_kept_and_what_they_leave_out_is_said(level, tmp_path):
    words = ("--samples", "4", "--error", "0", "--finest", "1", "--threads", "2")
    free = succeed("bake", level, "-o", tmp_path / "free", *words)
    points, size = free["data_points"] // 2, sum(free["bytes"].values()) // 2
    for option, limit, unit in (("--max-points", points, "data points"), ("--max-bytes", size, "bytes")):
        found = succeed("bake", level, "-o", tmp_path / unit, *words, option, limit)
        assert (found["data_points"] if unit == "data points" else sum(found["bytes"].values())) <= limit
        left_out = [item for item in found["left_out"] if "voxels" in item["what"]]
        assert len(left_out) == 1
        assert f"{limit:,} {unit}" in left_out[0]["why"]
    assert not [item for item in free["left_out"] if "voxels" in item["what"]]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("\n", "holds no directions"),
        ("1 0 1\n1 2\n", "line 2 (1 2): write three numbers"),
        ("0 0 1\n" * 65, "at most 64"),
        ("é", "line 1 (é): write three"),
    ],
)
def test_a_file_of_sun_directions_is_checked_before_the_bake(level, tmp_path, text, reason):
    (tmp_path / "arc").write_text(text)
    assert reason in call("bake", level, "-o", tmp_path / "out", "--sun", f"arc:{tmp_path / 'arc'}").reason
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("words", "bounces"), [((), 64), (("--bounces", "3"), 3)])
def test_the_surface_cache_follows_light_for_longer_unless_told_otherwise(level, tmp_path, words, bounces):
    succeed("bake", level, "-o", tmp_path / "out", *QUICK, "--method", "cache", *words)
    settings = json.loads((tmp_path / "out" / "world.json").read_text())["settings"]
    assert (settings["method"], settings["bounces"]) == ("cache", bounces)
    assert (Points(tmp_path, *ground_points(5)).ask("query", tmp_path / "out") > 0).all()


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["dance"],
        ["bake"],
        ["bake", "level.giv"],
        ["bake", "level.giv", "-o", ""],
        ["bake", "", "-o", "out"],
        ["bake", "level.giv", "-o", "out", "--quality", "best"],
        ["bake", "level.giv", "-o", "out", "--samples", "0"],
        ["bake", "level.giv", "-o", "out", "--samples", "many"],
        ["bake", "level.giv", "-o", "out", "--sam", "4"],
        ["bake", "level.giv", "-o", "out", "--seed", "-1"],
        ["bake", "level.giv", "-o", "out", "--samples", "9999999999"],
        ["bake", "level.giv", "-o", "out", "--threads", "1.5"],
        ["bake", "level.giv", "-o", "out", "--cells", ""],
        ["bake", "level.giv", "-o", "out", "--cells", "0,0/1"],
        ["bake", "level.giv", "-o", "out", "--progress", "xml"],
        ["bake", "level.giv", "-o", "out", "--error", "-0.1"],
        ["bake", "level.giv", "-o", "out", "--error", "nan"],
        ["bake", "level.giv", "-o", "out", "--error", "1.01"],
        ["bake", "level.giv", "-o", "out", "--error", "small"],
        ["bake", "level.giv", "-o", "out", "--minutes", "0"],
        ["bake", "level.giv", "-o", "out", "--minutes", "nan"],
        ["bake", "level.giv", "-o", "out", "--minutes", "inf"],
        ["bake", "level.giv", "-o", "out", "--minutes", "soon"],
        ["bake", "level.giv", "-o", "out", "--max-points", "0"],
        ["bake", "level.giv", "-o", "out", "--max-points", "65536"],
        ["bake", "level.giv", "-o", "out", "--max-points", "1e3"],
        ["bake", "level.giv", "-o", "out", "--max-bytes", "0"],
        ["bake", "level.giv", "-o", "out", "--max-bytes", "2GB"],
        ["bake", "level.giv", "-o", "out", "--max-bytes", "-5"],
        ["bake", "level.giv", "-o", "out", "--dilation", "none"],
        ["bake", "level.giv", "-o", "out", "--no-fit", "yes"],
        ["bake", "level.giv", "-o", "out", "--method", "photons"],
        ["query", "out", "--points", "p.npy", "-o", "e.npy"],
        ["query", "out", "--points", "p.npy", "--directions", "d.npy", "-o", "e.npy"],
        ["query", "out", "--points", "p.npy", "--normals", "n.npy", "--roughness", "r.npy", "-o", "e.npy"],
        ["query", "out", "--points", "p", "--directions", "d", "--roughness", "r", "-o", "e", "--transport", "sky"],
        ["query", "out", "--points", "p.npy", "--normals", "n.npy", "-o", "e.npy", "--transport", "moon"],
        ["compare", "out", "-o", "seen.png", "--size", "12"],
        ["compare", "out", "-o", "seen.png", "--size", "0x4"],
    ],
)
def test_wrong_usage_exits_with_2_and_writes_nothing(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    said = call(*words)
    assert said.code == 2
    assert said.out == ""
    last = said.err.splitlines()[-1]
    assert last.startswith("gi_volumes")
    assert ": error: " in last
    assert "_" not in last.split(": error: ")[1], "a name of the program's own shows through"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="pipes end otherwise on Windows")
@pytest.mark.parametrize("words", [["info"], ["verify"], ["info", "--json"]])
def test_a_reader_that_goes_away_ends_the_command_without_a_traceback(baked, words):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "gi_volumes", words[0], str(baked), *words[1:]]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, timeout=60)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("command", ["info", "bake"])
def test_a_result_that_nobody_can_store_is_a_failure(command, baked, level, tmp_path):
    words = {"info": [baked, "--json"], "bake": [level, "-o", tmp_path, *QUICK, "--progress", "json"]}[command]
    buffered = {name: text for name, text in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "gi_volumes", command, *map(str, words)]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=buffered, timeout=60)
    assert done.returncode == 1
    assert done.stderr == b"error: No space left on device\n"


def test_a_name_that_the_terminal_cannot_write_does_not_lose_the_result(tmp_path):
    import dataclasses

    from gi_volumes.bake.snapshot import Note

    named = dataclasses.replace(yard(), notes=(Note("mur d'été 壁", "a wall"),))
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = python("bake", stored(tmp_path, named), "-o", tmp_path / "out", *QUICK, env=environment)
    assert done.returncode == 0, done.stderr
    assert "left out: mur d'\\xe9t\\xe9 \\u58c1: a wall" in done.stdout


def test_a_scene_without_any_light_is_named(tmp_path):
    level = stored(tmp_path, yard(lamp=False, sun=False, sky=(0, 0, 0)))
    warnings = succeed("bake", level, "-o", tmp_path / "out", *QUICK)["warnings"]
    assert any("no light to bake" in text and "--sky 1.0" in text for text in warnings)


def test_a_bake_says_where_it_is(level, tmp_path):
    said = call("bake", level, "-o", tmp_path / "out", *QUICK)
    assert said.out.splitlines()[-1] == f"written to {tmp_path / 'out'}"


def test_the_triangles_of_a_free_sun_are_those_that_a_look_up_takes(baked_hemisphere):
    sun = load_header(baked_hemisphere)["transports"]["sun"]
    assert sun["triangles"] == SunKeys(np.array(sun["directions"])).triangles.tolist()
    assert len(sun["triangles"]) > 10


def test_query_gives_radiance_along_directions(level, points, tmp_path):
    """A bake without probes answers from its volume: straight up what a surface that faces up gets, over pi."""
    folder, count = tmp_path / "out", len(np.load(points.words[1]))
    succeed("bake", level, "-o", folder, *QUICK)
    up, rough, found = (tmp_path / name for name in ("up.npy", "rough.npy", "found.npy"))
    np.save(up, np.tile([0.0, 0, 2], (count, 1)))
    np.save(rough, np.full(count, 0.3))
    words = ("--points", points.words[1], "--directions", up)
    succeed("query", folder, *words, "--roughness", rough, "-o", found)
    expected = world.load(folder).irradiance(np.load(points.words[1]), np.load(up)) / np.pi
    np.testing.assert_allclose(np.load(found), expected, rtol=1e-5)
    more = (*words, "--roughness", rough, "-o", found)
    np.save(rough, np.full(count, 1.5))
    assert "row 0 is not between 0 and 1" in call("query", folder, *more).reason
    np.save(rough, np.full((count, 1), 0.5))
    assert "of shape (n,)" in call("query", folder, *more).reason
