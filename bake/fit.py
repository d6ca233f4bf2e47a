"""Fits data points to what surfaces see of them: stored values that are right after interpolation.

Comes in: receivers (surface points with the run time's own weights and their path-traced irradiance) and the values
traced at the data points. Goes out: values c that minimise, summed over receivers s and data points k,

    w_s (sum_k beta_sk Y(n_s) . c_k - E_s)^2  +  prior * |pi (c_k - traced_k) / cosine|^2

by conjugate gradients. The second term is the inverse of the variance that noise of the radiance has around a data
point: what no receiver sees stays as traced, and a change seen from one side does not reach the other.
Every function and channel is a column; the operator is the same for all, so the fit is linear in what is traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..tree import harmonics
from .normal_equations import Operator, Solver
from .parallel import run_tiles

__all__ = ["PRIOR", "System", "evaluate", "fit", "trust"]

PRIOR = 0.5
"""Trust in a traced value, in receivers of mean weight, where nothing is known about noise: no measured scene is worse
than as traced, and half or double this costs 3 % of the error."""

LEAST_TRUST = 0.25
NOISE_TRUST = 0.1
"""Trust where receivers have no noise, and what is added per noise variance over squared error of the traced values:
both from held-out points in five scenes (sponza, modern hall, courtyard, living room, small house)."""

MOST_TRUST = 100.0
DOUBT = 2.0
"""Receivers' worth of ratio 1 that steadies the estimate at each data point."""

DARKNESS = 1e-12
"""What is this much less than its column's largest value is 0: iterations carry traces of light to sealed rooms."""

NOTHING = 1e-300
"""Stands for 0 where something is divided by it."""

COLUMN_TAPS = 1 << 25
"""Taps times columns that are solved at a time: 128 MiB in each of about three arrays."""

RECEIVERS = 1 << 14
"""Receivers whose data points are read at a time: 46 MB for 26 functions."""

COLUMNS = 26
"""Most columns in one block: such products stay far below the size at which BLAS starts threads."""


@dataclass(frozen=True)
class System:
    """What receivers see of the data points.

    Parameters
    ----------
    points : int
        Number of data points.
    row : (n, t) int64
        Data points that light each receiver; any where the weight is 0.
    weight : (n, t) float
        Their share, sum 1, as the run time interpolates.
    basis : (n, 9) float
        `harmonics.basis` of the receivers' normals.
    receiver : (n,) float
        How much each receiver counts, 0 or more: the area it stands for, or its confidence. Only ratios matter.

    Raises
    ------
    ValueError
        Shapes do not fit, a value is not finite, a receiver counts less than nothing, a row is out of range.
    """

    points: int
    row: np.ndarray
    weight: np.ndarray
    basis: np.ndarray
    receiver: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.row)
        if self.row.ndim != 2 or self.weight.shape != self.row.shape:
            raise ValueError(f"rows {self.row.shape} and weights {self.weight.shape}; both must be (receivers, taps)")
        if self.basis.shape != (count, harmonics.COUNT) or self.receiver.shape != (count,):
            raise ValueError(f"{count} receivers need ({count}, 9) basis values and ({count},) weights")
        for name in ("weight", "basis", "receiver"):
            _check_finite(getattr(self, name), name)
        if (self.receiver < 0).any():
            raise ValueError("a receiver's weight is negative; leave such receivers out")
        used = self.row[self.weight != 0]
        if used.size and (used.min() < 0 or used.max() >= self.points):
            raise ValueError(f"rows from {used.min()} to {used.max()}; there are {self.points} data points")

    @cached_property
    def operator(self) -> Operator:
        """The linear map from values to what receivers see, built once."""
        return Operator(self.points, self.row, self.weight, self.basis, self.receiver / _mean(self.receiver))


def fit(
    system: System, traced: np.ndarray, seen: np.ndarray, prior: float | np.ndarray = PRIOR, threads: int = 1
) -> np.ndarray:
    """Fit the values of data points to irradiance on surfaces.

    Parameters
    ----------
    system : System
        The receivers.
    traced : (points, functions, 9, 3) float32 ndarray
        Irradiance harmonics measured at the data points.
    seen : (receivers, functions, 3) float32 ndarray
        Irradiance measured at the receivers; unbiased, as noisy as it comes.
    prior : float or (points,) ndarray
        Trust in the traced values, in receivers of mean weight; more where they have more paths than receivers.
    threads : int
        Blocks of columns solved at once.

    Returns
    -------
    (points, functions, 9, 3) float32 ndarray
        Linear in `traced` and `seen` together; equal to `traced` where no receiver looks.

    Raises
    ------
    ValueError
        Shapes do not fit, a value is not finite, the prior is not above 0.

    Notes
    -----
    Error: `TOLERANCE`; `test_the_fit_is_the_dense_least_squares_solution`. The same bits for any number of threads.
    With four receivers a data point and `trust` the error on surfaces fell by a quarter in the mean of ten transports
    of five scenes, and in free air rose by 2 %, by 12 % in the worst.
    Source: Iwanicki and Sloan 2017, "Precomputed Lighting in Call of Duty: Infinite Warfare"; the prior is ours.
    """
    traced, seen, prior = _check(system, traced, seen, prior)
    count = 3 * traced.shape[1]
    columns = traced.transpose(0, 2, 1, 3).reshape(system.points, harmonics.COUNT, count)
    flat, out = seen.reshape(len(seen), count), np.empty(columns.shape, np.float32)
    solver = Solver(system.operator, prior)
    size = max(1, min(COLUMNS, COLUMN_TAPS // max(system.operator.taps, 1)))
    parts = [slice(first, first + size) for first in range(0, count, size)]

    def work(part: slice) -> int:
        out[:, :, part] = solver.solve(columns[:, :, part], flat[:, part])
        return 1

    run_tiles(work, parts, threads)
    out[np.abs(out) < DARKNESS * np.abs(out).max(axis=(0, 1), initial=0)] = 0
    return np.ascontiguousarray(out.reshape(system.points, harmonics.COUNT, count // 3, 3).transpose(0, 2, 1, 3))


def trust(system: System, traced: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Choose the prior from how noisy receivers are, compared with how wrong the traced values are around them.

    Parameters
    ----------
    system : System
        The receivers.
    traced : (points, functions, 9, 3) float32 ndarray
        As for `fit`; one transport at a time, since each has its own noise.
    halves : (2, receivers, functions, 3) float32 ndarray
        Independent measurements of irradiance, as many paths in each.

    Returns
    -------
    (points,) float64 ndarray
        Prior for `fit`; large where fireflies would do more harm than good.

    Raises
    ------
    ValueError
        Shapes do not fit, or a value is not finite.

    Notes
    -----
    Error: as it knows the noise, fits are a little darker where fireflies are rare: by 0.3 % of the mean in most
    scenes, by 3 % where the traced values are 7 % too dark for the same reason.
    Source: empirical Bayes (Efron and Morris 1973).
    """
    if halves.shape != (2, len(system.row), traced.shape[1], 3):
        raise ValueError(f"halves are {halves.shape}; (2, {len(system.row)}, {traced.shape[1]}, 3) is needed")
    _check(system, traced, halves[0], PRIOR)
    _check_finite(halves[1], "seen")
    known = evaluate(system, traced)
    largest = max(np.abs(values).max(initial=0.0) for values in (known, halves))
    first, second = ((known - half).astype(np.float64) / (largest or 1.0) for half in halves)
    noise = _around(system, ((first - second) ** 2).sum(axis=(1, 2)) / 4)
    error = np.maximum(_around(system, (first * second).sum(axis=(1, 2))), 0.0)
    local = _local_weight(system)
    doubt = (
        DOUBT * local * _around(system, np.abs(first * second).sum(axis=(1, 2))) / np.maximum(_around(system), local)
    )
    ratio = (noise + doubt) / np.maximum(error + doubt, NOTHING)
    return np.minimum(LEAST_TRUST + NOISE_TRUST * ratio, MOST_TRUST) * local


def evaluate(system: System, values: np.ndarray) -> np.ndarray:
    """Return what receivers see of stored values.

    Parameters
    ----------
    system : System
        The receivers.
    values : (points, functions, 9, 3) float32 ndarray
        Irradiance harmonics.

    Returns
    -------
    (receivers, functions, 3) float32 ndarray
        Irradiance; not clamped at 0.
    """
    count = values.shape[1]
    by_term = np.ascontiguousarray(values.transpose(0, 2, 1, 3)).reshape(len(values), harmonics.COUNT, 3 * count)
    out = np.zeros((len(system.row), 3 * count), np.float32)
    basis = system.basis.astype(np.float32)
    for tap in range(system.row.shape[1]):
        seen = np.flatnonzero(system.weight[:, tap])
        for part in (seen[first : first + RECEIVERS] for first in range(0, len(seen), RECEIVERS)):
            share = system.weight[part, tap, None].astype(np.float32) * basis[part]
            out[part] += np.matmul(share[:, None], by_term[system.row[part, tap]])[:, 0]
    return out.reshape(len(out), count, 3)


def _around(system: System, values: np.ndarray | None = None) -> np.ndarray:
    """Sum over the receivers of each data point; of their weights without values."""
    share = system.weight * (system.receiver if values is None else system.receiver * values)[:, None]
    row = np.where(system.weight != 0, system.row, 0)
    return np.bincount(row.ravel(), share.ravel() / _mean(system.receiver), system.points)


def _local_weight(system: System) -> np.ndarray:
    """(points,) mean weight of the receivers around each data point; 1 where none counts."""
    row = np.where(system.weight != 0, system.row, 0)
    number = np.bincount(row.ravel(), system.weight.ravel(), system.points)
    weight = _around(system)
    return np.where(weight > 0, weight / np.maximum(number, NOTHING), 1.0)


def _mean(weights: np.ndarray) -> float:
    """Mean of the weights above 0; 1 where there is none."""
    positive = weights[weights > 0]
    return float(positive.mean(dtype=np.float64)) if len(positive) else 1.0


def _check(system: System, traced: np.ndarray, seen: np.ndarray, prior):
    """Refuse what does not fit together."""
    if traced.ndim != 4 or traced.shape[::2] != (system.points, harmonics.COUNT) or traced.shape[3] != 3:
        raise ValueError(f"traced is {traced.shape}; ({system.points}, functions, 9, 3) is needed")
    if seen.shape != (len(system.row), traced.shape[1], 3):
        raise ValueError(f"seen is {seen.shape}; ({len(system.row)}, {traced.shape[1]}, 3) is needed")
    _check_finite(traced, "traced")
    _check_finite(seen, "seen")
    return traced.astype(np.float32, copy=False), seen.astype(np.float32, copy=False), check_prior(system, prior)


def check_prior(system: System, prior: float | np.ndarray) -> np.ndarray:
    """Refuse a prior that is none.

    Parameters
    ----------
    system : System
        The receivers.
    prior : float or (points,) ndarray
        As in `fit`.

    Returns
    -------
    (points,) float64 ndarray
        The prior of each data point.

    Raises
    ------
    ValueError
        It is not above 0, or has another shape.
    """
    prior = np.asarray(prior, np.float64)
    if prior.shape not in ((), (system.points,)) or not (np.isfinite(prior) & (prior > 0)).all():
        raise ValueError(f"the prior must be above 0, one number or one for each of {system.points} data points")
    return np.broadcast_to(prior, (system.points,))


def _check_finite(values: np.ndarray, name: str) -> None:
    """Refuse NaN and infinity by name."""
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if len(wrong):
        raise ValueError(f"{name} of row {wrong[0]} is not finite ({len(wrong)} such rows); leave such receivers out")
