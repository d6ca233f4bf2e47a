"""The arrows between folders, read from the imports themselves."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDERS = ("", "bake", "operators", "preview", "tree")

# What each folder may import of ours: folders, or single modules.
ARROWS = {
    "": {"operators", "tree.world", "bake.cli", "bake.snapshot"},
    "tree": set(),
    "bake": {"tree"},
    "preview": {"tree", "bake.snapshot"},
    "operators": {"", "bake", "preview", "tree"},
}
BLENDER = {"bmesh", "bpy", "bpy_extras", "gpu", "gpu_extras", "mathutils", "addon_utils"}
# Packages that only some rooms may use; the rest of the standard library and numpy is for everybody.
ROOMS = {
    **dict.fromkeys(BLENDER, ("operators/", "preview/draw.py")),
    "embreex": ("bake/rays.py",),
    "moderngl": ("preview/",),
    "OpenEXR": ("bake/picture.py",),
    "zstandard": ("tree/",),
    "PIL": ("bake/picture.py",),
}
FREE = {"numpy", *sys.stdlib_module_names}
MASK_ROOM = "tree/bits.py"
# They describe stored bytes, and leave the arithmetic to the room of the masks.
MASK_LAYOUTS = ("tree/topology.py", "tree/container.py")


def modules() -> list[Path]:
    """Every module of the package."""
    return [path for folder in FOLDERS for path in sorted((REPOSITORY / folder).glob("*.py"))]


def imports(source: str, file: str) -> list[tuple[int, str, str]]:
    """All imports of a file as (line, "ours" or "theirs", dotted name from the package's root)."""
    found = []
    here = Path(file).parent.parts
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, "theirs", alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.append((node.lineno, "theirs", node.module))
        elif isinstance(node, ast.ImportFrom):
            base = [*here[: len(here) - node.level + 1], *(node.module or "").split(".")]
            base = [part for part in base if part]
            found += [(node.lineno, "ours", ".".join([*base, alias.name])) for alias in node.names]
    return found


def allowed(name: str, file: str) -> bool:
    """Whether a file may import a name of ours."""
    folder = file.rpartition("/")[0]
    home = name.split(".")[0]
    if folder and home == folder:
        return True
    return any(name == arrow or name.startswith(f"{arrow}.") or arrow == "" for arrow in ARROWS[folder])


def violations(source: str, file: str) -> list[str]:
    """What a file does that the house forbids, one line each."""
    found = []
    for line, whose, name in imports(source, file):
        if whose == "ours":
            if not allowed(name, file):
                found.append(f"{file}:{line}: may not import {name}")
            continue
        package = name.split(".")[0]
        rooms = ROOMS.get(package)
        if package == "gi_volumes":
            found.append(f"{file}:{line}: imports {name} by its absolute name; an extension has another")
        elif rooms is not None and not any(
            file == room or (room.endswith("/") and file.startswith(room)) for room in rooms
        ):
            found.append(f"{file}:{line}: only {', '.join(rooms)} may import {package}")
        elif rooms is None and package not in FREE:
            found.append(f"{file}:{line}: {package} is not a declared dependency")
    if file != MASK_ROOM:
        lines = uint64_lines(source, as_text=file not in MASK_LAYOUTS)
        found += [f"{file}:{line}: unsigned 64-bit numbers live in {MASK_ROOM} alone" for line in lines]
    return found


def uint64_lines(source: str, as_text: bool) -> list[int]:
    """Lines that name numpy's uint64, as an attribute or, if asked for, as text."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        named = isinstance(node, ast.Attribute) and node.attr == "uint64"
        written = as_text and isinstance(node, ast.Constant) and node.value in {"uint64", "<u8", "u8", "=u8"}
        if named or written:
            lines.append(node.lineno)
    return lines


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_a_module_imports_only_what_its_folder_may(path):
    assert violations(path.read_text(), path.relative_to(REPOSITORY).as_posix()) == []


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("tree/grid.py", "from ..bake import rays"),
        ("tree/grid.py", "from .. import bake"),
        ("bake/job.py", "def later():\n    from ..operators import extract"),
        ("bake/job.py", "import bpy"),
        ("bake/paths.py", "from embreex import rtcore"),
        ("preview/client.py", "import gpu"),
        ("preview/client.py", "from ..bake.paths import trace"),
        ("operators/job.py", "import gi_volumes.bake"),
        ("operators/job.py", "import requests"),
        ("bake/sampling.py", "import numpy as np\nx = np.uint64(1)"),
        ("bake/sampling.py", "x = y.astype('<u8')"),
        ("tree/topology.py", "import numpy as np\nx = np.uint64(1)"),
    ],
)
def test_a_planted_violation_is_found(file, source):
    assert len(violations(source, file)) == 1


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("bake/job.py", "from ..tree import grid\nfrom ..tree.grid import Grid\nfrom . import rays"),
        ("preview/client.py", "from ..bake.snapshot import Camera\nfrom ..tree import world"),
        ("operators/job.py", "from .. import VERSION\nfrom ..bake import snapshot_file\nimport bpy"),
        ("__init__.py", "from . import operators"),
        ("tree/bits.py", "import numpy as np\nx = np.uint64(1)"),
        ("tree/topology.py", "x = '<u8'"),
    ],
)
def test_a_permitted_import_passes(file, source):
    assert violations(source, file) == []


def test_importing_the_package_loads_neither_blender_nor_numpy(run_python):
    done = run_python("import sys, gi_volumes; print(sorted({'bpy', 'numpy'} & set(sys.modules)), gi_volumes.VERSION)")
    assert done.stdout.startswith("[] "), done.stderr
