"""What the fit of data points to surfaces costs and gains.

    python benchmarks/fit.py [BAKE...] [--record]

Costs are for a made-up level of 24,000 data points and 100,000 receivers, on one thread. For a bake, receivers are
spread over its surfaces; a tenth of them judge, by two independent halves, fits of data points to the others, for
paths per data point, paths per receiver and receivers per data point.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gi_volumes.bake import datapoints, measured, receivers, reference, snapshot_file
from gi_volumes.bake.fit import System, evaluate, fit, trust
from gi_volumes.bake.fit_error import leverage
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import from_header, model, of_reference
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import harmonics, interpolate, world

POINTS, RECEIVERS, TAPS = 24_000, 100_000, 5
"""Of the made-up level: as many taps as receivers in a courtyard have on average."""

FUNCTIONS = (1, 2, 26)
"""A fixed light; sun and sky; local light, 16 sun keys and 9 functions of the sky."""

REPEATS = 3
JUDGES = 10
"""One receiver in so many only judges."""

JUDGE_SAMPLES = 256
"""Paths of each half at a judge."""

DATA_SAMPLES = (64, 256)
RECEIVER_SAMPLES = (16, 64)
DENSITIES = (1, 4)
"""Receivers per data point."""

ENOUGH = 0.02
"""Confidence from which a receiver takes part."""


@dataclass(frozen=True, eq=False)
class Level:
    """A bake's data points and surfaces.

    scene, data : what was baked
    bounces : reflections that light may undergo
    use : (r,) int64 receivers that fit, in random order; judge : (j,) int64 those that judge
    spread : receivers.Receivers
    row, weight, basis : of all receivers, as `System` takes them
    """

    scene: Scene
    data: interpolate.DataPoints
    bounces: int
    use: np.ndarray
    judge: np.ndarray
    spread: receivers.Receivers
    row: np.ndarray
    weight: np.ndarray
    basis: np.ndarray

    def system(self, rows: np.ndarray) -> System:
        """Some of the receivers, all alike."""
        return System(len(self.data.valid), self.row[rows], self.weight[rows], self.basis[rows], np.ones(len(rows)))

    def seen(self, rows: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """(2, rows, functions, 3) irradiance in two halves that share the paths."""
        at = self.spread.take(rows)
        halves = []
        for half in range(2):
            effort = Effort(max(1, samples // 2), self.bounces, seed + half)
            found = reference.at(self.scene, at.position + self.scene.origin, at.normal, effort, None, at.key)
            halves.append(measured.stack(self.scene, found)[:, :, 0])
        return np.stack(halves)

    def traced(self, samples: int) -> np.ndarray:
        """(points, functions, 9, 3) values at the data points."""
        rows = np.flatnonzero(self.data.valid)
        position = np.ascontiguousarray(self.data.position[rows].T.astype(np.float32))
        key = datapoints.keys(self.data.level[rows], self.data.coords[rows])
        effort = Effort(samples, self.bounces, 3)
        found = measured.stack(self.scene, gather(self.scene, HarmonicsSensor(), position, key, effort))
        out = np.zeros((len(self.data.valid), *found.shape[1:]), np.float32)
        out[rows] = found
        return out


def made_up(points: int, count: int) -> System:
    """A level of one long curved wall: receivers see neighbours in a row, normals turn slowly."""
    generator = np.random.default_rng(1)
    place = np.sort(generator.random(count)) * (points - TAPS)
    row, weight = np.zeros((count, 16), np.int64), np.zeros((count, 16), np.float32)
    row[:, :TAPS] = place.astype(np.int64)[:, None] + np.arange(TAPS)
    weight[:, :TAPS] = generator.random((count, TAPS)) + 0.1
    weight /= weight.sum(axis=1, keepdims=True)
    normal = np.stack([np.cos(place / 40), np.sin(place / 40), generator.normal(size=count)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    order = generator.permutation(count)
    return System(points, row[order], weight[order], harmonics.basis(normal[order]), np.ones(count))


def cost() -> dict[str, float]:
    """Median seconds of processor time on one thread.

    Returns
    -------
    dict of str to float
        By figure.
    """
    generator, figures = np.random.default_rng(2), {}
    for functions in FUNCTIONS:
        traced = generator.random((POINTS, functions, 9, 3)).astype(np.float32)
        seen = generator.random((RECEIVERS, functions, 3)).astype(np.float32)
        figures[f"{functions} functions [s]"] = _median(lambda t=traced, s=seen: fit(made_up(POINTS, RECEIVERS), t, s))
    figures["trust of 1 function [s]"] = _median(
        lambda: trust(made_up(POINTS, RECEIVERS), traced[:, :1], np.stack([seen[:, :1], seen[:, 1:2]]))
    )
    figures["leverage [s]"] = _median(lambda: leverage(made_up(POINTS, RECEIVERS)))
    return figures


def open_level(path: Path) -> Level:
    """Load a bake and spread receivers over it.

    Parameters
    ----------
    path : Path
        Folder of the bake.

    Returns
    -------
    Level
        With enough receivers for the largest of `DENSITIES`, where its surfaces have room for them.
    """
    baked = world.load(path)
    settings = of_reference(from_header(baked.header["settings"]))
    scene = prepare(*model(snapshot_file.load(path / SNAPSHOT_NAME), settings))
    data = baked._data
    low, high = data.boxes[:, 0].min(axis=0), data.boxes[:, 1].max(axis=0)
    spacing = float(data.size.min()) / (2 * max(DENSITIES)) ** 0.5
    spread = receivers.spread(scene, low, high, spacing)
    row, weight = interpolate.weigh(data, spread.position, spread.normal)
    total = weight.sum(axis=1)
    order = np.random.default_rng(4).permutation(np.flatnonzero(total > ENOUGH))
    cut = len(order) // JUDGES
    basis = harmonics.basis(spread.normal.astype(np.float64))
    shares = weight / np.maximum(total, ENOUGH)[:, None]
    return Level(scene, data, settings.bounces, order[cut:], order[:cut], spread, row, shares, basis)


def gain(level: Level) -> dict[str, float]:
    """Relative error on surfaces, as traced and fitted.

    Parameters
    ----------
    level : Level
        The bake.

    Returns
    -------
    dict of str to float
        Root mean square over the mean, by what was done.
    """
    figures, judges = {}, level.system(level.judge)
    truth = level.seen(level.judge, 2 * JUDGE_SAMPLES, 77)
    for samples in DATA_SAMPLES:
        traced = level.traced(samples)
        figures[f"{samples} paths"] = _error(evaluate(judges, traced), truth)
        for density in DENSITIES:
            rows = level.use[: density * int(level.data.valid.sum())]
            for paths in RECEIVER_SAMPLES:
                halves, system = level.seen(rows, paths, 5), level.system(rows)
                found = _fit_each(system, traced, halves)
                name = f"{samples} paths, {len(rows) / level.data.valid.sum():.1f} receivers of {paths}"
                figures[name] = _error(evaluate(judges, found), truth)
    return figures


def _fit_each(system: System, traced: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Fit function after function, each with its own trust."""
    out = np.empty_like(traced)
    for number in range(traced.shape[1]):
        part, seen = traced[:, number, None], halves[:, :, number, None]
        out[:, number, None] = fit(system, part, seen.mean(axis=0), trust(system, part, seen))
    return out


def _error(found: np.ndarray, truth: np.ndarray) -> float:
    """Relative error of luminance, over all functions alike; the noise of the truth cancels."""
    found, first, second = (np.maximum(values, 0.0) @ LUMINANCE for values in (found, *truth))
    squared = ((found - first) * (found - second)).mean(axis=0)
    return float(np.sqrt(np.maximum(squared / (truth.mean(axis=(0, 1)) @ LUMINANCE) ** 2, 0.0).mean()))


def _median(work) -> float:
    """Median seconds of processor time."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bakes", nargs="*", type=Path)
    parser.add_argument("--record", action="store_true", help="append to results.csv")
    arguments = parser.parse_args()
    tasks = [("fit cost", "made-up", cost)] if not arguments.bakes else []
    tasks += [("fit gain", path.name, lambda p=path: gain(open_level(p))) for path in arguments.bakes]
    for benchmark, scene, measure in tasks:
        figures = measure()
        if arguments.record:
            add_row(benchmark, scene, figures)
        else:
            print("\n".join(f"{benchmark} {scene}: {name} = {value:.4g}" for name, value in figures.items()))


if __name__ == "__main__":
    main()
