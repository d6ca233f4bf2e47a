"""The command line: `python -m gi_volumes COMMAND ...` or `python FOLDER/__main__.py COMMAND ...`.

The second form needs no installation and any folder name: it is how Blender starts its workers. Reading a
.blend, .glb or .gltf needs `bpy`, which is imported in a process of its own (the command `snapshot`).
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import NoReturn

PACKAGE = "gi_volumes"
ROOT = Path(__file__).resolve().parent
INTERRUPTED = 130
ERROR_PREFIX = "error: "


def package() -> ModuleType:
    """Return the package of this file's folder, whatever the folder is called.

    Returns
    -------
    ModuleType
        The imported package.
    """
    if __package__:
        return importlib.import_module(__package__)
    loaded = sys.modules.get(PACKAGE)
    if loaded is None:
        spec = importlib.util.spec_from_file_location(
            PACKAGE, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
        )
        loaded = importlib.util.module_from_spec(spec)
        sys.modules[PACKAGE] = loaded
        spec.loader.exec_module(loaded)
    return loaded


def extract(scene: Path | str, snapshot: Path | str) -> None:
    """Read a scene in a process of its own and write its snapshot.

    Parameters
    ----------
    scene : Path or str
        A .blend, .glb or .gltf file.
    snapshot : Path or str
        File to create.

    Raises
    ------
    SnapshotError
        The scene cannot be read, or this Python has no `bpy`; the message is one line.
    """
    command = [sys.executable, str(ROOT / "__main__.py"), "snapshot", str(scene), "-o", str(snapshot)]
    reader = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, errors="replace"
    )
    if reader.returncode == INTERRUPTED:
        raise KeyboardInterrupt
    if reader.returncode != 0:
        error = importlib.import_module(".bake.snapshot", package().__name__).SnapshotError
        raise error(_reason(reader.stderr, reader.returncode))


def _reason(text: str, code: int) -> str:
    """One line out of what a failed reader said."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line.removeprefix(ERROR_PREFIX) for line in lines if line.startswith(ERROR_PREFIX)]
    if named:
        return named[-1]
    return f"reading the scene stopped with code {code}: {lines[-1] if lines else 'it said nothing'}"


def main(argv: list[str]) -> int:
    """Run one command.

    Parameters
    ----------
    argv : list of str
        The arguments after the program's name.

    Returns
    -------
    int
        0 done, 1 failed with a one-line reason, 2 wrong usage, 130 interrupted.
    """
    home = package().__name__
    try:
        if argv[:1] == ["snapshot"]:
            return importlib.import_module(".operators.snapshot_command", home).main(argv[1:])
        return importlib.import_module(".bake.cli", home).main(argv, extract)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except ModuleNotFoundError as error:
        print(f"{ERROR_PREFIX}this Python has no module {error.name}: install it, or run 'make setup'", file=sys.stderr)
        return 1


def _stop_like_ctrl_c() -> None:
    """Let a job that is told to stop, by a farm or by Blender, keep what it has finished."""
    for name in ("SIGTERM", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.default_int_handler)


def _leave(code: int) -> NoReturn:
    """End the process; one that holds Blender without its clean-up, which was seen to wait for ever after a render, and
    an interrupted one without waiting for threads in the middle of a long step."""
    if "bpy" in sys.modules or code == INTERRUPTED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    _stop_like_ctrl_c()
    importlib.import_module(".operators.worker", package().__name__).stop_with_parent()
    _leave(main(sys.argv[1:]))
