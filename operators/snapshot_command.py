"""The command `snapshot SCENE -o FILE`: a scene file to a snapshot file, in a Python that has `bpy`."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path


def main(argv: list[str]) -> int:
    """Write the snapshot of a scene file.

    Parameters
    ----------
    argv : list of str
        The arguments after `snapshot`.

    Returns
    -------
    int
        0 done, 1 failed with one line "error: ..." on standard error, 2 wrong usage.
    """
    parser = argparse.ArgumentParser(prog="gi_volumes snapshot", description="Write the snapshot of a scene.")
    parser.add_argument("scene", type=Path, help="a .blend, .glb or .gltf file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="file to create")
    arguments = parser.parse_args(argv)
    try:
        write(arguments.scene, arguments.output)
    except (OSError, ValueError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 1
    return 0


def write(scene: Path, output: Path) -> None:
    """Read a scene file and write its snapshot.

    Parameters
    ----------
    scene : Path
        A .blend, .glb or .gltf file.
    output : Path
        File to create or replace.

    Raises
    ------
    ValueError
        The scene is of an unknown kind or has nothing to bake, or `bpy` is missing.
    OSError
        A file cannot be read or written.
    """
    if sys.modules.get("bpy") is None and importlib.util.find_spec("bpy") is None:
        raise ValueError(
            f"{scene}: reading a {scene.suffix} file needs Blender's Python module: run 'make setup', "
            "or bake inside Blender: blender -b FILE --command gi_volumes bake"
        )
    from ..bake import snapshot_file
    from . import extract, properties

    properties.attach_alone()
    snapshot_file.save(extract.from_file(scene), output)


def one_line(error: Exception) -> str:
    """Return the message of an expected error on one line.

    Parameters
    ----------
    error : Exception
        What was raised.

    Returns
    -------
    str
        Its message without line breaks; for errors of the system, file and reason.
    """
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__
