"""Probes of voxels, as they are stored: rounding, one form of each entry, and all that can be wrong with a file."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.tree import container, probe_sets
from gi_volumes.tree.payload import NO_DATA
from gi_volumes.tree.probe_sets import WHOLE, ProbeSets, defect, encode, read_sets, write_sets

PROBES = 300


def some(count: int = 500, seed: int = 3) -> tuple[ProbeSets, np.ndarray]:
    """Entries of voxels, a tenth of them without a data point, a few without anything seen."""
    generator = np.random.default_rng(seed)
    probe = np.argsort(generator.random((count, PROBES)), axis=1)[:, :4]
    weight = generator.integers(0, 25, (count, 4)) * (generator.random((count, 1)) < 0.9)
    valid = generator.random(count) < 0.9
    return encode(probe, weight, valid), valid


def test_weights_are_kept_to_a_step_and_sum_to_the_whole():
    generator = np.random.default_rng(1)
    weight = generator.random((1000, 4)) ** 4
    sets = encode(np.tile(np.arange(4), (1000, 1)), weight, np.ones(1000, bool))
    stored = np.zeros((1000, 4))
    np.add.at(stored, (np.arange(1000)[:, None], sets.probe[sets.index]), sets.weight[sets.index])
    exact = WHOLE * weight / weight.sum(axis=1, keepdims=True)
    used = stored > 0
    assert (sets.weight.sum(axis=1, dtype=int) == WHOLE).all()
    assert np.abs(stored - exact)[used].max() < 1
    assert exact[~used].max() < 1


def test_an_entry_has_one_form_whatever_order_it_came_in():
    probe = np.array([[5, 9, 2, 7], [9, 5, 7, 2], [9, 5, 1, 1]])
    weight = np.array([[3, 6, 0, 3], [6, 3, 3, 0], [2, 2, 0, 0]])
    sets = encode(probe, weight, np.ones(3, bool))
    assert sets.index.tolist() == [0, 0, 1]
    assert sets.probe.tolist() == [[9, 5, 7, 0], [5, 9, 0, 0]]
    assert sets.weight.tolist() == [[127, 64, 64, 0], [128, 127, 0, 0]]


def test_voxels_that_see_nothing_have_an_entry_without_weights():
    sets = encode(np.zeros((2, 4), int), np.zeros((2, 4)), np.array([True, False]))
    assert sets.index.tolist() == [0, NO_DATA]
    assert not sets.weight.any()
    assert defect(sets, 0, np.array([True, False])) is None


@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf])
def test_weights_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="negative or not finite"):
        encode(np.zeros((1, 4), int), np.array([[1, wrong, 0, 0]]), np.ones(1, bool))


def test_more_probes_than_16_bits_number_are_refused():
    with pytest.raises(ValueError, match="16 bits number 65536"):
        encode(np.array([[65536]]), np.ones((1, 1)), np.ones(1, bool))


def test_a_file_holds_what_was_written(tmp_path):
    sets, valid = some()
    size = write_sets(tmp_path / "cell.probes", sets, {"cell": [0, 1]})
    found, meta = read_sets(tmp_path / "cell.probes", PROBES, valid)
    assert size == (tmp_path / "cell.probes").stat().st_size
    assert meta["cell"] == [0, 1]
    for name in ("index", "probe", "weight"):
        assert np.array_equal(getattr(found, name), getattr(sets, name))
        assert getattr(found, name).dtype == getattr(sets, name).dtype


def changed(sets: ProbeSets, **arrays) -> ProbeSets:
    """Entries with other arrays."""
    return ProbeSets(*(arrays.get(name, getattr(sets, name)) for name in ("index", "probe", "weight")))


def put(array: np.ndarray, place, value) -> np.ndarray:
    """A copy with another number in one place."""
    copy = array.copy()
    copy[place] = value
    return copy


def broken() -> dict[str, tuple[ProbeSets, str]]:
    """One kind of damage each, and what is said of it."""
    sets, valid = some()
    row, first = int(np.argmax((sets.weight > 0).sum(axis=1) == 4)), int(np.argmax(valid))
    probe, weight = sets.probe, sets.weight
    bare = int(np.argmax(weight.sum(axis=1) == 0))
    return {
        "past": (changed(sets, index=put(sets.index, first, len(probe))), "points past the table"),
        "voxels": (changed(sets, index=put(sets.index, first, NO_DATA)), "for other voxels"),
        "sum": (changed(sets, weight=put(weight, (row, 0), weight[row, 0] - 1)), f"entry {row} has weights that sum"),
        "beyond": (changed(sets, probe=put(probe, (row, 0), PROBES)), f"entry {row} names a probe beyond the 300"),
        "order": (changed(sets, weight=put(weight, row, weight[row][::-1])), f"entry {row} is not in the order"),
        "twice": (changed(sets, probe=put(probe, (row, 1), probe[row, 0])), f"entry {row} "),
        "unused": (changed(sets, probe=put(probe, (bare, 0), 7)), f"entry {bare} is not in the order"),
    }


@pytest.mark.parametrize("kind", list(broken()))
def test_a_file_with_unsound_entries_is_refused_with_the_reason(tmp_path, kind):
    sets, reason = broken()[kind]
    path = tmp_path / "cell.probes"
    write_sets(path, sets, {})
    with pytest.raises(container.FileError, match=reason):
        read_sets(path, PROBES, some()[1])


def test_a_probe_that_an_entry_names_twice_is_found():
    sets = ProbeSets(np.zeros(1, np.uint16), np.array([[4, 4]], np.uint16), np.array([[128, 127]], np.uint8))
    assert defect(sets, 9, np.ones(1, bool)) == "entry 0 names a probe twice"


@pytest.mark.parametrize(
    ("arrays", "version", "reason"),
    [
        ({}, 2, "version 2; this program reads version 1"),
        ({"probe": np.zeros((1, 4), np.int32)}, 1, "need index"),
        ({"weight": np.zeros((1, 3), np.uint8)}, 1, "both have 1 to 8 columns"),
        ({"probe": np.zeros((1, 9), np.uint16), "weight": np.zeros((1, 9), np.uint8)}, 1, "both have 1 to 8 columns"),
        ({"extra": np.zeros(1, np.uint8)}, 1, "need index"),
    ],
)
def test_arrays_that_are_no_entries_are_refused(tmp_path, arrays, version, reason):
    whole = {
        "index": np.zeros(1, np.uint16),
        "probe": np.zeros((1, 4), np.uint16),
        "weight": np.zeros((1, 4), np.uint8),
    }
    path = tmp_path / "cell.probes"
    container.write(path, probe_sets.KIND, whole | arrays, {"version": version})
    with pytest.raises(container.FileError, match=reason):
        read_sets(path, 1, np.ones(1, bool))


def test_every_truncation_of_a_file_is_refused(tmp_path):
    sets, valid = some(20)
    path = tmp_path / "cell.probes"
    write_sets(path, sets, {})
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(container.FileError):
            read_sets(path, PROBES, valid)
