"""Transform coding: rows of numbers as a few small integers each, in a basis of their own.

Comes in: the values of a payload's data points, K functions of 27 coefficients, and the error that is allowed. Goes
out: for each row an exponent and r coefficients, for all of them one basis of r rows:

    value[i, k, :] = 2**(exponent[i] + gain[k]) * sum over j of coefficient[i, j] * step[j] * basis[j, k, :]

A row is divided by its length (its octave), so dark points are as exact as bright ones. Both factors of the product
are rounded with the steps that share the error out evenly; rows and columns that fall below it are left out.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["COARSEST", "FINEST", "WIDTH", "Coded", "Goal", "encode"]

WIDTH = 27
"""Numbers of each function: 9 harmonics, 3 colours."""
FINEST, COARSEST = 1.0 / 1024, 0.5
"""Errors that may be asked for; below the first, float16 would be smaller."""
STEPS = 2.0 ** (-1 - np.arange(105) / 8)
"""Steps of coefficients that are tried; the last, 2**-14, keeps them within 16 bits."""
ROW_BITS = 16
"""Fraction bits of rows in sums of products: up to 2**14 rows stay below 2**53 and are exact in any order."""
FITTED_ROWS = 1 << 13
"""Most rows that the basis and the steps are fitted to; more are thinned out evenly."""
KEPT = 0.5
"""A direction of the basis is kept where its variance exceeds this times the squared step: below, zstd's least of one
bit for a symbol costs more than it gains. Measured between 1/12 and 0.8, see `docs/accuracy.md`."""
ROUNDING = 0.42
"""Coefficients are rounded down up to this fraction: zeros are cheaper than the error they add."""
FINEST_BASIS = 2.0**-15
"""Finest step of the basis, whose numbers are at most 1 and have 16 bits."""
BYTE = 256
"""A coefficient of 16 bits is stored as two of 8 bits, with the same row of the basis: no second type is needed."""
TABLE_BYTES, TABLE_SHARE = 70, 1 / 8
"""What zstd takes beyond the entropy of a column: at most so many bytes, and this share of the numbers."""
CHUNK = 4096
"""Rows decoded at a time."""


@dataclass(frozen=True)
class Goal:
    """What an encoder aims at.

    Parameters
    ----------
    tolerance : float
        Root mean square, over rows that are not zero, of the error's length relative to the row's.
    spare : float
        A size that nobody minds [bytes a row]: up to it, errors are made smaller than asked for.
    most : float
        A size that is not exceeded for the tolerance's sake [bytes a row]: noise of few samples costs more to keep
        than it is worth.
    """

    tolerance: float
    spare: float = 0.0
    most: float = math.inf


@dataclass(frozen=True)
class Coded:
    """Rows in a basis.

    Parameters
    ----------
    exponent : (n,) int16
        Octave of each row.
    coefficient : (n, r) int8
        What to multiply the rows of the basis with.
    basis : (r, K, 9, 3) int16
        The basis.
    step : (r,) float32
        Unit of the products of coefficients and basis.
    gain : (K,) int8
        Octave of each function: the larger, the less exact it is.
    """

    exponent: np.ndarray
    coefficient: np.ndarray
    basis: np.ndarray
    step: np.ndarray
    gain: np.ndarray

    @property
    def functions(self) -> int:
        """Number of functions K."""
        return self.basis.shape[1]

    def expanded(self) -> np.ndarray:
        """Return the basis in its unit.

        Returns
        -------
        (r, K, 27) float64
            A row with exponent 0 is its coefficients times this.
        """
        basis = self.basis.reshape(len(self.basis), self.functions, WIDTH)
        return basis * self.step.astype(np.float64)[:, None, None] * np.exp2(self.gain.astype(np.float64))[:, None]

    def fold(self, factors: np.ndarray) -> np.ndarray:
        """Sum the functions of each row, by folding the basis first.

        Parameters
        ----------
        factors : (K, 3) float64
            Factor of each function and colour.

        Returns
        -------
        (n, 27) float32
            The sums, within what single precision can hold.
        """
        factors = np.tile(np.asarray(factors, np.float64), (1, WIDTH // 3))
        return self._times(np.einsum("jkw,kw->jw", self.expanded(), factors))

    def values(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Decode rows.

        Parameters
        ----------
        rows : (m,) int or slice
            Which; all if not given.

        Returns
        -------
        (m, K, 9, 3) float32
            Their values.
        """
        flat = self.expanded().reshape(len(self.basis), self.functions * WIDTH)
        return self._times(flat, rows).reshape(-1, self.functions, WIDTH // 3, 3)

    def _times(self, matrix: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """(m, w) float32 product of coefficients and an (r, w) matrix, a chunk at a time."""
        coefficient, scale = self.coefficient[rows], np.exp2(self.exponent[rows].astype(np.float64))
        out, most = np.empty((len(scale), matrix.shape[1]), np.float32), float(np.finfo(np.float32).max)
        for start in range(0, len(out), CHUNK):
            part = slice(start, start + CHUNK)
            out[part] = np.clip(coefficient[part].astype(np.float64) @ matrix * scale[part, None], -most, most)
        return out


def encode(values: np.ndarray, gain: np.ndarray, goal: Goal) -> Coded:
    """Write rows with the coarsest steps that reach a goal.

    Parameters
    ----------
    values : (n, K, 9, 3) float32
        Finite.
    gain : (K,) int8
        Octave of each function: errors count divided by 2**gain.
    goal : Goal
        How exact, and how large.

    Returns
    -------
    Coded
        The rows. Single ones may have a larger error than the goal's.

    Notes
    -----
    Error: `test_the_error_that_was_asked_for_is_kept`. The same input gives the same bytes whatever the number of
    threads: products that decide are sums of whole numbers, exact in any order, and what is not exact is
    rounded coarsely before it is stored; `test_threads_do_not_change_a_byte`.
    Source: reverse water-filling on both factors of a singular value decomposition; Berger 1971, section 4.5. Sloan et
    al. 2003 for transport in a principal basis.
    """
    exponent, rows = _normalized(values, gain)
    few = rows[:: -(-len(rows) // FITTED_ROWS) or 1]
    axes = _principal(few.astype(np.float64))

    def attempt(number: int, of: np.ndarray = few) -> tuple[np.ndarray, ...]:
        return _attempt(of, *axes, STEPS[number], len(rows))

    exact = _first(lambda number: _error(few, *attempt(number)) <= goal.tolerance)
    cheap = _first(lambda number: _size(*attempt(number), len(rows)) > goal.spare) - 1
    dear = _first(lambda number: _size(*attempt(number), len(rows)) > goal.most) - 1 if exact > cheap else cheap
    coefficient, basis, step = attempt(max(min(max(exact, cheap), dear, len(STEPS) - 1), 0), rows)
    exponent[~coefficient.any(axis=1)] = 0
    coefficient, source, step = _bytes_of(coefficient, step)
    return Coded(exponent, coefficient, basis[source].reshape(-1, *values.shape[1:]), step, np.asarray(gain, np.int8))


def _first(is_met: Callable[[int], bool]) -> int:
    """Number of the coarsest step that meets a condition, which all finer ones then do; one past the last if none."""
    return bisect.bisect_left(range(len(STEPS)), True, key=lambda number: bool(is_met(number)))


def _normalized(values: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) int16 octaves of the rows' lengths, (n, 27 K) float32 rows of length 0.5 to 1 as whole numbers / 2**16."""
    exponent = np.zeros(len(values), np.int16)
    rows = np.zeros((len(values), values[:1].size or int(np.prod(values.shape[1:]))), np.float32)
    weight = np.repeat(np.exp2(-np.asarray(gain, np.float64)), WIDTH)
    for start in range(0, len(values), CHUNK):
        part = slice(start, start + CHUNK)
        chunk = values[part].reshape(len(values[part]), -1) * weight
        exponent[part] = np.frexp(np.sqrt((chunk * chunk).sum(axis=1)))[1]
        rows[part] = np.rint(np.ldexp(chunk, ROW_BITS - exponent[part, None].astype(np.int32)))
    return exponent, rows


def _principal(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares along the principal axes, falling, and the axes as columns; by way of the smaller Gram matrix."""
    count, width = rows.shape
    small = count < width
    square, vectors = np.linalg.eigh(rows @ rows.T if small else rows.T @ rows)
    kept = square > max(square.max(initial=0.0), 1.0) * np.finfo(np.float64).eps * max(count, width)
    square, vectors = square[kept][::-1], vectors[:, kept][:, ::-1]
    axes = rows.T @ (vectors / np.sqrt(square)) if small else vectors
    return square / max(count, 1) * 0.25**ROW_BITS, axes


def _attempt(rows: np.ndarray, variance: np.ndarray, axes: np.ndarray, step: float, count: int) -> tuple:
    """Coefficients, basis and steps for one step of the coefficients: a basis row's step is that over its spread."""
    width = rows.shape[1]
    rank = np.count_nonzero(count * variance > KEPT * step * step * max(count, width))
    fine = np.maximum(step / np.sqrt(count * variance[:rank]), FINEST_BASIS)
    most = np.iinfo(np.int16).max
    basis = np.clip(np.rint(axes[:, :rank] / fine), -most, most).T
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], 1) if rank else basis[:, :1]
    basis *= np.where(largest < 0, -1.0, 1.0)
    unit = (step * fine).astype(np.float32)
    dual = np.linalg.pinv((basis * fine[:, None]) @ (basis * fine[:, None]).T, hermitian=True)
    coefficient = np.empty((len(rows), rank), np.int16)
    for start in range(0, len(rows), CHUNK):
        part = slice(start, start + CHUNK)
        exact = (rows[part].astype(np.float64) @ basis.T) * (fine * 0.5**ROW_BITS) @ dual * (fine / unit)
        coefficient[part] = np.sign(exact) * np.floor(np.minimum(np.abs(exact) + ROUNDING, most))
    return coefficient, basis.astype(np.int16), unit


def _bytes_of(coefficient: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n, r) int8 digits of coefficients, the basis row of each, and its step; zero digits left out."""
    high = (coefficient.astype(np.int32) + BYTE // 2) // BYTE
    low = (coefficient - high * BYTE).astype(np.int8)
    coarse, fine = np.flatnonzero(high.any(axis=0)), np.flatnonzero(low.any(axis=0))
    digits = np.concatenate([high[:, coarse].astype(np.int8), low[:, fine]], axis=1)
    source = np.concatenate([coarse, fine])
    return digits, source, np.concatenate([step[coarse] * np.float32(BYTE), step[fine]])


def _size(coefficient: np.ndarray, basis: np.ndarray, step: np.ndarray, count: int) -> float:
    """Estimated bytes on disk for each row: the entropy of the columns, with what zstd takes beyond it."""
    thinned = count / max(len(coefficient), 1)
    tables = min(TABLE_BYTES, TABLE_SHARE * count) + min(TABLE_BYTES, TABLE_SHARE * basis.shape[1])
    return (_entropy(basis) / 8 + _entropy(coefficient.T) / 8 * thinned + tables * len(basis)) / max(count, 1)


def _entropy(rows: np.ndarray) -> float:
    """Bits that the numbers of all rows take when each row has a code of its own."""
    bits = 0.0
    for numbers in rows:
        share = np.bincount(numbers.astype(np.int64) - int(numbers.min(initial=0)))
        share = share[share > 0] / max(len(numbers), 1)
        bits -= len(numbers) * float((share * np.log2(share)).sum())
    return bits


def _error(rows: np.ndarray, coefficient: np.ndarray, basis: np.ndarray, step: np.ndarray) -> float:
    """Root mean square relative error of the rows that are not zero."""
    matrix, total, count = basis * (step.astype(np.float64) * 2.0**ROW_BITS)[:, None], 0.0, 0
    for start in range(0, len(rows), CHUNK):
        exact = rows[start : start + CHUNK].astype(np.float64)
        lost = coefficient[start : start + CHUNK].astype(np.float64) @ matrix - exact
        length = (exact * exact).sum(axis=1)
        count += np.count_nonzero(length)
        total += float(((lost * lost).sum(axis=1) / np.where(length > 0, length, 1.0)).sum())
    return float(np.sqrt(total / max(count, 1)))
