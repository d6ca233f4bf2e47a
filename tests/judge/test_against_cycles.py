"""The benchmark at equal error: its figures follow from runs whose time and noise are known."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="Cycles comes with the bpy wheel")

from gi_volumes.benchmarks.against_cycles import Runs, bias, time_at

POINTS, REPEATS = 500, 40


def runs(samples: int, seconds: float = 1e-3, slope: float = -0.5, factor: float = 1.0, seed: int = 0) -> Runs:
    """An estimate of 1 W/m2 whose noise is samples^slope and whose time is proportional to samples."""
    noise = np.random.default_rng(seed + samples).standard_normal((REPEATS, POINTS, 6)) * samples**slope
    return Runs(np.full(REPEATS, seconds * samples), factor + noise)


def test_noise_is_that_of_one_repeat():
    assert runs(16).noise == pytest.approx(0.25, rel=0.01)
    assert runs(16).typical_noise == pytest.approx(0.25, rel=0.03)


def test_the_time_is_the_median_so_that_one_disturbance_does_not_count():
    found = runs(16)
    assert Runs(np.array([1.0, 2.0, 50.0]), found.values[:3]).time == 2.0


@pytest.mark.parametrize("slope", [-0.5, -0.6])
@pytest.mark.parametrize("noise", [0.5, 0.1, 0.02])
def test_the_time_at_a_noise_follows_the_slope_within_the_ladder_and_beyond(slope, noise):
    ladder = [runs(samples, slope=slope) for samples in (16, 64, 256)]
    assert time_at(noise, ladder) == pytest.approx(1e-3 * noise ** (1 / slope), rel=0.05)
    assert time_at(noise, ladder, "typical_noise") == pytest.approx(1e-3 * noise ** (1 / slope), rel=0.15)


def test_a_planted_bias_is_measured_and_noise_is_not_taken_for_one():
    reference = runs(4096, seed=1).values[:2]
    mean, spread = bias(runs(64, factor=1.05), reference)
    assert (mean, spread) == (pytest.approx(0.05, abs=2e-3), pytest.approx(0.05, abs=2e-3))
    mean, spread = bias(runs(64), reference)
    assert abs(mean) < 2e-3
    assert spread < 5e-3
