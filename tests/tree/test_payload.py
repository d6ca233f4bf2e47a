"""Payload compression: the stated bound holds, distinct entries are kept once, damage is refused."""

import numpy as np
import pytest
from gi_volumes.tree import container, payload
from hypothesis import given, settings
from hypothesis import strategies as st


def random_values(count, functions=1, seed=0, exponents=(-3, 3)):
    rng = np.random.default_rng(seed)
    magnitude = 10.0 ** rng.uniform(*exponents, (count, functions, 9, 3))
    return (rng.normal(size=magnitude.shape) * magnitude).astype(np.float32)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32), low=st.integers(-36, 36), span=st.integers(0, 30))
def test_every_value_is_within_the_stated_bound(seed, low, span):
    values = random_values(50, 2, seed, (low, min(low + span, 37)))
    got = payload.quantize(values, np.ones(50, bool))
    bound = np.maximum(payload.RELATIVE_ERROR * np.abs(values.astype(np.float64)), got.absolute_error)
    error = np.abs(got.values().astype(np.float64) - values)
    float32_rounding = 2.0**-149
    assert (error <= bound + float32_rounding).all()


def test_a_tighter_bound_would_be_broken():
    """The bound is no larger than it has to be: half of it fails."""
    values = random_values(500)
    got = payload.quantize(values, np.ones(500, bool))
    error = np.abs(got.values().astype(np.float64) - values)
    assert (error > 0.5 * payload.RELATIVE_ERROR * np.abs(values)).any()


def test_equal_entries_are_stored_once_in_the_order_of_first_use():
    values = random_values(3)[[2, 0, 2, 1, 0]]
    valid = np.array([True, True, True, False, True])
    got = payload.quantize(values, valid)
    assert got.index.tolist() == [0, 1, 0, payload.NO_DATA, 1]
    assert len(got.table) == 2
    assert not got.values()[3].any()


def test_negative_zero_and_zero_are_one_entry():
    values = np.zeros((2, 1, 9, 3), np.float32)
    values[1] = -0.0
    assert len(payload.quantize(values, np.ones(2, bool)).table) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_by_data_point(bad):
    values, valid = random_values(4), np.array([True, False, True, True])
    values[1] = bad
    payload.quantize(values, valid)
    values[2, 0, 3, 1] = bad
    with pytest.raises(ValueError, match="sun: the value of data point 2 is not finite"):
        payload.quantize(values, valid, "sun")


def test_all_zeros_and_no_valid_points_are_no_error():
    values = np.zeros((3, 1, 9, 3), np.float32)
    assert not payload.quantize(values, np.ones(3, bool)).values().any()
    assert (payload.quantize(values, np.zeros(3, bool)).index == payload.NO_DATA).all()
    assert payload.quantize(values[:0], np.zeros(0, bool)).values().shape == (0, 1, 9, 3)


def test_the_largest_cell_fits_and_one_more_entry_is_refused():
    values = np.zeros((65_536, 1, 9, 3), np.float32)
    values[:, 0, 0, 0] = np.arange(65_536) % 2048
    values[:, 0, 0, 1] = np.arange(65_536) // 2048
    assert len(payload.quantize(values[:65_535], np.ones(65_535, bool)).table) == 65_535
    with pytest.raises(ValueError, match="65536 distinct entries"):
        payload.quantize(values, np.ones(65_536, bool))


@pytest.mark.parametrize("shape", [(4, 9, 3), (4, 1, 9), (4, 1, 3, 9), (5, 1, 9, 3)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="needed"):
        payload.quantize(np.zeros(shape, np.float32), np.ones(4, bool))


def test_a_file_holds_the_payload_and_its_bounds(tmp_path):
    values, valid = random_values(20, 3), np.arange(20) % 4 > 0
    payload.write_payload(tmp_path / "a", "sun", values, valid, {"bake": "x"}, "1")
    got, meta = payload.read_payload(tmp_path / "a")
    np.testing.assert_array_equal(got.values(), payload.quantize(values, valid).values())
    assert meta["relative_error"] == 2.0**-11
    assert meta["absolute_error"] == got.absolute_error
    assert (meta["name"], meta["bake"]) == ("sun", "x")


GOOD = {"index": np.array([0, 65535], np.uint16), "table": np.ones((1, 1, 9, 3), np.float16)}


@pytest.mark.parametrize(
    ("arrays", "exponent", "what"),
    [
        (GOOD | {"index": np.array([0, 1], np.uint16)}, 0, "points past the table"),
        (GOOD | {"index": np.array([0, 1], np.int32)}, 0, "uint16"),
        (GOOD | {"table": np.ones((1, 9, 3), np.float16)}, 0, "shape"),
        (GOOD | {"table": np.full((1, 1, 9, 3), np.inf, np.float16)}, 0, "not finite"),
        (GOOD, "0", "whole number"),
        (GOOD, 5000, "whole number"),
        ({"index": GOOD["index"]}, 0, "needs"),
    ],
)
def test_a_sound_container_that_is_no_payload_is_refused(arrays, exponent, what, tmp_path):
    container.write(tmp_path / "a", payload.KIND, arrays, {"exponent": exponent})
    with pytest.raises(container.FileError, match=what):
        payload.read_payload(tmp_path / "a")
