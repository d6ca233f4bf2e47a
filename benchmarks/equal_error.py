"""Errors of many transports at once, and the samples that an estimator needs for a given error.

Comes in: irradiance at points and axes for many functions of light, and two independent references. Goes out: errors of
groups of functions and of each function, noise of the references taken out as in `errors.py`; the slope of error
against samples. A point's error is the root mean square over axes and channels, relative to that of its light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

KINDS = "median", "rms"
"""Median over points of a point's relative error; root mean square over points, relative to the points' mean light."""

DARK = 1e-2
"""Points with less light than this part of the mean are left out of medians: references cannot tell it from none."""

COUNTS = 0.1
"""A function counts where it brings at least this part of what its group brings."""

FEWEST = 20
"""Points on which a function has to count; others share the error of their group."""

LEAST = 1e-6
"""Errors are at least this, as their logarithms are taken."""

SPREAD = 4
"""A function takes at most this many times more or fewer samples than its group: beyond, its error is scatter."""

FLATTEST = -0.2
"""Errors of independent samples fall at least so fast, though scatter may hide it."""


@dataclass(frozen=True)
class Errors:
    """Relative errors.

    Parameters
    ----------
    group : dict of str to float
        Of all functions of a group together.
    each : (functions,) float64 ndarray
        Of each function, where it counts.
    """

    group: dict[str, float]
    each: np.ndarray


class Judge:
    """Compares with two independent references.

    Parameters
    ----------
    halves : (2, n, functions, axes, 3) ndarray
        Irradiance [W/m2].
    groups : dict of str to slice
        Functions that belong together.
    """

    def __init__(self, halves: np.ndarray, groups: dict[str, slice]) -> None:
        self._halves, self.groups = halves.astype(np.float64), groups
        self._own = (self._halves[0] * self._halves[1]).mean(axis=(2, 3))
        self._light = {name: self._own[:, part].mean(axis=1) for name, part in groups.items()}

    def errors(self, runs: list[np.ndarray], kind: str) -> Errors:
        """Judge independent runs of an estimator.

        Parameters
        ----------
        runs : list of (n, functions, axes, 3) ndarray
            What they found.
        kind : str
            One of `KINDS`.

        Returns
        -------
        Errors
            Of one run, on average.
        """
        one, other = self._halves
        squared = np.mean([((run - one) * (run - other)).mean(axis=(2, 3)) for run in runs], axis=0)
        return self._summed(squared, kind)

    def apart(self, other: Judge, kind: str) -> Errors:
        """Compare the references themselves with those of another judge.

        Parameters
        ----------
        other : Judge
            Of independent halves.
        kind : str
            One of `KINDS`.

        Returns
        -------
        Errors
            What no number of samples takes away.
        """
        squared = np.prod(self._halves - other._halves, axis=0).mean(axis=(2, 3))
        return self._summed(squared, kind)

    def _summed(self, squared: np.ndarray, kind: str) -> Errors:
        """Errors from (n, functions) squared ones."""
        group, each = {}, np.zeros(squared.shape[1])
        for name, part in self.groups.items():
            light = self._light[name]
            group[name] = _relative(squared[:, part].mean(axis=1), light, kind)
            for function in range(part.start, part.stop):
                rows = self._own[:, function] > COUNTS**2 * light
                rows &= light > 0
                enough = rows.sum() >= FEWEST
                own = _relative(squared[rows, function], self._own[rows, function], kind) if enough else group[name]
                each[function] = own
        return Errors(group, each)


def _relative(squared: np.ndarray, light: np.ndarray, kind: str) -> float:
    """Root of squared errors of points relative to their light, both (n,) mean squares."""
    mean = np.sqrt(np.maximum(light, 0)).mean()
    if kind == "rms":
        found = squared.mean() / max(mean, LEAST) ** 2
    else:
        rows = light > (DARK * mean) ** 2
        found = np.median(squared[rows] / light[rows]) if rows.any() else 0
    return float(max(np.sqrt(max(found, 0)), LEAST))


def slopes(
    first: tuple[np.ndarray, Errors], last: tuple[np.ndarray, Errors], groups: dict[str, slice]
) -> dict[str, float]:
    """Say how errors fall from one run to another.

    Parameters
    ----------
    first, last : (samples, errors)
        (functions,) samples of each function, and the errors with them.
    groups : dict of str to slice
        Functions that belong together.

    Returns
    -------
    dict of str to float
        Exponents of the samples, at most `FLATTEST`.
    """
    out = {}
    for name, part in groups.items():
        more = np.log(last[0][part] / first[0][part]).mean()
        out[name] = min(FLATTEST, np.log(last[1].group[name] / first[1].group[name]) / max(more, LEAST))
    return out


def needed(
    run: tuple[np.ndarray, Errors], target: Errors, slope: dict[str, float], groups: dict[str, slice]
) -> tuple[dict[str, float], np.ndarray]:
    """Say how many samples reach given errors, from a run that is near them.

    Parameters
    ----------
    run : (samples, errors)
        (functions,) samples of each function, and the errors with them.
    target : Errors
        What to reach.
    slope : dict of str to float
        As `slopes` returns it.
    groups : dict of str to slice
        Functions that belong together.

    Returns
    -------
    group : dict of str to float
        Geometric mean of samples at which the group's error is that of the target.
    each : (functions,) float64 ndarray
        Samples of each function for its own error; at least 1, and not too far from the group's.
    """
    group, each = {}, np.zeros(len(target.each))
    for name, part in groups.items():
        power = 1 / slope[name]
        group[name] = float(np.exp(np.log(run[0][part]).mean()) * (target.group[name] / run[1].group[name]) ** power)
        known = (target.each[part] > LEAST) & (run[1].each[part] > LEAST)
        own = run[0][part] * (target.each[part] / run[1].each[part]) ** power
        each[part] = np.clip(np.where(known, own, group[name]), group[name] / SPREAD, group[name] * SPREAD)
    return group, np.maximum(each, 1)
