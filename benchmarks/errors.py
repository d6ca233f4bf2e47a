"""Errors of estimates against a noisy reference, with the reference's noise taken out.

Comes in: values at points, and two independent halves of what they are compared with. Goes out: mean squares without
bias: the noise of two independent halves does not correlate, so mean((x - a) (x - b)) has the expectation of
mean((x - truth)^2), where mean((x - a)^2) would add the noise of a.
"""

from __future__ import annotations

import numpy as np

LEAK = 4.0
"""A value this many times too large, or too small, is seen as light where none is, or none where there is."""

SIGMAS = 3.0
"""Of the reference's noise, beyond which a leak has to be: at the point or usually, as two halves say little of one."""

UNSEEN = 0.02
"""Differences below this share of the mean reference are nobody's concern."""

PERCENTILES = (50, 90, 99)


def mean_product(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Mean square without noise.

    Parameters
    ----------
    first, second : (n,) ndarray
        The same differences with independent noise.

    Returns
    -------
    mean : float
        May be slightly negative where there is noise only.
    error : float
        Its standard error over points.
    """
    product = np.asarray(first, np.float64) * second
    return float(product.mean()), float(product.std() / np.sqrt(len(product)))


def root(square: float) -> float:
    """Root of a mean square, with its sign.

    Parameters
    ----------
    square : float
        Mean square; below 0 where noise exceeds what is left.

    Returns
    -------
    float
        Negative where `square` is.
    """
    return float(np.copysign(np.sqrt(abs(square)), square))


def compare(values: np.ndarray, halves: np.ndarray) -> dict[str, float]:
    """Describe the errors of values.

    Parameters
    ----------
    values : (n,) ndarray
        What is judged.
    halves : (2, n) ndarray
        Two independent references.

    Returns
    -------
    dict
        `rmse` and its standard error `rmse_error`, `bias`, `noise` of the mean of the halves, `p50`, `p90`, `p99`
        of the absolute error, all relative to the mean reference; `bright` and `dark`, the share of points that are
        more than `LEAK` times too bright or too dark, beyond noise.
    """
    reference = halves.mean(axis=0, dtype=np.float64)
    mean = float(reference.mean())
    if not mean > 0:
        return {}
    square, error = mean_product(values - halves[0], values - halves[1])
    noise = np.abs(halves[0] - halves[1]) / 2
    usual = float(np.sqrt(np.mean(noise**2)))
    difference = values - reference
    beyond = np.abs(difference) > SIGMAS * np.maximum(noise, usual) + UNSEEN * mean
    found = {
        "rmse": root(square) / mean,
        "rmse_error": error / max(2 * np.sqrt(abs(square)), 1e-30) / mean,
        "bias": float(difference.mean()) / mean,
        "noise": usual / mean,
        "bright": float((beyond & (values > LEAK * reference)).mean()),
        "dark": float((beyond & (values < reference / LEAK)).mean()),
    }
    return found | {f"p{p}": float(np.percentile(np.abs(difference), p)) / mean for p in PERCENTILES}
