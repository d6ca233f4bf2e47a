"""What tests of several folders share."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

# A shell starts background jobs with this signal ignored, and so would be every command that the tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The repository's root, which is the package."""
    return REPOSITORY


@pytest.fixture
def run_python(tmp_path):
    """Run a program in a Python of its own, with Blender's user files in a fresh folder."""

    def run(program: str, *arguments: str, **options) -> subprocess.CompletedProcess:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
        return subprocess.run(
            [sys.executable, "-c", program, *arguments],
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            env=environment,
            cwd=tmp_path,
            timeout=300,
            **options,
        )

    return run


def pytest_sessionfinish(session, exitstatus):
    """Keep the exit code for the end."""
    session.config.exit_code = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """Leave without Blender's clean-up where it was imported: after a render it was seen to wait for ever."""
    if "bpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(getattr(config, "exit_code", 1))
