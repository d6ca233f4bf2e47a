"""The files of one world cell: its tree, its data points and its payloads.

    cell_I_J.tree           topology; written last, it lists the cell's other files with their SHA-256
    cell_I_J.points         offset, validity and occluding planes of the data points
    cell_I_J.local|sun|sky  payloads; one that the scene does not need is absent

Comes in: a tree and arrays over its index space. Goes out: files that are complete or absent, and that know the
bake, cell and tree that they belong to.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import container, payload, validate
from .container import FileError
from .planes import NONE, CellPlanes, empty, planes_defect
from .topology import NODE, Topology, is_terminal, link_blocks

__all__ = [
    "PAYLOADS",
    "Cell",
    "bake_of_cell",
    "cell_path",
    "copy_cell",
    "describe_file",
    "digest_of_cell",
    "has_cell",
    "read_cell",
    "read_tree",
    "topology_hash",
    "tree_from",
    "tree_parts",
    "write_cell",
]

TREE, POINTS = "tree", "points"
PAYLOADS = ("local", "sun", "sky")
UNITS = {"local": "W/m2", "sun": "1", "sky": "W/m2"}
OFFSET_STEPS = 254
"""Offsets are stored in voxel sizes / 254: 127 is half a voxel."""


@dataclass(frozen=True)
class Cell:
    """Everything that a bake holds for one world cell.

    Parameters
    ----------
    topology : Topology
        The tree.
    offset : (size, 3) int8
        Data point minus voxel centre, in voxel sizes / 254.
    valid : (size,) bool
        Whether there is a data point: not inside a wall.
    payloads : dict of str to Payload
        By name.
    meta : dict
        Header of the tree's file.
    planes : CellPlanes
        What hides surfaces from the data points.
    """

    topology: Topology
    offset: np.ndarray
    valid: np.ndarray
    payloads: dict[str, payload.Payload]
    meta: dict
    planes: CellPlanes


def cell_path(folder: str | os.PathLike, cell: tuple[int, int], name: str) -> Path:
    """Return where a file of a cell lies.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).
    name : str
        "tree", "points" or a payload's name.

    Returns
    -------
    Path
        The file's path.
    """
    return Path(folder) / f"cell_{cell[0]}_{cell[1]}.{name}"


def write_cell(
    folder: str | os.PathLike,
    topology: Topology,
    payloads: dict[str, np.ndarray],
    valid: np.ndarray,
    offsets: np.ndarray,
    meta: dict,
    planes: CellPlanes | None = None,
) -> dict[str, int]:
    """Write all files of a cell, the tree last: a cell without a fitting tree counts as not baked.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake; it exists.
    topology : Topology
        The tree.
    payloads : dict of str to (size, K, 9, 3) float32
        Irradiance coefficients by name, "local", "sun" or "sky".
    valid : (size,) bool
        Which voxels have a data point.
    offsets : (size, 3) int8
        Data point minus voxel centre, in voxel sizes / 254.
    meta : dict
        Header fields; "bake" identifies what the values depend on, "early" marks a coarse cell that will be replaced.
    planes : CellPlanes, optional
        Occluding planes of the data points; none when left out.

    Returns
    -------
    dict of str to int
        Length of each file [bytes].

    Raises
    ------
    ValueError
        For a broken tree, unknown payloads, arrays of a wrong shape, values that are not finite.
    OSError
        When a file cannot be written; files written before remain and are overwritten by the next attempt.
    """
    valid, offsets = np.asarray(valid), np.asarray(offsets)
    planes = empty(topology.size) if planes is None else planes
    _check_cell(topology, payloads, valid, offsets, planes)
    cell, size = topology.cell, topology.size
    common = {"bake": str(meta["bake"]), "cell": list(cell), "topology": topology_hash(topology)}
    sizes = {}
    arrays = {"offset": np.where(valid[:, None], offsets, 0).astype(np.int8), "valid": valid.astype(bool)}
    arrays |= {"planes": np.where(valid[:, None], planes.planes, NONE).astype(np.uint16), "plane": planes.plane}
    if planes.fill is not None:
        arrays["fill"] = planes.fill
    units = {"offset": f"voxel size / {OFFSET_STEPS}", "plane": "1, 1, 1, m, m", "fill": "1 / 255"}
    own = common | {"shade": planes.shade}
    sizes[POINTS] = container.write(cell_path(folder, cell, POINTS), POINTS, arrays, own, units)
    for name in PAYLOADS:
        path = cell_path(folder, cell, name)
        if name in payloads:
            unit = "sr" if name == "sky" and payloads[name].shape[1] > 1 else UNITS[name]
            sizes[name] = payload.write_payload(path, name, payloads[name], valid, common, unit)
        else:
            path.unlink(missing_ok=True)
    listed = {name: describe_file(cell_path(folder, cell, name)) for name in sizes}
    header = {**meta, **common, "files": listed, "data_points": size, "valid_points": int(valid.sum())}
    nodes, shape = tree_parts(topology)
    sizes[TREE] = container.write(cell_path(folder, cell, TREE), TREE, nodes, header | shape)
    return sizes


def tree_parts(topology: Topology) -> tuple[dict[str, np.ndarray], dict]:
    """Take a tree apart for a file.

    Parameters
    ----------
    topology : Topology
        The tree.

    Returns
    -------
    arrays : dict of str to ndarray
        What `tree_from` needs.
    meta : dict
        Likewise, of the header.
    """
    meta = {"cell": list(topology.cell), "grid_min": list(topology.grid_min), "grid_shape": list(topology.grid_shape)}
    meta |= {"levels": topology.levels, "left_out": topology.left_out, "dilated": topology.dilated}
    return {"mask": topology.nodes["mask"], "terminal": is_terminal(topology.nodes)}, meta


def tree_from(arrays: dict[str, np.ndarray], meta: dict) -> Topology:
    """Put a tree together again; nothing is allocated on the word of a file.

    Parameters
    ----------
    arrays : dict of str to ndarray
        As from `tree_parts`, among others.
    meta : dict
        Likewise.

    Returns
    -------
    Topology
        The tree, whose invariants `validate.first_defect` checks.

    Raises
    ------
    KeyError, TypeError, ValueError
        Something is missing, or of a wrong type or length.
    """
    cell, low, shape = (_ints(meta[key]) for key in ("cell", "grid_min", "grid_shape"))
    levels, left_out, dilated = _ints([meta["levels"], meta["left_out"], meta.get("dilated", 0)])
    mask, terminal = arrays["mask"], arrays["terminal"]
    if (len(cell), len(low), len(shape)) != (2, 3, 3) or mask.ndim != 1 or mask.shape != terminal.shape:
        raise ValueError("arrays or header fields have a wrong length")
    if (mask.dtype, terminal.dtype) != (NODE["mask"], bool):
        raise ValueError("mask and terminal have wrong types")
    if not 0 < math.prod(shape) <= len(mask) or (terminal & (mask == 0)).any():
        raise ValueError("nodes are missing for voxels of the dense grid, or one without children is terminal")
    return Topology(cell, low, shape, link_blocks(mask, terminal, math.prod(shape)), levels, left_out, dilated)


def topology_hash(topology: Topology) -> str:
    """Identify a tree, so that a payload cannot be read with another one.

    Parameters
    ----------
    topology : Topology
        The tree.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    numbers = [*topology.cell, *topology.grid_min, *topology.grid_shape, topology.levels]
    digest = hashlib.sha256(np.array(numbers, "<i8").tobytes())
    digest.update(np.ascontiguousarray(topology.nodes, NODE).tobytes())
    return digest.hexdigest()[:32]


def read_tree(path: str | os.PathLike) -> tuple[Topology, dict]:
    """Read a tree and check every invariant of it.

    Parameters
    ----------
    path : str or Path
        A `.tree` file.

    Returns
    -------
    topology : Topology
        The tree.
    meta : dict
        The file's header.

    Raises
    ------
    FileError
        For a damaged file, or a tree with a broken invariant, which the message names.
    OSError
        When the file cannot be read.
    """
    file = container.read(path, TREE)
    try:
        topology = tree_from(file.arrays, file.meta)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(path, container.PREFIX_BYTES, f"this is no tree: {error}") from None
    defect = validate.first_defect(topology)
    if defect:
        raise FileError(path, container.PREFIX_BYTES, defect)
    return topology, file.meta


def read_cell(folder: str | os.PathLike, cell: tuple[int, int]) -> Cell:
    """Read all files of a cell and check that they belong together.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    Cell
        The cell.

    Raises
    ------
    FileError
        For a damaged file, or one of another bake, cell or tree.
    OSError
        When a file is missing or cannot be read.
    """
    path = cell_path(folder, cell, TREE)
    topology, meta = read_tree(path)
    if topology.cell != tuple(cell):
        raise FileError(path, container.PREFIX_BYTES, f"this is cell {topology.cell}")
    own = {key: meta.get(key) for key in ("bake", "cell", "topology")}
    if own["topology"] != topology_hash(topology) or not isinstance(meta.get("files"), dict):
        raise FileError(path, container.PREFIX_BYTES, "the header does not describe this tree")
    points = container.read(cell_path(folder, cell, POINTS), POINTS)
    _check_belongs(cell_path(folder, cell, POINTS), points.meta, own)
    offset, valid = points.arrays.get("offset"), points.arrays.get("valid")
    shapes = [None if a is None else (a.shape, a.dtype.str) for a in (offset, valid)]
    if shapes != [((topology.size, 3), "|i1"), ((topology.size,), "|b1")]:
        reason = f"the data points do not fit a tree of {topology.size} voxels"
        raise FileError(cell_path(folder, cell, POINTS), container.PREFIX_BYTES, reason)
    planes = _read_planes(cell_path(folder, cell, POINTS), points, valid)
    payloads = {}
    for name in (name for name in PAYLOADS if name in meta["files"]):
        payloads[name], header = payload.read_payload(cell_path(folder, cell, name))
        _check_belongs(cell_path(folder, cell, name), header, own | {"name": name})
        if not np.array_equal(payloads[name].index != payload.NO_DATA, valid):
            reason = "the payload has data for other voxels than the valid ones"
            raise FileError(cell_path(folder, cell, name), container.PREFIX_BYTES, reason)
    return Cell(topology, offset, valid, payloads, meta, planes)


def has_cell(folder: str | os.PathLike, cell: tuple[int, int], bake: str) -> bool:
    """Say whether a cell is there, complete and undamaged, belongs to a bake, and is baked to its end.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).
    bake : str
        What identifies the bake.

    Returns
    -------
    bool
        False for anything missing, damaged or different, and for an early look at the cell.
    """
    meta = _meta(folder, cell)
    return meta.get("bake") == bake and not meta.get("early", False)


def bake_of_cell(folder: str | os.PathLike, cell: tuple[int, int]) -> str | None:
    """Say which bake a cell belongs to, baked to its end or not.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    str or None
        What identifies the bake; None for a cell that is missing or damaged.
    """
    return _meta(folder, cell).get("bake")


def _meta(folder: str | os.PathLike, cell: tuple[int, int]) -> dict:
    """Header fields of a cell whose files are all there and undamaged; none of another."""
    try:
        return read_cell(folder, cell).meta
    except (OSError, FileError):
        return {}


def digest_of_cell(cell: Cell) -> str:
    """Digest what a cell's files hold, whatever bake they belong to.

    Parameters
    ----------
    cell : Cell
        The cell.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    state = hashlib.sha256(topology_hash(cell.topology).encode())
    arrays = [cell.offset, cell.valid, cell.planes.planes, cell.planes.plane]
    arrays += [] if cell.planes.fill is None else [cell.planes.fill]
    for name in sorted(cell.payloads):
        table = cell.payloads[name].table
        arrays += [cell.payloads[name].index, *(getattr(table, field.name) for field in dataclasses.fields(table))]
    for array in arrays:
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()[:32]


def copy_cell(source: str | os.PathLike, target: str | os.PathLike, cell: tuple[int, int], bake: str) -> None:
    """Copy a cell as it is into another bake.

    Parameters
    ----------
    source, target : str or Path
        Folders; the cell in the first is whole.
    cell : (2,) int
        World cell (i, j).
    bake : str
        What identifies the other bake.

    Raises
    ------
    FileError
        A file is damaged.
    OSError
        A file cannot be read or written.
    """
    tree = container.read(cell_path(source, cell, TREE), TREE)
    listed = {}
    for name in tree.meta["files"]:
        file, path = container.read(cell_path(source, cell, name)), cell_path(target, cell, name)
        container.write(path, file.kind, file.arrays, {**file.meta, "bake": bake}, file.units)
        listed[name] = describe_file(path)
    header = {**tree.meta, "bake": bake, "files": listed}
    container.write(cell_path(target, cell, TREE), TREE, tree.arrays, header, tree.units)


def describe_file(path: Path) -> dict:
    """Describe a file, so that another one can vouch for it.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    dict
        Name, length [bytes] and SHA-256.

    Raises
    ------
    OSError
        When the file cannot be read.
    """
    content = path.read_bytes()
    return {"name": path.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _ints(numbers: list) -> tuple[int, ...]:
    """Whole numbers of a header."""
    if not isinstance(numbers, list) or any(type(number) is not int for number in numbers):
        raise ValueError(f"{numbers!r} are not whole numbers")
    return tuple(numbers)


def _check_belongs(path: Path, meta: dict, own: dict) -> None:
    """Refuse a file of another bake, cell or tree."""
    for key, value in own.items():
        if meta.get(key) != value:
            reason = f"its {key} is {meta.get(key)!r}, the tree's is {value!r}: the files do not belong together"
            raise FileError(path, container.PREFIX_BYTES, reason)


def _read_planes(path: Path, file: container.Container, valid: np.ndarray) -> CellPlanes:
    """The planes of a file of data points; those without a data point have none."""
    if "planes" not in file.arrays or "plane" not in file.arrays:
        raise FileError(path, container.PREFIX_BYTES, "the data points have no occluding planes")
    arrays = file.arrays
    planes = CellPlanes(arrays["planes"], arrays["plane"], file.meta.get("shade"), arrays.get("fill"))
    reason = planes_defect(planes, len(valid))
    if not reason and (planes.planes[~valid] != NONE).any():
        reason = "a voxel without a data point has occluding planes"
    if reason:
        raise FileError(path, container.PREFIX_BYTES, reason)
    return planes


def _check_cell(
    topology: Topology, payloads: dict[str, np.ndarray], valid: np.ndarray, offsets: np.ndarray, planes: CellPlanes
) -> None:
    """Refuse what a reader would refuse, before anything is written."""
    defect = validate.first_defect(topology)
    if defect:
        raise ValueError(f"cell {topology.cell}: {defect}")
    unknown = set(payloads) - set(PAYLOADS)
    if unknown:
        raise ValueError(f"unknown payloads {sorted(unknown)}; a cell has {', '.join(PAYLOADS)}")
    size = topology.size
    if valid.shape != (size,) or valid.dtype != bool or offsets.shape != (size, 3) or offsets.dtype != np.int8:
        raise ValueError(
            f"valid is {valid.dtype} {valid.shape}, offsets {offsets.dtype} {offsets.shape}; size is {size}"
        )
    reason = planes_defect(planes, size)
    if reason:
        raise ValueError(f"cell {topology.cell}: {reason}")
    for name, values in payloads.items():
        if len(values) != size:
            raise ValueError(f"payload {name} has {len(values)} rows; the tree has {size} voxels")
