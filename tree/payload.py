"""Compresses the values of a payload: a 16-bit index per voxel into a table of distinct float16 entries.

Comes in: irradiance coefficients of each data point. Goes out: a record, and a file of kind "payload". The table
holds `value / 2**exponent` as float16, with the exponent that puts the largest value just below 2**15: nothing
overflows, and small values keep 11 bits until they are 2**-29 of the largest.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np

from . import container

__all__ = ["KIND", "NO_DATA", "RELATIVE_ERROR", "Payload", "quantize", "read_payload", "write_payload"]

KIND = "payload"
NO_DATA = 0xFFFF
"""Index of a voxel without data."""
RELATIVE_ERROR = 2.0**-11
"""Half a unit in the last place of float16, relative to the value."""
TOP_EXPONENT = 15
"""Stored values stay below 2**15, a factor 2 away from the largest float16."""
SUBNORMAL_ERROR_EXPONENT = -25
"""Half the smallest float16 is 2**-25."""
EXPONENTS = (-900, 900)
"""Exponents beyond what float32 values can need are damage."""


@dataclass(frozen=True)
class Payload:
    """Values of one payload over the index space of a tree.

    Parameters
    ----------
    index : (size,) uint16
        Row of the table, or `NO_DATA`.
    table : (n, K, 9, 3) float16
        Distinct entries: K functions, 9 coefficients, linear Rec.709; times 2**exponent [W/m2 per unit].
    exponent : int
        Binary exponent of the table's unit.
    """

    index: np.ndarray
    table: np.ndarray
    exponent: int

    @property
    def scale(self) -> float:
        """Factor of the table's entries."""
        return 2.0**self.exponent

    @property
    def absolute_error(self) -> float:
        """Bound of the error of values too small for `RELATIVE_ERROR` [the payload's unit]."""
        return 2.0 ** (self.exponent + SUBNORMAL_ERROR_EXPONENT)

    def values(self) -> np.ndarray:
        """Unpack all values.

        Returns
        -------
        (size, K, 9, 3) float32
            Zeros where there is no data.
        """
        values = np.zeros((len(self.index), *self.table.shape[1:]), np.float32)
        known = self.index != NO_DATA
        values[known] = self.table[self.index[known]].astype(np.float64) * self.scale
        return values


def quantize(values: np.ndarray, valid: np.ndarray, name: str = "payload") -> Payload:
    """Round values to float16 and keep each distinct entry once, in the order of first use.

    Parameters
    ----------
    values : (size, K, 9, 3) float32
        Irradiance coefficients; rows that are not valid are ignored.
    valid : (size,) bool
        Which voxels have data.
    name : str
        What the values are, for messages.

    Returns
    -------
    Payload
        The record.

    Raises
    ------
    ValueError
        For a wrong shape, a valid value that is not finite, more entries than 16 bits can number.

    Notes
    -----
    Error: each value is within max(2**-11 |value|, `absolute_error`); `test_every_value_is_within_the_stated_bound`.
    Source: the talk's index-based compression, row 8.
    """
    values, valid = np.asarray(values), np.asarray(valid, bool)
    if values.ndim != 4 or values.shape[2:] != (9, 3) or valid.shape != values.shape[:1]:
        raise ValueError(f"{name}: values of shape {values.shape} with {valid.shape} flags; (size, K, 9, 3) is needed")
    kept = values[valid].astype(np.float64)
    if not np.isfinite(kept).all():
        point = int(np.flatnonzero(valid)[~np.isfinite(kept).all(axis=(1, 2, 3))][0])
        raise ValueError(f"{name}: the value of data point {point} is not finite")
    largest = float(np.abs(kept).max(initial=0.0))
    exponent = math.frexp(largest)[1] - TOP_EXPONENT if largest > 0 else 0
    entries = (kept * 2.0**-exponent).astype(np.float16) + np.float16(0)
    first, rank = _distinct(entries.reshape(len(entries), int(np.prod(entries.shape[1:]))))
    if len(first) > NO_DATA:
        raise ValueError(f"{name}: {len(first)} distinct entries; 16 bits number at most {NO_DATA}")
    index = np.full(len(values), NO_DATA, np.uint16)
    index[valid] = rank
    return Payload(index, entries[first], exponent)


def write_payload(
    path: str | os.PathLike, name: str, values: np.ndarray, valid: np.ndarray, meta: dict, unit: str = "W/m2"
) -> int:
    """Quantise values and write them as a file.

    Parameters
    ----------
    path : str or Path
        The file.
    name : str
        Name of the payload.
    values : (size, K, 9, 3) float32
        As for `quantize`.
    valid : (size,) bool
        As for `quantize`.
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
        As `quantize`.
    OSError
        When the file cannot be written.
    """
    payload = quantize(values, valid, name)
    bounds = {"relative_error": RELATIVE_ERROR, "absolute_error": payload.absolute_error}
    header = {**meta, **bounds, "name": name, "exponent": payload.exponent}
    arrays = {"index": payload.index, "table": payload.table}
    return container.write(path, KIND, arrays, header, {"table": f"2^{payload.exponent} {unit}"})


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
    index, table, exponent = file.arrays.get("index"), file.arrays.get("table"), file.meta.get("exponent")
    defect = _defect(index, table, exponent)
    if defect:
        raise container.FileError(path, container.PREFIX_BYTES, defect)
    return Payload(index, table, exponent), file.meta


def _defect(index: np.ndarray | None, table: np.ndarray | None, exponent: object) -> str | None:
    """Name what keeps arrays from being a payload."""
    if index is None or table is None or index.dtype != np.uint16 or table.dtype != np.float16:
        return "a payload needs a uint16 index and a float16 table"
    if index.ndim != 1 or table.ndim != 4 or table.shape[2:] != (9, 3) or table.shape[1] < 1:
        return f"the index has shape {index.shape} and the table {table.shape}; (size,) and (n, K, 9, 3) are needed"
    if type(exponent) is not int or not EXPONENTS[0] <= exponent <= EXPONENTS[1]:
        return f"the exponent {exponent!r} is not a whole number within {EXPONENTS}"
    used = index[index != NO_DATA]
    if used.max(initial=0) >= len(table) and len(used):
        return f"an index of {int(used.max())} points past the table's {len(table)} entries"
    if not np.isfinite(table).all():
        return "the table holds a value that is not finite"
    return None


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First row of each distinct one, in order of appearance, and for each row the number of its like."""
    if not len(rows):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order], rank[inverse.reshape(-1)]
