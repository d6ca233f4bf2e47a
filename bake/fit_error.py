"""How wrong a fit is: estimates that its own receivers give, without the flattery of having been fitted.

Comes in: receivers measured twice, independently, and what was fitted to them. Goes out: squared errors, right on
average. A residual over (1 - leverage) is that of a fit which never saw the receiver; two independent halves take
the noise of the receiver out of its square.
"""

from __future__ import annotations

import numpy as np

from ..tree import harmonics
from .fit import PRIOR, System, check_prior, evaluate, fit
from .normal_equations import Solver
from .sobol import scramble

__all__ = ["leverage", "squared_bias", "squared_error"]

MOST_LEVERAGE = 0.8
"""A receiver that alone decides a data point says nothing about the error there; its residual grows 5 times at most."""


def leverage(system: System, prior: float | np.ndarray = PRIOR) -> np.ndarray:
    """Say how much of a receiver's own noise its fitted irradiance follows.

    Parameters
    ----------
    system : System
        The receivers.
    prior : float or (points,) ndarray
        As in `fit`.

    Returns
    -------
    (receivers,) float32 ndarray
        Derivative of the fitted irradiance by the receiver's own, 0 (ignored) to 1 (decides alone).

    Notes
    -----
    Error: each from its data points' own blocks as if they were independent, then scaled to the right mean;
    10 % off (standard deviation) in rooms; `test_the_leverage_is_that_of_the_dense_fit`.
    Source: the mean is Hutchinson's estimate of a trace, 1990, "A Stochastic Estimator of the Trace".
    """
    solver = Solver(system.operator, check_prior(system, prior))
    single = _single_leverage(system, solver)
    sign = _signs(len(single))
    followed = evaluate(system, fit(system, np.zeros((system.points, 1, harmonics.COUNT, 3), np.float32), sign, prior))
    counted = system.receiver > 0
    mean, wanted = single[counted].sum(dtype=np.float64), (sign * followed)[counted].mean(axis=(1, 2)).sum(dtype=float)
    return np.clip(single * (wanted / mean if mean > 0 else 1.0), 0.0, 1.0).astype(np.float32)


def squared_error(system: System, fitted: np.ndarray, halves: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Estimate the squared error that other points near each receiver see, noise of the fit included.

    The residual over (1 - leverage) is that of a fit without the receiver (leave one out). Its noise is independent
    of that fit, and what the halves differ by measures it.

    Parameters
    ----------
    system : System
        The receivers.
    fitted : (points, functions, 9, 3) float32 ndarray
        Fit to the mean of the halves.
    halves : (2, receivers, functions, 3) float32 ndarray
        Independent measurements of irradiance, as many paths in each.
    share : (receivers,) ndarray
        `leverage` of the receivers, 0 for receivers that were not fitted.

    Returns
    -------
    (receivers, functions, 3) float32 ndarray
        Right on average, negative where noise says so: average many before comparing, never clamp first.

    Notes
    -----
    Error: within the judges' own noise in four of five rooms' transports; too small where the prior comes from the
    same halves (`trust`) and fireflies decide it, by a quarter in the worst one.
    Source: Allen 1974, "The Relationship Between Variable Selection and Data Augmentation" (PRESS).
    """
    residual = evaluate(system, fitted) - halves.mean(axis=0, dtype=np.float32)
    noise = (halves[0] - halves[1]) / 2
    return (residual / _held_out(share)) ** 2 - noise**2


def squared_bias(system: System, fitted: np.ndarray, halves: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Estimate the squared error near each receiver that more paths would not remove, but more data points may.

    Parameters
    ----------
    system : System
        The receivers.
    fitted : (2, points, functions, 9, 3) float32 ndarray
        One fit to each half; their mean is the fit to the mean.
    halves : (2, receivers, functions, 3) float32 ndarray
        Independent measurements of irradiance.
    share : (receivers,) ndarray
        As in `squared_error`.

    Returns
    -------
    (receivers, functions, 3) float32 ndarray
        Right on average, and 0 on average where there is nothing but noise; noise of `traced` counts as error.
    """
    first, second = (evaluate(system, fitted[half]) - halves[half] for half in range(2))
    return first * second / _held_out(share) ** 2


def _single_leverage(system: System, solver: Solver) -> np.ndarray:
    """Leverage, were the data points of a receiver independent."""
    row = np.where(system.weight != 0, system.row, 0)
    basis, total = system.basis.astype(np.float32), np.zeros(len(row), np.float32)
    for tap in range(row.shape[1] if system.points else 0):
        part = (np.matmul(basis[:, None], solver.inverse[row[:, tap]])[:, 0] * basis).sum(axis=1)
        total += system.weight[:, tap].astype(np.float32) ** 2 * part
    weight = np.empty_like(total)
    weight[system.operator.order] = system.operator.weight[:, 0]
    return total * weight


def _signs(count: int) -> np.ndarray:
    """(count, 1, 3) random -1 or 1, always the same."""
    number = np.arange(count * 3, dtype=np.uint32)
    return np.where(scramble(number, 0) & 1, 1.0, -1.0).astype(np.float32).reshape(count, 1, 3)


def _held_out(share: np.ndarray) -> np.ndarray:
    """1 - leverage, not too near 0."""
    return 1.0 - np.minimum(share, MOST_LEVERAGE).astype(np.float32)[:, None, None]
