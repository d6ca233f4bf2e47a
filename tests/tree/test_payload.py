"""Payloads: the stated bound holds, distinct entries are kept once, random access agrees, damage is refused."""

import numpy as np
import pytest
from gi_volumes.tree import container, payload
from gi_volumes.tree.payload import encode
from gi_volumes.tree.transform import Goal
from gi_volumes.tree.values import Values
from hypothesis import given, settings
from hypothesis import strategies as st

GOAL = Goal(0.02)


def random_values(count, functions=1, seed=0, exponents=(-3, 3)):
    rng = np.random.default_rng(seed)
    magnitude = 10.0 ** rng.uniform(*exponents, (count, 1, 1, 1))
    return (rng.normal(size=(count, functions, 9, 3)) * magnitude).astype(np.float32)


def smooth_values(count, functions, seed=0, rank=4, noise=1e-3):
    """What a room looks like: a few patterns of light, a little noise."""
    rng = np.random.default_rng(seed)
    patterns = rng.normal(size=(rank, functions * 27))
    rows = rng.normal(size=(count, rank)) @ patterns + noise * rng.normal(size=(count, functions * 27))
    return rows.reshape(count, functions, 9, 3).astype(np.float32)


def lengths(rows, gain):
    rows = rows.astype(np.float64) * np.exp2(-gain.astype(np.float64))[:, None, None]
    return np.sqrt(np.square(rows).sum(axis=(1, 2, 3)))


def assert_bound(values, valid, got):
    gain = got.table.gain
    error = lengths(got.values()[valid].astype(np.float64) - values[valid], gain)
    assert (error <= got.relative_error * lengths(values[valid], gain) + payload.ABSOLUTE_ERROR).all()
    assert not got.values()[~valid].any()


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    low=st.integers(-45, 36),
    span=st.integers(0, 80),
    tolerance=st.floats(1 / 1024, 0.5),
    functions=st.sampled_from([1, 2, 9]),
    name=st.sampled_from(["sun", "sky"]),
)
def test_every_entry_is_within_the_stated_bound(seed, low, span, tolerance, functions, name):
    values = random_values(40, functions, seed, (low, min(low + span, 37)))
    valid = np.random.default_rng(seed).random(40) > 0.2
    got = encode(values, valid, Goal(tolerance), name)
    assert np.isfinite(got.values()).all()
    assert_bound(values, valid, got)


def test_a_tighter_bound_would_be_broken():
    """The bound is no larger than it has to be."""
    values = random_values(500)
    got = encode(values, np.ones(500, bool), GOAL)
    error = lengths(got.values().astype(np.float64) - values, got.table.gain)
    assert (error > 0.999 * got.relative_error * lengths(values, got.table.gain)).any()


def test_dark_entries_are_as_exact_as_bright_ones():
    values = smooth_values(400, 4)
    values[::2] *= np.float32(1e-6)
    got = encode(values, np.ones(400, bool), GOAL)
    error = lengths(got.values().astype(np.float64) - values, got.table.gain) / lengths(values, got.table.gain)
    assert np.sqrt(np.square(error[::2]).mean()) < 0.03
    assert np.sqrt(np.square(error[1::2]).mean()) < 0.03


@pytest.mark.parametrize("factor", [1e-30, 1e-18, 1e18, 1e30])
def test_the_unit_of_the_values_does_not_matter(factor):
    values = smooth_values(100, 3)
    valid = np.ones(100, bool)
    scaled = encode((values * factor).astype(np.float32), valid, GOAL)
    assert scaled.relative_error == pytest.approx(encode(values, valid, GOAL).relative_error, rel=0.5)
    assert_bound((values * factor).astype(np.float32), valid, scaled)


@pytest.mark.parametrize("functions", [1, 2, 16, 64])
@pytest.mark.parametrize("count", [1, 2, 3, 30])
def test_few_points_and_many_functions_are_no_special_case(count, functions):
    values = random_values(count, functions)
    got = encode(values, np.ones(count, bool), GOAL)
    assert got.functions == functions
    assert got.relative_error < 0.1
    assert_bound(values, np.ones(count, bool), got)


def test_single_spikes_among_zeros_are_kept():
    values = np.zeros((50, 2, 9, 3), np.float32)
    values[7, 1, 4, 2], values[30, 0, 0, 0] = 1e30, -1e-30
    got = encode(values, np.ones(50, bool), GOAL)
    assert_bound(values, np.ones(50, bool), got)
    assert got.relative_error < 0.1


def test_equal_entries_are_stored_once_in_the_order_of_first_use():
    values = random_values(3)[[2, 0, 2, 1, 0]]
    valid = np.array([True, True, True, False, True])
    got = encode(values, valid, GOAL)
    assert got.index.tolist() == [0, 1, 0, payload.NO_DATA, 1]
    assert len(got.table.exponent) == 2
    assert not got.values()[3].any()


def test_entries_that_differ_by_less_than_the_tolerance_are_merged():
    rng = np.random.default_rng(0)
    values = np.repeat(smooth_values(4, 2), 100, axis=0)
    values = (values * (1 + 1e-4 * rng.normal(size=values.shape))).astype(np.float32)
    got = encode(values, np.ones(400, bool), Goal(0.05))
    assert len(got.table.exponent) < 40
    assert_bound(values, np.ones(400, bool), got)


def test_negative_zero_and_zero_are_one_entry():
    values = np.zeros((2, 1, 9, 3), np.float32)
    values[1] = -0.0
    assert len(encode(values, np.ones(2, bool), GOAL).table.exponent) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_by_data_point(bad):
    values, valid = random_values(4), np.array([True, False, True, True])
    values[1] = bad
    encode(values, valid, GOAL)
    values[2, 0, 3, 1] = bad
    with pytest.raises(ValueError, match="sun: the value of data point 2 is not finite"):
        encode(values, valid, GOAL, "sun")


def test_all_zeros_and_no_valid_points_are_no_error():
    values = np.zeros((3, 1, 9, 3), np.float32)
    assert not encode(values, np.ones(3, bool), GOAL).values().any()
    assert (encode(values, np.zeros(3, bool), GOAL).index == payload.NO_DATA).all()
    assert encode(values[:0], np.zeros(0, bool), GOAL).values().shape == (0, 1, 9, 3)


def test_the_largest_cell_fits_and_one_more_entry_is_refused():
    values = np.zeros((65_536, 1, 9, 3), np.float32)
    angle = np.arange(65_536) / 65_536
    values[:, 0, 0, 0], values[:, 0, 0, 1] = np.cos(angle), np.sin(angle)
    values *= np.exp2(np.arange(65_536) % 64)[:, None, None, None].astype(np.float32)
    values[:, 0, 1, 0] = (np.arange(65_536) // 64 % 64) * np.abs(values[:, 0, 0, 0])
    valid = np.ones(65_535, bool)
    got = encode(values[:65_535], valid, Goal(1 / 1024))
    assert_bound(values[:65_535], valid, got)
    exact = payload.distinct(np.arange(65_536, dtype=np.uint32)[:, None])
    assert len(exact[0]) == 65_536


def test_more_entries_than_16_bits_number_are_refused(monkeypatch):
    monkeypatch.setattr(payload, "NO_DATA", 20)
    with pytest.raises(ValueError, match="sky: 21 distinct entries"):
        encode(random_values(21), np.ones(21, bool), GOAL, "sky")


@pytest.mark.parametrize("shape", [(4, 9, 3), (4, 1, 9), (4, 1, 3, 9), (5, 1, 9, 3), (4, 0, 9, 3), (4, 65, 9, 3)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"needed|functions"):
        encode(np.zeros(shape, np.float32), np.ones(4, bool), GOAL)


@pytest.mark.parametrize("tolerance", [0, 1e-4, 0.6, np.nan, -1])
def test_tolerances_that_cannot_be_kept_are_refused(tolerance):
    with pytest.raises(ValueError, match="tolerance"):
        encode(random_values(4), np.ones(4, bool), Goal(tolerance))


@pytest.mark.parametrize(("name", "functions"), [("sun", 16), ("sky", 9), ("sky", 1), ("local", 1)])
def test_folding_equals_decoding_and_then_summing(name, functions):
    values = smooth_values(300, functions)
    got = encode(values, np.ones(300, bool), payload.GOALS[name], name)
    factors = np.random.default_rng(1).normal(size=(functions, 3)) * 10
    folded = got.fold(factors)
    assert folded.shape == (len(got.table.exponent), 9, 3)
    expected = np.einsum("nkhc,kc->nhc", got.values().astype(np.float64), factors)
    np.testing.assert_allclose(folded[got.index], expected, atol=1e-5 * np.abs(expected).max())


def test_one_entry_is_decoded_without_the_others():
    got = encode(smooth_values(300, 16), np.ones(300, bool), GOAL)
    everything = got.table.values()
    for row in (0, 17, len(everything) - 1):
        np.testing.assert_allclose(got.table.values(np.array([row]))[0], everything[row], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(got.values(), everything[got.index])


def test_folding_what_single_precision_cannot_hold_stays_finite():
    values = random_values(5, 2, exponents=(37, 37))
    assert np.isfinite(encode(values, np.ones(5, bool), GOAL).fold(np.full((2, 3), 1e30))).all()


def test_values_of_cells_are_folded_at_their_places():
    one, other = smooth_values(6, 2, 1), smooth_values(4, 2, 2)
    valid = np.array([True, False, True, True, True, True])
    parts = [encode(one, valid, GOAL), None, encode(other, np.ones(4, bool), GOAL)]
    factors = np.array([[1.0, 2.0, 0.5], [-1.0, 0.0, 3.0]])
    got = Values("sun", parts, np.array([0, 6, 9, 13])).folded(factors)
    assert got.shape == (13, 27)
    assert not got[[1, 6, 7, 8]].any()
    decoded = np.concatenate([parts[0].values(), np.zeros((3, 2, 9, 3)), parts[2].values()])
    np.testing.assert_allclose(got, np.einsum("nkhc,kc->nhc", decoded, factors).reshape(13, 27), atol=1e-4)
    with pytest.raises(ValueError, match="different numbers of functions in their sun"):
        Values("sun", [parts[0], encode(smooth_values(4, 3), np.ones(4, bool), GOAL)], np.array([0, 6, 10]))


def test_a_file_holds_the_payload_and_its_bounds(tmp_path):
    values, valid = random_values(20, 3), np.arange(20) % 4 > 0
    length = payload.write_payload(tmp_path / "a", "sun", values, valid, {"bake": "x"}, "1")
    assert length == (tmp_path / "a").stat().st_size
    got, meta = payload.read_payload(tmp_path / "a")
    expected = encode(values, valid, payload.GOALS["sun"], "sun")
    np.testing.assert_array_equal(got.values(), expected.values())
    assert meta["relative_error"] == got.relative_error == expected.relative_error
    assert meta["absolute_error"] == payload.ABSOLUTE_ERROR
    assert (meta["name"], meta["bake"]) == ("sun", "x")
    assert_bound(values, valid, got)


def test_sun_sky_and_local_light_take_less_than_100_bytes_a_point(tmp_path):
    """Even of pure noise, which nothing compresses: then the error is what gives."""
    count, total = 3000, 0
    for name, functions in (("local", 1), ("sun", 16), ("sky", 9)):
        values = smooth_values(count, functions, rank=200, noise=1.0)
        total += payload.write_payload(tmp_path / name, name, values, np.ones(count, bool), {})
    assert total < 100 * count


def test_a_uniform_cell_is_nearly_free_and_nearly_exact(tmp_path):
    values = np.repeat(random_values(1, 16), 3000, axis=0)
    assert payload.write_payload(tmp_path / "a", "sun", values, np.ones(3000, bool), {}) < 4000
    assert payload.read_payload(tmp_path / "a")[0].relative_error < 0.001


def good():
    return {
        "index": np.array([0, 65535], np.uint16),
        "exponent": np.zeros(1, np.int16),
        "coefficient": np.ones((2, 1), np.int8),
        "basis": np.ones((2, 3, 9, 3), np.int16),
        "step": np.ones(2, np.float32),
        "gain": np.zeros(3, np.int8),
    }


META = {"version": payload.VERSION, "relative_error": 0.1}


def test_the_smallest_payload_is_read(tmp_path):
    container.write(tmp_path / "a", payload.KIND, good(), META)
    assert payload.read_payload(tmp_path / "a")[0].values()[0, 0, 0, 0] == 2


@pytest.mark.parametrize(
    ("arrays", "meta", "what"),
    [
        ({"index": np.array([0, 1], np.uint16)}, {}, "points past the table"),
        ({"index": np.array([0, 1], np.int32)}, {}, "uint16"),
        ({"coefficient": np.ones((2, 1), np.int16)}, {}, "int8"),
        ({"coefficient": np.ones((3, 1), np.int8)}, {}, "do not fit"),
        ({"coefficient": np.ones((2, 2), np.int8)}, {}, "do not fit"),
        ({"exponent": np.zeros((1, 1), np.int16)}, {}, "axes"),
        ({"exponent": np.full(1, 201, np.int16)}, {}, "exponent is not within"),
        ({"exponent": np.full(1, -(2**15), np.int16)}, {}, "exponent is not within"),
        ({"basis": np.ones((2, 3, 9, 4), np.int16)}, {}, "do not fit"),
        ({"basis": np.ones((2, 4, 9, 3), np.int16)}, {}, "do not fit"),
        ({"step": np.ones(3, np.float32)}, {}, "do not fit"),
        ({"step": np.array([1, np.nan], np.float32)}, {}, "step"),
        ({"step": np.array([1, np.inf], np.float32)}, {}, "step"),
        ({"step": np.array([1, 0], np.float32)}, {}, "step"),
        ({"gain": np.array([0, 0, -128], np.int8)}, {}, "gain is not within"),
        ({"gain": np.zeros(0, np.int8)}, {}, "functions"),
        ({"gain": np.zeros(65, np.int8)}, {}, "functions"),
        ({"more": np.zeros(1)}, {}, "needs"),
        ({}, {"version": 1}, "version 1"),
        ({}, {"version": None}, "version None"),
        ({}, {"relative_error": "0"}, "not a number"),
        ({}, {"relative_error": -1}, "not a number"),
        ({}, {"relative_error": 10**400}, "not a number"),
        ({}, {"relative_error": None}, "not a number"),
    ],
)
def test_a_sound_container_that_is_no_payload_is_refused(arrays, meta, what, tmp_path):
    container.write(tmp_path / "a", payload.KIND, good() | arrays, META | meta)
    with pytest.raises(container.FileError, match=what):
        payload.read_payload(tmp_path / "a")


@pytest.mark.parametrize("name", list(good()))
def test_a_payload_that_lacks_an_array_is_refused(name, tmp_path):
    arrays = good()
    del arrays[name]
    container.write(tmp_path / "a", payload.KIND, arrays, META)
    with pytest.raises(container.FileError, match="needs"):
        payload.read_payload(tmp_path / "a")
