"""The extension in a desktop Blender with a window, installed from the zip that is shipped.

The Blender is named by the environment variable GI_VOLUMES_BLENDER_GUI, a command to which Blender's arguments
are added ("blender", "xvfb-run -a blender"); without it, by the script beside the repository, where there is one.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.gui, pytest.mark.skipif(os.name == "nt", reason="needs a virtual display")]

HERE = Path(__file__).resolve().parent
SCRIPT = HERE.parent.parent.parent / "shared" / "blender-gui" / "blender-gui.sh"
VARIABLE = "GI_VOLUMES_BLENDER_GUI"
INSTALL_S = 900
RUN_S = 420


@pytest.fixture(scope="session")
def desktop(repository):
    """The command of a desktop Blender."""
    if os.environ.get(VARIABLE):
        return shlex.split(os.environ[VARIABLE])
    if not SCRIPT.is_file() or os.geteuid() != 0:
        pytest.skip(f"NO DESKTOP BLENDER, NOTHING WAS TESTED IN A WINDOW: set {VARIABLE} to a command that runs one")
    installed = subprocess.run([str(SCRIPT), "install"], cwd=repository, stdin=subprocess.DEVNULL, timeout=INSTALL_S)
    assert installed.returncode == 0
    return [str(SCRIPT), "run", "--"]


@pytest.fixture
def archive(repository, tmp_path):
    """The zip of the extension."""
    subprocess.run([sys.executable, str(repository / "tools" / "package.py"), str(tmp_path)], check=True)
    return next(tmp_path.glob("*.zip"))


@pytest.fixture
def blender(desktop, repository, tmp_path):
    """Run the desktop Blender with fresh user files; returns exit code and output."""

    def run(*arguments: str) -> tuple[int, str]:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
        done = subprocess.run(
            [*desktop, *arguments],
            cwd=repository,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=RUN_S,
        )
        return done.returncode, done.stdout

    return run


def test_an_artist_bakes_in_the_window_cancels_and_bakes_to_the_end(blender, archive, tmp_path):
    code, said = blender(
        "--enable-event-simulate", "--python", str(HERE / "drive.py"), "--", str(archive), str(tmp_path)
    )
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert seen.get("done"), f"{seen.get('error')}\n{said}\npictures: {tmp_path}"
    assert seen["steps"] == [
        ["finish", "done"],
        ["probes", "done"],
        ["escape", "stopped"],
        ["cancel", "stopped"],
        ["disable", "alive"],
        ["another file", "forgotten"],
    ]
    assert {"Reading the scene", "Baking", "Stopping"} <= set(seen["progress"])
    assert "data points" in seen["message"]
    assert seen["probes"] == [False, True]
    assert (tmp_path / "finished" / "world.json").is_file()
    assert "Traceback" not in said
    assert code == 0


def test_the_command_line_inside_blender_bakes_the_loaded_file(blender, archive, tmp_path):
    file, output = tmp_path / "level.blend", tmp_path / "out"
    set_up = (
        f"import bpy; bpy.ops.extensions.package_install_files(filepath={str(archive)!r}, repo='user_default',"
        f" enable_on_install=True); bpy.ops.wm.save_userpref(); bpy.ops.wm.save_as_mainfile(filepath={str(file)!r})"
    )
    code, said = blender("--background", "--python-exit-code", "9", "--python-expr", set_up)
    assert code == 0, said
    command = ["--background", str(file), "--command", "gi_volumes"]
    code, said = blender(*command, "bake", "--quality", "draft", "-o", str(output), "--json")
    assert code == 0, said
    result = json.loads(next(line for line in said.splitlines() if line.startswith("{")))
    assert result["triangles"] == 12
    assert (output / "world.json").is_file()
    code, said = blender(*command, "verify", str(output))
    assert code == 0, said
    code, said = blender(*command, "bake", "--quality", "draft")
    assert code == 0, said
    assert (tmp_path / "gi_bake" / "world.json").is_file()
    code, said = blender(*command, "bake", "missing.blend")
    assert (code, "error: missing.blend: no such file" in said) == (1, True), said
    assert blender(*command, "dance")[0] == 2
