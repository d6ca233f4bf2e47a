"""What a bake of a cell keeps for the next one: everything that was measured and decided, and for what.

Comes in: a cell that has been refined. Goes out: a file, and what it holds. It lies in a folder of its own within the
bake's; engines don't need it, and it can be deleted at any time.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..tree import container, validate
from ..tree.cells import tree_from, tree_parts
from ..tree.container import FileError
from ..tree.grid import Grid
from ..tree.topology import Topology
from .measured import PARTS, Measured
from .receivers import FIELDS, Receivers, none
from .survey import Seen

__all__ = ["FOLDER", "Look", "Memory", "Moved", "digest", "files", "load", "memory_path", "save"]

FOLDER = "memory"
"""Where the files lie within the folder of a bake."""

KIND, VERSION = "memory", 2

MOST_PATHS = 1 << 21
"""Paths of a data point, beyond which a file is not believed: the most that can be asked for, doubled."""


@dataclass(frozen=True, eq=False)
class Look:
    """Receivers of one level.

    coords : (k, 3) int64, voxels of the level whose surfaces they stand for
    seen : Seen
    closer : (n,) bool, which of them have been looked at closer
    """

    coords: np.ndarray
    seen: Seen
    closer: np.ndarray


@dataclass(frozen=True, eq=False)
class Moved:
    """Data points that were moved into cracks.

    row : (m,) int64, which voxels of the tree
    offset : (m, 3) int8, light : (m, functions, 9, 3) float32, as in `Measured`, there
    """

    row: np.ndarray
    offset: np.ndarray
    light: np.ndarray


@dataclass(frozen=True, eq=False)
class Memory:
    """One cell as it was refined.

    tree : Topology
    measured : Measured, its data points before any was moved into a crack
    moved : Moved
    pilot : (size, functions, 9, 3) float32, light by few paths at the same data points, when `measured` was measured
    looks : list of Look, by level
    current : (n,) bool, which receivers of all looks were not replaced by those of finer levels
    need : list of (coords (k, 3) int64, value (k,) float64), by level: voxels that are to be subdivided
    asked : list of (k, 3) int64, by level: voxels that are wanted in front of thin surfaces
    planes, plane : as in `Occluders`
    corners : (t, 3, 3) float32 [m], opaque : (t,) bool, the triangles in and around the cell
    cached : bool, whether it was measured by a surface cache
    causes : dict of str to str, digests of what the light of each transport depends on
    rules : str, digest of the settings
    bounds : dict of str to float, by how much storing may change an entry of each transport, relative to it
    content : str, digest of the cell's files, as `folder.digest_of_cell` finds it
    """

    tree: Topology
    measured: Measured
    moved: Moved
    pilot: np.ndarray
    looks: list[Look]
    current: np.ndarray
    need: list[tuple[np.ndarray, np.ndarray]]
    asked: list[np.ndarray]
    planes: np.ndarray
    plane: np.ndarray
    corners: np.ndarray
    opaque: np.ndarray
    cached: bool
    causes: dict[str, str]
    rules: str
    bounds: dict[str, float] = field(default_factory=dict)
    content: str = ""


def memory_path(target: str | os.PathLike, cell: tuple[int, int]) -> Path:
    """Return where a cell's memory lies.

    Parameters
    ----------
    target : str or Path
        Folder of a bake.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    Path
        The file.
    """
    return Path(target) / FOLDER / f"cell_{cell[0]}_{cell[1]}.memory"


def save(memory: Memory, target: str | os.PathLike) -> int:
    """Write a cell's memory, atomically.

    Parameters
    ----------
    memory : Memory
        The cell.
    target : str or Path
        Folder of the bake.

    Returns
    -------
    int
        The file's length [bytes].

    Raises
    ------
    OSError
        The file cannot be written.
    """
    tree, moved = memory.tree, memory.moved
    arrays, meta = tree_parts(tree)
    arrays |= {f"measured/{name}": getattr(memory.measured, name) for name in PARTS}
    arrays |= {f"moved/{name}": getattr(moved, name) for name in ("row", "offset", "light")}
    for level, look in enumerate(memory.looks):
        arrays |= {f"look/{level}/coords": look.coords, f"look/{level}/light": look.seen.light}
        arrays[f"look/{level}/closer"] = look.closer
        arrays |= {f"look/{level}/{name}": getattr(look.seen.at, name) for name in FIELDS}
    for level, (coords, value) in enumerate(memory.need):
        arrays |= {f"need/{level}/coords": coords, f"need/{level}/value": value}
    arrays |= {f"asked/{level}": coords for level, coords in enumerate(memory.asked)}
    for name in ("pilot", "current", "planes", "plane", "corners", "opaque"):
        arrays[name] = getattr(memory, name)
    counts = [len(memory.looks), len(memory.need), len(memory.asked)]
    meta |= {"version": VERSION, "counts": counts}
    meta |= {name: getattr(memory, name) for name in ("cached", "causes", "rules", "bounds", "content")}
    path = memory_path(target, tree.cell)
    path.parent.mkdir(exist_ok=True)
    return container.write(path, KIND, arrays, meta)


def load(target: str | os.PathLike, cell: tuple[int, int], grid: Grid, rules: str) -> Memory | None:
    """Read a cell's memory.

    Parameters
    ----------
    target : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).
    grid : Grid
        The lattice.
    rules : str
        Digest of the settings that it has to be of.

    Returns
    -------
    Memory or None
        None where there is none, it is damaged, or it was made by other rules.
    """
    try:
        file = container.read(memory_path(target, cell), KIND)
        if (file.meta["version"], file.meta["rules"], tuple(file.meta["cell"])) != (VERSION, rules, tuple(cell)):
            return None
        return _memory(file, grid)
    except (OSError, FileError, KeyError, TypeError, ValueError):
        return None


def files(target: str | os.PathLike) -> list[Path]:
    """List what is remembered of a bake.

    Parameters
    ----------
    target : str or Path
        Folder of the bake.

    Returns
    -------
    list of Path
        The cells' files, sorted.
    """
    return sorted((Path(target) / FOLDER).glob("cell_*.memory"))


def _memory(file: container.Container, grid: Grid) -> Memory:
    """A file's content; its checksums were right, so that only a program of another version can have left gaps."""
    meta, arrays = file.meta, file.arrays
    tree = tree_from(arrays, meta)
    if validate.first_defect(tree):
        raise ValueError("the tree is broken")
    measured = Measured(*tree.voxels(), *(arrays[f"measured/{name}"] for name in PARTS))
    moved = Moved(*(arrays[f"moved/{name}"] for name in ("row", "offset", "light")))
    looks = []
    for level in range(meta["counts"][0]):
        at = Receivers(*(arrays[f"look/{level}/{name}"] for name in FIELDS))
        coords, light, closer = (arrays[f"look/{level}/{name}"] for name in ("coords", "light", "closer"))
        looks.append(Look(coords, Seen(at, light), closer))
    need = [(arrays[f"need/{level}/coords"], arrays[f"need/{level}/value"]) for level in range(meta["counts"][1])]
    asked = [arrays[f"asked/{level}"] for level in range(meta["counts"][2])]
    own = (arrays[name] for name in ("planes", "plane", "corners", "opaque"))
    parts = (measured, moved, arrays["pilot"], looks, arrays["current"], need, asked, *own)
    memory = Memory(tree, *parts, meta["cached"], meta["causes"], meta["rules"], meta["bounds"], meta["content"])
    _check(memory)
    return memory


def _check(memory: Memory) -> None:
    """Refuse what `changes` and `again` would stumble over, or take for unchanged."""
    size, functions = memory.tree.size, memory.measured.light.shape[1]
    light = (functions, 9, 3)
    shapes = [
        (memory.measured.light, (size, *light)),
        (memory.measured.offset, (size, 3)),
        (memory.measured.valid, (size,)),
        (memory.measured.noise, (size, *memory.measured.noise.shape[1:])),
        (memory.measured.paths, (size,)),
        (memory.pilot, (size, *light)),
        (memory.moved.offset, (len(memory.moved.row), 3)),
        (memory.moved.light, (len(memory.moved.row), *light)),
        (memory.planes, (size, 3)),
        (memory.plane, (len(memory.plane), 5)),
        (memory.current, (sum(len(look.seen.at.key) for look in memory.looks),)),
        (memory.corners, (len(memory.opaque), 3, 3)),
        *((look.seen.light, (2, len(look.seen.at.key), functions, 3)) for look in memory.looks),
        *((look.closer, look.seen.at.key.shape) for look in memory.looks),
        *(
            (getattr(look.seen.at, name), (len(look.seen.at.key), *getattr(none(), name).shape[1:]))
            for look in memory.looks
            for name in FIELDS
        ),
        *((coords, (len(value), 3)) for coords, value in memory.need),
    ]
    if any(array.shape != shape for array, shape in shapes):
        raise ValueError("arrays do not fit together")
    if any(not np.isfinite(array).all() for array, _ in shapes if array.dtype.kind == "f"):
        raise ValueError("a number is not finite")
    paths = memory.measured.paths
    if len(paths) and not (paths.min() > 0 and paths.max() <= MOST_PATHS):
        raise ValueError("a data point has no paths, or too many")
    for row, end in ((memory.moved.row, size), (memory.planes, len(memory.plane))):
        if len(row) and not (row.min() >= -1 and row.max() < end):
            raise ValueError("a row does not exist")
    if not all(isinstance(part, dict) for part in (memory.causes, memory.bounds)):
        raise ValueError("causes or bounds are missing")


def digest(*parts: object) -> str:
    """Hash arrays and texts.

    Parameters
    ----------
    *parts : ndarray or object
        Arrays count by type, shape and bytes, other things by their text.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    state = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray):
            state.update(f"{part.dtype.str}{part.shape}".encode())
            state.update(np.ascontiguousarray(part).data)
        else:
            state.update(repr(part).encode())
    return state.hexdigest()
