"""Compresses the values of a payload: a 16-bit index per voxel into a table of distinct entries.

Comes in: irradiance coefficients of each data point. Goes out: a record, and a file of kind "payload". An entry is
an exponent and a few 8-bit coefficients in a basis that the table's entries share (`transform`): one entry, or all of
them for one sun and one sky, can be read without unpacking the others, in memory and on the GPU.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np

from . import container, transform
from .transform import Coded, Goal

__all__ = [
    "ABSOLUTE_ERROR",
    "GOALS",
    "KIND",
    "NO_DATA",
    "Payload",
    "distinct",
    "encode",
    "read_payload",
    "write_payload",
]

KIND = "payload"
VERSION = 2
NO_DATA = 0xFFFF
"""Index of a voxel without data."""
GOALS = {"local": Goal(0.005, 8, 9), "sun": Goal(0.01, 8, 53), "sky": Goal(0.01, 8, 25)}
"""Root mean square relative errors of entries, and the bytes of an entry that may be spent on them: all three stay
within 100 bytes of a data point, shared out so that another byte would help each as much; `docs/accuracy.md`."""
SKY_GAIN = (0, 1, 1, 1, 2, 2, 2, 2, 2)
"""Octaves by which the response to a sky's harmonic may be less exact: skies have half as much of the order 1 as of the
order 0, and a quarter of the order 2."""
ABSOLUTE_ERROR = 2.0**-140
"""Added to the relative bound: values near the end of single precision are rounded to 2**-149."""
MARGIN = 1e-6
"""Relative; more than the decoders' rounding."""
MOST_FUNCTIONS = 64
MOST_EXPONENT, MOST_GAIN = 200, 8
"""Octaves beyond what float32 values can need are damage."""
MOST_STEP = 1e3
UNIT_STEP = "1"


@dataclass(frozen=True)
class Payload:
    """Values of one payload over the index space of a tree.

    Parameters
    ----------
    index : (size,) uint16
        Row of the table, or `NO_DATA`.
    table : Coded
        Distinct entries: K functions, 9 coefficients, linear Rec.709.
    relative_error : float
        Bound of each entry: the length of its error relative to its own, functions divided by 2**gain. To it
        comes `ABSOLUTE_ERROR`.
    """

    index: np.ndarray
    table: Coded
    relative_error: float

    @property
    def functions(self) -> int:
        """Number of functions K."""
        return self.table.functions

    def values(self) -> np.ndarray:
        """Unpack all values.

        Returns
        -------
        (size, K, 9, 3) float32
            Zeros where there is no data.
        """
        values = np.zeros((len(self.index), self.functions, 9, 3), np.float32)
        known = self.index != NO_DATA
        values[known] = self.table.values()[self.index[known]]
        return values

    def fold(self, factors: np.ndarray) -> np.ndarray:
        """Sum the functions of each entry of the table.

        Parameters
        ----------
        factors : (K, 3) float64
            Factor of each function and colour.

        Returns
        -------
        (entries, 9, 3) float32
            Irradiance coefficients, within what single precision can hold.
        """
        return self.table.fold(factors).reshape(-1, 9, 3)


def encode(values: np.ndarray, valid: np.ndarray, goal: Goal, name: str = "payload") -> Payload:
    """Compress values and keep each distinct entry once, in the order of first use.

    Parameters
    ----------
    values : (size, K, 9, 3) float32
        Irradiance coefficients; rows that are not valid are ignored.
    valid : (size,) bool
        Which voxels have data.
    goal : Goal
        How exact, and how large; the tolerance is 1/1024 to 1/2.
    name : str
        What the values are, for messages; of "sky", the functions count by what skies have of them.

    Returns
    -------
    Payload
        The record. Its bound is measured; single entries may exceed the tolerance, but not the bound.

    Raises
    ------
    ValueError
        For a wrong shape, a tolerance out of range, a valid value that is not finite, more entries than 16 bits
        can number.

    Notes
    -----
    Error: `relative_error`; `test_every_entry_is_within_the_stated_bound`.
    Source: the talk's index-based compression, row 8.
    """
    values, valid = np.asarray(values), np.asarray(valid, bool)
    _check(values, valid, goal.tolerance, name)
    kept = values[valid].astype(np.float32)
    gain = np.array(SKY_GAIN if (name, values.shape[1]) == ("sky", len(SKY_GAIN)) else [0] * values.shape[1], np.int8)
    coded = transform.encode(kept, gain, goal)
    first, rank = distinct(np.concatenate([coded.exponent[:, None], coded.coefficient], axis=1))
    if len(first) > NO_DATA:
        raise ValueError(f"{name}: {len(first)} distinct entries; 16 bits number at most {NO_DATA}")
    index = np.full(len(values), NO_DATA, np.uint16)
    index[valid] = rank
    table = Coded(coded.exponent[first], coded.coefficient[first], coded.basis, coded.step, gain)
    return Payload(index, table, _bound(kept, rank, table))


def write_payload(
    path: str | os.PathLike, name: str, values: np.ndarray, valid: np.ndarray, meta: dict, unit: str = "W/m2"
) -> int:
    """Compress values within the payload's tolerance and write them as a file.

    Parameters
    ----------
    path : str or Path
        The file.
    name : str
        Name of the payload; `GOALS` lists them.
    values : (size, K, 9, 3) float32
        As for `encode`.
    valid : (size,) bool
        As for `encode`.
    meta : dict
        More header fields.
    unit : str
        Unit of the values.

    Returns
    -------
    int
        Length of the file [bytes].

    Raises
    ------
    ValueError
        As `encode`.
    OSError
        When the file cannot be written.
    """
    payload = encode(values, valid, GOALS[name], name)
    table = payload.table
    bounds = {"relative_error": payload.relative_error, "absolute_error": ABSOLUTE_ERROR}
    arrays = {"index": payload.index, "exponent": table.exponent, "coefficient": table.coefficient.T}
    arrays |= {"basis": table.basis, "step": table.step, "gain": table.gain}
    return container.write(path, KIND, arrays, {**meta, **bounds, "name": name, "version": VERSION}, {"step": unit})


def read_payload(path: str | os.PathLike) -> tuple[Payload, dict]:
    """Read a payload and check that it is one.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    payload : Payload
        The values.
    meta : dict
        The file's header.

    Raises
    ------
    FileError
        For a damaged file, or one whose arrays are no payload.
    OSError
        When the file cannot be read.
    """
    file = container.read(path, KIND)
    defect = _defect(file.arrays, file.meta)
    if defect:
        raise container.FileError(path, container.PREFIX_BYTES, defect)
    exponent, coefficient, basis, step, gain = (file.arrays[name] for name in list(ARRAYS)[1:])
    table = Coded(exponent, np.ascontiguousarray(coefficient.T), basis, step, gain)
    return Payload(file.arrays["index"], table, float(file.meta["relative_error"])), file.meta


ARRAYS = {
    "index": (np.uint16, 1),
    "exponent": (np.int16, 1),
    "coefficient": (np.int8, 2),
    "basis": (np.int16, 4),
    "step": (np.float32, 1),
    "gain": (np.int8, 1),
}
"""Type and number of axes of a file's arrays."""


def _defect(arrays: dict[str, np.ndarray], meta: dict) -> str | None:
    """Name what keeps arrays from being a payload."""
    if type(meta.get("version")) is not int or meta["version"] != VERSION:
        return f"a payload of version {meta.get('version')!r}; this program reads version {VERSION}"
    if set(arrays) != set(ARRAYS) or any((arrays[k].dtype, arrays[k].ndim) != v for k, v in ARRAYS.items()):
        return "a payload needs " + ", ".join(f"{k} ({np.dtype(t)}, {n} axes)" for k, (t, n) in ARRAYS.items())
    index, exponent, coefficient, basis, step, gain = (arrays[name] for name in ARRAYS)
    rank, count = coefficient.shape
    functions = len(gain)
    if not 1 <= functions <= MOST_FUNCTIONS:
        return f"a payload has 1 to {MOST_FUNCTIONS} functions, not {functions}"
    if basis.shape != (rank, functions, 9, 3) or step.shape != (rank,) or exponent.shape != (count,):
        return f"coefficients of shape {coefficient.shape} do not fit a basis of shape {basis.shape}, " + (
            f"{len(step)} steps, {functions} gains and {len(exponent)} exponents"
        )
    used = index[index != NO_DATA]
    if used.max(initial=0) >= count and len(used):
        return f"an index of {int(used.max())} points past the table's {count} entries"
    return _number_defect(exponent, step, gain, meta.get("relative_error"))


def _number_defect(exponent: np.ndarray, step: np.ndarray, gain: np.ndarray, error: object) -> str | None:
    """Name a number that no encoder writes."""
    if not ((step > 0) & (step <= MOST_STEP)).all():
        return f"a step of the basis is not between 0 and {MOST_STEP:g}"
    for name, octaves, most in (("exponent", exponent, MOST_EXPONENT), ("gain", gain, MOST_GAIN)):
        if np.abs(octaves.astype(np.int64)).max(initial=0) > most:
            return f"a number of the {name} is not within {-most} and {most}"
    if type(error) is not float or not 0 <= error < math.inf:
        return f"the relative error {error!r} is not a number"
    return None


def _check(values: np.ndarray, valid: np.ndarray, tolerance: float, name: str) -> None:
    """Refuse what cannot be compressed."""
    if values.ndim != 4 or values.shape[2:] != (9, 3) or valid.shape != values.shape[:1]:
        raise ValueError(f"{name}: values of shape {values.shape} with {valid.shape} flags; (size, K, 9, 3) is needed")
    if not 1 <= values.shape[1] <= MOST_FUNCTIONS:
        raise ValueError(f"{name}: {values.shape[1]} functions; a payload has 1 to {MOST_FUNCTIONS}")
    if not transform.FINEST <= tolerance <= transform.COARSEST:
        raise ValueError(f"{name}: a tolerance of {tolerance}; {transform.FINEST} to {transform.COARSEST} can be kept")
    finite = np.isfinite(values).all(axis=(1, 2, 3)) | ~valid
    if not finite.all():
        raise ValueError(f"{name}: the value of data point {int(np.argmin(finite))} is not finite")


def _bound(values: np.ndarray, rank: np.ndarray, table: Coded) -> float:
    """Largest relative error of an entry, by decoding every one."""
    weight, worst = np.exp2(-table.gain.astype(np.float64))[:, None, None], 0.0
    for start in range(0, len(values), transform.CHUNK):
        exact = values[start : start + transform.CHUNK].astype(np.float64)
        lost = (table.values(rank[start : start + transform.CHUNK]) - exact) * weight
        length, off = (np.sqrt(np.square(a).sum(axis=(1, 2, 3))) for a in (exact * weight, lost))
        off = np.maximum(off - 0.5 * ABSOLUTE_ERROR, 0.0)
        worst = max(worst, float(np.divide(off, length, out=np.zeros_like(off), where=length > 0).max(initial=0.0)))
    return float(np.float32(worst * (1 + MARGIN) + MARGIN))


def distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find equal rows.

    Parameters
    ----------
    rows : (n, k) ndarray
        Equal where all bytes are.

    Returns
    -------
    first : (m,) int64 ndarray
        First row of each distinct one, in the order of first use.
    rank : (n,) int64 ndarray
        For each row the number of its like in `first`.
    """
    if not len(rows):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order], rank[inverse.reshape(-1)]
