"""The files of cells that say which reflection probes count where: `cell_I_J.probes`.

Comes in: entries of a cell's voxels (`probe_sets.py`). Goes out: a file that knows the bake, the cell, the tree and the
probes that it belongs to. `world.json` lists it among the cell's files where `probes.exr` is of the same making; cells
without one are lit by the volume alone.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from . import container
from .cells import Cell, cell_path, topology_hash
from .container import FileError
from .probe_sets import KIND, ProbeSets, encode, read_sets, write_sets

__all__ = ["is_of", "load", "path_of", "read", "write"]


def path_of(folder: str | os.PathLike, cell: tuple[int, int]) -> Path:
    """Return where a cell's file lies.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    Path
        The file's path.
    """
    return cell_path(folder, cell, KIND)


def write(folder: str | os.PathLike, cell: Cell, sets: ProbeSets, made: str) -> int:
    """Write a cell's file.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : Cell
        The cell.
    sets : ProbeSets
        Its entries.
    made : str
        What the probes were made of, as given to `probe_file.write`.

    Returns
    -------
    int
        Length of the file [bytes].

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    return write_sets(path_of(folder, cell.topology.cell), sets, _meta(cell) | {"made": made})


def is_of(path: Path, bake: str, made: str) -> bool:
    """Say whether a file is whole, and belongs to a bake and its probes.

    Parameters
    ----------
    path : Path
        The file.
    bake : str
        What identifies the bake.
    made : str
        What its probes were made of.

    Returns
    -------
    bool
        False for anything missing, damaged or different.
    """
    try:
        meta = container.read(path, KIND).meta
    except (OSError, FileError):
        return False
    return meta.get("bake") == bake and meta.get("made") == made


def read(folder: str | os.PathLike, cell: Cell, probes: dict) -> ProbeSets:
    """Read a cell's file.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : Cell
        The cell.
    probes : dict
        What `world.json` says of the probes.

    Returns
    -------
    ProbeSets
        Sound entries.

    Raises
    ------
    FileError
        For a damaged file, one whose entries are not sound, or one of another cell, tree, bake or of other probes.
    OSError
        When the file cannot be read.
    """
    path = path_of(folder, cell.topology.cell)
    sets, meta = read_sets(path, len(probes["positions"]), cell.valid)
    for key, value in (_meta(cell) | {"made": probes["made"]}).items():
        if meta.get(key) != value:
            reason = f"its {key} is {meta.get(key)!r}, not {value!r}: the files do not belong together"
            raise FileError(path, container.PREFIX_BYTES, reason)
    return sets


def load(folder: str | os.PathLike, header: dict, cells: list[Cell]) -> list[ProbeSets]:
    """Read the files of all cells.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    header : dict
        Content of `world.json`.
    cells : list of Cell
        Its cells, in the order in which it lists them.

    Returns
    -------
    list of ProbeSets
        Without weights for cells that have no file.

    Raises
    ------
    FileError, OSError
        As `read`.
    """
    sets = []
    for entry, cell in zip(header["cells"], cells, strict=True):
        nothing = np.zeros((len(cell.valid), 1), np.int64)
        has = KIND in entry["files"] and "probes" in header
        sets.append(read(folder, cell, header["probes"]) if has else encode(nothing, nothing, cell.valid))
    return sets


def _meta(cell: Cell) -> dict:
    """Header fields that say which cell a file is of."""
    return {"bake": cell.meta["bake"], "cell": list(cell.topology.cell), "topology": topology_hash(cell.topology)}
