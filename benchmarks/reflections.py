"""Reflections from probes against path tracing: which probe to ask.

    python benchmarks/reflections.py FOLDER... [--rays 10000] [--paths 128] [--record]

Each folder holds a bake with probes. From random points of surfaces mirror rays leave by the cosine; the truth is what
a lobe about them gathers by path tracing (`mirrored.py`), at three roughnesses. Compared are

    nearest    the nearest probe, with parallax by its distances
    blend      the four nearest probes, by the inverse of their distance, likewise
    ours       the probes of the point's voxels, as far as they see what the ray meets
    volume     irradiance of a surface that faces along the ray, over pi: no probe at all

by the mean of absolute differences over the mean of the truth, of all rays and of those that meet a surface, and by
the median of relative ones. The noise of the truth, from two halves of its paths, is in all of them.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake.rays import MISS
from gi_volumes.benchmarks.mirrored import Baked, Mirrors, choose, gathered
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import ggx
from gi_volumes.tree.probe_atlas import fetch_between
from gi_volumes.tree.reflections import Rays, Reflections, Used

ROUGHNESS = (0.1, 0.3, 0.6)
NEIGHBOURS = 4
SEED = 7
TINY = 1e-6
"""Keeps quotients finite [W/(m2 sr)]."""


class Nearest(Reflections):
    """Look-up in the nearest probes, whatever they see.

    Parameters
    ----------
    other : Reflections
        Of the same probes.
    count : int
        How many.
    """

    def __init__(self, other: Reflections, count: int):
        self.__dict__.update(other.__dict__)
        self._count = count

    def used(self, points: np.ndarray, normals: np.ndarray) -> Used:
        """Find the nearest probes.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            As in `Reflections.used`.
        normals : (n, 3) float ndarray
            Not looked at.

        Returns
        -------
        Used
            Weighted by the inverse of their distance.
        """
        count = min(self._count, len(self._position))
        squared = ((points[:, None] - self._position) ** 2).sum(axis=2)
        nearest = np.argsort(squared, axis=1, kind="stable")[:, :count]
        weight = 1 / np.sqrt(np.maximum(np.take_along_axis(squared, nearest, 1), TINY))
        weight /= weight.sum(axis=1, keepdims=True)
        return Used(
            np.repeat(np.arange(len(points)), count), nearest.reshape(-1), weight.reshape(-1).astype(np.float32)
        )


def without_sight(probes: Nearest, rays: Rays, levels: tuple[np.ndarray, ...]) -> np.ndarray:
    """Look up nearest probes; where they find nothing on the ray, in its own direction.

    Parameters
    ----------
    probes : Nearest
        The probes.
    rays : Rays
        The rays.
    levels : tuple of ndarray
        As in `Reflections.look`.

    Returns
    -------
    (n, 3) float64 ndarray
        Radiance.
    """
    light, seen = probes.look(rays, levels)
    used, total = probes.used(rays.point, rays.normal), np.zeros((len(rays.point), 3))
    level = ggx.level_of(rays.roughness, probes._ladder)[used.point]
    plain = fetch_between(levels, probes._layout, level, used.probe, rays.direction[used.point])
    for channel in range(3):
        total[:, channel] = np.bincount(used.point, used.weight * plain[:, channel], len(total))
    return np.where(seen[:, None] > 0, light, total)


def answers(baked: Baked, mirrors: Mirrors, roughness: float) -> dict[str, np.ndarray]:
    """Ask everybody.

    Parameters
    ----------
    baked : Baked
        The bake.
    mirrors : Mirrors
        Where.
    roughness : float
        Of all of them.

    Returns
    -------
    dict of str to (n, 3) ndarray
        Radiance by name.
    """
    loaded = baked.world
    point, rough = loaded.grid.to_local(mirrors.point), np.full(len(mirrors.point), roughness)
    rays = Rays(point, mirrors.direction, rough, mirrors.normal)
    probes = loaded._reflections
    levels = probes.mixed(loaded._sources.factors(None, None, "all"))
    found = {
        "nearest": without_sight(Nearest(probes, 1), rays, levels),
        "blend": without_sight(Nearest(probes, NEIGHBOURS), rays, levels),
        "ours": loaded.radiance(mirrors.point, mirrors.direction, rough, normals=mirrors.normal),
    }
    loaded._reflections = None
    found["volume"] = loaded.radiance(mirrors.point, mirrors.direction, rough, normals=mirrors.normal)
    loaded._reflections = probes
    return found


def meets(baked: Baked, mirrors: Mirrors) -> np.ndarray:
    """Find out which rays meet a surface.

    Parameters
    ----------
    baked : Baked
        The bake.
    mirrors : Mirrors
        Rays.

    Returns
    -------
    (n,) bool ndarray
        The others leave the scene.
    """
    rays = (baked.local(mirrors.point), mirrors.direction)
    hits = baked.scene.tracer.intersect(*(np.ascontiguousarray(part.T.astype(np.float32)) for part in rays))
    return hits.triangle != MISS


def figures(folder: Path, count: int, paths: int) -> dict[str, float]:
    """Measure one bake.

    Parameters
    ----------
    folder : Path
        The bake.
    count : int
        Rays.
    paths : int
        Of each, in two halves.

    Returns
    -------
    dict of str to float
        By roughness, name and measure.
    """
    baked = Baked.load(folder)
    mirrors = choose(baked, count, SEED)
    met = meets(baked, mirrors)
    measured: dict[str, float] = {"probes": len(baked.world._reflections._position), "rays that meet": met.mean()}
    for roughness in ROUGHNESS:
        halves = [gathered(baked, mirrors, roughness, paths // 2, SEED + number) for number in (0, 1)]
        truth = (halves[0] + halves[1]) / 2
        start = time.perf_counter()
        for name, found in answers(baked, mirrors, roughness).items():
            off = np.abs(found - truth)
            measured[f"{roughness} {name}: mean"] = float(off.mean() / truth.mean())
            measured[f"{roughness} {name}: mean of those that meet"] = float(off[met].mean() / truth[met].mean())
            relative = off.sum(axis=1) / np.maximum(truth.sum(axis=1), TINY)
            measured[f"{roughness} {name}: median"] = float(np.median(relative))
        measured[f"{roughness} noise of the truth"] = float(np.abs(halves[0] - halves[1]).mean() / 2 / truth.mean())
        measured[f"{roughness} seconds"] = time.perf_counter() - start
    return measured


def main() -> None:
    """Read the command line, measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--rays", type=int, default=10_000)
    parser.add_argument("--paths", type=int, default=128)
    parser.add_argument("--record", action="store_true", help="append rows to results.csv")
    words = parser.parse_args()
    for folder in words.folders:
        found = figures(folder, words.rays, words.paths)
        for name, value in found.items():
            print(f"{folder.name:16} {name:32} {value:.4f}", flush=True)
        if words.record:
            add_row("reflections", folder.name, found)


if __name__ == "__main__":
    main()
