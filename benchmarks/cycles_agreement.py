"""Compares our path-traced reference with Cycles, transport by transport, on surface points of a scene.

    python benchmarks/cycles_agreement.py SCENE [--points N] [--samples S] [--paths P] [--bounces B]
                                          [--transports sky,sun,local] [--keep-coincident] [--bright] [--worst K]
                                          [--materials diffuse|smooth|filtered|clear|original]

Comes in: a .blend, .glb or .gltf file; what lacks a sky or a sun gets one. Goes out: a line for each transport, and
a row of agreement.csv. With diffuse materials Cycles models what we model, so that the difference has to be noise;
with the original ones the difference is what we leave out.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import bpy
import numpy as np
from gi_volumes.benchmarks import coincident_faces, cycles_judge, scene_edits, surface_points
from gi_volumes.benchmarks.results import commit

RESULTS = Path(__file__).with_name("agreement.csv")
TRANSPORTS = ("sky", "sun", "local")
MATERIALS = ("diffuse", "smooth", "filtered", "clear", "original")
"""What Cycles gets: what the bake models, that with smooth normals or with filtered textures, everything but glass
that refracts, or everything."""

SKY_RADIANCE, SUN_IRRADIANCE = 1.0, 4.0
SUN_TILT = (math.radians(38), 0.0, math.radians(-35))
"""Turns a sun that shines down: high enough to reach into courts and windows."""
FIRST_SEED, SEEDS = 1, 2
PILOT_PATHS, PILOT_SEED = 32, 99
PILOT_CANDIDATES = 4
"""Points to choose the bright ones from, for each one that is wanted."""

PILOT_FLOOR = 0.05
"""Chance of dark points, over that of a point of mean brightness, so that nothing is left out."""


Estimator = Callable[[np.ndarray, np.ndarray, str, tuple[int, ...]], np.ndarray]
"""From points, normals, a transport and k seeds to k runs of irradiance, (k, n, 3) [W/m2]."""


@dataclass(frozen=True)
class Agreement:
    """How two estimates of one transport compare, on the mean of the three channels.

    Parameters
    ----------
    mean : float [W/m2]
        Of Cycles, over all points.
    difference : float
        Of our mean from it, relative.
    error : float
        Standard error of `difference` that the noise of both explains.
    correlation : float
        Over the points.
    rmse : float
        Root mean square difference, relative to the mean.
    noise : float
        The same as the noise of both explains.
    z : float
        `difference` in units of its error.
    channel_z : float
        The same of the channel, red, green or blue, that is furthest off.
    """

    mean: float
    difference: float
    error: float
    correlation: float
    rmse: float
    noise: float
    z: float
    channel_z: float


def agreement(ours: np.ndarray, judge: np.ndarray) -> Agreement:
    """Compare two sets of runs on the same points.

    Parameters
    ----------
    ours, judge : (k, n, 3) ndarray [W/m2]
        At least two independent runs each; k may differ.

    Returns
    -------
    Agreement
        All NaN but the mean where Cycles sees no light at all.
    """
    means, variances = zip(*(_moments(runs) for runs in (ours, judge)), strict=True)
    scale = means[1].mean()
    if scale == 0:
        return Agreement(0.0, *(7 * [math.nan]))
    apart, variance = means[0] - means[1], variances[0] + variances[1]
    error = np.sqrt(variance.sum()) / len(apart)
    return Agreement(
        mean=float(scale),
        difference=float(apart.mean() / scale),
        error=float(error / scale),
        correlation=float(np.corrcoef(*means)[0, 1]),
        rmse=float(np.sqrt((apart**2).mean()) / scale),
        noise=float(np.sqrt(variance.mean()) / scale),
        z=float(apart.mean() / error),
        channel_z=max((_pooled_z(ours[..., k], judge[..., k]) for k in range(3)), key=abs),
    )


def worst(ours: np.ndarray, judge: np.ndarray, count: int) -> np.ndarray:
    """Find the points that a difference of the pooled means comes from.

    Parameters
    ----------
    ours, judge : (k, n, 3) ndarray [W/m2]
        As in `agreement`.
    count : int
        How many.

    Returns
    -------
    (count,) int64 ndarray
        Rows, those that are furthest apart first.
    """
    apart = np.abs(_moments(ours)[0] - _moments(judge)[0])
    return np.argsort(-apart, kind="stable")[:count]


def _moments(runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) mean over runs and channels, and the variance of that mean."""
    runs = np.asarray(runs, np.float64)
    grey = runs.mean(axis=2) if runs.ndim == 3 else runs
    return grey.mean(axis=0), grey.var(axis=0, ddof=1) / len(grey)


def _pooled_z(ours: np.ndarray, judge: np.ndarray) -> float:
    """Difference of the means over all points of one channel (k, n), in units of its error; 0 where neither varies."""
    (mine, variance), (other, other_variance) = _moments(ours), _moments(judge)
    error = np.sqrt((variance + other_variance).sum())
    return float((mine - other).sum() / error) if error > 0 else 0.0


def open_scene(path: Path) -> list[str]:
    """Open a scene, and light it if nobody did.

    Parameters
    ----------
    path : Path
        A .blend, .glb or .gltf file.

    Returns
    -------
    list of str
        What was added.
    """
    if path.suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(path))
    else:
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.import_scene.gltf(filepath=str(path))
    scene, added = bpy.context.scene, []
    if scene.world is None:
        scene.world = scene_edits.uniform_world("added sky", SKY_RADIANCE)
        added.append("sky")
    if not any(light.type == "SUN" for light in bpy.data.lights):
        sun = bpy.data.lights.new("added sun", "SUN")
        sun.energy = SUN_IRRADIANCE
        lamp = bpy.data.objects.new("added sun", sun)
        lamp.rotation_euler = SUN_TILT
        scene.collection.objects.link(lamp)
        added.append("sun")
    bpy.context.view_layer.update()
    return added


def our_estimator(paths: int, bounces: int) -> Estimator:
    """Prepare our reference on the open scene.

    Parameters
    ----------
    paths, bounces : int
        Paths for each point in one run, and reflections.

    Returns
    -------
    Estimator
        The sun at its own strength.
    """
    from gi_volumes.bake import reference
    from gi_volumes.operators import extract

    snapshot = extract.extract(bpy.context)
    suns = snapshot.lights.strength[snapshot.lights.kind == reference.LightKind.SUN]

    def estimate(points: np.ndarray, normals: np.ndarray, transport: str, seeds: tuple[int, ...]) -> np.ndarray:
        scale = suns[0] if transport == "sun" else 1.0
        runs = [
            reference.irradiance(snapshot, points, normals, transport, samples=paths, bounces=bounces, seed=seed)
            for seed in seeds
        ]
        return np.stack(runs) * scale

    return estimate


def cycles_estimator(samples: int, bounces: int) -> Estimator:
    """Prepare the judge on the open scene.

    Parameters
    ----------
    samples, bounces : int
        As in `cycles_judge.Settings`.

    Returns
    -------
    Estimator
    """

    def estimate(points: np.ndarray, normals: np.ndarray, transport: str, seeds: tuple[int, ...]) -> np.ndarray:
        settings = cycles_judge.Settings(samples=samples, bounces=bounces, seeds=seeds)
        return cycles_judge.irradiance(points, normals, transport, settings).runs

    return estimate


def bright(points: np.ndarray, pilot: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Choose points by how much light arrives, so that few samples are spent on darkness.

    Parameters
    ----------
    points : (n, 3) ndarray
        To choose from.
    pilot : (n,) ndarray
        Rough irradiance there, from numbers that nothing else uses.
    count : int
        How many, at most n.
    seed : int
        Of the choice.

    Returns
    -------
    (count,) int64 ndarray
        Rows.
    """
    chance = pilot + max(PILOT_FLOOR * pilot.mean(), 1e-30)
    return np.random.default_rng(seed).choice(len(points), count, replace=False, p=chance / chance.sum())


@dataclass(frozen=True)
class Plan:
    """What to compare, and how well; the fields are the options of the command line, and columns of the results.

    points : on surfaces
    samples : of Cycles for each point, seed and pass
    paths : of ours for each point and seed
    bounces : reflections
    seed : of the choice of points; light has its own
    materials : one of `MATERIALS`
    against : "ours", or "cycles": the judge against itself
    keep_coincident : whether faces that lie in others stay in the scene
    bright : whether points are chosen by how much light arrives, not by area alone
    """

    points: int = 1000
    samples: int = 128
    paths: int = 512
    bounces: int = 4
    seed: int = 0
    materials: str = "diffuse"
    against: str = "ours"
    keep_coincident: bool = False
    bright: bool = False


@dataclass(frozen=True)
class Comparison:
    """Runs of one transport at the same points.

    Parameters
    ----------
    points, normals : (n, 3) float64 ndarray
        World space [m], unit length.
    ours, judge : (k, n, 3) ndarray [W/m2]
        Independent runs.
    """

    points: np.ndarray
    normals: np.ndarray
    ours: np.ndarray
    judge: np.ndarray


def compare(plan: Plan, transports: Iterable[str] = TRANSPORTS) -> Iterator[Comparison]:
    """Compare ours with Cycles on the open scene, whose materials and faces are changed.

    Parameters
    ----------
    plan : Plan
        What to compare.
    transports : iterable of str
        Keys of `cycles_judge.TRANSPORTS`.

    Yields
    ------
    Comparison
        One for each transport.
    """
    if not plan.keep_coincident:
        removed, left = coincident_faces.remove_coincident()
        print(f"removed {removed} faces that lie in others; {100 * left:.2f} % of the area still lies in others")
    count = plan.points * (PILOT_CANDIDATES if plan.bright else 1)
    candidates = surface_points.pick(surface_points.world_triangles(), count, plan.seed)
    # Ours read the scene before the judge's edits.
    pilot, ours = our_estimator(PILOT_PATHS, plan.bounces), our_estimator(plan.paths, plan.bounces)
    judge = cycles_estimator(plan.samples, plan.bounces)
    if plan.materials != "original":
        scene_edits.make_diffuse(*(plan.materials == kept for kept in ("smooth", "filtered", "clear")))
    seeds, others = (tuple(range(first, first + SEEDS)) for first in (FIRST_SEED, FIRST_SEED + SEEDS))
    for transport in transports:
        points, normals = candidates
        if plan.bright:
            light = pilot(points, normals, transport, (PILOT_SEED,))[0].mean(axis=1)
            rows = bright(points, light, plan.points, plan.seed)
            points, normals = points[rows], normals[rows]
        mine = (ours if plan.against == "ours" else judge)(points, normals, transport, others)
        yield Comparison(points, normals, mine, judge(points, normals, transport, seeds))


def main() -> None:
    """Compare, print, and append to the results."""
    options = _parse()
    added = open_scene(options.scene)
    print(f"{options.scene.name}: added {', '.join(added) or 'nothing'}")
    plan = Plan(**{field.name: getattr(options, field.name) for field in fields(Plan)})
    transports = options.transports.split(",")
    for transport, found in zip(transports, compare(plan, transports), strict=True):
        result = agreement(found.ours, found.judge)
        print(_line(transport, result), flush=True)
        _print_worst(found, options.worst)
        if options.record:
            _append(options.scene.name, transport, plan, result)


def _print_worst(found: Comparison, count: int) -> None:
    """Where to look for the cause of a difference."""
    for row in worst(found.ours, found.judge, count):
        mine, theirs = (
            f"{part[:, row].mean():.5f} {part[:, row].mean(axis=1).round(5)}" for part in (found.ours, found.judge)
        )
        print(f"    at {found.points[row].round(3)} facing {found.normals[row].round(3)}: ours {mine}, Cycles {theirs}")


def _parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help=".blend, .glb or .gltf file")
    parser.add_argument("--transports", default=",".join(TRANSPORTS), help="with commas between")
    for name, help in (
        ("points", None),
        ("samples", "of Cycles for each point, seed and pass"),
        ("paths", "of ours for each point and seed"),
        ("bounces", None),
        ("seed", "of the choice of points"),
    ):
        parser.add_argument(f"--{name}", type=int, default=getattr(Plan, name), help=help)
    parser.add_argument("--materials", choices=MATERIALS, default="diffuse")
    parser.add_argument(
        "--against", choices=("ours", "cycles"), default="ours", help="cycles: the judge against itself"
    )
    parser.add_argument("--keep-coincident", action="store_true", help="faces that lie in others stay in the scene")
    parser.add_argument("--bright", action="store_true", help="choose points by how much light arrives")
    parser.add_argument("--worst", type=int, default=0, help="print so many points that are furthest apart")
    parser.add_argument("--no-record", dest="record", action="store_false", help="leave agreement.csv alone")
    return parser.parse_args()


def _line(transport: str, result: Agreement) -> str:
    """A result for people."""
    return (
        f"{transport:6} mean {result.mean:9.5f} W/m2   difference {100 * result.difference:+7.3f} % "
        f"+- {100 * result.error:.3f} % (z {result.z:+.1f}, channel {result.channel_z:+.1f})   "
        f"correlation {result.correlation:.4f}   RMSE {100 * result.rmse:.1f} % (noise {100 * result.noise:.1f} %)"
    )


def _append(scene: str, transport: str, plan: Plan, result: Agreement) -> None:
    """Add a row to the results, under a header if it is the first."""
    row = {"commit": commit(), "blender": bpy.app.version_string, "scene": scene, "transport": transport}
    row |= asdict(plan) | {name: f"{value:.6g}" for name, value in asdict(result).items()}
    is_new = not RESULTS.exists()
    with RESULTS.open("a", newline="") as file:
        writer = csv.DictWriter(file, row, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
