"""Following a worker: whole lines only, nothing blocks, an early end is an order that is carried out."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gi_volumes.operators import dependencies, worker

STUBBORN = """
import signal, sys, time
for name in ("SIGTERM", "SIGBREAK"):
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
print('{"stage": "Baking", "done": 1, "total": 2}', flush=True)
time.sleep(60)
"""


@pytest.fixture
def follow(tmp_path, monkeypatch):
    """A worker that runs a given program instead of a command of ours."""
    started = []

    def start(arguments, **streams):
        group = {} if os.name == "nt" else {"process_group": 0}
        started.append(subprocess.Popen([sys.executable, "-c", arguments[0]], **group, **streams))
        return started[-1]

    monkeypatch.setattr(worker, "start", start)
    yield lambda program: worker.Worker([program], tmp_path)
    for process in started:
        process.kill()
        process.wait()


def finish(running: worker.Worker, seconds: float = 20.0) -> worker.Worker:
    """Poll until the worker has ended."""
    end = time.monotonic() + seconds
    while running.poll():
        assert time.monotonic() < end, "the worker does not end"
        time.sleep(0.02)
    return running


def test_a_line_is_understood_when_it_is_whole_and_not_before(follow, tmp_path):
    program = f"""
import sys, time
from pathlib import Path
print('{{"stage": "Baking", "done": 1, "to', end="", flush=True)
Path({str(tmp_path / "half")!r}).touch()
while not Path({str(tmp_path / "go")!r}).exists():
    time.sleep(0.01)
print('tal": 4, "seconds_left": 90}}', flush=True)
print('{{"result": {{"cells": 1}}}}', flush=True)
"""
    running = follow(program)
    while not (tmp_path / "half").exists():
        time.sleep(0.01)
    assert running.poll()
    assert running.progress == worker.Progress("Starting")
    (tmp_path / "go").touch()
    finish(running)
    assert running.progress == worker.Progress("Baking", 0.25, 90.0)
    assert running.progress.text == "Baking 25%, 1 min 30 s left"
    assert (running.result, running.error) == ({"cells": 1}, "")


def test_what_is_not_a_message_is_passed_over(follow):
    running = finish(follow("print('chatter'); print('[1]'); print('null'); print('{\"result\": {}}')"))
    assert (running.result, running.error) == ({}, "")


def test_a_megabyte_of_chatter_does_not_stall_the_worker(follow):
    running = follow("for _ in range(20000): print('x' * 64)\nprint('{\"result\": {}}')")
    time.sleep(0.5)
    assert finish(running).result == {}


@pytest.mark.parametrize(
    ("program", "error"),
    [
        ("import sys; sys.exit(1)", "it said nothing"),
        ("import sys; print('error: no such file', file=sys.stderr); sys.exit(1)", "no such file"),
        (
            "import os, sys; print('boom', file=sys.stderr, flush=True); os._exit(7)",
            "the worker stopped with code 7: boom",
        ),
        ('print(\'{"error": "disk full"}\'); import sys; sys.exit(1)', "disk full"),
        ("pass", "the worker stopped with code 0: it said nothing"),
    ],
)
def test_a_worker_that_ends_without_a_result_has_an_error(follow, program, error):
    running = finish(follow(program))
    assert (running.result, running.error) == (None, error)


def test_a_worker_that_ignores_the_order_to_stop_is_ended(follow, monkeypatch):
    monkeypatch.setattr(worker, "PATIENCE_S", 0.3)
    running = follow(STUBBORN)
    while running.progress.stage != "Baking":
        assert running.poll()
        time.sleep(0.02)
    running.stop()
    finish(running)
    assert running.stopped


def test_waiting_ends_a_stubborn_worker_too(follow):
    running = follow(STUBBORN)
    while running.progress.stage != "Baking":
        assert running.poll()
        time.sleep(0.02)
    running.wait(0.2)
    assert not running.poll()


def test_another_python_without_site_packages_finds_the_libraries_by_the_path_that_is_passed_on():
    names = ", ".join(dependencies.NEEDED)
    command = [sys.executable, "-S", "-s", "-P", "-c", f"import {names}"]
    bare = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    assert subprocess.run(command, env=bare, capture_output=True).returncode != 0
    found = {**bare, "PYTHONPATH": dependencies.search_path()}
    assert subprocess.run(command, env=found, capture_output=True).returncode == 0


def test_a_worker_is_our_command_line():
    with worker.start(["snapshot"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        said = process.stderr.read()
        code = process.wait(60)
    assert (code, said.startswith(b"usage: gi_volumes snapshot")) == (2, True)


LONG_CLI = """
import os, subprocess, sys, threading, time
from pathlib import Path

def main(argv, extract):
    how, folder = argv[0], Path(argv[1])
    if how == "family":
        child = subprocess.run([sys.executable, sys.argv[0], "read", argv[1]], stdin=subprocess.DEVNULL)
        (folder / "child").write_text(str(child.returncode))
    if how == "read":
        (folder / "read").write_text(repr(sys.stdin.read()))
        return 0
    (folder / "pid").write_text(str(os.getpid()))
    (folder / "started").touch()
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            threading.Event().wait(60) if how == "blocked" else time.sleep(0.01)
        except KeyboardInterrupt:
            (folder / "kept").touch()
            if how != "stubborn":
                raise
    (folder / "finished").touch()
    return 0
"""
HOLDER = """
import sys, time
from pathlib import Path
sys.path.insert(0, str(Path(sys.argv[1]).parent))
from {package}.operators import worker
running = worker.Worker([sys.argv[2], sys.argv[3]], Path(sys.argv[3]))
Path(sys.argv[3], "held").touch()
time.sleep(60)
"""


@pytest.fixture
def home(repository, tmp_path):
    """The package under another name, with a command that takes long."""
    place = tmp_path / "package"
    place.mkdir()
    for name in ("__init__.py", "__main__.py"):
        shutil.copy(repository / name, place)
    shutil.copytree(repository / "operators", place / "operators", ignore=shutil.ignore_patterns("__pycache__"))
    (place / "bake").mkdir()
    (place / "bake" / "cli.py").write_text(LONG_CLI)
    text = (place / "operators" / "worker.py").read_text()
    (place / "operators" / "worker.py").write_text(text.replace("PATIENCE_S = 15.0", "PATIENCE_S = 1.0"))
    return place


def until(condition, seconds: float = 20.0) -> None:
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.02)


def runs(folder: Path) -> bool:
    """Whether the worker that left its number in a folder is alive."""
    state = Path("/proc") / (folder / "pid").read_text() / "stat"
    return state.exists() and state.read_text().rpartition(") ")[2][0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for the worker in /proc")
@pytest.mark.parametrize("how", ["busy", "blocked", "stubborn", "family"])
def test_a_worker_ends_by_itself_when_its_parent_is_killed(home, tmp_path, how):
    program = HOLDER.format(package=home.name)
    parent = subprocess.Popen([sys.executable, "-c", program, str(home), how, str(tmp_path)])
    try:
        until((tmp_path / "started").exists)
        time.sleep(0.3)
        assert runs(tmp_path), "it must not end before its parent"
    finally:
        parent.kill()
        parent.wait()
    until(lambda: not runs(tmp_path))
    assert (tmp_path / "kept").exists()
    assert not (tmp_path / "finished").exists()


def test_a_command_that_a_worker_starts_is_not_taken_for_an_orphan(home, tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "ROOT", home)
    running = worker.Worker(["family", str(tmp_path)], tmp_path)
    until((tmp_path / "started").exists)
    assert ((tmp_path / "child").read_text(), (tmp_path / "read").read_text()) == ("0", "''")
    running.wait(10)
    assert running.stopped


def test_a_command_that_is_no_worker_does_not_mind_an_empty_standard_input(home, tmp_path):
    command = [sys.executable, str(home / "__main__.py"), "busy", str(tmp_path)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until((tmp_path / "started").exists)
        time.sleep(0.5)
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()
