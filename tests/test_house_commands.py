"""The entry points: exit codes, one-line errors, and running without an installation."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

STAND_IN_CLI = """
import sys, time
from pathlib import Path

def main(argv, extract):
    print("ROOT", sys.modules[__package__].__path__, __package__)
    if argv[0] == "wait":
        Path(argv[1]).touch()
        time.sleep(60)
    if argv[0] == "missing":
        import no_such_library
    if argv[0] == "bake":
        try:
            extract(argv[1], argv[2])
        except ValueError as error:
            print(type(error).__name__, "|", error)
            return 1
    return 0
"""
STAND_IN_READER = """
import os, sys

def main(argv):
    print("chatter of an importer")
    if argv[0] == "bad":
        print("chatter", file=sys.stderr)
        print("error: bad: the reason", file=sys.stderr)
        print("more chatter", file=sys.stderr)
        return 1
    if argv[0] == "crash":
        print("Segmentation fault", file=sys.stderr, flush=True)
        os.abort()
    if argv[0] == "interrupt":
        raise KeyboardInterrupt
    open(argv[2], "w").write(argv[0])
    return 0
"""


@pytest.fixture
def copy(repository, tmp_path):
    """The package under another name, with stand-ins for what does the work."""
    home = tmp_path / "another name"
    home.mkdir()
    for name in ("__init__.py", "__main__.py"):
        shutil.copy(repository / name, home)
    for folder in ("bake", "operators", "tree"):
        shutil.copytree(repository / folder, home / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (home / "bake" / "cli.py").write_text(STAND_IN_CLI)
    (home / "operators" / "snapshot_command.py").write_text(STAND_IN_READER)
    return home


def run(*command: str, **options) -> subprocess.CompletedProcess:
    """A command without a terminal, with its output."""
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120, **options)


def test_the_file_runs_under_any_folder_name_without_an_installation(copy, tmp_path):
    done = run(sys.executable, "-P", str(copy / "__main__.py"), "info", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"ROOT ['{copy / 'bake'}'] gi_volumes.bake" in done.stdout


def test_a_scene_is_read_in_a_process_of_its_own(copy, tmp_path):
    done = run(sys.executable, str(copy / "__main__.py"), "bake", "scene.glb", str(tmp_path / "out"))
    assert (done.returncode, done.stderr) == (0, "")
    assert "chatter" not in done.stdout
    assert (tmp_path / "out").read_text() == "scene.glb"


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        ("bad", "SnapshotError | bad: the reason"),
        ("crash", "SnapshotError | reading the scene stopped with code -6: Segmentation fault"),
    ],
)
def test_a_reader_that_fails_gives_one_line(copy, scene, reason):
    done = run(sys.executable, str(copy / "__main__.py"), "bake", scene, "unused")
    assert done.returncode == 1
    assert reason in done.stdout.splitlines()
    assert done.stderr == ""


def test_an_interrupted_reader_interrupts_the_command(copy):
    done = run(sys.executable, str(copy / "__main__.py"), "bake", "interrupt", "unused")
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_a_missing_library_is_named_in_one_line(copy):
    done = run(sys.executable, str(copy / "__main__.py"), "missing")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "no_such_library" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_told_to_stop_exits_with_130(copy, tmp_path, number):
    started = tmp_path / "started"
    process = subprocess.Popen(
        [sys.executable, str(copy / "__main__.py"), "wait", str(started)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    while not started.exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert (process.returncode, said) == (130, b"interrupted\n")


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        ([], 2, "usage:"),
        (["dance"], 2, "dance"),
        (["snapshot"], 2, "usage:"),
        (["snapshot", "missing.blend", "-o", "x.giv"], 1, "error: missing.blend: no such file"),
        (
            ["snapshot", "missing.txt", "-o", "x.giv"],
            1,
            "error: missing.txt: not a scene; expected .blend, .glb, .gltf",
        ),
        (["bake", "missing.glb", "-o", "out"], 1, "error: missing.glb"),
        (["info", "missing"], 1, "error: missing"),
        (["verify", "missing"], 1, "missing"),
    ],
)
def test_wrong_words_give_a_reason_and_a_code_and_no_traceback(tmp_path, words, code, reason):
    done = run(sys.executable, "-m", "gi_volumes", *words, cwd=tmp_path)
    assert done.returncode == code
    assert reason in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_python_without_bpy_says_what_to_do(repository, tmp_path):
    (tmp_path / "scene.blend").touch()
    program = (
        "import sys, runpy; sys.modules['bpy'] = None; sys.argv = ['x', 'snapshot', 'scene.blend', '-o', 'out.giv'];"
        f"runpy.run_path({str(repository / '__main__.py')!r}, run_name='__main__')"
    )
    done = run(sys.executable, "-c", program, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: scene.blend: reading a .blend file needs Blender's Python module")
    assert done.stderr.count("\n") == 1


@pytest.fixture
def recipe(repository):
    """What `make` would run for a target, were nothing there yet."""
    if shutil.which("make") is None:
        pytest.skip("there is no make")

    def ask(target: str, python_52: str) -> str:
        done = run("make", "--dry-run", "--always-make", target, f"PYTHON_52={python_52}", cwd=repository)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return ask


def test_the_demo_needs_no_second_blender(recipe):
    assert ".venv-5.2" in recipe("test", "python3.13")
    commands = recipe("bake", "python3.13")
    assert ".venv-5.2" not in commands
    assert "gi_volumes bake" in commands


def test_tests_without_a_second_blender_say_so(recipe):
    assert "SKIPPED: no Python 3.13" in recipe("test", "")
    assert "SKIPPED" not in recipe("test", "python3.13")
