"""What statistical tests share: chi-square with merged bins, and standard errors."""

from __future__ import annotations

import numpy as np
from scipy import stats

LEAST_EXPECTED = 5.0
"""Bins that expect fewer counts are merged: below, the statistic is not chi-square distributed (Cochran 1954)."""

SIGNIFICANCE = 1e-3
"""A correct sampler is refused once in a thousand seeds, and the seeds are fixed."""


def chi_square(observed, expected) -> float:
    """Probability of counts at least this far from the expected ones."""
    observed, expected = np.ravel(observed).astype(float), np.ravel(expected).astype(float)
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    rare = np.searchsorted(np.cumsum(expected), LEAST_EXPECTED) + 1 if expected[0] < LEAST_EXPECTED else 0
    rare = max(rare, np.searchsorted(expected, LEAST_EXPECTED))
    if rare > 1:
        observed = np.append(observed[rare:], observed[:rare].sum())
        expected = np.append(expected[rare:], expected[:rare].sum())
    kept = expected > 0
    if observed[~kept].any():
        return 0.0
    statistic = ((observed - expected)[kept] ** 2 / expected[kept]).sum()
    return float(stats.chi2.sf(statistic, kept.sum() - 1))


def grid_counts(x, y, bins: tuple[int, int]) -> np.ndarray:
    """Counts of points of the unit square in equal cells."""
    columns = np.minimum((np.asarray(x) * bins[0]).astype(int), bins[0] - 1)
    rows = np.minimum((np.asarray(y) * bins[1]).astype(int), bins[1] - 1)
    return np.bincount(columns * bins[1] + rows, minlength=bins[0] * bins[1])


def is_uniform(x, y, bins: tuple[int, int] = (12, 24)) -> bool:
    """Whether points fill the unit square evenly."""
    counts = grid_counts(x, y, bins)
    return chi_square(counts, np.full(counts.size, len(x) / counts.size)) > SIGNIFICANCE


def standard_error(estimates: np.ndarray) -> np.ndarray:
    """Of the mean over the first axis."""
    return np.std(estimates, axis=0, ddof=1) / np.sqrt(len(estimates))
