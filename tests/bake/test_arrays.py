"""Files of points and normals: what is read, and that nothing else is taken or executed."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from command_line import QUICK, Points, call, ground_points, stored, succeed, yard


@pytest.fixture(scope="module")
def level(tmp_path_factory) -> Path:
    return stored(tmp_path_factory.mktemp("level"), yard())


@pytest.fixture(scope="module")
def baked(level) -> Path:
    succeed("bake", level, "-o", level.parent / "baked", *QUICK)
    return level.parent / "baked"


def test_no_points_give_no_rows(baked, level, tmp_path):
    nowhere = Points(tmp_path, np.zeros((0, 3)), np.zeros((0, 3)))
    assert nowhere.ask("query", baked).shape == (0, 3)
    assert nowhere.ask("reference", level).shape == (0, 3)


@pytest.mark.parametrize("kind", ["f2", ">f8", "i4", "fortran"])
def test_points_may_be_numbers_of_any_kind(baked, tmp_path, kind):
    rows = np.array([[4, 5, 1], [9, 9, 1]], float)
    there = np.asfortranarray(rows) if kind == "fortran" else rows.astype(kind)
    expected = Points(tmp_path, rows, np.tile([0, 0, 1.0], (2, 1))).ask("query", baked)
    up = np.tile([0, 0, 1e-200], (2, 1))
    assert np.array_equal(Points(tmp_path, there, up).ask("query", baked), expected)


class Bomb:
    """A pickle that leaves a trace when it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def npy(header: bytes) -> bytes:
    """A .npy file of one header and no data."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def bad_arrays(trace: Path) -> dict[str, object]:
    rows = np.ones((2, 3))
    return {
        "objects": np.array([[Bomb(trace)] * 3], object),
        "a pickle": pickle.dumps(Bomb(trace)),
        "one row": rows[0],
        "two columns": rows[:, :2],
        "complex": rows.astype(complex),
        "text": rows.astype(str),
        "truth values": rows > 0,
        "records": np.zeros((2, 3), [("x", float)]),
        "NaN": rows * np.nan,
        "infinity": rows * np.inf,
        "an empty file": b"",
        "an end within the magic": b"\x93NUM",
        "an end within the data": npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }\n") + bytes(40),
        "more rows than bytes": npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }\n"),
        "negative rows": npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }\n"),
        "a header that is no Python": npy(b"(" * 500 + b"\n"),
        "a header that is a call": npy(b"exit(7)\n"),
    }


@pytest.mark.parametrize("what", bad_arrays(Path()))
def test_an_array_of_anything_else_is_refused_and_executes_nothing(baked, tmp_path, what):
    made = bad_arrays(tmp_path / "trace")[what]
    asked = Points(tmp_path, *ground_points(2))
    if isinstance(made, bytes):
        (tmp_path / "points.npy").write_bytes(made)
    else:
        np.save(tmp_path / "points.npy", made, allow_pickle=True)
    assert call("query", baked, *asked.words).reason.startswith(f"{tmp_path / 'points.npy'}: ")
    assert not (tmp_path / "trace").exists()
    assert not (tmp_path / "found.npy").exists()


def test_normals_without_length_and_unequal_numbers_are_refused(baked, tmp_path):
    assert "points nowhere" in call("query", baked, *Points(tmp_path, np.ones((2, 3)), np.zeros((2, 3))).words).reason
    assert "2 rows and" in call("query", baked, *Points(tmp_path, np.ones((2, 3)), np.ones((3, 3))).words).reason
