"""Which probes show what is mirrored around a voxel: a 16-bit index per voxel into a table of distinct entries.

Comes in: a few probes and weights for each voxel with a data point. Goes out: a record, and a file of kind "probes".
An entry has the same few slots for all; those with a weight come first, the heaviest first, and of equals the probe
with the lower number. What is left of them is probe 0 with weight 0. Weights are bytes that sum to 255, or to 0 where
no probe shows anything. As a tree has at most 65,535 voxels, its entries can always be numbered.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from . import container
from .container import FileError
from .payload import NO_DATA, distinct

__all__ = ["KIND", "MOST_PROBES", "WHOLE", "ProbeSets", "defect", "encode", "read_sets", "write_sets"]

KIND = "probes"
VERSION = 1
WHOLE = 255
"""Sum of an entry's weights."""
MOST_PROBES = 1 << 16
"""Probes that 16 bits can number."""
MOST_SLOTS = 8
"""Slots of an entry; a bake uses half of them."""
ARRAYS = {"index": (np.uint16, 1), "probe": (np.uint16, 2), "weight": (np.uint8, 2)}
"""Type and number of axes of a file's arrays."""


@dataclass(frozen=True, eq=False)
class ProbeSets:
    """Probes and weights over the index space of a tree.

    index : (size,) uint16, row of the table; `payload.NO_DATA` where a voxel has no data point
    probe : (m, slots) uint16, numbers of probes
    weight : (m, slots) uint8, sums to `WHOLE`, or to 0
    """

    index: np.ndarray
    probe: np.ndarray
    weight: np.ndarray


def encode(probe: np.ndarray, weight: np.ndarray, valid: np.ndarray) -> ProbeSets:
    """Round weights, and keep each distinct entry once, in the order of first use.

    Parameters
    ----------
    probe : (size, slots) int64 ndarray
        Numbers of probes, different ones where weights are above 0.
    weight : (size, slots) float ndarray
        0 or more, in any unit; all 0 where no probe shows anything.
    valid : (size,) bool ndarray
        Which voxels have a data point.

    Returns
    -------
    ProbeSets
        Of each voxel the weights, divided by their sum, to 1/255.

    Raises
    ------
    ValueError
        A weight is negative or not finite; a probe's number takes more than 16 bits.
    """
    probe, weight = np.asarray(probe)[valid], np.asarray(weight, np.float64)[valid]
    if not (np.isfinite(weight).all() and (weight >= 0).all()):
        raise ValueError("a weight of a probe is negative or not finite")
    if probe.size and not (probe.min() >= 0 and probe.max() < MOST_PROBES):
        raise ValueError(f"probes {probe.min()} to {probe.max()}; 16 bits number {MOST_PROBES}")
    probe, weight = _in_order(*_rounded(*_in_order(probe, weight)))
    first, rank = distinct(np.concatenate([probe, weight.astype(np.uint16)], axis=1))
    index = np.full(len(valid), NO_DATA, np.uint16)
    index[valid] = rank
    return ProbeSets(index, probe[first], weight[first])


def _rounded(probe: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probes, and uint8 weights that sum to `WHOLE`; what rounding down leaves goes to the largest remainders."""
    total = weight.sum(axis=1, keepdims=True)
    exact = WHOLE * weight / np.where(total > 0, total, 1)
    floor = np.floor(exact)
    missing = np.where(total > 0, WHOLE, 0) - floor.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(floor - exact, axis=1, kind="stable"), axis=1, kind="stable")
    return probe, (floor + (rank < missing)).astype(np.uint8)


def _in_order(probe: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entries in the one order in which they are stored."""
    probe = np.where(weight > 0, probe, 0).astype(np.uint16)
    order = np.lexsort((probe, -weight.astype(np.float64)), axis=1)
    return np.take_along_axis(probe, order, 1), np.take_along_axis(weight, order, 1)


def defect(sets: ProbeSets, probes: int, valid: np.ndarray) -> str | None:
    """Name what is wrong with entries.

    Parameters
    ----------
    sets : ProbeSets
        Of a tree, as from a file.
    probes : int
        How many probes there are.
    valid : (size,) bool ndarray
        Which of the tree's voxels have a data point.

    Returns
    -------
    str or None
        A sentence; None for sound entries.
    """
    if not np.array_equal(sets.index != NO_DATA, valid):
        return "it has entries for other voxels than those with a data point"
    past = int(sets.index[valid].max(initial=0))
    if past >= len(sets.probe) and valid.any():
        return f"an index of {past} points past the table's {len(sets.probe)} entries"
    for broken, what in _broken(sets, probes):
        if broken.any():
            return f"entry {int(np.argmax(broken))} {what}"
    return None


def _broken(sets: ProbeSets, probes: int) -> Iterator[tuple[np.ndarray, str]]:
    """Which entries break each rule, and how."""
    total, used = sets.weight.sum(axis=1, dtype=np.int64), sets.weight > 0
    yield (total != 0) & (total != WHOLE), f"has weights that sum neither to {WHOLE} nor to 0"
    yield ((sets.probe >= probes) & used).any(axis=1), f"names a probe beyond the {probes} that there are"
    probe, weight = _in_order(sets.probe, sets.weight)
    yield ((probe != sets.probe) | (weight != sets.weight)).any(axis=1), "is not in the order of its weights"
    number = np.sort(np.where(used, sets.probe.astype(np.int64), -1 - np.arange(used.shape[1])), axis=1)
    yield (np.diff(number, axis=1) == 0).any(axis=1), "names a probe twice"


def write_sets(path: str | os.PathLike, sets: ProbeSets, meta: dict) -> int:
    """Write a tree's entries as a file.

    Parameters
    ----------
    path : str or Path
        The file.
    sets : ProbeSets
        The entries.
    meta : dict
        More header fields.

    Returns
    -------
    int
        Length of the file [bytes].

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    arrays = {"index": sets.index, "probe": sets.probe, "weight": sets.weight}
    return container.write(path, KIND, arrays, {**meta, "version": VERSION}, {"weight": f"1 / {WHOLE}"})


def read_sets(path: str | os.PathLike, probes: int, valid: np.ndarray) -> tuple[ProbeSets, dict]:
    """Read a tree's entries, and check that they are sound.

    Parameters
    ----------
    path : str or Path
        The file.
    probes : int
        How many probes there are.
    valid : (size,) bool ndarray
        Which of the tree's voxels have a data point.

    Returns
    -------
    sets : ProbeSets
        The entries.
    meta : dict
        The file's header.

    Raises
    ------
    FileError
        For a damaged file, or one whose entries are not sound.
    OSError
        When the file cannot be read.
    """
    file = container.read(path, KIND)
    reason = _form_defect(file.arrays, file.meta)
    if reason is None:
        sets = ProbeSets(*(file.arrays[name] for name in ARRAYS))
        reason = defect(sets, probes, valid)
    if reason:
        raise FileError(path, container.PREFIX_BYTES, reason)
    return sets, file.meta


def _form_defect(arrays: dict[str, np.ndarray], meta: dict) -> str | None:
    """Name what keeps arrays from being entries at all."""
    if type(meta.get("version")) is not int or meta["version"] != VERSION:
        return f"probes of version {meta.get('version')!r}; this program reads version {VERSION}"
    if set(arrays) != set(ARRAYS) or any((arrays[k].dtype, arrays[k].ndim) != v for k, v in ARRAYS.items()):
        return "the probes of voxels need " + ", ".join(
            f"{k} ({np.dtype(t)}, {n} axes)" for k, (t, n) in ARRAYS.items()
        )
    probe, weight = arrays["probe"].shape, arrays["weight"].shape
    if probe != weight or not 1 <= probe[1] <= MOST_SLOTS:
        return f"probes of shape {probe} and weights of shape {weight}; both have 1 to {MOST_SLOTS} columns"
    return None
