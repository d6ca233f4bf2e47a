"""The fit of data points to surfaces: the dense solution, what the prior holds, noise, and honest errors."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import fit as module
from gi_volumes.bake import normal_equations
from gi_volumes.bake.fit import PRIOR, System, evaluate, fit, trust
from gi_volumes.bake.fit_error import leverage, squared_bias, squared_error
from gi_volumes.tree import harmonics

TAPS = 16
PENALTY = (harmonics.COSINE[0] / harmonics.COSINE) ** 2


def directions(generator, count: int) -> np.ndarray:
    vector = generator.normal(size=(count, 3))
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def random_system(points: int, receivers: int, seed: int = 0, taps: int = 4, counts=None) -> System:
    """Receivers that each see a few neighbours on a line of data points, with random normals."""
    generator = np.random.default_rng(seed)
    row, weight = np.zeros((receivers, TAPS), np.int64), np.zeros((receivers, TAPS))
    first = generator.integers(0, max(points - taps, 0) + 1, receivers)
    used = min(taps, points)
    row[:, :used] = first[:, None] + np.arange(used)
    weight[:, :used] = generator.random((receivers, used)) + 0.05
    weight /= weight.sum(axis=1, keepdims=True)
    counts = np.ones(receivers) if counts is None else counts
    return System(points, row, weight, harmonics.basis(directions(generator, receivers)), counts)


def random_values(points: int, functions: int = 1, seed: int = 1) -> np.ndarray:
    """Harmonics of irradiance, whose higher orders are weaker."""
    values = np.random.default_rng(seed).normal(size=(points, functions, 9, 3)) / PENALTY[:, None]
    values[:, :, 0] += 5
    return values.astype(np.float32)


def dense(system: System) -> np.ndarray:
    """(receivers, points * 9) matrix of what receivers see."""
    matrix = np.zeros((len(system.row), system.points, 9))
    for tap in range(system.row.shape[1]):
        matrix[np.arange(len(matrix)), system.row[:, tap]] += system.weight[:, tap, None] * system.basis
    return matrix.reshape(len(matrix), -1)


def dense_fit(system: System, traced: np.ndarray, seen: np.ndarray, prior) -> np.ndarray:
    """The same minimum, by numpy's solver, over the columns one after the other."""
    positive = system.receiver[system.receiver > 0]
    root = np.sqrt(system.receiver / positive.mean())[:, None]
    held = np.sqrt(np.broadcast_to(prior, system.points)[:, None] * PENALTY).ravel()
    values = traced.astype(np.float64).transpose(0, 2, 1, 3).reshape(system.points * 9, -1)
    matrix = np.concatenate([root * dense(system), np.diag(held)])
    right = np.concatenate([root * seen.reshape(len(seen), -1), held[:, None] * values])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return found.reshape(system.points, 9, -1, 3).transpose(0, 2, 1, 3)


@pytest.fixture
def exact(monkeypatch):
    """Solve to rounding."""
    monkeypatch.setattr(normal_equations, "TOLERANCE", 1e-7)
    monkeypatch.setattr(normal_equations, "ITERATIONS", 300)


@pytest.mark.parametrize(("points", "receivers", "prior"), [(1, 50, 0.3), (7, 5, 0.3), (12, 200, 0.05), (30, 700, 2.0)])
def test_the_fit_is_the_dense_least_squares_solution(exact, points, receivers, prior):
    generator = np.random.default_rng(points)
    system = random_system(points, receivers, points, counts=generator.random(receivers))
    traced, seen = random_values(points, 2), generator.random((receivers, 2, 3)).astype(np.float32)
    found, wanted = fit(system, traced, seen, prior), dense_fit(system, traced, seen, prior)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_a_prior_for_each_data_point_is_the_dense_solution_too(exact):
    system, generator = random_system(12, 300), np.random.default_rng(3)
    traced, seen = random_values(12), generator.random((300, 1, 3)).astype(np.float32)
    prior = generator.uniform(0.1, 10, 12)
    found, wanted = fit(system, traced, seen, prior), dense_fit(system, traced, seen, prior)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_the_usual_tolerance_is_far_below_the_change():
    system, traced = random_system(60, 1000), random_values(60)
    seen = evaluate(system, random_values(60, seed=5))
    wanted = dense_fit(system, traced, seen, PRIOR)
    error = np.sqrt(np.mean((fit(system, traced, seen) - wanted) ** 2))
    assert error < 0.02 * np.sqrt(np.mean((wanted - traced) ** 2))


def test_values_that_surfaces_confirm_do_not_change():
    system, traced = random_system(40, 1000), random_values(40, 3)
    found = fit(system, traced, evaluate(system, traced))
    assert np.abs(found - traced).max() < 1e-4


def test_enough_receivers_recover_the_truth(exact):
    system, truth = random_system(20, 5000), random_values(20)
    found = fit(system, random_values(20, seed=9), evaluate(system, truth), prior=1e-4)
    assert np.abs(found - truth).max() < 0.02


def test_what_no_receiver_looks_at_stays_as_traced():
    system, traced = random_system(10, 100), random_values(12)
    system = System(12, system.row, system.weight, system.basis, system.receiver)
    found = fit(system, traced, np.ones((100, 1, 3), np.float32))
    assert np.array_equal(found[10:], traced[10:])
    assert not np.array_equal(found[:10], traced[:10])


def test_a_change_seen_from_one_side_does_not_reach_the_other():
    up, down = (harmonics.basis(np.array([[0.0, 0.0, z]])) for z in (1.0, -1.0))
    row, weight = np.zeros((1, TAPS), np.int64), np.eye(1, TAPS)
    system, traced = System(1, row, weight, up, np.ones(1)), np.zeros((1, 1, 9, 3), np.float32)
    found = fit(system, traced, np.ones((1, 1, 3), np.float32), prior=0.01)[0, 0, :, 0]
    assert found @ up[0] > 0.9
    assert abs(found @ down[0]) < 0.02 * (found @ up[0])


def test_the_fit_is_linear(exact):
    system, generator = random_system(20, 300), np.random.default_rng(4)
    traced, seen = random_values(20), generator.random((2, 300, 1, 3)).astype(np.float32)
    first, second = (fit(system, traced, half) for half in seen)
    assert np.allclose((first + second) / 2, fit(system, traced, seen.mean(axis=0)), atol=1e-5)


def test_the_fit_is_better_than_the_traced_values_and_than_receivers_alone():
    generator, system = np.random.default_rng(6), random_system(100, 3000)
    truth = random_values(100)
    seen = evaluate(system, truth)
    traced = truth + (generator.normal(size=truth.shape) / np.sqrt(PENALTY)[:, None]).astype(np.float32)
    noisy = seen + generator.normal(size=seen.shape).astype(np.float32)
    sigma = {
        name: np.sqrt(np.mean((evaluate(system, v) - seen) ** 2))
        for name, v in {
            "traced": traced,
            "fitted": fit(system, traced, noisy, 1.0),
            "receivers": fit(system, 0 * traced, noisy, 1e-3),
        }.items()
    }
    assert sigma["fitted"] < 0.9 * min(sigma["traced"], sigma["receivers"], 1.0)


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e20, 1e30])
def test_the_unit_of_light_does_not_matter(scale):
    system, traced = random_system(20, 300), random_values(20)
    seen = np.random.default_rng(2).random((300, 1, 3)).astype(np.float32)
    wanted = fit(system, traced, seen)
    found = fit(system, traced * np.float32(scale), seen * np.float32(scale))
    assert np.allclose(found / np.float32(scale), wanted, rtol=1e-4, atol=1e-5)


def test_columns_of_very_different_size_do_not_disturb_each_other():
    system, traced = random_system(20, 300), random_values(20, 2)
    seen = np.random.default_rng(2).random((300, 2, 3)).astype(np.float32)
    scale = np.array([1e-25, 1e25], np.float32)
    found = fit(system, traced * scale[:, None, None], seen * scale[:, None])
    assert np.allclose(found / scale[:, None, None], fit(system, traced, seen), rtol=1e-4, atol=1e-5)


def test_the_largest_numbers_stay_finite():
    system = random_system(5, 100)
    most = np.finfo(np.float32).max
    found = fit(system, np.full((5, 1, 9, 3), most, np.float32), np.full((100, 1, 3), -most, np.float32))
    assert np.isfinite(found).all()


def test_receivers_count_relative_to_each_other():
    system, traced = random_system(20, 300), random_values(20)
    seen = np.random.default_rng(2).random((300, 1, 3)).astype(np.float32)
    heavy = System(20, system.row, system.weight, system.basis, np.full(300, 1e-12))
    assert np.allclose(fit(heavy, traced, seen), fit(system, traced, seen), atol=1e-6)


def test_nothing_to_fit_leaves_everything_as_it_is():
    traced = random_values(6, 2)
    none = System(6, np.zeros((0, TAPS), np.int64), np.zeros((0, TAPS)), np.zeros((0, 9)), np.zeros(0))
    assert np.array_equal(fit(none, traced, np.zeros((0, 2, 3), np.float32)), traced)
    system = random_system(6, 50, counts=np.zeros(50))
    assert np.array_equal(fit(system, traced, np.ones((50, 2, 3), np.float32)), traced)
    assert fit(system, traced[:, :0], np.ones((50, 0, 3), np.float32)).shape == (6, 0, 9, 3)
    empty = System(0, np.zeros((0, TAPS), np.int64), np.zeros((0, TAPS)), np.zeros((0, 9)), np.zeros(0))
    assert fit(empty, traced[:0], np.zeros((0, 2, 3), np.float32)).shape == (0, 2, 9, 3)


def test_darkness_stays_dark():
    system = random_system(6, 50)
    assert not fit(system, np.zeros((6, 1, 9, 3), np.float32), np.zeros((50, 1, 3), np.float32)).any()


def test_a_receiver_that_counts_nothing_is_not_there():
    system, traced = random_system(20, 300, counts=np.repeat([1.0, 0.0], 150)), random_values(20)
    seen = np.random.default_rng(2).random((300, 1, 3)).astype(np.float32)
    half = System(20, system.row[:150], system.weight[:150], system.basis[:150], np.ones(150))
    seen[150:] *= 1e6
    assert np.allclose(fit(system, traced, seen)[..., :], fit(half, traced, seen[:150]), atol=1e-3)


def test_threads_do_not_change_a_bit(monkeypatch):
    monkeypatch.setattr(module, "COLUMNS", 7)
    system, traced = random_system(500, 4000), random_values(500, 12)
    seen = np.random.default_rng(2).random((4000, 12, 3)).astype(np.float32)
    alone = fit(system, traced, seen, threads=1)
    assert all(np.array_equal(alone, fit(system, traced, seen, threads=count)) for count in (2, 3, 8))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("weight", np.nan, "weight of row 3 is not finite"),
        ("basis", np.inf, "basis of row 3 is not finite"),
        ("receiver", np.nan, "receiver of row 3 is not finite"),
        ("receiver", -1.0, "negative"),
        ("row", 20, "20 data points"),
        ("row", -1, "from -1"),
    ],
)
def test_a_system_that_makes_no_sense_is_refused(field, value, words):
    good = random_system(20, 50)
    arrays = {name: getattr(good, name).copy() for name in ("row", "weight", "basis", "receiver")}
    arrays[field][3, ...] = value
    with pytest.raises(ValueError, match=words):
        System(20, **arrays)


def test_input_that_does_not_fit_is_refused():
    system, traced, seen = random_system(20, 50), random_values(20), np.ones((50, 1, 3), np.float32)
    broken = traced.copy()
    broken[4, 0, 2, 1] = np.nan
    with pytest.raises(ValueError, match="traced of row 4 is not finite"):
        fit(system, broken, seen)
    with pytest.raises(ValueError, match="seen of row 0 is not finite"):
        fit(system, traced, seen * np.inf)
    with pytest.raises(ValueError, match=r"\(20, functions, 9, 3\)"):
        fit(system, traced[:19], seen)
    with pytest.raises(ValueError, match=r"\(50, 1, 3\)"):
        fit(system, traced, seen[:, :, 0])
    with pytest.raises(ValueError, match="prior"):
        fit(system, traced, seen, prior=0.0)
    with pytest.raises(ValueError, match="taps"):
        System(20, system.row, system.weight[:, :4], system.basis, system.receiver)


def test_the_leverage_is_that_of_the_dense_fit():
    system = random_system(30, 600, counts=np.random.default_rng(1).uniform(0.5, 2, 600))
    matrix, weight = dense(system), system.receiver / system.receiver.mean()
    normal = matrix.T @ (weight[:, None] * matrix) + np.diag(np.tile(PRIOR * PENALTY, 30))
    wanted = weight * np.einsum("ni,ni->n", matrix, np.linalg.solve(normal, matrix.T).T)
    found = leverage(system)
    assert abs(found.mean() / wanted.mean() - 1) < 0.05
    assert np.corrcoef(found, wanted)[0, 1] > 0.9


def test_the_leverage_is_exact_where_a_receiver_has_one_data_point():
    system = random_system(30, 600, taps=1)
    matrix = dense(system)
    normal = matrix.T @ matrix + np.diag(np.tile(PRIOR * PENALTY, 30))
    wanted = np.einsum("ni,ni->n", matrix, np.linalg.solve(normal, matrix.T).T)
    assert np.allclose(leverage(system) * wanted.mean() / leverage(system).mean(), wanted, atol=1e-4)


def test_trust_grows_with_noise_and_only_there():
    system, traced = random_system(60, 3000), random_values(60)
    generator, truth = np.random.default_rng(8), evaluate(system, random_values(60, seed=2))
    noisy = (system.row[:, :4].min(axis=1) > 30)[:, None, None]
    halves = truth + np.where(noisy, 30.0, 0.01) * generator.normal(size=(2, *truth.shape))
    found = trust(system, traced, halves.astype(np.float32))
    assert found[:28].max() < 0.5
    assert found[36:56].min() > 0.5
    assert found[36:56].mean() > 4 * found[:28].mean()
    scaled = trust(system, traced * np.float32(1e25), (halves * 1e25).astype(np.float32))
    assert np.allclose(scaled, found, rtol=1e-3)


@pytest.mark.parametrize("times", [1e-3, 10.0, 1e4])
def test_trust_in_the_weight_around_does_not_depend_on_what_counts_elsewhere(times):
    """Two data points that share no receiver; those of the second count more, or less."""
    generator = np.random.default_rng(4)
    row, basis = np.repeat([0, 1], 30)[:, None], harmonics.basis(directions(generator, 60))
    traced = np.ones((2, 1, 9, 3), np.float32)
    halves = generator.normal(1.0, 0.3, (2, 60, 1, 3)).astype(np.float32)

    def first(counts) -> float:
        system = System(2, row, np.ones((60, 1)), basis, counts)
        return float(trust(system, traced, halves)[0] / (counts[0] / counts.mean()))

    assert first(np.repeat([1.0, times], 30)) == pytest.approx(first(np.ones(60)), rel=1e-6)


def test_trust_where_nothing_is_known_is_finite():
    system, traced = random_system(6, 50, counts=np.zeros(50)), random_values(6)
    for halves in (np.zeros((2, 50, 1, 3), np.float32), np.ones((2, 50, 1, 3), np.float32)):
        assert np.isfinite(trust(system, traced, halves)).all()
    none = System(6, np.zeros((0, TAPS), np.int64), np.zeros((0, TAPS)), np.zeros((0, 9)), np.zeros(0))
    assert (trust(none, traced, np.zeros((2, 0, 1, 3), np.float32)) > 0).all()
    with pytest.raises(ValueError, match="halves"):
        trust(system, traced, np.zeros((50, 1, 3), np.float32))


def test_trust_keeps_fireflies_out():
    system, truth = random_system(60, 3000), random_values(60)
    generator, seen = np.random.default_rng(5), evaluate(system, truth)
    halves = np.repeat(seen[None], 2, axis=0)
    halves[0, generator.random(3000) < 0.01] *= 300
    traced = truth + (0.1 * generator.normal(size=truth.shape)).astype(np.float32)
    mean = halves.mean(axis=0)
    plain, wary = fit(system, traced, mean), fit(system, traced, mean, trust(system, traced, halves))
    plain_error, wary_error = (np.sqrt(((evaluate(system, found) - seen) ** 2).mean()) for found in (plain, wary))
    assert wary_error < 0.25 * plain_error


def noise_runs(system: System, traced: np.ndarray, truth: np.ndarray, runs: int, sigma: float = 1.0):
    """Halves of noisy measurements and the fits to them; the runs are functions."""
    generator = np.random.default_rng(8)
    traced = np.repeat(traced, runs, axis=1)
    halves = truth + sigma * generator.normal(size=(2, len(truth), runs, 3))
    halves = halves.astype(np.float32)
    return halves, np.stack([fit(system, traced, half) for half in halves])


def test_noise_alone_is_no_bias():
    system, traced = random_system(60, 800), random_values(60)
    truth = evaluate(system, traced)
    halves, fitted = noise_runs(system, traced, truth, 100)
    found = squared_bias(system, fitted, halves, leverage(system))
    naive = np.prod([evaluate(system, fitted.mean(axis=0)) - half for half in halves], axis=0)
    deviation = found.mean(axis=0).std() / np.sqrt(found.shape[1] * 3)
    assert abs(found.mean()) < 4 * deviation
    assert naive.mean() < -20 * deviation, "a residual of what was fitted must show overfitting"


def left_out(system: System, traced: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """What receivers see of fits that left them out, a twentieth of the receivers at a time."""
    out = np.zeros_like(seen)
    for part in range(20):
        held = np.arange(len(seen)) % 20 == part
        kept = System(system.points, system.row, system.weight, system.basis, np.where(held, 0.0, system.receiver))
        out[held] = evaluate(kept, fit(kept, traced, seen))[held]
    return out


def test_the_bias_of_a_fit_that_cannot_follow_is_found():
    system, traced = random_system(60, 3000), random_values(60)
    truth = evaluate(system, traced) + np.random.default_rng(3).normal(size=(3000, 1, 1)).astype(np.float32)
    halves, fitted = noise_runs(system, traced, truth, 40, 0.5)
    found = squared_bias(system, fitted, halves, leverage(system)).mean()
    wanted = ((left_out(system, traced, truth) - truth) ** 2).mean()
    assert 0.95 < found / wanted < 1.1


def test_the_squared_error_is_that_of_fits_without_the_receiver():
    system, traced = random_system(60, 3000), random_values(60)
    truth = evaluate(system, random_values(60, seed=2))
    halves, fitted = noise_runs(system, traced, truth, 20, 0.5)
    mean, repeated = halves.mean(axis=0), np.repeat(traced, 20, axis=1)
    found = squared_error(system, fitted.mean(axis=0), halves, leverage(system)).mean()
    wanted = ((left_out(system, repeated, mean) - truth) ** 2).mean()
    naive = np.prod([evaluate(system, fitted.mean(axis=0)) - half for half in halves], axis=0).mean()
    assert 0.9 < found / wanted < 1.15
    assert naive < 0.5 * wanted, "a residual of what was fitted must show overfitting"
