"""Reflection probes as an artist works with them: real bakes of a small room, in a Blender with the extension."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="this Python has no bpy")

PREAMBLE = """
import sys, bpy, addon_utils
from pathlib import Path
repository, output = Path(sys.argv[1]), Path(sys.argv[2])
bpy.context.preferences.extensions.repos.new(
    name="dev", module="dev", custom_directory=str(repository), remote_url="")
NAME = "bl_ext.dev.gi_volumes"
assert addon_utils.enable(NAME, default_set=True)
from bl_ext.dev.gi_volumes.operators import job, probe_panels, properties
scene, ops = bpy.context.scene, bpy.ops.gi_volumes
cube = bpy.data.objects["Cube"]
cube.scale, cube.location = (4, 4, 4), (64, 64, 0)  # in one world cell
bpy.data.objects["Light"].location = (65, 65, 2)
cube.data.flip_normals()
scene.gi_volumes.output_folder, scene.gi_volumes.quality, scene.gi_volumes.finest = str(output), "draft", "4"
scene.gi_volumes.probes, scene.gi_volumes.probe_count = "count", 3

def probes():
    return [object for object in scene.objects if object.gi_volumes.role == "PROBE"]

def places():
    return sorted(tuple(object.location) for object in probes())

def files():
    return {path.name: path.read_bytes() for path in output.iterdir() if path.is_file()}

def failure(operator):
    try:
        operator()
    except RuntimeError as error:
        return str(error).strip()
    raise AssertionError("it did not fail")
"""


def run(program: str, repository: Path, place: Path) -> str:
    """Run a program in a Blender with the extension enabled and a room in the scene; returns what it printed."""
    home = place / "linked"
    home.mkdir()
    (home / "gi_volumes").symlink_to(repository, target_is_directory=True)
    words = [sys.executable, "-c", PREAMBLE + program, str(home), str(place / "out")]
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(place / "user")}
    quiet = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True, "timeout": 300}
    done = subprocess.run(words, env=environment, cwd=place, **quiet)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def room(repository, tmp_path_factory):
    """A folder where the room has been baked."""
    place = tmp_path_factory.mktemp("room")
    run('print("BAKED", ops.bake(), len(probes()))', repository, place)
    return place / "out"


@pytest.fixture
def blender(repository, tmp_path):
    """Run a program; nothing is baked."""
    return lambda program: run(program, repository, tmp_path)


@pytest.fixture
def baked(room, blender, tmp_path):
    """Run a program; the room is baked."""
    shutil.copytree(room, tmp_path / "out")
    return blender


def test_an_artist_moves_adds_and_deletes_probes_and_only_those_are_made_again(blender, repository, tmp_path):
    said = blender("""
print("NONE YET", failure(ops.place_probes))
ops.bake()
assert not probes()  # nobody has asked to see them
ops.place_probes()
assert len(probes()) == 3
print("STATUS", probe_panels.status(scene, probes()))
first, before = files(), places()
moved, _, gone = probes()
away = tuple(gone.location)
moved.location = (66.5, 65.5, -1)
bpy.data.objects.remove(gone)
scene.cursor.location = (62, 66, 1)
ops.add_probe()
assert bpy.context.object.gi_volumes.pinned and tuple(bpy.context.object.location) == (62, 66, 1)
print("STATUS", probe_panels.status(scene, probes()))
ops.bake()
second = files()
print("CHANGED", sorted(name for name in first if second[name] != first[name] and not name.endswith(".probes")))
import json
listed = json.loads(second["world.json"])["probes"]
assert [tuple(place) for place in listed["positions"][:2]] == [(62, 66, 1), (66.5, 65.5, -1)]
assert listed["pinned"] == [True, True, False]
assert places() == sorted(tuple(place) for place in listed["positions"])
assert away not in places() and scene.gi_volumes.deleted_probes[0].place[:] == away
ops.bake()
assert files() == second and len(probes()) == 3
bpy.ops.wm.save_as_mainfile(filepath=str(output.parent / "level.blend"))
""")
    assert f"NONE YET Error: No bake in {tmp_path / 'out'} yet: press Bake GI first" in said
    assert "STATUS ['The bake has 3: 1.5 MB, file " in said
    assert "kB', 'Next bake: 0 pinned, 0 deleted']" in said
    assert "kB', 'Next bake: 2 pinned, 1 deleted']" in said
    assert "CHANGED ['probes.exr', 'scene.giv', 'world.json']" in said
    words = ["bake", str(tmp_path / "level.blend"), "-o", str(tmp_path / "alone"), "--quality", "draft"]
    command = [sys.executable, str(repository / "__main__.py"), *words, "--finest", "4", "--probes", "3"]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL, cwd=tmp_path, timeout=300)
    folders = [json.loads((tmp_path / name / "world.json").read_text())["probes"] for name in ("out", "alone")]
    assert folders[0]["positions"] == folders[1]["positions"]
    assert folders[0]["pinned"] == folders[1]["pinned"] == [True, True, False]


def test_showing_probes_is_undone_and_done_again(baked):
    baked("""
bpy.ops.ed.undo_push(message="before")
ops.place_probes()
bpy.ops.ed.undo_push(message="shown")
assert len(probes()) == 3
bpy.ops.ed.undo()
scene = bpy.context.scene
assert not probes() and len(scene.gi_volumes.placed_probes) == 0
bpy.ops.ed.redo()
scene = bpy.context.scene
assert len(probes()) == 3
bpy.data.objects.remove(probes()[0])
bpy.ops.ed.undo_push(message="deleted")
assert "1 deleted" in probe_panels.status(scene, probes())[-1]
bpy.ops.ed.undo()
scene = bpy.context.scene
assert "0 deleted" in probe_panels.status(scene, probes())[-1]
""")


def test_a_bake_without_probes_takes_its_own_away_and_leaves_the_artists(baked):
    said = baked("""
ops.place_probes()
probes()[0].gi_volumes.pinned = True
scene.gi_volumes.probes = "none"
ops.bake()
assert [object.gi_volumes.pinned for object in probes()] == [True]
print(probe_panels.status(scene, probes()))
print(ops.place_probes(), places() != [])
""")
    assert "['The bake has none', 'Next bake: 1 pinned, 0 deleted']" in said
    assert "{'FINISHED'} True" in said


def test_selected_probes_are_pinned_released_and_deleted_ones_allowed_again(baked):
    baked("""
assert not ops.pin_probes.poll() and ops.forget_deleted_probes() == {"CANCELLED"}
ops.place_probes()
first, _, last = probes()
first.location.x += 1
home = tuple(first.gi_volumes.placed)
last.select_set(True)
first.select_set(True)
ops.pin_probes()
assert [object.gi_volumes.pinned for object in probes()] == [True, False, True]
ops.pin_probes(pin=False)
assert [object.gi_volumes.pinned for object in probes()] == [False, False, False]
assert tuple(first.location) == home
bpy.data.objects.remove(last)
assert ops.forget_deleted_probes() == {"FINISHED"}
assert ops.forget_deleted_probes() == {"CANCELLED"}
ops.place_probes()
assert len(probes()) == 3
""")


def test_probes_are_shown_in_object_mode_only_and_a_bake_in_another_mode_leaves_them(baked):
    said = baked("""
ops.place_probes()
before = places()
bpy.context.view_layer.objects.active = cube
bpy.ops.object.mode_set(mode="EDIT")
print(failure(ops.place_probes))
scene.gi_volumes.probe_count = 1
ops.bake()
assert places() == before
bpy.ops.object.mode_set(mode="OBJECT")
ops.place_probes()
assert len(probes()) == 1
""")
    assert "Probes are shown and added in Object Mode" in said


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, {}),
        ({"probes": "none"}, {"--probes": "none"}),
        ({"probes": "count", "probe_count": 7}, {"--probes": "7"}),
        ({"probe_megabytes": 2.5}, {"--probe-megabytes": "2.5"}),
        (
            {"probes": "count", "probe_count": 0, "probe_megabytes": 1024.0},
            {"--probes": "0", "--probe-megabytes": "1024"},
        ),
    ],
)
def test_settings_become_words_of_the_command(blender, settings, words):
    said = blender(f"""
scene.gi_volumes.probes = "auto"
for name, value in {settings}.items():
    setattr(scene.gi_volumes, name, value)
print("WORDS", {{k: v for k, v in properties.arguments(scene).items() if "probe" in k}})
""")
    assert f"WORDS {words}" in said
