"""Quasi-random numbers that are a function of (seed, point, sample, dimension) alone.

Comes in: a key for each point. Goes out: uniform numbers in [0, 1). Sobol points, scrambled by a random
digital shift for each point and dimension; past the table's dimensions, hashed random numbers. Nothing depends
on threads, chunks or order, so a bake is the same, bit for bit, however it is split.
"""

from __future__ import annotations

import functools

import numpy as np

BITS = 32
"""Binary digits of a Sobol coordinate."""

UNIT = np.float32(2.0**-24)
"""Spacing of the floats made from the upper 24 bits: the largest result, 1 - 2**-24, is below 1."""

_JOE_KUO = (
    "3:1 7:1,3 11:1,3,1 13:1,1,1 19:1,1,3,3 25:1,3,5,13 37:1,1,5,5,17 41:1,1,5,5,5 47:1,1,7,11,19 55:1,1,5,1,1 "
    "59:1,1,1,3,11 61:1,3,5,5,31 67:1,3,3,9,7,49 91:1,1,1,15,21,21 97:1,3,1,13,27,49 103:1,1,1,15,7,5 "
    "109:1,3,1,15,13,25 115:1,1,5,5,19,61 131:1,3,7,11,23,15,103 137:1,3,7,13,13,15,69 143:1,1,3,13,7,35,63 "
    "145:1,3,5,9,1,25,53 157:1,3,1,13,9,35,107 167:1,3,1,5,27,61,31 171:1,1,5,11,19,41,61 185:1,3,5,3,3,13,69 "
    "191:1,1,7,13,1,19,1 193:1,3,7,5,13,19,59 203:1,1,3,9,25,29,41 211:1,3,5,13,23,1,55 213:1,3,7,3,13,59,17 "
    "229:1,3,1,3,5,53,69 239:1,1,5,5,23,33,13 241:1,1,7,7,1,61,123 247:1,1,7,9,13,61,49 253:1,3,3,5,3,55,33 "
    "285:1,3,1,15,31,13,49,245 299:1,3,5,15,31,59,63,97 301:1,3,1,11,11,11,77,249 333:1,3,1,11,27,43,71,9 "
    "351:1,1,7,15,21,11,81,45 355:1,3,7,3,25,31,65,79 357:1,3,1,1,19,11,3,205 361:1,1,5,9,19,21,29,157 "
    "369:1,3,7,11,1,33,89,185 391:1,3,3,3,15,9,79,71 397:1,3,7,11,15,39,119,27 425:1,1,3,1,11,31,97,225 "
    "451:1,1,1,3,23,43,57,177 463:1,3,7,7,17,17,37,71 487:1,3,1,5,27,63,123,213 501:1,1,3,5,11,43,53,133 "
    "529:1,3,5,5,29,17,47,173,479 539:1,3,3,11,3,1,109,9,69 545:1,1,1,5,17,39,23,5,343 557:1,3,1,5,25,15,31,103,499 "
    "563:1,1,1,11,11,17,63,105,183 601:1,1,5,11,9,29,97,231,363 607:1,1,5,15,19,45,41,7,383 617:1,3,7,7,31,19,83,"
    "137,221 623:1,1,1,3,23,15,111,223,83 631:1,1,5,13,31,15,55,25,161 637:1,1,3,13,25,47,39,87,257"
)
"""Primitive polynomial and first direction numbers of dimensions 1..63 (Joe and Kuo 2008, new-joe-kuo-6)."""

DIMENSIONS = 1 + len(_JOE_KUO.split())
"""Dimensions with Sobol points."""


def directions() -> np.ndarray:
    """Direction numbers of every dimension.

    Returns
    -------
    (DIMENSIONS, 32) uint32 ndarray
        Column k is what bit k of the sample's number toggles.

    Notes
    -----
    Source: Bratley and Fox 1988, recurrence (2); Joe and Kuo 2008 for the initial numbers.
    """
    table = np.empty((DIMENSIONS, BITS), np.uint32)
    table[0] = [1 << (BITS - 1 - k) for k in range(BITS)]
    for row, entry in enumerate(_JOE_KUO.split(), start=1):
        polynomial, initial = entry.split(":")
        table[row] = _recur(int(polynomial), [int(value) for value in initial.split(",")])
    return table


def _recur(polynomial: int, initial: list[int]) -> list[int]:
    """Bratley and Fox's recurrence, on numbers already shifted to 32 bits."""
    degree = polynomial.bit_length() - 1
    numbers = [value << (BITS - 1 - k) for k, value in enumerate(initial)]
    for k in range(degree, BITS):
        value = numbers[k - degree] ^ (numbers[k - degree] >> degree)
        for tap in range(1, degree):
            if polynomial >> (degree - tap) & 1:
                value ^= numbers[k - tap]
        numbers.append(value)
    return numbers


@functools.lru_cache(maxsize=16)
def points(first: int, count: int) -> np.ndarray:
    """Unscrambled Sobol points in every dimension.

    Parameters
    ----------
    first : int
        Number of the first point.
    count : int
        How many.

    Returns
    -------
    (DIMENSIONS, count) uint32 ndarray
        Coordinates times 2**32.
    """
    number = np.arange(first, first + count, dtype=np.uint32)
    table = np.zeros((DIMENSIONS, count), np.uint32)
    for bit, column in enumerate(directions().T):
        toggled = (number >> np.uint32(bit)) & np.uint32(1)
        table ^= column[:, None] * toggled
    return table


def scramble(key: np.ndarray, salt: int) -> np.ndarray:
    """Hash 32-bit keys.

    Parameters
    ----------
    key : uint32 ndarray
        What to hash.
    salt : int
        Another 32-bit input, the same for every key.

    Returns
    -------
    uint32 ndarray
        A bijection of `key` for a given salt.

    Notes
    -----
    Source: Wellons 2018, "Prospecting for hash functions", the two-round function lowbias32.
    """
    bits = key ^ np.uint32(salt * 0x9E3779B9 & 0xFFFFFFFF)
    bits = (bits ^ (bits >> np.uint32(16))) * np.uint32(0x7FEB352D)
    bits = (bits ^ (bits >> np.uint32(15))) * np.uint32(0x846CA68B)
    return bits ^ (bits >> np.uint32(16))


class Sampler:
    """The random numbers of a tile of points times a block of samples.

    Parameters
    ----------
    keys : (p,) uint32 ndarray
        One key for each point; equal keys give equal numbers.
    first : int
        Number of the block's first sample.
    count : int
        Samples in the block.

    Notes
    -----
    Error: some pairs of high dimensions are poorly stratified at a few hundred samples. Padded two-dimensional nets
    (Burley 2020), where every pair is good, were 2 to 20 % noisier at 64 to 1,024 paths in rooms and courts.
    """

    def __init__(self, keys: np.ndarray, first: int, count: int) -> None:
        self._keys = keys
        self._first = first
        self._table = points(first, count)

    def uniform(self, point: np.ndarray, sample: np.ndarray, dimension: int) -> np.ndarray:
        """One number for each lane.

        Parameters
        ----------
        point : (n,) int64 ndarray
            Row of the point's key.
        sample : (n,) int64 ndarray
            Number of the sample within the block.
        dimension : int
            Which coordinate; any non-negative number.

        Returns
        -------
        (n,) float32 ndarray
            Uniform in [0, 1), 24 bits.
        """
        shift = scramble(self._keys, dimension + 1)[point]
        if dimension < DIMENSIONS:
            bits = self._table[dimension][sample] ^ shift
        else:
            number = (sample + self._first).astype(np.uint32)
            bits = scramble(number ^ shift, dimension)
        return (bits >> np.uint32(8)).astype(np.float32) * UNIT
