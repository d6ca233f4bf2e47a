"""The lobe of prefiltered maps: its integral, its cones, the split sum's own sampling; roughness by level."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.tree import ggx
from statistics_checks import SIGNIFICANCE, chi_square

ROUGHNESS = (0.05, 0.12, 0.3, 0.6, 0.9, 0.99999, 1 - 1e-7, 1.0)
STEPS = 400_001


def integral(roughness: float, cosine: float, density=ggx.density) -> float:
    """Of a density within a cone, by Simpson's rule over the tangent of half the angle: as wide as narrow lobes are."""
    narrow = roughness**2
    end = np.arcsinh(np.tan(np.arccos(cosine) / 2) / narrow)
    s = np.linspace(0, end, STEPS)
    tangent = narrow * np.sinh(s)
    angle = 2 * np.arctan(tangent)
    measure = 2 * np.pi * np.sin(angle) * 2 / (1 + tangent**2) * narrow * np.cosh(s)
    value = density(np.cos(angle), roughness) * measure
    weight = np.ones(STEPS)
    weight[1:-1:2], weight[2:-1:2] = 4, 2
    return float((value * weight).sum() * end / (STEPS - 1) / 3)


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_the_lobe_has_its_share_in_every_cone_and_all_of_it_before_a_right_angle(roughness):
    for cosine in (0.999, 0.9, 0.5, 0.1, 0.0):
        assert integral(roughness, cosine) == pytest.approx(float(ggx.share(cosine, roughness)), rel=1e-7)
    assert ggx.share(np.array([0.0, -0.5, -1.0]), roughness) == pytest.approx(1, abs=1e-12)
    assert ggx.share(1.0, roughness) == pytest.approx(0, abs=1e-10)
    assert (ggx.density(np.array([0.0, -0.3, -1.0]), roughness) == 0).all()


def test_a_lobe_without_the_cosine_is_found():
    def planted(cosine, roughness):
        return ggx.density(cosine, roughness) / np.maximum(cosine, 1e-12)

    assert abs(integral(0.6, 0.0, planted) - 1) > 0.05


def test_the_roughest_lobe_is_the_cosine():
    cosine = np.linspace(0, 1, 101)
    assert ggx.density(cosine, 1.0) == pytest.approx(cosine / np.pi, rel=1e-12)
    assert ggx.share(cosine, 1.0) == pytest.approx(1 - cosine**2, abs=1e-12)


def split_sum_cosines(roughness: float, seed: int, count: int = 400_000) -> np.ndarray:
    """Cosines between R and the light that Karis' sampling weighs: half vectors by D, light kept by its cosine."""
    u, keep = np.random.default_rng(seed).random((2, count))
    squared = roughness**4
    half = np.sqrt((1 - u) / (1 + (squared - 1) * u))
    light = 2 * half * half - 1
    return light[keep < light]


@pytest.mark.parametrize("roughness", [0.15, 0.4, 0.8, 1.0])
def test_the_lobe_is_the_split_sums_by_chi_square_and_another_roughness_is_not(roughness):
    cosine = split_sum_cosines(roughness, 1)
    share = np.linspace(0, 1, 41)[1:-1]
    fine = np.concatenate([1 - np.geomspace(1e-7, 0.5, 20_000), np.linspace(0.5, 0, 20_000)[1:]])
    edges = np.interp(share, ggx.share(fine, roughness), fine)
    counts = np.bincount(np.searchsorted(-edges, -cosine), minlength=40)
    for tried, fits in ((roughness, True), (0.97 * roughness, False)):
        parts = np.diff(np.concatenate([[0], ggx.share(edges, tried), [1]]))
        assert (chi_square(counts, parts * len(cosine)) > SIGNIFICANCE) == fits


def test_roughness_rises_from_a_texels_width_to_one_and_back():
    sizes = (126, 62, 30, 14, 6)
    levels = ggx.ladder(sizes)
    assert levels[-1] == 1
    assert levels[1:] / levels[:-1] == pytest.approx(np.full(4, levels[1] / levels[0]))
    width = 2 * levels**2 * np.array(sizes) / np.sqrt(4 * np.pi)
    assert width[0] == pytest.approx(1)
    assert (np.diff(width) > 0).all()
    assert width[-1] < 4
    assert ggx.level_of(levels, levels) == pytest.approx(np.arange(5))
    assert ggx.level_of(np.array([0.0, 0.05, 1.0]), levels) == pytest.approx([0, 0, 4])
    assert (np.diff(ggx.level_of(np.linspace(levels[0], 1, 99), levels)) > 0).all()
    assert ggx.level_of(np.array([0.3, 1.0]), ggx.ladder((6,))).tolist() == [0, 0]


def test_single_precision_stays_and_agrees():
    cosine = np.linspace(-1, 1, 1001)
    single = ggx.density(cosine.astype(np.float32), 0.2)
    assert single.dtype == np.float32
    # 1 - t loses 2**-24 of 1, against alpha^2 = 0.0016 at the peak, squared.
    assert single == pytest.approx(ggx.density(cosine, 0.2), rel=3 * 2**-24 / 0.0016 * 2)
