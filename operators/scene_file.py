"""Opening scene files in a Blender without a window.

Comes in: a .blend, .glb or .gltf path. Goes out: the scene, open in Blender.
"""

from __future__ import annotations

from pathlib import Path

import bpy

from ..bake.snapshot import SnapshotError

SUFFIXES = (".blend", ".glb", ".gltf")


def open_scene(path: Path) -> None:
    """Open a scene file, replacing whatever is open.

    Parameters
    ----------
    path : Path
        A .blend, .glb or .gltf file.

    Raises
    ------
    SnapshotError
        It is missing, unreadable, or of another kind; the message is one line.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SnapshotError(f"{path}: not a scene; expected {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise SnapshotError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise SnapshotError(f"{path}: {error.strerror}") from error
    try:
        _open(path)
    except Exception as error:  # importers raise anything at all on damaged files
        raise SnapshotError(f"{path}: Blender cannot read it ({_reason(error)})") from error


def _open(path: Path) -> None:
    """Load a .blend without its window layout, or import into an empty scene."""
    if path.suffix.lower() == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
        return
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if not hasattr(bpy.types, "IMPORT_SCENE_OT_gltf"):
        import addon_utils

        addon_utils.enable("io_scene_gltf2")
    result = bpy.ops.import_scene.gltf(filepath=str(path))
    if "FINISHED" not in result:
        raise RuntimeError("the importer gave up")


def _reason(error: Exception) -> str:
    """The last line of an error, which says what; Blender puts tracebacks before it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].removeprefix("Error: ") if lines else type(error).__name__
