"""Scenes, folders and files that cannot be used: one line, exit code 1, and nothing half-written."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import build_scenes
import numpy as np
import pytest
from command_line import QUICK, Points, call, content, ground_points, stored, stored_unchecked, succeed, yard
from gi_volumes.bake.snapshot import Material, Snapshot, SnapshotError


@pytest.fixture(scope="module")
def level(tmp_path_factory) -> Path:
    return stored(tmp_path_factory.mktemp("level"), yard())


@pytest.fixture(scope="module")
def home(level) -> Path:
    """A folder that holds a bake."""
    succeed("bake", level, "-o", level.parent / "home", *QUICK)
    return level.parent / "home"


def with_geometry(**arrays: np.ndarray) -> Snapshot:
    made = yard()
    return dataclasses.replace(made, geometry=dataclasses.replace(made.geometry, **arrays))


def positions() -> np.ndarray:
    return yard().geometry.positions.copy()


def spoiled() -> np.ndarray:
    made = positions()
    made[5, 1] = np.nan
    return made


NOTHING: dict[str, np.ndarray | tuple] = {
    "instance_mesh": np.zeros(0, np.int32),
    "instance_transform": np.zeros((0, 3, 4)),
    "instance_names": (),
}
SCENES: dict[str, tuple[Callable[[], Snapshot], str]] = {
    "nothing at all": (lambda: build_scenes.snapshot([]), "has no triangles to bake; add a mesh"),
    "only lights": (
        lambda: build_scenes.snapshot([], build_scenes.lamps({"strength": (9, 9, 9)}), sky=(1, 1, 1)),
        "has no triangles to bake; add a mesh",
    ),
    "no instance": (lambda: with_geometry(**NOTHING), "has no triangles to bake; add a mesh"),
    "a vertex of NaN": (lambda: with_geometry(positions=spoiled()), "geometry.positions: holds NaN or infinity"),
    "one point": (lambda: with_geometry(positions=positions() * 0), "every triangle of the scene has zero area"),
    "lines": (
        lambda: with_geometry(positions=positions() * np.float32([1, 0, 0])),
        "every triangle of the scene has zero area",
    ),
    "a scale of zero": (
        lambda: with_geometry(instance_transform=np.zeros((1, 3, 4))),
        "every triangle of the scene has zero area",
    ),
    "an instance nowhere": (
        lambda: with_geometry(instance_transform=np.full((1, 3, 4), np.nan)),
        "geometry.instance_transform: holds NaN or infinity",
    ),
    "no such material": (
        lambda: with_geometry(materials=yard().geometry.materials + 9),
        "geometry.materials: an index is outside",
    ),
    "no such vertex": (
        lambda: with_geometry(triangles=yard().geometry.triangles + 9),
        "geometry.triangles: an index is outside",
    ),
    "a sky of NaN": (lambda: yard(sky=(np.nan, 0, 0)), "sky: "),
    "a dark sun": (
        lambda: dataclasses.replace(yard(), lights=build_scenes.lamps({"strength": (-1, 0, 0)})),
        "lights: strength is negative",
    ),
}


@pytest.mark.parametrize("what", SCENES)
def test_a_scene_that_cannot_be_baked_is_refused_in_one_line(what, home, tmp_path):
    make, reason = SCENES[what]
    before = content(home)
    scene = stored_unchecked(tmp_path, make())
    assert reason in call("bake", scene, "-o", tmp_path / "out", *QUICK).reason
    assert reason in call("bake", scene, "-o", home, *QUICK).reason
    assert [path.name for path in tmp_path.iterdir()] == [scene.name]
    assert content(home) == before


def make_files(folder: Path, level: Path) -> None:
    """Things that are no scenes."""
    (folder / "folder.giv").mkdir()
    (folder / "folder").mkdir()
    (folder / "empty.giv").touch()
    (folder / "text.giv").write_text("a scene")
    (folder / "image.png").touch()
    data = level.read_bytes()
    (folder / "short.giv").write_bytes(data[:-1])
    (folder / "flipped.giv").write_bytes(data[:300] + bytes([data[300] ^ 4]) + data[301:])


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing.giv", "there is no such file"),
        ("missing", "there is no such file"),
        ("image.png", "unknown kind of scene; use .blend, .glb, .gltf or a snapshot"),
        ("folder", "unknown kind of scene; use .blend, .glb, .gltf or a snapshot"),
        ("folder.giv", "Is a directory"),
        ("empty.giv", "byte 0: this is not a GI Volumes file"),
        ("text.giv", "byte 0: this is not a GI Volumes file"),
        ("short.giv", "incomplete or damaged"),
        ("flipped.giv", "the file is damaged"),
    ],
)
@pytest.mark.parametrize("command", ["bake", "reference"])
def test_what_is_no_scene_is_named_with_the_reason(name, reason, command, level, home, tmp_path):
    make_files(tmp_path, level)
    asked = Points(tmp_path, *ground_points(1))
    before, elsewhere = content(home), content(tmp_path)
    words = ("-o", home, *QUICK) if command == "bake" else asked.words
    said = call(command, tmp_path / name, *words)
    assert said.reason.startswith(f"{tmp_path / name}: ")
    assert reason in said.reason
    assert (content(home), content(tmp_path)) == (before, elsewhere)


def test_a_scene_that_blender_cannot_read_gives_its_reason_and_leaves_the_bake_alone(home, tmp_path):
    def extract(scene: Path, snapshot: Path) -> None:
        snapshot.write_text("half")
        raise SnapshotError(f"{scene}: the file is of a newer Blender")

    (tmp_path / "scene.glb").touch()
    before = content(home)
    said = call("bake", tmp_path / "scene.glb", "-o", home, extract=extract)
    assert said.reason == f"{tmp_path / 'scene.glb'}: the file is of a newer Blender"
    assert content(home) == before


def test_an_output_that_is_no_folder_is_refused(level, tmp_path):
    (tmp_path / "file").write_text("x")
    assert call("bake", level, "-o", tmp_path / "file").reason.endswith("this is a file; a bake needs a folder")
    assert (
        "file is a file; choose another folder" in call("bake", level, "-o", tmp_path / "file" / "below", *QUICK).reason
    )
    assert content(tmp_path) == {"file": b"x"}


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="this system has no /proc, which nobody can write to")
@pytest.mark.parametrize("folder", ["/proc", "/proc/bake"])
def test_a_folder_that_even_the_administrator_cannot_write_to_is_refused(level, folder):
    assert call("bake", level, "-o", folder, *QUICK).reason.startswith(f"{folder}: ")


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 64 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("there is no command to mount a small disk")
    if done.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_is_named_and_the_bake_before_stays_whole(level, small_disk):
    reason = "cannot write: No space left on device"
    large = ("--samples", "4", "--error", "0.02", "--sky", "harmonics")
    assert call("bake", level, "-o", small_disk / "new", *large).reason.endswith(reason)
    assert set(content(small_disk)) <= {"new/scene.giv", "new/world.json"}
    succeed("bake", level, "-o", small_disk / "old", "--samples", "4", "--finest", "8")
    before = content(small_disk / "old")
    assert call("bake", level, "-o", small_disk / "old", *large).reason.endswith(reason)
    assert content(small_disk / "old") == before
    assert succeed("verify", small_disk / "old") == {"defects": []}
    asked = Points(small_disk, *ground_points(9))
    (small_disk / "filler").write_bytes(bytes(os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_bsize))
    assert call("query", small_disk / "old", *asked.words).reason == f"{small_disk / 'found.npy'}: {reason}"


KINDS = ("world.json", "scene.giv", *(f"cell_0_0.{kind}" for kind in ("tree", "points", "local", "sun", "sky")))


def damages(data: bytes, seed: str) -> list[bytes]:
    """A file cut at some lengths, and with some bytes changed."""
    rng = random.Random(seed)
    whole = len(data.rstrip())
    cuts = {0, 1, 27, 28, whole - 1, *(rng.randrange(whole) for _ in range(5))}
    made = [data[:length] for length in sorted(cuts)]
    places = (0, 8, whole - 1, *(rng.randrange(whole) for _ in range(7)))
    made += [data[:at] + bytes([data[at] ^ rng.choice((1, 128, 255))]) + data[at + 1 :] for at in places]
    return [*made, data + b"more"]


@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_file_of_a_bake_is_refused_by_its_name(name, level, tmp_path):
    home = tmp_path / "home"
    succeed("bake", level, "-o", home, *QUICK)
    asked = Points(tmp_path, *ground_points(1))
    whole = (home / name).read_bytes()
    for number, damaged in enumerate(damages(whole, name)):
        (home / name).write_bytes(damaged)
        said = call("verify", home, "--json")
        assert said.code == 1, number
        assert {defect["file"] for defect in said.object["defects"]} == {name}
        for words in [("query", home, *asked.words), ("info", home)] if name != "scene.giv" else []:
            assert call(*words).reason.startswith(f"{home / name}: "), number
        if name == "scene.giv":
            assert call("bake", home / name, "-o", tmp_path / "out").reason.startswith(f"{home / name}: byte ")
            assert call("compare", home, "-o", tmp_path / "seen.png").reason.startswith(f"{home / name}: byte ")
    assert {path.name for path in tmp_path.iterdir()} == {"home", "points.npy", "normals.npy"}
    (home / name).write_bytes(whole)
    assert succeed("verify", home) == {"defects": []}


@pytest.mark.parametrize("name", KINDS)
def test_a_missing_file_of_a_bake_is_named_and_baked_again(name, level, home, tmp_path):
    succeed("bake", level, "-o", tmp_path / "home", *QUICK)
    (tmp_path / "home" / name).unlink()
    defects = call("verify", tmp_path / "home", "--json").object["defects"]
    assert {(defect["file"], defect["what"]) for defect in defects} == {(name, "the file is missing")}
    if name != "scene.giv":
        said = call("query", tmp_path / "home", *Points(tmp_path, *ground_points(1)).words)
        assert said.reason == f"{tmp_path / 'home' / name}: No such file or directory"
    succeed("bake", level, "-o", tmp_path / "home", *QUICK)
    assert content(tmp_path / "home") == content(home)


@pytest.mark.parametrize("command", ["info", "verify", "query", "compare"])
def test_a_folder_without_a_bake_is_named(command, tmp_path):
    asked = Points(tmp_path, *ground_points(1))
    (tmp_path / "empty").mkdir()
    words = {"query": asked.words, "compare": ("-o", tmp_path / "seen.png")}.get(command, ())
    assert str(tmp_path / "missing") in call(command, tmp_path / "missing", *words).reason
    said = call(command, tmp_path / "empty", *words)
    assert said.code == 1
    assert "world.json" in said.err + said.out
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "points.npy", "normals.npy"}


PEAK = """
import resource, runpy, sys
sys.argv = ["gi_volumes", *sys.argv[1:]]
try:
    runpy.run_module("gi_volumes", run_name="__main__")
finally:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)
"""


@pytest.mark.slow
def test_a_scene_of_two_hundred_thousand_triangles_needs_less_than_one_and_a_half_gigabytes(tmp_path):
    pytest.importorskip("resource", reason="this system does not say how much memory a process took")
    side = 317
    x, y = np.meshgrid(np.linspace(0, 120, side), np.linspace(0, 120, side), indexing="ij")
    rng = np.random.default_rng(3)
    heights = 6 * np.sin(x / 9) * np.cos(y / 7) + rng.uniform(0, 0.3, x.shape)
    grid = np.stack([x, y, heights], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    assert len(triangles) > 199_000
    sun = {"kind": 4, "frame": build_scenes.sun_frame((1, 2, 3)), "strength": (3, 3, 3)}
    hills = build_scenes.snapshot([(triangles, Material("hills"))], build_scenes.lamps(sun), sky=(1, 1, 1))
    words = ["bake", str(stored(tmp_path, hills)), "-o", str(tmp_path / "out"), "--samples", "8", "--json"]
    done = subprocess.run([sys.executable, "-c", PEAK, *words], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["data_points"] > 30_000
    kilobytes = int(done.stderr.splitlines()[-1]) / (1024 if sys.platform == "darwin" else 1)
    assert kilobytes < 1.5e6
