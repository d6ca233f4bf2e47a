"""The libraries that a worker process needs, and where this Blender found them.

A bake cannot do without `NEEDED`; `FOR_PICTURES` are for the commands that write images.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

NEEDED = ("numpy", "embreex", "zstandard")
FOR_PICTURES = ("PIL", "OpenEXR")


def missing() -> list[str]:
    """Return the names of the needed libraries that cannot be imported.

    Returns
    -------
    list of str
        Names, in the order of `NEEDED`.
    """
    return [module for module in NEEDED if importlib.util.find_spec(module) is None]


def search_path() -> str:
    """Return a PYTHONPATH by which another process finds what this one found.

    Returns
    -------
    str
        Folders, each once, joined by the system's separator.
    """
    folders = []
    for module in (*NEEDED, *FOR_PICTURES):
        spec = importlib.util.find_spec(module)
        if spec is None or not spec.origin:
            continue
        file = Path(spec.origin)
        folder = file.parent.parent if spec.submodule_search_locations else file.parent
        folders.append(str(folder))
    return os.pathsep.join(dict.fromkeys(folders))


def complaint() -> str:
    """Return one line that names the missing libraries, or an empty string.

    Returns
    -------
    str
        What is missing and the remedy.
    """
    names = missing()
    if not names:
        return ""
    remedy = f'"{sys.executable}" -m pip install {" ".join(names)}'
    return f"Missing: {', '.join(names)}. Install into Blender's Python: {remedy}"
