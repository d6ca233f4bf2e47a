"""64-bit child masks: the only module that computes with uint64.

Comes in: masks, bit numbers as int64. Goes out: counts and bit numbers as int64, so that no caller mixes signed
and unsigned integers (numpy would turn both into float64).
"""

from __future__ import annotations

import numpy as np

__all__ = ["contains", "pack", "popcount", "rank", "unpack", "zeros"]

_ONE = np.uint64(1)


def zeros(count: int) -> np.ndarray:
    """Return masks without a set bit.

    Parameters
    ----------
    count : int
        Number of masks.

    Returns
    -------
    (count,) uint64
        Zeros.
    """
    return np.zeros(count, np.uint64)


def popcount(mask: np.ndarray) -> np.ndarray:
    """Return the number of set bits.

    Parameters
    ----------
    mask : (n,) uint64
        Masks.

    Returns
    -------
    (n,) int64
        0 to 64.

    Notes
    -----
    Source: Warren, "Hacker's Delight", figure 5-2, used where numpy has no `bitwise_count` (before 2.0).
    """
    mask = np.asarray(mask, np.uint64)
    if hasattr(np, "bitwise_count"):
        return np.bitwise_count(mask).astype(np.int64)
    return _popcount_by_halving(mask)


def _popcount_by_halving(mask: np.ndarray) -> np.ndarray:
    """Sum bits in pairs, nibbles and bytes; the multiplication sums the bytes."""
    pairs, nibbles = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    octets, ones = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
    count = mask - ((mask >> _ONE) & pairs)
    count = (count & nibbles) + ((count >> np.uint64(2)) & nibbles)
    count = (count + (count >> np.uint64(4))) & octets
    return ((count * ones) >> np.uint64(56)).astype(np.int64)


def contains(mask: np.ndarray, bit: np.ndarray) -> np.ndarray:
    """Say whether bits are set.

    Parameters
    ----------
    mask : (n,) uint64
        Masks.
    bit : (n,) int64
        Bit numbers, 0 to 63.

    Returns
    -------
    (n,) bool
        Whether each bit is set in its mask.
    """
    return (np.asarray(mask, np.uint64) >> np.asarray(bit).astype(np.uint64)) & _ONE != 0


def rank(mask: np.ndarray, bit: np.ndarray) -> np.ndarray:
    """Count the set bits below a bit: a child's place in its packed block.

    Parameters
    ----------
    mask : (n,) uint64
        Masks.
    bit : (n,) int64
        Bit numbers, 0 to 63.

    Returns
    -------
    (n,) int64
        0 to 63.
    """
    below = (_ONE << np.asarray(bit).astype(np.uint64)) - _ONE
    return popcount(np.asarray(mask, np.uint64) & below)


def pack(row: np.ndarray, bit: np.ndarray, count: int) -> np.ndarray:
    """Set bits in masks.

    Parameters
    ----------
    row : (n,) int64
        Which mask, below `count`.
    bit : (n,) int64
        Which bit of it, 0 to 63; pairs may repeat.
    count : int
        Number of masks.

    Returns
    -------
    (count,) uint64
        Masks.
    """
    flags = np.zeros((count, 64), np.uint8)
    flags[row, bit] = 1
    return np.packbits(flags, axis=1, bitorder="little").view("<u8").astype(np.uint64).reshape(count)


def unpack(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List set bits.

    Parameters
    ----------
    mask : (n,) uint64
        Masks.

    Returns
    -------
    row, bit : (m,) int64
        Which mask and which bit of it; rows ascend, and bits within a row.
    """
    octets = np.ascontiguousarray(mask, "<u8").view(np.uint8).reshape(-1, 8)
    row, bit = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
    return row.astype(np.int64), bit.astype(np.int64)
