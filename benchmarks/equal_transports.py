"""The surface cache, paths and Cycles at equal error for each of many transports: samples that each needs, and runs.

Comes in: our estimators and Cycles' bakes at the same points. Goes out: all runs, with their costs and errors. First a
ladder of samples shows how errors fall; then paths and Cycles get what they need for the errors of the cache.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from gi_volumes.benchmarks.cost import Cost, median
from gi_volumes.benchmarks.cycles_transports import Bakes
from gi_volumes.benchmarks.equal_error import KINDS, Errors, Judge, needed, slopes
from gi_volumes.benchmarks.our_transports import Ours

GOAL = 0.05
"""Median error that the cache is to have."""

CACHE_LADDER, PATHS_LADDER, CYCLES_LADDER = (64, 128, 256, 512, 1024), (64, 512), (16, 128)
LIMITS = {"paths": (1 / 4, 8), "cycles": (1 / 8, 8)}
"""Samples of the last run over those of the ladder's end; beyond, equal error is extrapolated."""

APART = 1.5
"""Times more samples than the ladder's end, from which on the last run says how errors fall."""

CACHE_SEEDS = 1, 2
OTHER_SEED = 100
"""Between Cycles' seeds for one number of samples and the next: runs must not share samples."""

TIMED, TIMINGS = 128, 3
"""Paths of the points on which the cache and paths are timed against each other, and how often in a round."""

REFERENCE_SEEDS = 1000, 1001
AXIS_SHARE = 4
"""Paths of a reference for each of the six axes: this part of those that harmonics have."""


@dataclass
class Runs:
    """All runs of one estimator: `values` and `costs` by (samples, or function and samples), one for each repeat."""

    values: dict = field(default_factory=dict)
    costs: dict = field(default_factory=dict)

    def add(self, name, cost: Cost, values: np.ndarray | None) -> None:
        """Keep a run.

        Parameters
        ----------
        name : hashable
            Of what.
        cost : Cost
            Of it.
        values : ndarray or None
            Irradiance.
        """
        self.costs.setdefault(name, []).append(cost)
        self.values.setdefault(name, []).append(values)


class Comparison:
    """Everything that is measured in one scene.

    Parameters
    ----------
    ours : Ours
        Points, paths, cache.
    bakes : Bakes
        Cycles, at the judged points.
    reference : int
        Paths of each half of the reference.
    rounds : (int, int)
        Paths of a point with the cache at which errors are made equal, and repeats.
    """

    def __init__(self, ours: Ours, bakes: Bakes, reference: int, rounds: tuple[int, int]) -> None:
        self.ours, self.bakes, (self.samples, self.repeat) = ours, bakes, rounds
        self.cache, self.paths, self.cycles = Runs(), Runs(), Runs()
        self.timed, self.filling, self.equal = Runs(), [], {}
        rows, seeds = ours.judged, REFERENCE_SEEDS
        halves = [ours.measure(ours.scene, rows, reference, seed)[1] for seed in seeds]
        axes = [ours.exact(reference // AXIS_SHARE, seed) for seed in seeds]
        self.truth = Judge(np.stack(halves), ours.groups)
        self.exact = Judge(np.stack(axes), ours.groups)

    def run(self) -> None:
        """Measure: first how errors fall, then at equal error."""
        self.bakes.run(self.ours.transports[0], 1, 1)  # warms up
        self.caches = [self._fill(seed) for seed in range(1, self.repeat + 1)]
        self.enough = self._look_at_cache()
        functions = range(len(self.ours.transports))
        self._in_turn([(self._path, (n,)) for n in PATHS_LADDER], [(f, n) for f in functions for n in CYCLES_LADDER])
        for name, runs in self._ladders().items():
            slope, target = slopes(*runs["median"], self.ours.groups), self.targets("median")
            group, each = needed(runs["median"][1], target, slope, self.ours.groups)
            print(f"{name}: slopes {slope}, samples {group}", flush=True)
            least, most = np.array(LIMITS[name]) * runs["median"][1][0][0]
            each = np.full(len(each), max(group.values())) if name == "paths" else each
            self.equal[name] = np.clip(each, least, most).round().astype(int)
        bakes = list(zip(functions, self.equal["cycles"].tolist(), strict=True))
        self._in_turn([(self._path, (int(self.equal["paths"][0]),))], bakes)

    def needed(self, name: str, kind: str, samples: int = 0) -> tuple[dict[str, float], dict[str, float], np.ndarray]:
        """Say how many samples reach the cache's errors, after the runs that have nearly reached them.

        Parameters
        ----------
        name : str
            "paths" or "cycles".
        kind : str
            One of `KINDS`.
        samples : int
            Paths of the cache; 0 for those at which errors are made equal.

        Returns
        -------
        slope : dict of str to float
            Of each group, from the last rung of the ladder to the last run, or on the ladder if that is no farther.
        group : dict of str to float
            Samples of each group.
        each : (functions,) float64 ndarray
            Of each function.
        """
        ladder, groups = self._ladders()[name][kind], self.ours.groups
        last = self.equal[name].astype(float), self.errors_at_equal(kind)[name]
        slope, later = slopes(*ladder, groups), slopes(ladder[1], last, groups)
        for group, part in groups.items():
            if np.log(last[0][part] / ladder[1][0][part]).mean() > np.log(APART):
                slope[group] = later[group]
        return slope, *needed(last, self.targets(kind, samples), slope, groups)

    def cache_errors(self) -> dict[int, Errors]:
        """Median errors of the cache on its ladder.

        Returns
        -------
        dict of int to Errors
            By paths.
        """
        return {samples: self.truth.errors(runs, "median") for samples, runs in self.cache.values.items()}

    def targets(self, kind: str, samples: int = 0) -> Errors:
        """Errors of the cache, which the others are to have.

        Parameters
        ----------
        kind : str
            One of `KINDS`.
        samples : int
            Its paths; 0 for those at which errors are made equal.

        Returns
        -------
        Errors
        """
        return self.truth.errors(self.cache.values[samples or self.samples], kind)

    def errors_at_equal(self, kind: str) -> dict[str, Errors]:
        """Errors that all three have in the last runs.

        Parameters
        ----------
        kind : str
            One of `KINDS`.

        Returns
        -------
        dict of str to Errors
            By estimator.
        """
        return {
            "cache": self.targets(kind),
            "paths": self.truth.errors(self.paths.values[int(self.equal["paths"][0])], kind),
            "cycles": self.exact.errors(self._stacked(self.equal["cycles"]), kind),
        }

    def cycles_cost(self, function: int) -> tuple[Cost, Cost]:
        """What Cycles takes for a transport.

        Parameters
        ----------
        function : int
            Which.

        Returns
        -------
        sample : Cost
            Of one sample of a data point, all axes.
        overhead : Cost
            Of a bake without samples.
        """
        most = max(samples for one, samples in self.cycles.costs if one == function)
        first, last = (median(self.cycles.costs[function, samples]) for samples in (1, most))
        sample = (last - first) * (1 / (most - 1))
        return sample * (1 / len(self.ours.judged)), first - sample

    def _fill(self, seed: int):
        """A scene with a cache; the time it takes is kept."""
        cost, cached = self.ours.fill(seed)
        self.filling.append(cost)
        return cached

    def _look_at_cache(self) -> int:
        """Run the cache's ladder; the least paths with which it is good enough in each group, or the last ones."""
        for samples in CACHE_LADDER:
            for seed in CACHE_SEEDS:
                cached = self.caches[seed % len(self.caches)]
                self.cache.add(samples, *self.ours.measure(cached, self.ours.judged, samples, seed))
            found = self.truth.errors(self.cache.values[samples], "median").group
            print(f"cache, {samples} paths: {found}", flush=True)
        good = [n for n, errors in self.cache_errors().items() if max(errors.group.values()) <= GOAL]
        return min(good, default=CACHE_LADDER[-1])

    def _in_turn(self, ours: list[tuple[Callable, tuple]], cycles: list[tuple[int, int]]) -> None:
        """Everything of a round in random order, so that a busy minute disturbs no estimator more than others."""
        for seed in range(1, self.repeat + 1):
            jobs = [*ours, *((self._bake, job) for job in cycles), *TIMINGS * [(self._time, ("cache",))]]
            jobs += TIMINGS * [(self._time, ("paths",))]
            jobs += [(self._bake, (function, 1)) for function in sorted({function for function, _ in cycles})]
            for row in np.random.default_rng(seed).permutation(len(jobs)):
                run, arguments = jobs[row]
                run(*arguments, seed)

    def _path(self, samples: int, seed: int) -> None:
        """Paths at the judged points."""
        self.paths.add(samples, *self.ours.measure(self.ours.scene, self.ours.judged, samples, seed))

    def _time(self, which: str, seed: int) -> None:
        """The cache or paths where points are as dense as in a bake."""
        scene = self.caches[0] if which == "cache" else self.ours.scene
        self.timed.add(which, self.ours.measure(scene, self.ours.stretches, TIMED, seed)[0], None)

    def _bake(self, function: int, samples: int, seed: int) -> None:
        """Cycles at the judged points."""
        run = self.bakes.run(self.ours.transports[function], samples, seed + OTHER_SEED * samples)
        self.cycles.add((function, samples), *run)

    def _stacked(self, samples: Iterable[int]) -> list[np.ndarray]:
        """Runs of Cycles with so many samples for each function, as ours are."""
        parts = [self.cycles.values[function, int(count)] for function, count in enumerate(samples)]
        return [np.stack(each, axis=1) for each in zip(*parts, strict=False)]

    def _ladders(self) -> dict[str, dict[str, list[tuple[np.ndarray, Errors]]]]:
        """By estimator and kind of error: samples of each function, and errors, on the first two rungs."""
        ones, found = np.ones(len(self.ours.transports)), {"paths": {}, "cycles": {}}
        for kind in KINDS:
            found["paths"][kind] = [(ones * n, self.truth.errors(self.paths.values[n], kind)) for n in PATHS_LADDER]
            found["cycles"][kind] = [
                (ones * n, self.exact.errors(self._stacked([n] * len(ones)), kind)) for n in CYCLES_LADDER
            ]
        return found
