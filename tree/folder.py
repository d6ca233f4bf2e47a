"""The folder of a bake: the files of its world cells, and one `world.json` that lists them.

Comes in: finished cells, in any order and from any process. Goes out: `world.json` with format, grid, bounds,
transports, the cells and the probes with the SHA-256 of each file, and a checksum of its own. Written atomically from
whatever belongs to the bake, so that a bake can stop at any moment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np

from . import probe_cells
from .atomic import write_bytes_atomically
from .cells import (
    TREE,
    Cell,
    bake_of_cell,
    cell_path,
    copy_cell,
    describe_file,
    digest_of_cell,
    has_cell,
    read_cell,
    read_tree,
    write_cell,
)
from .container import FileError
from .grid import Grid
from .probe_file import PROBES, describe, is_ours
from .topology import Topology

__all__ = [
    "Cell",
    "assemble",
    "bake_of_cell",
    "copy_cell",
    "digest_of_cell",
    "files",
    "grid_of",
    "has_cell",
    "list_again",
    "load_header",
    "read_cell",
    "write_cell",
]

WORLD = "world.json"
WORLD_FORMAT = "gi_volumes world"
WORLD_VERSION = 2
MAX_WORLD_BYTES = 1 << 28
"""A `world.json` of a million cells; anything longer is not one."""
FILE_NAME = re.compile(r"cell_(-?\d+)_(-?\d+)\.(tree|points|local|sun|sky|probes)")


def assemble(folder: str | os.PathLike, header: dict) -> dict:
    """Write `world.json` from the cells and probes that belong to a bake.

    Processes that bake other cells into the folder may do the same at the same time: whoever writes last looks
    again afterwards, and so lists all cells.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    header : dict
        "bake", "grid" (a `Grid`), "transports", and whatever else to store; "expected_cells" lists the cells that
        a finished bake has.

    Returns
    -------
    dict
        What `load_header` will return.

    Raises
    ------
    OSError
        When the folder cannot be read or written.
    """
    grid, probes = header["grid"], describe(folder) or {}
    made = probes["made"] if probes.get("bake") == header["bake"] else None
    cells = []
    for cell in _cells_in(folder):
        try:
            topology, meta = read_tree(cell_path(folder, cell, TREE))
        except FileError:
            continue
        if meta.get("bake") == header["bake"] and topology.cell == cell:
            cells.append(_describe_cell(folder, topology, meta, grid, made))
    lattice = dataclasses.asdict(grid) | {"cell_size": grid.cell_size, "unit": "m"}
    content = header | {"format": WORLD_FORMAT, "version": WORLD_VERSION, "grid": lattice, "cells": cells}
    content["bounds"] = _bounds([entry["bounds"] for entry in cells])
    content.pop("probes", None)
    content |= {} if made is None else {"probes": probes}
    content = json.loads(json.dumps(content, allow_nan=False))
    content["checksum"] = _checksum(content)
    write_bytes_atomically(Path(folder) / WORLD, _to_text(content))
    return content


def list_again(folder: str | os.PathLike) -> dict:
    """Write `world.json` anew: it lists what has come and gone since.

    Parameters
    ----------
    folder : str or Path
        Folder of a bake.

    Returns
    -------
    dict
        What `load_header` will return.

    Raises
    ------
    FileError, OSError
        When it cannot be read, or written.
    """
    header = load_header(folder)
    return assemble(folder, header | {"grid": grid_of(header)})


def load_header(folder: str | os.PathLike) -> dict:
    """Read `world.json`.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.

    Returns
    -------
    dict
        Its content.

    Raises
    ------
    FileError
        When it is damaged, changed by hand, or of another version.
    OSError
        When it is missing or cannot be read.
    """
    path = Path(folder) / WORLD
    if not Path(folder).is_dir():
        reason = "this is a file, not the folder of a bake" if Path(folder).exists() else "no such folder"
        raise FileNotFoundError(2, reason, os.fspath(folder))
    if not files(folder):
        raise FileNotFoundError(2, f"the folder holds no bake: it has no {WORLD}", os.fspath(folder))
    if path.stat().st_size > MAX_WORLD_BYTES:
        raise FileError(path, 0, "the file is too long for a world.json")
    text = path.read_bytes()
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = "it is no text" if isinstance(error, UnicodeDecodeError) else " ".join(str(error).split())
        raise FileError(path, getattr(error, "pos", 0), f"this is not JSON: {reason}") from None
    if not isinstance(content, dict) or content.get("format") != WORLD_FORMAT:
        raise FileError(path, 0, "this is not the world.json of a bake")
    if content.get("version") != WORLD_VERSION:
        version = f"format version {content.get('version')}; this program reads {WORLD_VERSION}"
        raise FileError(path, 0, f"{version}: bake again, or use the program that wrote it")
    if content.get("checksum") != _checksum(content) or text != _to_text(content):
        raise FileError(path, 0, "the checksum is wrong: the file is damaged or was changed by hand")
    return content


def grid_of(header: dict) -> Grid:
    """Return the lattice of a bake.

    Parameters
    ----------
    header : dict
        From `load_header`.

    Returns
    -------
    Grid
        The lattice.
    """
    lattice = header["grid"]
    return Grid(lattice["first_size"], lattice["levels"], tuple(lattice["origin"]))


def files(folder: str | os.PathLike) -> list[Path]:
    """List the files of a bake in a folder, and leftovers of interrupted ones; other files are not listed.

    Parameters
    ----------
    folder : str or Path
        The folder; it may be missing.

    Returns
    -------
    list of Path
        `world.json`, the snapshot `scene.giv`, the cells' files and the probes', sorted.

    Raises
    ------
    OSError
        When the folder cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if path.is_file() and _is_ours(path.name))
    return sorted(path for path in found if path.name != PROBES or is_ours(path))


def _is_ours(name: str) -> bool:
    """Whether a bake writes files of this name; temporary ones carry the name they will get."""
    temporary = re.fullmatch(r"\.(.+)\.[0-9a-f]{32}\.tmp", name)
    name = temporary[1] if temporary else name
    return name in (WORLD, "scene.giv", PROBES) or FILE_NAME.fullmatch(name) is not None


def _cells_in(folder: str | os.PathLike) -> list[tuple[int, int]]:
    """Cells that have a tree file, sorted."""
    names = (FILE_NAME.fullmatch(name) for name in os.listdir(folder))
    return sorted({(int(match[1]), int(match[2])) for match in names if match and match[3] == TREE})


def _describe_cell(folder: str | os.PathLike, topology: Topology, meta: dict, grid: Grid, made: str | None) -> dict:
    """A cell's entry in `world.json`; `made` says what the bake's probes were made of, if it has any."""
    low = np.array(topology.grid_min) * grid.first_size + grid.origin
    high = low + np.array(topology.grid_shape) * grid.first_size
    listed = meta["files"] | {TREE: describe_file(cell_path(folder, topology.cell, TREE))}
    seen = probe_cells.path_of(folder, topology.cell)
    if made is not None and probe_cells.is_of(seen, meta["bake"], made):
        listed["probes"] = describe_file(seen)
    keys = ("data_points", "valid_points", "left_out")
    entry = {"cell": list(topology.cell), "bounds": [low.tolist(), high.tolist()], "files": listed}
    entry |= {key: meta[key] for key in keys} | {"dilated": meta.get("dilated", 0)}
    return entry | {mark: True for mark in ("early", "by_paths") if meta.get(mark)}


def _bounds(boxes: list) -> list | None:
    """Box around boxes; None without any."""
    if not boxes:
        return None
    boxes = np.array(boxes)
    return [boxes[:, 0].min(axis=0).tolist(), boxes[:, 1].max(axis=0).tolist()]


def _to_text(content: dict) -> bytes:
    """The one text of a `world.json`, so that a change of white space shows as well."""
    return json.dumps(content, indent=1, sort_keys=True).encode() + b"\n"


def _checksum(content: dict) -> str:
    """SHA-256 of everything else in a `world.json`."""
    rest = {key: value for key, value in content.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
