"""A bake again after a change: how much less time it takes than a whole bake, and how far apart the two are.

    python benchmarks/incremental.py BAKE (--dim LAMP | --move OBJECT=x,y,z) [--strength 0.5] [--runs 3] [--record]

A lamp of the scene is dimmed, or an object moved. BAKE says scene and settings. The scene is baked as it was with
`--incremental`; then, in turns, changed and baked again over a copy of that, and baked as a whole. Seconds are those of
the clock, and those of all processors, the medians. Both are looked up at 20,000 points all over the surfaces:
differences relative to what is there, at least to a tenth of the mean.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import job, receivers, snapshot_file
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, from_header, model
from gi_volumes.bake.snapshot import Snapshot
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import world

POINTS, SPACING = 20_000, 0.35
"""Points on surfaces, and the distance between those that they are drawn from [m]."""

DARK = 0.1
"""Part of the mean that differences are relative to at least."""


def dimmed(snapshot: Snapshot, lamp: str, factor: float) -> Snapshot:
    """Scale a lamp.

    Parameters
    ----------
    snapshot : Snapshot
        A scene.
    lamp : str
        Its name.
    factor : float
        What its strength is multiplied with.

    Returns
    -------
    Snapshot
        The scene with that lamp.
    """
    strength = snapshot.lights.strength.copy()
    strength[snapshot.lights.names.index(lamp)] *= factor
    return dataclasses.replace(snapshot, lights=dataclasses.replace(snapshot.lights, strength=strength))


def moved(snapshot: Snapshot, thing: str, by: np.ndarray) -> Snapshot:
    """Move an object.

    Parameters
    ----------
    snapshot : Snapshot
        A scene.
    thing : str
        Its name.
    by : (3,) float64 ndarray
        How far [m].

    Returns
    -------
    Snapshot
        The scene with the object there.
    """
    transform = snapshot.geometry.instance_transform.copy()
    transform[snapshot.geometry.instance_names.index(thing), :, 3] += by
    return dataclasses.replace(snapshot, geometry=dataclasses.replace(snapshot.geometry, instance_transform=transform))


def differences(snapshot: Snapshot, settings: Settings, again: Path, whole: Path) -> dict[str, float]:
    """Compare two bakes of a scene.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    settings : Settings
        How it was baked.
    again, whole : Path
        The bakes.

    Returns
    -------
    dict of str to float
        By transport: quantiles of relative differences, and what the means differ by.
    """
    scene = prepare(*model(snapshot, settings))
    at = receivers.spread(scene, *scene.soup.bounds, SPACING)
    rows = np.random.default_rng(0).choice(len(at.key), POINTS, p=at.area / at.area.sum(dtype=np.float64))
    points, normals = at.position[rows] + snapshot.origin, at.normal[rows]
    bakes, found = [world.load(path) for path in (again, whole)], {}
    for name in bakes[1].header["transports"]:
        new, old = (baked.irradiance(points, normals, transport=name).mean(axis=1) for baked in bakes)
        off = np.abs(new - old) / np.maximum(old, DARK * old.mean())
        found |= {f"{name} difference {part:g} %": float(np.quantile(off, part / 100)) for part in (50, 90, 99)}
        found[f"{name} mean"] = float(new.mean() / old.mean() - 1)
    return found


def figures(before: Snapshot, after: Snapshot, settings: Settings, runs: int) -> dict[str, float]:
    """Measure one change.

    Parameters
    ----------
    before, after : Snapshot
        The scene.
    settings : Settings
        How to bake it.
    runs : int
        How often to time it.

    Returns
    -------
    dict of str to float
        By name.
    """
    seconds, busy, kept = {"again": [], "whole": []}, {"again": [], "whole": []}, {}
    with tempfile.TemporaryDirectory() as scratch:
        first, again, whole = (Path(scratch) / name for name in ("first", "again", "whole"))
        job.bake(before, first, settings, manner=job.Manner(incremental=True))
        for _ in range(runs):
            for path in (again, whole):
                shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(first, again)
            for path in (again, whole):
                start, used = time.perf_counter(), time.process_time()
                outcome = job.bake(after, path, settings, manner=job.Manner(incremental=path is again))
                seconds[path.name].append(time.perf_counter() - start)
                busy[path.name].append(time.process_time() - used)
                kept[path.name] = outcome.kept / outcome.data_points
        found = {f"{name} [s]": float(np.median(part)) for name, part in seconds.items()}
        found |= {f"{name}, processor [s]": float(np.median(part)) for name, part in busy.items()}
        found |= {"time": found["again [s]"] / found["whole [s]"], "kept": kept["again"]}
        found["processor time"] = found["again, processor [s]"] / found["whole, processor [s]"]
        return found | differences(after, settings, again, whole)


def main() -> None:
    """Measure one change of one scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bake", type=Path)
    change = parser.add_mutually_exclusive_group(required=True)
    change.add_argument("--dim", metavar="LAMP")
    change.add_argument("--move", metavar="OBJECT=x,y,z")
    parser.add_argument("--strength", type=float, default=0.5)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    before = snapshot_file.load(options.bake / SNAPSHOT_NAME)
    settings = from_header(world.load(options.bake).header["settings"])
    if options.dim:
        after, what = dimmed(before, options.dim, options.strength), f"{options.dim} at {options.strength:g}"
    else:
        name, by = options.move.split("=")
        after, what = moved(before, name, np.array([float(word) for word in by.split(",")])), f"{options.move} m"
    found = figures(before, after, settings, options.runs)
    for name, value in found.items():
        print(f"{options.bake.name}, {what}: {name} = {value:.4g}")
    if options.record:
        add_row("incremental", f"{options.bake.name}, {what}", found)


if __name__ == "__main__":
    main()
