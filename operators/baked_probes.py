"""The reflection probes that a bake's folder lists, for those who show them.

Comes in: the folder. Goes out: places and sizes from `world.json`, which is read again only when it has changed, as
panels ask whenever they are drawn.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Pairs of places whose distances are worked out at once: 25 MB.
PAIRS = 1 << 20


@dataclass(frozen=True, eq=False)
class Baked:
    """What a bake says of its probes.

    place : (k, 3) float64 [m], world space, in the order of their use
    reach : (k,) float64 [m], half the distance to the nearest other one; of a single one half a first-level voxel
    pinned : (k,) bool
    made : str, hash of what they were made of; empty without any
    texture_bytes : what they take as textures
    file_bytes : length of their file
    """

    place: np.ndarray
    reach: np.ndarray
    pinned: np.ndarray
    made: str
    texture_bytes: int
    file_bytes: int


def read(folder: Path) -> Baked | None:
    """Read what a bake says of its probes.

    Parameters
    ----------
    folder : Path
        The bake's folder.

    Returns
    -------
    Baked or None
        Of no place where the bake has no probes; None without a bake.

    Raises
    ------
    ValueError
        `world.json` is damaged, or another program's.
    OSError
        It cannot be read.
    """
    try:
        stat = (folder / "world.json").stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return _read(folder, stat.st_mtime_ns, stat.st_size)


def reaches(place: np.ndarray, alone: float) -> np.ndarray:
    """Return half of each place's distance to the nearest other one.

    Parameters
    ----------
    place : (k, 3) float64 [m]
        Places.
    alone : float [m]
        For a place without another one.

    Returns
    -------
    (k,) float64 ndarray [m]
        More than 0: places that coincide don't count for each other.

    Examples
    --------
    >>> reaches(np.array([[0.0, 0, 0], [0, 0, 2], [0, 0, 2]]), 4.0).tolist()
    [1.0, 1.0, 1.0]
    """
    found = np.full(len(place), np.inf)
    step = max(PAIRS // max(len(place), 1), 1)
    for start in range(0, len(place), step):
        apart = np.linalg.norm(place[start : start + step, None] - place, axis=2)
        found[start : start + step] = np.where(apart > 0, apart, np.inf).min(axis=1, initial=np.inf) / 2
    return np.where(np.isfinite(found), found, alone)


@functools.lru_cache(maxsize=4)
def _read(folder: Path, time_ns: int, size: int) -> Baked:
    """As `read`; time and size say which state of the file is meant."""
    # Imported here, since without the libraries the extension must still start.
    from ..bake.probe_job import probe_bytes
    from ..tree import folder as bakes

    header = bakes.load_header(folder)
    nothing = {"positions": [], "pinned": [], "made": "", "parts": [], "pitch": 0, "file": {"bytes": 0}}
    try:
        return _of(header.get("probes", nothing), bakes.grid_of(header).first_size / 2, probe_bytes)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{folder / 'world.json'}: it does not say where the probes are; bake again") from error


def _of(listed: dict, alone: float, probe_bytes: Callable[[int, int], int]) -> Baked:
    """What an entry of `world.json` says; `probe_bytes` knows what a probe of a pitch and parts takes."""
    place = np.array(listed["positions"], np.float64).reshape(-1, 3)
    each = probe_bytes(listed["pitch"], len(listed["parts"])) if len(place) else 0
    pinned, file_bytes = np.array(listed["pinned"], bool), listed["file"]["bytes"]
    return Baked(place, reaches(place, alone), pinned, listed["made"], len(place) * each, file_bytes)
