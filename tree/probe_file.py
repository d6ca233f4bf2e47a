"""The file of a bake's reflection probes, `probes.exr`, and its entry in `world.json`.

Comes in: maps. Goes out: an OpenEXR file that any viewer opens, and back. Its parts are named `local.level_0`,
`local.level_1`, ... for each part of radiance and mip level, then `distance`, `normal`, `albedo`. What the pictures
don't say stands in a note, an attribute of the first part, as JSON; `world.json` repeats the note, and vouches for
every byte by a SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np

from . import exr, ggx
from .atomic import write_bytes_atomically
from .container import FileError
from .probe_atlas import SMALLEST_PITCH, Layout
from .probe_maps import ProbeMaps, empty

__all__ = ["PROBES", "describe", "is_ours", "load", "made_of", "read", "write"]

PROBES = "probes.exr"
SURFACES = ("distance", "normal", "albedo")
PART_NAME = re.compile(r"local|sun\.\d+|sky(\.\d+)?")
AGAIN = "bake again"
"""What to do about a file that cannot be used."""

NOTED = 1 << 24
"""Bytes of a file that its note is looked for in: those before its pixels, of a hundred thousand probes."""


def write(folder: str | os.PathLike, maps: ProbeMaps, bake: str, made: str, said: dict | None = None) -> None:
    """Write the file, atomically.

    Parameters
    ----------
    folder : str or Path
        Folder of the bake.
    maps : ProbeMaps
        Any number of probes.
    bake : str
        Hash of the bake.
    made : str
        Hash of what the probes depend on besides.
    said : dict, optional
        What else the note is to hold, as "said"; anything that JSON has.

    Raises
    ------
    OSError
        It cannot be written; an older one stays.
    """
    note = {
        "bake": bake,
        "made": made,
        "pitch": maps.layout.pitch,
        "columns": maps.layout.columns,
        "rows": maps.layout.rows,
        "roughness": ggx.ladder(maps.layout.sizes).tolist(),
        "parts": list(maps.radiance),
        "positions": np.asarray(maps.position, np.float64).tolist(),
        "pinned": [bool(value) for value in maps.pinned],
        "said": said or {},
    }
    images = {f"{name}.level_{k}": level for name, levels in maps.radiance.items() for k, level in enumerate(levels)}
    images |= {name: getattr(maps, name) for name in SURFACES}
    write_bytes_atomically(Path(folder) / PROBES, exr.encode(images, json.dumps(note, sort_keys=True)))


def read(path: str | os.PathLike) -> tuple[ProbeMaps, dict]:
    """Read a file.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    maps : ProbeMaps
        As they were written, bit for bit.
    entry : dict
        As from `describe`.

    Raises
    ------
    FileError
        It is damaged, or no file of probes; the message says where and what to do.
    OSError
        It is missing, or cannot be read.
    """
    data = Path(path).read_bytes()
    images, text = exr.decode(data, path)
    try:
        return _maps_of(images, json.loads(text)), _entry(Path(path), data, json.loads(text))
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        reason = str(error) if type(error) is ValueError else "its note is not what a file of probes has"
        raise FileError(path, 0, f"{reason}; {AGAIN}") from None


def is_ours(path: str | os.PathLike) -> bool:
    """Say whether a file is one of a bake's probes, by its beginning.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    bool
        False for those of other programs, and where the beginning is damaged.
    """
    try:
        with Path(path).open("rb") as file:
            return _is_note(json.loads(exr.note_of(file.read(NOTED), path)))
    except (OSError, ValueError, TypeError, RecursionError):
        return False


def describe(folder: str | os.PathLike) -> dict | None:
    """Say what `world.json` has to say of the probes in a folder.

    Parameters
    ----------
    folder : str or Path
        Folder of a bake.

    Returns
    -------
    dict or None
        The note, and name, length and SHA-256 of the file; None where no file has a note of a bake's probes.
    """
    path = Path(folder) / PROBES
    try:
        data = path.read_bytes()
        note = json.loads(exr.note_of(data, path), parse_constant=_refuse)
        return _entry(path, data, note) if _is_note(note) else None
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def made_of(folder: str | os.PathLike, bake: str) -> str | None:
    """Say what the probes in a folder were made of.

    Parameters
    ----------
    folder : str or Path
        Folder of a bake.
    bake : str
        Its hash.

    Returns
    -------
    str or None
        As given to `write`; None without a whole file of this bake.
    """
    try:
        entry = read(Path(folder) / PROBES)[1]
    except (OSError, FileError):
        return None
    return entry["made"] if entry["bake"] == bake else None


def load(folder: str | os.PathLike, header: dict) -> ProbeMaps:
    """Read the probes of a bake.

    Parameters
    ----------
    folder : str or Path
        Its folder.
    header : dict
        Content of `world.json`.

    Returns
    -------
    ProbeMaps
        Of no probe and no part where the bake has none.

    Raises
    ------
    FileError
        The file is damaged, or another one than `world.json` lists.
    OSError
        It is missing, or cannot be read.
    """
    listed = header.get("probes")
    if listed is None:
        return empty(np.zeros((0, 3)), np.zeros(0, bool), SMALLEST_PITCH, ())
    path = Path(folder) / PROBES
    try:
        maps, entry = read(path)
    except FileNotFoundError:
        raise FileNotFoundError(2, f"world.json lists this file, but it is missing; {AGAIN}", os.fspath(path)) from None
    if entry != listed:
        raise FileError(path, 0, f"this is not the file that world.json lists; {AGAIN}")
    return maps


def _entry(path: Path, data: bytes, note: dict) -> dict:
    """The note and what vouches for the file."""
    file = {"name": path.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return dict(note) | {"file": file}


def _is_note(note: object) -> bool:
    """Whether a note says which bake it belongs to."""
    return isinstance(note, dict) and all(isinstance(note.get(key), str) for key in ("bake", "made"))


def _refuse(constant: str) -> float:
    """`world.json` has no numbers that are none."""
    raise ValueError(f"{constant} is no number")


def _maps_of(images: dict[str, np.ndarray], note: dict) -> ProbeMaps:
    """Maps of a file's images, if note and images fit; the note alone makes nothing large."""
    position, pinned = np.array(note["positions"] or np.zeros((0, 3)), np.float64), np.array(note["pinned"])
    if position.ndim != 2 or position.shape[1] != 3:
        raise ValueError("its note has places that are not three numbers each")
    layout = Layout.of(len(position), note["pitch"])
    if (note["columns"], note["rows"]) != (layout.columns, layout.rows) or not np.isfinite(position).all():
        raise ValueError("its note names other tiles than its probes have, or places that are no numbers")
    if len(pinned) != len(position) or (len(pinned) and pinned.dtype != bool) or not _are_parts(note["parts"]):
        raise ValueError("its note names unknown parts, or is not clear about pinned probes")
    if not (_is_note(note) and isinstance(note["said"], dict)):
        raise ValueError("its note does not say which bake it belongs to")
    radiance = {
        name: tuple(_image(images, f"{name}.level_{level}", layout, level) for level in range(layout.levels))
        for name in note["parts"]
    }
    distance, normal, albedo = (_image(images, name, layout, 0) for name in SURFACES)
    if len(images) != len(radiance) * layout.levels + len(SURFACES):
        raise ValueError("it has parts that probes do not have")
    if np.isnan(distance).any() or (distance < 0).any():
        raise ValueError("part distance holds numbers that are no distances")
    return ProbeMaps(layout, position, pinned.astype(bool), radiance, distance, normal, albedo)


def _are_parts(names: object) -> bool:
    """Whether these name parts of radiance, each once."""
    strings = isinstance(names, list) and all(isinstance(name, str) and PART_NAME.fullmatch(name) for name in names)
    return strings and len(set(names)) == len(names)


def _image(images: dict[str, np.ndarray], name: str, layout: Layout, level: int) -> np.ndarray:
    """One image, if it is there and of the right shape."""
    shape = layout.shape(level) + (() if name == "distance" else (3,))
    found = images.get(name)
    if found is None or found.shape != shape:
        has = "is missing" if found is None else f"has the shape {found.shape}"
        raise ValueError(f"part {name} {has}; {shape} is needed")
    if name != "distance" and not np.isfinite(found).all():
        raise ValueError(f"part {name} holds numbers that are not finite")
    return found
