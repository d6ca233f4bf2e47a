"""Which probes show what the surroundings of each data point reflect: the few that together show it best.

Comes in: a scene, data points, places of probes. Goes out: probes with weights for each data point. Rays leave the
data point in all directions, as the surfaces around it mirror most of them, and objects that move all. Shadow rays go
from what they meet to all probes that would show it well. Probes are chosen greedily, by what each adds to the best
worth (`views.py`) over all rays; the weight of each is the share of the rays that it shows best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree.interpolate import DataPoints
from ..tree.probe_sets import ProbeSets, encode
from . import warp
from .datapoints import keys
from .gather import Effort, seeded
from .parallel import check, run_tiles, tiles
from .patches import Patches
from .rays import MISS
from .scene import Scene
from .sobol import Sampler
from .views import LEAST, worths

__all__ = ["RAYS", "SLOTS", "see"]

RAYS = 24
"""Rays of a data point: neither 16 nor 48 reflect better in all scenes (`docs/accuracy.md`)."""

SLOTS = 4
"""Probes of a data point: 3 reflect 2 % worse, 6 no better (`docs/accuracy.md`)."""

FAR = np.float32(4)
"""Length of shadow rays towards the sky, in sizes of the scene: past everything."""

PAIRS = 1 << 22
"""Pairs of rays and probes of a tile: 16 MB for each number that is kept of them."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """What the rays of n data points meet; m = n * `RAYS`.

    place : Patches, (m,) where they end; of rays that leave the scene, where they begin
    direction : (3, m) float32
    leaves : (m,) bool, whether they meet nothing
    """

    place: Patches
    direction: np.ndarray
    leaves: np.ndarray


def see(
    scene: Scene,
    data: DataPoints,
    probes: np.ndarray,
    effort: Effort,
    progress: Callable[[int], bool] | None = None,
) -> ProbeSets:
    """Choose the probes of data points.

    Parameters
    ----------
    scene : Scene
        What may be in the way; transparent surfaces are not.
    data : DataPoints
        The data points, of a cell or of several.
    probes : (k, 3) float64 ndarray
        Places of probes, relative to the scene's origin [m].
    effort : Effort
        Seed, threads.
    progress : callable, optional
        As in `parallel.run_tiles`, counting data points.

    Returns
    -------
    ProbeSets
        The same for any number of threads, and for a voxel in whatever cell; without weights where nothing that is
        reflected is seen by any probe.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Source: row 4 of the talk; the worth, the greedy choice and the weights are ours.
    """
    rows = np.flatnonzero(data.valid)
    probe, weight = np.zeros((len(data.valid), SLOTS), np.int64), np.zeros((len(data.valid), SLOTS))
    place = np.ascontiguousarray(probes.T.astype(np.float32))
    key = seeded(keys(data.level, data.coords), effort.seed)

    def work(part: np.ndarray) -> int:
        some = rows[part]
        position = np.ascontiguousarray(data.position[some].T.astype(np.float32))
        worth = _seen(scene, place, _look(scene, position, key[some]), _nearness(place, position))
        probe[some], weight[some] = _best(worth)
        return len(part)

    if len(probes):
        run_tiles(work, tiles(len(rows), max(1, PAIRS // (RAYS * len(probes)))), effort.threads, progress)
    return encode(probe, weight, data.valid)


def _look(scene: Scene, position: np.ndarray, key: np.ndarray) -> _Shown:
    """What rays from data points meet, by their random keys."""
    lane, sample = np.divmod(np.arange(len(key) * RAYS), RAYS)
    sampler = Sampler(key, 0, RAYS)
    direction = warp.sphere(*(sampler.uniform(lane, sample, dimension) for dimension in (0, 1)))
    start = np.ascontiguousarray(position[:, lane])
    hits = scene.tracer.intersect(start, direction)
    leaves = hits.triangle == MISS
    length = np.where(leaves, np.float32(0), hits.distance)
    normal = hits.facing(direction)
    end = start + direction * length
    end += np.where(leaves, 0, normal * (4 * scene.tracer.offset(end, length)))
    return _Shown(Patches(end, normal, np.ones_like(length), length), direction, leaves)


def _nearness(probe: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(k, n) distance of the nearest probe over those of all: the worth of a probe that sees the sky where a ray leaves
    the scene, as it shows that rightly from anywhere."""
    squared = sum((probe[axis][:, None] - position[axis]) ** 2 for axis in range(3))
    return np.sqrt(squared.min(axis=0) / np.maximum(squared, np.float32(1e-30)))


def _seen(scene: Scene, probe: np.ndarray, shown: _Shown, nearness: np.ndarray) -> np.ndarray:
    """(k, n, RAYS) worth of what each of k probes shows of each ray."""
    check()
    worth = worths(probe, shown.place)
    sky = np.flatnonzero(shown.leaves)
    worth[:, sky] = nearness[:, sky // RAYS]
    number, ray = np.nonzero(worth >= LEAST)
    leaves = shown.leaves[ray]
    start = np.where(leaves, probe[:, number], shown.place.start[:, ray])
    far = shown.direction[:, ray] * np.float32(FAR * scene.tracer.size)
    toward = np.where(leaves, far, probe[:, number] - start)
    hidden = scene.tracer.blocked(start, toward, np.ones(len(ray), np.float32))
    seen = np.zeros_like(worth)
    seen[number[~hidden], ray[~hidden]] = worth[number[~hidden], ray[~hidden]]
    return seen.reshape(len(worth), -1, RAYS)


def _best(worth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, SLOTS) probes that add most, one after the other, and the shares of the rays that each shows best."""
    count = worth.shape[1]
    best, point = np.zeros(worth.shape[1:], np.float32), np.arange(count)
    chosen = np.zeros((SLOTS, count), np.int64)
    values = np.zeros((SLOTS, *best.shape), np.float32)
    for slot in range(SLOTS):
        gain = np.maximum(worth - best, 0).sum(axis=2)
        chosen[slot] = gain.argmax(axis=0)
        values[slot] = np.where(gain.max(axis=0)[:, None] > 0, worth[chosen[slot], point], 0)
        best = np.maximum(best, values[slot])
    share = (values.argmax(axis=0) == np.arange(SLOTS)[:, None, None]) & (best > 0)
    return chosen.T, share.sum(axis=2).T.astype(np.float64)
