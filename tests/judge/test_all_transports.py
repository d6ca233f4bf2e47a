"""What compares estimators at equal error: errors that are planted, powers that are known, skies of either sign."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Cycles comes with the bpy wheel")

from gi_volumes.benchmarks.cycles_transports import Bakes, Transport  # noqa: E402
from gi_volumes.benchmarks.equal_error import Errors, Judge, needed, slopes  # noqa: E402
from gi_volumes.tree import harmonics  # noqa: E402

AXES = np.concatenate([np.eye(3), -np.eye(3)])
GROUPS = {"sun": slice(0, 4), "sky": slice(4, 6)}
POINTS = 4000
SAMPLES = 256


def noisy(light: np.ndarray, relative: float, seed: int) -> np.ndarray:
    """Light with independent errors."""
    return light * (1 + relative * np.random.default_rng(seed).normal(size=light.shape))


@pytest.mark.parametrize("kind", ["median", "rms"])
def test_planted_errors_are_found_whatever_the_noise_of_the_references(kind):
    light = np.ones((POINTS, 6, 6, 3))
    judge = Judge(np.stack([noisy(light, 0.05, seed) for seed in (1, 2)]), GROUPS)
    found = judge.errors([noisy(light, 0.1, 3)], kind)
    # A median of mean squares of few numbers lies below their mean: by 4 % of chi-square with 18 degrees of freedom.
    assert found.group["sun"] == pytest.approx(0.1, rel=0.05)
    assert found.each == pytest.approx(np.full(6, 0.1), rel=0.05)


def test_references_that_converge_elsewhere_show_how_far():
    light = np.ones((POINTS, 6, 6, 3))
    judge, other = (
        Judge(np.stack([noisy(scale * light, 0.05, seed + k) for k in range(2)]), GROUPS)
        for seed, scale in ((1, 1.0), (3, 1.1))
    )
    assert judge.apart(other, "rms").group["sky"] == pytest.approx(0.1, rel=0.05)


def test_half_the_error_takes_four_times_the_samples_where_errors_fall_with_the_root():
    ones = np.ones(6)
    first, last = (Errors(dict.fromkeys(GROUPS, error), error * ones) for error in (0.4, 0.1))
    slope = slopes((16 * ones, first), (256 * ones, last), GROUPS)
    assert slope == pytest.approx(dict.fromkeys(GROUPS, -0.5))
    target = Errors(dict.fromkeys(GROUPS, 0.05), 0.05 * ones)
    group, each = needed((256 * ones, last), target, slope, GROUPS)
    assert group == pytest.approx(dict.fromkeys(GROUPS, 1024))
    assert each == pytest.approx(1024 * ones)


@pytest.mark.parametrize("function", range(harmonics.COUNT))
def test_cycles_takes_a_sky_of_either_sign(function):
    bpy.ops.wm.read_homefile(use_empty=True)
    points = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    found = Bakes(points, AXES, 4, 2, 0.0).run(Transport("sky", (), function), SAMPLES, 1)[1]
    closed_form = harmonics.COSINE[function] * harmonics.basis(AXES)[:, function]
    # Radiance is below 1.1 everywhere: 50 x 256 samples of a cosine lobe are within pi 1.1 / sqrt(12,800) = 0.03.
    assert np.abs(found.mean(axis=(0, 2)) - closed_form).max() < 0.03
