"""Checks a baked folder: every checksum, every hash, every invariant, every cell, the probes.

Comes in: a folder. Goes out: the list of all defects, each as a file and a sentence; empty for a sound bake.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from . import folder, probe_cells, probe_file
from .cells import cell_path, describe_file
from .container import FileError

__all__ = ["Defect", "verify"]


@dataclass(frozen=True)
class Defect:
    """One thing that is wrong.

    Parameters
    ----------
    file : str
        Name of the file in the folder.
    what : str
        What is wrong with it.
    """

    file: str
    what: str


def verify(path: str | os.PathLike) -> list[Defect]:
    """Find everything that is wrong with a bake.

    Parameters
    ----------
    path : str or Path
        The folder.

    Returns
    -------
    list of Defect
        Empty for a complete, undamaged bake.

    Raises
    ------
    FileNotFoundError
        When there is no such folder.
    """
    if not Path(path).is_dir():
        reason = "this is a file, not the folder of a bake" if Path(path).exists() else "no such folder"
        raise FileNotFoundError(2, reason, os.fspath(path))
    try:
        header = folder.load_header(path)
    except (OSError, FileError) as error:
        return [Defect(folder.WORLD, _reason(error))]
    return list(_defects(Path(path), header))


def _defects(path: Path, header: dict) -> Iterator[Defect]:
    """Cell by cell, then what should be there and is not, then the probes."""
    listed = {tuple(entry["cell"]) for entry in header["cells"]}
    of_probes = _probes_defect(path, header)
    for entry in header["cells"]:
        yield from _cell_defects(path, entry, header, of_probes is None)
        if entry.get("early"):
            what = f"cell {entry['cell'][0]},{entry['cell'][1]} is an early look: not baked to its end yet"
            yield Defect(cell_path(path, entry["cell"], "tree").name, what)
    for cell in header.get("expected_cells", []):
        if tuple(cell) not in listed:
            yield Defect(cell_path(path, cell, "tree").name, f"cell {cell[0]},{cell[1]} is missing: not baked yet")
    if of_probes is not None:
        yield of_probes
    for entry in header["cells"] if "probes" in header else ():
        if "probes" not in entry["files"]:
            what = f"cell {entry['cell'][0]},{entry['cell'][1]} does not say which probes count where"
            yield Defect(probe_cells.path_of(path, entry["cell"]).name, what)


def _probes_defect(path: Path, header: dict) -> Defect | None:
    """What is wrong with the probes' file."""
    try:
        probe_file.load(path, header)
    except (OSError, FileError) as error:
        return Defect(probe_file.PROBES, _reason(error))
    return None


def _cell_defects(path: Path, entry: dict, header: dict, has_probes: bool) -> Iterator[Defect]:
    """Files against their hashes; when these fit, the cell against its invariants."""
    broken = False
    for file in entry["files"].values():
        defect = _hash_defect(path / file["name"], file)
        broken |= defect is not None
        if defect is not None:
            yield Defect(file["name"], defect)
    tree = cell_path(path, entry["cell"], "tree").name
    if broken:
        return
    try:
        cell = folder.read_cell(path, tuple(entry["cell"]))
    except (OSError, FileError) as error:
        yield Defect(Path(getattr(error, "path", tree)).name, _reason(error))
        return
    try:
        if has_probes:
            probe_cells.load(path, header | {"cells": [entry]}, [cell])
    except (OSError, FileError) as error:
        yield Defect(Path(getattr(error, "path", tree)).name, _reason(error))
    if cell.meta["bake"] != header["bake"]:
        yield Defect(tree, "the cell belongs to another bake than world.json")
    if cell.topology.size != entry["data_points"]:
        yield Defect(tree, f"{cell.topology.size} data points; world.json says {entry['data_points']}")


def _hash_defect(path: Path, stated: dict) -> str | None:
    """Why a file is not the one that was listed."""
    try:
        found = describe_file(path)
    except OSError as error:
        return _reason(error)
    if found["bytes"] != stated["bytes"]:
        return f"{found['bytes']} bytes; world.json says {stated['bytes']}"
    return None if found["sha256"] == stated["sha256"] else "its SHA-256 is not the one in world.json"


def _reason(error: Exception) -> str:
    """What an error says, without the path that the defect names anyway."""
    if isinstance(error, FileError):
        return f"byte {error.offset}: {error.reason}"
    return "the file is missing" if isinstance(error, FileNotFoundError) else str(error)
