"""Transform coding: the error that was asked for, the size that was asked for, the same bytes everywhere."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from gi_volumes.tree import transform
from gi_volumes.tree.transform import Goal


def light(count, functions, seed=0, noise=0.05):
    """Patterns of light whose strengths fall as those of real cells do."""
    rng = np.random.default_rng(seed)
    strength = np.arange(1, 61)[:, None] ** -1.0
    patterns = strength * rng.normal(size=(60, functions * 27))
    rows = rng.normal(size=(count, 60)) @ patterns + noise * rng.normal(size=(count, functions * 27))
    return (rows * 10.0 ** rng.uniform(-3, 3, (count, 1))).reshape(count, functions, 9, 3).astype(np.float32)


def relative_rms(values, coded):
    lost, exact = (a.astype(np.float64).reshape(len(a), -1) for a in (coded.values() - values, values))
    return np.sqrt((np.square(lost).sum(axis=1) / np.square(exact).sum(axis=1)).mean())


@pytest.mark.parametrize("tolerance", [0.5, 0.1, 0.03, 0.01, 1 / 1024])
@pytest.mark.parametrize(("count", "functions"), [(300, 1), (300, 16), (2000, 4)])
def test_the_error_that_was_asked_for_is_kept(count, functions, tolerance):
    values = light(count, functions)
    error = relative_rms(values, transform.encode(values, np.zeros(functions, np.int8), Goal(tolerance)))
    assert error <= tolerance * 1.001
    assert error > tolerance / 2


def test_a_smaller_error_takes_more_bytes():
    values = light(1000, 16)
    ranks = [len(transform.encode(values, np.zeros(16, np.int8), Goal(t)).step) for t in (0.3, 0.1, 0.03, 0.01)]
    assert ranks == sorted(set(ranks))


def test_a_larger_gain_makes_a_function_less_exact_and_the_others_no_worse():
    values = light(1000, 2, noise=0.3)
    coded = transform.encode(values, np.array([0, 3], np.int8), Goal(0.05))
    first, second = (
        relative_rms(values, coded_one) for coded_one in (_Part(coded, values, 0), _Part(coded, values, 1))
    )
    assert first < 0.07
    assert second > 2 * first


class _Part:
    """Decoded values with all but one function exact."""

    def __init__(self, coded, values, function):
        self.decoded = values.copy()
        self.decoded[:, function] = coded.values()[:, function]

    def values(self):
        return self.decoded


def test_noise_does_not_take_more_than_the_size_that_was_set():
    values = light(1500, 16, noise=3.0)
    free = transform.encode(values, np.zeros(16, np.int8), Goal(0.02))
    capped = transform.encode(values, np.zeros(16, np.int8), Goal(0.02, most=30))
    assert free.coefficient.shape[1] > 150
    assert capped.coefficient.shape[1] < 100
    assert relative_rms(values, capped) > 0.05


def test_what_costs_little_is_more_exact_than_asked_for():
    values = np.repeat(light(3, 4), 500, axis=0)
    assert relative_rms(values, transform.encode(values, np.zeros(4, np.int8), Goal(0.1, spare=4))) < 0.001


def test_coefficients_of_more_than_a_byte_are_two_with_the_same_basis():
    values = np.linspace(1, 2, 1000)[:, None, None, None] * np.ones((1, 1, 9, 3), np.float32)
    coded = transform.encode(values.astype(np.float32), np.zeros(1, np.int8), Goal(1 / 1024))
    assert coded.coefficient.dtype == np.int8
    assert len(coded.step) == 2
    np.testing.assert_array_equal(coded.basis[0], coded.basis[1])
    assert coded.step[0] == 256 * coded.step[1]


def test_the_last_row_of_a_large_cell_counts():
    values = light(transform.FITTED_ROWS + 5000, 1)
    assert relative_rms(values, transform.encode(values, np.zeros(1, np.int8), Goal(0.02))) <= 0.0201


SCRIPT = """
import hashlib, sys
sys.path.insert(0, {here!r})
import numpy as np
from test_transform import light, fingerprint
print(fingerprint())
"""


def fingerprint():
    digest = hashlib.sha256()
    for count, functions in ((200, 16), (2500, 16), (6000, 1)):
        coded = transform.encode(light(count, functions), np.zeros(functions, np.int8), Goal(0.03, 8, 60))
        for array in (coded.exponent, coded.coefficient, coded.basis, coded.step):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def test_threads_do_not_change_a_byte():
    found = set()
    for threads in ("1", "2", "5"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        script = SCRIPT.format(here=os.path.dirname(__file__))
        run = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        )
        found.add(run.stdout.strip())
    assert len(found) == 1
