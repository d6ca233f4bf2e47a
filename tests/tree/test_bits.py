"""Masks: every function against Python's own integers."""

import numpy as np
import pytest
from gi_volumes.tree import bits
from hypothesis import given
from hypothesis import strategies as st

masks = st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=20)
EDGES = [0, 1, 2**63, 2**64 - 1, 0x5555555555555555, 2**32, 2**32 - 1]


@given(masks)
def test_popcount_counts_bits(numbers):
    array = np.array(numbers, np.uint64)
    expected = [number.bit_count() for number in numbers]
    assert bits.popcount(array).tolist() == expected
    assert bits._popcount_by_halving(array).tolist() == expected
    assert bits.popcount(array).dtype == np.int64


@pytest.mark.parametrize("number", EDGES)
def test_rank_and_contains_agree_with_python_for_every_bit(number):
    mask, bit = np.full(64, number, np.uint64), np.arange(64)
    assert bits.rank(mask, bit).tolist() == [(number & ((1 << b) - 1)).bit_count() for b in range(64)]
    assert bits.contains(mask, bit).tolist() == [bool(number >> b & 1) for b in range(64)]


@given(masks)
def test_pack_undoes_unpack(numbers):
    array = np.array(numbers, np.uint64)
    row, bit = bits.unpack(array)
    assert (np.diff(row * 64 + bit) > 0).all()
    np.testing.assert_array_equal(bits.pack(row, bit, len(array)), array)


def test_pack_accepts_a_pair_twice():
    assert bits.pack(np.array([1, 1, 1]), np.array([63, 63, 0]), 2).tolist() == [0, 2**63 + 1]
