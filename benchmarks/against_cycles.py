"""Time to bake at equal error, ours and Cycles, on the same data points of a scene.

    python benchmarks/against_cycles.py SCENE [--points 1000] [--samples 64] [--bounces 4] [--repeat 5] [--threads 2]

Both estimate irradiance on the six axes of data points. Cycles bakes a quad for each axis; we gather nine harmonics
once ("harmonics", what a bake stores) or paths for each axis ("axes", what Cycles does). Runs alternate, each repeat
with another seed: times are medians, and noise is the scatter of the repeats. Bias is apart from it: the mean over
repeats against axes with many paths, which for harmonics is their truncation.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import bpy
import numpy as np
from gi_volumes.bake.gather import Effort, Gathered, gather
from gi_volumes.bake.scene import Model, Scene, prepare, scene_suns
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.snapshot import LightKind
from gi_volumes.benchmarks import coincident_faces, cycles_judge, scene_edits
from gi_volumes.benchmarks.cycles_agreement import TRANSPORTS, open_scene
from gi_volumes.benchmarks.results import add_row
from gi_volumes.benchmarks.transport import data_points
from gi_volumes.operators import extract
from gi_volumes.tree import harmonics

AXES = np.concatenate([np.eye(3), -np.eye(3)])
LADDER = {"harmonics": (16, 64, 256, 1024), "axes": (8, 32, 128)}
"""Our paths for each point, or axis: the error of Cycles lies between those of the first and the last."""

REFERENCE_SEEDS = (1000, 1001)
FIRST_SEED = 1


@dataclass(frozen=True)
class Runs:
    """Repeats of one estimate at n points; the first one has warmed up and is gone.

    Parameters
    ----------
    seconds : (k,) float64 [s]
        Of each repeat.
    values : (k, n, 6) float64 [W/m2]
        Mean of the three channels.
    """

    seconds: np.ndarray
    values: np.ndarray

    @property
    def time(self) -> float:
        """Median [s]."""
        return float(np.median(self.seconds))

    @property
    def noise(self) -> float:
        """Standard deviation of one repeat, root mean square over points and axes, relative to the mean."""
        return float(np.sqrt(self.values.var(axis=0, ddof=1).mean()) / self.values.mean())

    @property
    def typical_noise(self) -> float:
        """Median over points of the same, relative to each point's own mean: bright spots do not decide it."""
        own = self.values.mean(axis=(0, 2))
        deviation = np.sqrt(self.values.var(axis=0, ddof=1).mean(axis=1))
        return float(np.median(deviation[own > 0] / own[own > 0]))


def bias(runs: Runs, reference: np.ndarray) -> tuple[float, float]:
    """Compare the mean over repeats with a reference.

    Parameters
    ----------
    runs : Runs
        What is judged.
    reference : (2, n, 6) float64 ndarray [W/m2]
        Two independent runs with many paths.

    Returns
    -------
    mean : float
        Difference of the means over all points and axes, relative.
    spread : float
        Root mean square difference over points and axes, relative to the mean, without what the noise of both
        explains.
    """
    apart = runs.values.mean(axis=0) - reference.mean(axis=0)
    explained = runs.values.var(axis=0, ddof=1) / len(runs.values) + reference.var(axis=0, ddof=1) / len(reference)
    scale = reference.mean()
    return float(apart.mean() / scale), float(np.sqrt(max((apart**2 - explained).mean(), 0)) / scale)


def time_at(noise: float, ladder: list[Runs], kind: str = "noise") -> float:
    """Interpolate the time that an estimate takes to come down to a noise.

    Parameters
    ----------
    noise : float
        Above 0.
    ladder : list of Runs
        At least two, of more and more paths.
    kind : str
        "noise" or "typical_noise".

    Returns
    -------
    float [s]
        On a straight line through the two nearest rungs, both axes logarithmic; beyond the ladder, its end prolonged.
    """
    x = np.log([getattr(runs, kind) for runs in ladder])
    y = np.log([runs.time for runs in ladder])
    rung = int(np.clip(np.searchsorted(-x, -np.log(noise)), 1, len(x) - 1))
    slope = (y[rung] - y[rung - 1]) / (x[rung] - x[rung - 1])
    return float(np.exp(y[rung] + slope * (np.log(noise) - x[rung])))


class Ours:
    """Our gathering at data points of the open scene.

    Parameters
    ----------
    count : int
        Of points.
    bounces, threads : int
        As in `Effort`.
    """

    def __init__(self, count: int, bounces: int, threads: int) -> None:
        self.snapshot = extract.extract(bpy.context)
        self._suns = scene_suns(self.snapshot)
        self._effort = Effort(1, bounces, threads=threads)
        start = time.perf_counter()
        self._scene = prepare(self.snapshot, Model(True, self._suns, "fixed"))
        self.preparation = time.perf_counter() - start
        self._position, self._keys = data_points(self._scene, count)

    @property
    def points(self) -> np.ndarray:
        """(n, 3) float64 data points in world space [m]."""
        return self._position.T.astype(np.float64) + self.snapshot.origin

    def estimate(self, transport: str, sensor: str, samples: int, seed: int) -> tuple[float, dict[str, np.ndarray]]:
        """Gather once.

        Parameters
        ----------
        transport : str
            One of `TRANSPORTS`, or "all".
        sensor : str
            "harmonics" or "axes".
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        seconds : float [s]
        values : dict
            (n, 6) irradiance [W/m2] for each transport, mean of the channels.
        """
        scene = self._with(transport)
        effort = replace(self._effort, samples=samples, seed=seed)
        start = time.perf_counter()
        if sensor == "harmonics":
            found = gather(scene, HarmonicsSensor(), self._position, self._keys, effort)
        else:
            position, keys = np.repeat(self._position, 6, axis=1), np.arange(6 * len(self._keys), dtype=np.uint32)
            normals = np.tile(AXES.T, len(self._keys)).astype(np.float32)
            found = gather(scene, SurfaceSensor(normals), position, keys, effort)
        seconds = time.perf_counter() - start
        names = TRANSPORTS if transport == "all" else (transport,)
        return seconds, {name: self._irradiance(scene, found, name, sensor) for name in names}

    def _with(self, transport: str) -> Scene:
        """The scene with one transport, or all of them."""
        suns = self._suns if transport in ("sun", "all") else type(self._suns)()
        sky = "fixed" if transport in ("sky", "all") else "none"
        return replace(self._scene, model=Model(transport in ("local", "all"), suns, sky))

    def _irradiance(self, scene: Scene, found: Gathered, transport: str, sensor: str) -> np.ndarray:
        """(n, 6) irradiance at the scene's own light."""
        part = {"local": found.local, "sky": found.sky[:, 0] if len(found.sky) else found.sky}.get(transport)
        if transport == "sun":
            lights = self.snapshot.lights
            strength = lights.strength[(lights.kind == LightKind.SUN) & (lights.strength > 0).any(axis=1)]
            part = np.einsum("nkrc,kc->nrc", found.sun, strength)
        if sensor == "axes":
            return part.astype(np.float64).mean(axis=2).reshape(-1, 6)
        grey = part.astype(np.float64).mean(axis=2)
        return grey @ harmonics.basis(AXES).T.astype(np.float64)


def cycles(points: np.ndarray, transport: str, samples: int, bounces: int, threads: int, seed: int):
    """Let Cycles bake the six axes once.

    Parameters
    ----------
    points : (n, 3) float64 ndarray [m]
        In world space.
    transport : str
        One of `TRANSPORTS`.
    samples, bounces, threads, seed : int
        As in `cycles_judge.Settings`.

    Returns
    -------
    seconds : float [s]
        Of all that is needed: quads, synchronisation, rays.
    values : (n, 6) float64 ndarray [W/m2]
        Mean of the channels.
    """
    settings = cycles_judge.Settings(samples=samples, bounces=bounces, seeds=(seed,), threads=threads)
    quads, normals = np.repeat(points, 6, axis=0), np.tile(AXES, (len(points), 1))
    start = time.perf_counter()
    found = cycles_judge.irradiance(quads, normals, transport, settings)
    return time.perf_counter() - start, found.mean.mean(axis=1).reshape(-1, 6)


def repeat(jobs: dict[tuple, Callable[[int], tuple[float, dict]]], count: int) -> dict[tuple, Runs]:
    """Run jobs in turn, again and again, after one round to warm up.

    Parameters
    ----------
    jobs : dict
        From a name to a function of the seed that returns seconds and values by transport.
    count : int
        Rounds that are kept.

    Returns
    -------
    dict
        Runs by (*name, transport).
    """
    rounds = [{name: job(FIRST_SEED + k) for name, job in jobs.items()} for k in range(count + 1)][1:]
    return {
        (*name, transport): Runs(
            np.array([each[name][0] for each in rounds]), np.stack([each[name][1][transport] for each in rounds])
        )
        for name in jobs
        for transport in rounds[0][name][1]
    }


def main() -> None:
    """Measure one scene."""
    options = _parse()
    open_scene(options.scene)
    coincident_faces.remove_coincident()
    ours = Ours(options.points, options.bounces, options.threads)
    scene_edits.make_diffuse()
    transports = [name for name in TRANSPORTS if ours.estimate(name, "harmonics", 16, 0)[1][name].any()]
    runs = repeat(_jobs(ours, transports, options), options.repeat)
    references = [ours.estimate("all", "axes", options.reference, seed)[1] for seed in REFERENCE_SEEDS]
    for transport in transports:
        reference = np.stack([each[transport] for each in references])
        add_row("against_cycles", f"{options.scene.stem} {transport}", _figures(runs, transport, reference))
    add_row(
        "against_cycles",
        f"{options.scene.stem} all",
        _figures_of_all(runs, transports) | {"prepare_s": ours.preparation},
    )


def _jobs(ours: Ours, transports: list[str], options: argparse.Namespace) -> dict[tuple, Callable]:
    """Everything that is timed."""
    jobs = {}

    def add_ours(transport: str, sensor: str, samples: int) -> None:
        jobs[("ours", sensor, transport, samples)] = lambda seed: ours.estimate(transport, sensor, samples, seed)

    def add_cycles(transport: str, samples: int) -> None:
        def job(seed: int) -> tuple[float, dict]:
            seconds, values = cycles(ours.points, transport, samples, options.bounces, options.threads, seed)
            return seconds, {transport: values}

        jobs[("cycles", transport, samples)] = job

    for transport in transports:
        add_cycles(transport, 1)
        add_cycles(transport, options.samples)
        for sensor, ladder in LADDER.items():
            for samples in ladder:
                add_ours(transport, sensor, samples)
    for samples in LADDER["harmonics"]:
        add_ours("all", "harmonics", samples)
    return jobs


def _ladder(runs: dict[tuple, Runs], sensor: str, model: str, transport: str) -> list[Runs]:
    """Our runs of one transport, fewer paths first, traced alone or with all others."""
    return [runs["ours", sensor, model, samples, transport] for samples in LADDER[sensor]]


def _cycles(runs: dict[tuple, Runs], transport: str) -> tuple[Runs, float]:
    """Cycles' runs, and the seconds that it spends on other things than samples."""
    first, full = sorted(key for key in runs if key[:2] == ("cycles", transport))
    samples = full[2]
    overhead = runs[first].time - (runs[full].time - runs[first].time) / (samples - 1)
    return runs[full], overhead


def _figures(runs: dict[tuple, Runs], transport: str, reference: np.ndarray) -> dict[str, float]:
    """Figures of one transport."""
    judge, overhead = _cycles(runs, transport)
    seconds = judge.time - overhead
    figures = {
        "reference_noise": float(np.sqrt(reference.var(axis=0, ddof=1).mean() / 2) / reference.mean()),
        "cycles_s": seconds,
        "cycles_overhead_s": overhead,
        "cycles_noise": judge.noise,
        "cycles_typical_noise": judge.typical_noise,
        "cycles_bias": bias(judge, reference)[0],
        "cycles_s_noise2": seconds * judge.noise**2,
    }
    for sensor in LADDER:
        ladder = _ladder(runs, sensor, transport, transport)
        last = ladder[-1]
        figures |= {
            f"{sensor}_s_at_cycles_noise": time_at(judge.noise, ladder),
            f"{sensor}_speedup": seconds / time_at(judge.noise, ladder),
            f"{sensor}_typical_speedup": seconds / time_at(judge.typical_noise, ladder, "typical_noise"),
            f"{sensor}_s_noise2": last.time * last.noise**2,
            f"{sensor}_bias": bias(last, reference)[0],
            f"{sensor}_bias_rms": bias(last, reference)[1],
        }
    return figures


def _figures_of_all(runs: dict[tuple, Runs], transports: list[str]) -> dict[str, float]:
    """One gathering of all transports, long enough for the slowest, against one bake for each."""
    judges = {name: _cycles(runs, name) for name in transports}
    seconds = sum(judge.time - overhead for judge, overhead in judges.values())
    figures = {"cycles_s": seconds, "cycles_overhead_s": sum(overhead for _, overhead in judges.values())}
    for kind, name in (("noise", "speedup"), ("typical_noise", "typical_speedup")):
        needed = [
            time_at(getattr(judges[each][0], kind), _ladder(runs, "harmonics", "all", each), kind)
            for each in transports
        ]
        figures[f"harmonics_{name}"] = seconds / max(needed)
    return figures


def _parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help=".blend, .glb or .gltf file")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=64, help="of Cycles for each point and axis")
    parser.add_argument("--bounces", type=int, default=4)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--reference", type=int, default=1024, help="paths for each point and axis, twice")
    return parser.parse_args()


if __name__ == "__main__":
    main()
