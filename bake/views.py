"""What probes see: which patches from which place, and how well.

Comes in: places, patches. Goes out: a sparse matrix of worths. A texel of a probe at distance d covers an area
proportional to d^2 / cos on the patch; surfaces whose reflection shows the patch see it from a distance r. With

    q = cos (4 r)^2 / d^2,    worth = q / (1 + q) = cos (4 r)^2 / (cos (4 r)^2 + d^2)    where nothing lies between,

and 0 elsewhere, a probe beside the patch is worth 1, one straight above it at four times r a half, and a far one next
to nothing. q is a ratio of lengths: a doll's house and a town are treated alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import warp
from .parallel import run_tiles, tile_size, tiles
from .patches import Patches
from .scene import Scene

__all__ = ["Views", "affordable", "views", "worths"]

HALF = np.float32(4)
"""Distance at which a view is worth a half, in those from which the patch is looked at: half a texel is 6 % of these
there. With 1 or 2 the same number of probes sees less and reflects worse, with 8 nearest probes are much worse
(`benchmarks/placement.py`: sponza, small_house)."""

MOST = 3 << 23
"""Views that a choice is made from, about: 200 MB, and as much again while they are put together."""

SAMPLE = 64
"""Places that tell how much is seen from a place."""

LEAST = np.float32(1 / 32)
"""Worth below which a view is none: from 22 times as far away as the patch is looked at."""


@dataclass(frozen=True, eq=False)
class Views:
    """A sparse matrix by rows: place i sees the patches `patch[first[i] : first[i + 1]]`.

    first : (n + 1,) int64
    patch : (m,) int32, ascending within a row
    worth : (m,) float32, above 0 to 1
    """

    first: np.ndarray
    patch: np.ndarray
    worth: np.ndarray

    def row(self, place: int) -> slice:
        """Find a place's views.

        Parameters
        ----------
        place : int
            Number of the place.

        Returns
        -------
        slice
            Of `patch` and `worth`.
        """
        return slice(int(self.first[place]), int(self.first[place + 1]))


def views(scene: Scene, position: np.ndarray, patches: Patches, threads: int = 0) -> Views:
    """Find out what is seen from places.

    Parameters
    ----------
    scene : Scene
        What may be in the way; transparent surfaces are not.
    position : (n, 3) float64 ndarray
        Places [m].
    patches : Patches
        What is looked at; a patch is seen where its middle is.
    threads : int
        Worker threads; 0 uses every core.

    Returns
    -------
    Views
        The same for any number of threads; 8 bytes for each view.
    """
    parts: dict[int, tuple[np.ndarray, ...]] = {}

    def work(rows: np.ndarray) -> int:
        parts[int(rows[0])] = _see(scene, position[rows].T.astype(np.float32), patches)
        return len(rows)

    count = max(len(patches.weight), 1)
    run_tiles(work, tiles(len(position), max(1, 2 * tile_size() // count)), threads)
    found = [_NONE, *(parts[first] for first in sorted(parts))]
    counts, patch, worth = (np.concatenate(kind) for kind in zip(*found, strict=True))
    return Views(np.concatenate([[0], np.cumsum(counts)]), patch, worth)


def affordable(scene: Scene, position: np.ndarray, patches: Patches, threads: int = 0) -> int:
    """Say from how many places views fit into memory: where there is little in the way each sees a lot.

    Parameters
    ----------
    scene : Scene
        What may be in the way.
    position : (n, 3) float64 ndarray
        Places [m].
    patches : Patches
        What is looked at.
    threads : int
        Worker threads; 0 uses every core.

    Returns
    -------
    int
        At least 1.
    """
    some = position[:: max(1, len(position) // SAMPLE)]
    count = len(views(scene, some, patches, threads).patch)
    return max(1, int(MOST * len(some) // max(count, 1)))


_NONE = np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, np.float32)
"""Counts, patches and worths of no places."""


def _see(scene: Scene, position: np.ndarray, patches: Patches) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of some places the number of their views, patches and worths."""
    worth = worths(position, patches)
    place, patch = np.nonzero(worth >= LEAST)
    if not len(place):
        return np.zeros(position.shape[1], np.int64), *_NONE[1:]
    start = np.ascontiguousarray(patches.start[:, patch])
    toward = position[:, place] - start
    seen = np.flatnonzero(~scene.tracer.blocked(start, toward, np.ones(len(place), np.float32)))
    place, patch = place[seen], patch[seen]
    return np.bincount(place, minlength=position.shape[1]), patch.astype(np.int32), worth[place, patch]


def worths(position: np.ndarray, patches: Patches) -> np.ndarray:
    """Worths of views, were nothing between.

    Parameters
    ----------
    position : (3, n) float32 ndarray
        Places [m].
    patches : Patches
        What is looked at.

    Returns
    -------
    (n, patches) float32 ndarray
        0 to 1; 0 from behind.
    """
    toward = [position[axis][:, None] - patches.start[axis] for axis in range(3)]
    squared = np.maximum(warp.dot(toward, toward), np.float32(1e-30))
    facing = np.maximum(warp.dot(toward, patches.normal), 0) / np.sqrt(squared) * (HALF * patches.reach) ** 2
    return facing / (facing + squared)
