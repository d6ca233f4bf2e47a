"""The operators in Blender, with a stand-in for the bake that obeys the worker's protocol.

Each test runs `bpy` in a process of its own, with the repository's files as a real extension.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="this Python has no bpy")

STAND_IN_CLI = """
import json, os, sys, time
from pathlib import Path

def say(**message):
    print(json.dumps(message), flush=True)

def main(argv, extract):
    how = os.environ.get("STAND_IN", "finish")
    import argparse
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path)
    folder = parser.parse_known_args(argv)[0].output
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "argv.json").write_text(json.dumps([argv, "bpy" in sys.modules, Path(argv[1]).stat().st_size]))
    print("a line that is not ours")
    say(stage="Tracing", done=1, total=4, seconds_left=75.0)
    if how == "fail":
        say(error="nothing to bake: the scene has no lights")
        return 1
    if how == "crash":
        print("some library: out of memory", file=sys.stderr)
        os.abort()
    if how == "hang":
        (folder / "started").touch()
        try:
            time.sleep(120)
        except KeyboardInterrupt:
            (folder / "kept").touch()
            return 130
    say(result={"data_points": 12345, "bytes": {"tree": 1000000, "local": 500000}, "seconds": {"trace": 61.0},
                "warnings": ["a lamp has no power"], "left_out": [{"what": "sun", "why": "the scene has none"}]})
    return 0
"""
STAND_IN_SNAPSHOT_FILE = "def save(snapshot, path):\n    open(path, 'wb').write(snapshot)\n"
STAND_IN_EXTRACT = """
def extract(context):
    if not context.scene.objects:
        raise ValueError("the scene has no\\n   geometry")
    return b"snapshot of %d objects" % len(context.scene.objects)

def from_file(path):
    import bpy
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return b"snapshot of a file"
"""
PREAMBLE = """
import sys, bpy, addon_utils
from pathlib import Path
repository, output = Path(sys.argv[1]), Path(sys.argv[2])
bpy.context.preferences.extensions.repos.new(
    name="dev", module="dev", custom_directory=str(repository), remote_url="")
NAME = "bl_ext.dev.gi_volumes"
assert addon_utils.enable(NAME, default_set=True)
scene = bpy.context.scene
scene.gi_volumes.output_folder = str(output)

def failure(operator):
    try:
        operator()
    except RuntimeError as error:
        return str(error).strip()
    raise AssertionError("it did not fail")
"""


@pytest.fixture
def extension(repository, tmp_path):
    """A copy of the extension with stand-ins; returns the folder of the extension repository."""
    home = tmp_path / "repository" / "gi_volumes"
    home.mkdir(parents=True)
    for name in ("__init__.py", "__main__.py", "blender_manifest.toml"):
        shutil.copy(repository / name, home)
    for folder in ("bake", "operators", "tree"):
        shutil.copytree(repository / folder, home / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (home / "bake" / "cli.py").write_text(STAND_IN_CLI)
    (home / "bake" / "snapshot_file.py").write_text(STAND_IN_SNAPSHOT_FILE)
    (home / "operators" / "extract.py").write_text(STAND_IN_EXTRACT)
    return home.parent


@pytest.fixture
def blender(extension, run_python, tmp_path, monkeypatch):
    """Run a program in Blender with the extension enabled; returns what it printed."""

    def run(program: str, stand_in: str = "finish") -> str:
        monkeypatch.setenv("STAND_IN", stand_in)
        done = run_python(PREAMBLE + program, str(extension), str(tmp_path / "out"))
        assert done.returncode == 0, done.stderr + done.stdout
        return done.stdout

    return run


def test_a_bake_in_the_background_blocks_until_it_is_done_and_remembers_how_it_ended(blender, tmp_path):
    said = blender("""
scene.gi_volumes.quality = "draft"
scene.gi_volumes.threads = 3
assert bpy.ops.gi_volumes.bake() == {"FINISHED"}
from bl_ext.dev.gi_volumes.operators import job
assert job.current is None
print("LAST", job.last.kind, "|", job.last.message, "|", job.last.warnings, job.last.left_out)
import json
argv, has_bpy, size = json.loads((output / "argv.json").read_text())
print("ARGV", argv[2:], has_bpy, size, Path(argv[1]).parent.exists())
""")
    assert "LAST done | Baked 12,345 data points, 1.5 MB in 1 min 1 s |" in said
    assert "| ('a lamp has no power',) ('sun: the scene has none',)" in said
    options = [
        "-o",
        str(tmp_path / "out"),
        "--early",
        "--incremental",
        "--quality",
        "draft",
        "--sun",
        "scene",
        "--sky",
        "scene",
    ]
    assert f"ARGV {[*options, '--seed', '0', '--threads', '3', '--progress', 'json']} False 21 False" in said


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("fail", "Error: nothing to bake: the scene has no lights"),
        ("crash", "Error: the worker stopped with code -6: some library: out of memory"),
    ],
)
def test_a_worker_that_fails_gives_one_line(blender, how, reason):
    said = blender("print(repr(failure(bpy.ops.gi_volumes.bake)))", how)
    assert repr(reason) in said


def test_a_scene_that_cannot_be_read_gives_one_line(blender):
    said = blender("""
for thing in list(bpy.data.objects):
    bpy.data.objects.remove(thing)
print(repr(failure(bpy.ops.gi_volumes.bake)), output.exists())
""")
    assert "'Error: the scene has no geometry' False" in said


@pytest.mark.parametrize(
    ("folder", "remedy"),
    [
        ("//gi_bake/", "save the .blend first"),
        ("", "set one in Render Properties"),
        ("somewhere", "neither absolute nor relative to the .blend file"),
    ],
)
def test_an_output_folder_that_cannot_be_used_is_named_with_the_remedy(blender, folder, remedy):
    said = blender(f"""
scene.gi_volumes.output_folder = {folder!r}
print(failure(bpy.ops.gi_volumes.bake))
print(failure(bpy.ops.gi_volumes.clear))
""")
    assert said.count(remedy) >= 2


def test_a_defect_of_ours_does_not_leave_a_bake_running_for_ever(blender):
    blender("""
from bl_ext.dev.gi_volumes.operators import extract, job
def broken(context):
    raise ZeroDivisionError("a defect")
extract.extract = broken
assert "a defect" in failure(bpy.ops.gi_volumes.bake)
assert job.current is None and bpy.ops.gi_volumes.bake.poll()
""")


def test_missing_libraries_are_named_and_do_not_keep_the_extension_from_starting(blender):
    said = blender("""
from bl_ext.dev.gi_volumes.operators import dependencies
dependencies.NEEDED = (*dependencies.NEEDED, "no_such_library")
print(failure(bpy.ops.gi_volumes.bake))
""")
    assert (
        f'Missing: no_such_library. Install into Blender\'s Python: "{sys.executable}" -m pip install no_such_l' in said
    )


def test_a_bake_leaves_selection_mode_and_materials_alone(blender):
    blender("""
def state():
    objects = [(o.name, o.select_get(), o.mode, len(o.material_slots)) for o in scene.objects]
    return objects, bpy.context.view_layer.objects.active.name, list(bpy.data.materials), bpy.data.is_dirty
bpy.ops.object.mode_set(mode="EDIT")
before = state()
bpy.ops.gi_volumes.bake()
assert state() == before
""")


def test_disabling_the_extension_stops_a_bake_that_runs_and_leaves_nothing(blender):
    said = blender(
        """
import time
from bl_ext.dev.gi_volumes.operators import job
steps = job.begin(scene).steps()
while job.current.progress.stage != "Tracing" or not (output / "started").exists():
    next(steps)
    time.sleep(0.05)
print(job.current.progress.text)
addon_utils.disable(NAME, default_set=True)
print("KEPT", (output / "kept").exists(), [n for n in dir(bpy.types) if "GIVOLUMES" in n or "GI_VOLUMES" in n])
""",
        "hang",
    )
    assert "Tracing 25%, 1 min 15 s left" in said
    assert "KEPT True []" in said


def test_cancel_keeps_what_is_finished(blender):
    said = blender(
        """
import time
from bl_ext.dev.gi_volumes.operators import job
assert not bpy.ops.gi_volumes.cancel.poll()
steps = job.begin(scene).steps()
while not (output / "started").exists():
    next(steps)
    time.sleep(0.05)
assert not bpy.ops.gi_volumes.bake.poll() and not bpy.ops.gi_volumes.clear.poll()
assert bpy.ops.gi_volumes.cancel() == {"FINISHED"}
for progress in steps:
    assert progress.stage == "Stopping"
    time.sleep(0.05)
outcome = job.end()
print("ENDED", outcome.kind, outcome.message, (output / "kept").exists())
assert bpy.ops.gi_volumes.bake.poll()
""",
        "hang",
    )
    assert "ENDED stopped Bake cancelled; finished cells are kept True" in said


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
def test_ctrl_c_during_a_bake_in_the_background_keeps_what_is_finished(extension, tmp_path):
    program = PREAMBLE + 'print("FAILED", bpy.ops.gi_volumes.bake())'
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user"), "STAND_IN": "hang"}
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(extension), str(tmp_path / "out")],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    while not (tmp_path / "out" / "started").exists():
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert (tmp_path / "out" / "kept").exists(), said
    assert "FAILED {'CANCELLED'}" in said


def test_the_command_reads_the_loaded_file_and_takes_its_settings(blender, tmp_path):
    said = blender("""
import json
from bl_ext.dev.gi_volumes.operators import command
scene.gi_volumes.quality = "final"
print("CODE", command.main(["bake", "--seed", "7"]))
print("ARGV", json.loads((output / "argv.json").read_text())[0][2:])
""")
    assert said.count("CODE 0") == 1
    settings = ["--quality", "final", "--sun", "scene", "--sky", "scene", "--seed", "0", "-o", str(tmp_path / "out")]
    assert f"ARGV {[*settings, '--seed', '7']}" in said


@pytest.mark.parametrize("words", [["-o", "{}"], ["-o{}"], ["--output={}"], ["--output", "{}"]])
def test_the_words_of_the_command_line_win_over_the_settings(blender, tmp_path, words):
    words = [*(word.format(tmp_path / "other") for word in words), "--quality=draft"]
    said = blender(f"""
import json
from bl_ext.dev.gi_volumes.operators import command
print("CODE", command.main(["bake", *{words}]), output.exists())
scene.gi_volumes.output_folder = "//cannot be used in an unsaved file"
print("CODE", command.main(["bake", *{words}]))
print("LAST", json.loads((output.parent / "other" / "argv.json").read_text())[0][-{len(words)}:])
""")
    assert "CODE 0 False" in said
    assert said.count("CODE 0") == 2
    assert f"LAST {words}" in said


def test_every_size_of_the_finest_voxels_that_is_offered_can_be_baked(blender):
    said = blender("""
from bl_ext.dev.gi_volumes.operators import properties
sizes = [item.identifier for item in scene.gi_volumes.bl_rna.properties["finest"].enum_items]
for size in sizes:
    scene.gi_volumes.finest = size
    print("FINEST", size, properties.arguments(scene).get("--finest"))
""")
    found = [line.split()[1:] for line in said.splitlines() if line.startswith("FINEST")]
    assert found[0] == ["automatic", "None"]
    assert [(name, float(value)) for name, value in found[1:]] == [
        ("4", 4), ("2", 2), ("1", 1), ("0.5", 0.5), ("0.25", 0.25), ("0.125", 0.125)
    ]  # fmt: skip


def test_the_panel_forgets_how_a_bake_of_another_file_ended(blender):
    blender("""
from bl_ext.dev.gi_volumes.operators import job
bpy.ops.wm.save_as_mainfile(filepath=str(output.parent / "a.blend"))
bpy.ops.gi_volumes.bake()
assert job.last.kind == "done"
bpy.ops.ed.undo_push()
bpy.ops.wm.save_mainfile()
assert job.last is not None
for _ in range(2):  # a handler that is not persistent is gone after the first
    bpy.ops.wm.open_mainfile(filepath=str(output.parent / "a.blend"))
    assert job.last is None
    job.last = job.Outcome("done", "")
""")


@pytest.mark.parametrize(("how", "code"), [("fail", 1), ("finish", 0)])
def test_the_command_passes_the_exit_code_on(blender, how, code):
    said = blender("from bl_ext.dev.gi_volumes.operators import command\nprint('CODE', command.main(['bake']))", how)
    assert f"CODE {code}" in said


def test_the_command_gives_one_line_for_what_it_cannot_read(blender):
    said = blender("""
import contextlib, io
from bl_ext.dev.gi_volumes.operators import command
told = io.StringIO()
with contextlib.redirect_stderr(told):
    codes = [command.main(["bake", "missing.blend"])]
    scene.gi_volumes.output_folder = "//x"
    codes.append(command.main(["bake"]))
print(codes, told.getvalue().splitlines())
""")
    assert "[1, 1] ['error: missing.blend: no such file', 'error: Unsaved file: save the .blend first" in said
