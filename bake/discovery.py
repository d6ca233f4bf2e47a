"""Finds the surfels of a surface cache: those that paths from a cell meet, as far as each is one open piece.

Comes in: receivers in a cell. Goes out: keys of surfels, and places on each where paths have been. What paths see often
has many places, so that the mean over them is the mean over what is seen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from . import paths
from .gather import Effort, seeded
from .parallel import run_tiles, tile_size, tiles
from .paths import Numbers, Radiance, Vertex, Wave
from .receivers import Receivers, lifted
from .scene import Scene
from .sobol import Sampler
from .surfels import NONE, Lattice, are_crowded, open_between

__all__ = ["Places", "Spending", "find", "numbers", "vertex"]

FINDERS, EACH = 1 << 20, (16, 256)
"""Paths that look for surfels, and the fewest and most from each receiver."""

FOUND_BOUNCES = 1
"""Reflections of those paths."""

MET = 64
"""Hits on a surfel without which others may share its cube unseen."""

OPEN = np.float32(1 / 4)
"""Height above a surfel that what belongs to it must see [cubes]."""


@dataclass(frozen=True)
class Spending:
    """What a cache may cost.

    surfels : most surfels; cubes are doubled until there are no more
    places : places of each surfel that are lit directly
    rays : rays from each surfel
    """

    surfels: int = 1 << 17
    places: int = 16
    rays: int = 32


@dataclass(frozen=True, eq=False)
class Places:
    """Surfels, and where they are lit.

    key : (n,) int64, ascending
    middle : (3, n) float32 [m], a little above one hit of each, which all of its places see
    crowded : (n,) bool, whether other surfels share its cube, or may, as few paths have been there
    position, normal : (3, n * places) float32, hits on each, one surfel's after another's
    """

    key: np.ndarray
    middle: np.ndarray
    crowded: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def find(
    scene: Scene,
    at: Receivers,
    lattice: Lattice,
    effort: Effort,
    spending: Spending,
    show: Callable[[float], bool],
) -> tuple[Lattice, Places]:
    """Find the surfels that matter.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    at : Receivers
        Where they are seen from.
    lattice : Lattice
        Cubes; they are doubled until there are few enough.
    effort : Effort
        Seed, threads.
    spending : Spending
        Most surfels, and places on each.
    show : callable
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    lattice : Lattice
        With the cubes that were taken.
    places : Places
        The same for any number of threads.

    Raises
    ------
    CancelledError
        `show` returned False.
    """
    position, normal = _met(scene, at, effort, show)
    while True:
        key, size = lattice.keys(position, normal)
        used, count = np.unique(key[key != NONE], return_counts=True)
        if len(used) <= spending.surfels:
            break
        lattice = dataclasses.replace(lattice, size=2 * lattice.size)
    order = np.argsort(key, kind="stable")[len(key) - int(count.sum()) :]
    middle = order[np.cumsum(count) - count + count // 2]
    above = position[:, middle] + normal[:, middle] * (OPEN * size[middle])
    order = order[_see(scene, position[:, order], np.repeat(above, count, axis=1), effort.threads)]
    known, count = np.unique(key[order], return_counts=True)
    rows = order[(np.cumsum(count) - count)[:, None] + np.arange(spending.places) * count[:, None] // spending.places]
    some, chosen = np.searchsorted(used, known), rows.reshape(-1)
    crowded = are_crowded(used)[some] | (count < MET)
    return lattice, Places(known, above[:, some], crowded, position[:, chosen], normal[:, chosen])


def vertex(position: np.ndarray, normal: np.ndarray) -> Vertex:
    """Take places for vertices of paths.

    Parameters
    ----------
    position, normal : (3, n) float32 ndarray
        Places off their surfaces [m], and where these face.

    Returns
    -------
    Vertex
        With reflectance pi, so that what it reflects is its irradiance.
    """
    return Vertex(np.zeros(position.shape[1], np.int32), position, normal, np.full(position.shape, np.pi, np.float32))


def numbers(keys: np.ndarray, seed: int, stage: int, count: int) -> Numbers:
    """Random numbers of some lanes for each key.

    Parameters
    ----------
    keys : (n,) uint32 ndarray
        Random keys.
    seed, stage : int
        Other ones give other numbers.
    count : int
        Lanes of each key, one key's after another's.

    Returns
    -------
    Numbers
        For n * count lanes.
    """
    keys = seeded(keys, seed, 0xCAC4E + stage)
    return Numbers(Sampler(keys, 0, count), *np.divmod(np.arange(len(keys) * count), count))


class _Finder:
    """A cache that ends nothing, and remembers where paths were."""

    def __init__(self) -> None:
        self.position, self.normal = [], []

    def finish(self, wave: Wave, vertex: Vertex, travelled: np.ndarray, light: Radiance) -> tuple:
        self.position.append(vertex.position.copy())
        self.normal.append(vertex.normal.copy())
        rows = np.arange(len(travelled) if len(self.position) <= FOUND_BOUNCES else 0)
        return rows, rows

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        return np.arange(len(travelled))


def _met(scene: Scene, at: Receivers, effort: Effort, show: Callable[[float], bool]) -> tuple[np.ndarray, np.ndarray]:
    """(3, n) positions and normals of where paths from receivers were, the same for any number of threads."""
    finders = int(np.clip(FINDERS // max(len(at.key), 1), *EACH))
    at = at.take(np.arange(0, len(at.key), max(1, len(at.key) * finders // FINDERS)))
    start, normal = lifted(scene, at), np.ascontiguousarray(at.normal.T)
    dark, size = _in_the_dark(scene), tile_size() // finders
    parts = tiles(len(at.key), size)
    found = [_Finder() for _ in parts]

    def work(tile: np.ndarray) -> int:
        lane = np.repeat(tile, finders)
        begin = vertex(start[:, lane], normal[:, lane])
        random = numbers(at.key[tile], effort.seed, 0, finders)
        paths.arriving(dark, begin, random, 2 + FOUND_BOUNCES, found[tile[0] // size])
        return len(tile)

    run_tiles(work, parts, effort.threads, lambda done: show(done / len(at.key)))
    return _by_bounce([finder.position for finder in found]), _by_bounce([finder.normal for finder in found])


def _by_bounce(parts: list[list[np.ndarray]]) -> np.ndarray:
    """(3, n) what tiles found, bounce after bounce, so that the order does not depend on the tiles."""
    empty = np.zeros((3, 0), np.float32)
    ordered = [part for bounce in zip_longest(*parts, fillvalue=empty) for part in bounce]
    return np.concatenate([empty, *ordered], axis=1)


def _in_the_dark(scene: Scene) -> Scene:
    """The scene with nothing that shines."""
    model = dataclasses.replace(scene.model, local=False, suns=type(scene.model.suns)(), sky="none")
    return dataclasses.replace(scene, model=model)


def _see(scene: Scene, position: np.ndarray, target: np.ndarray, threads: int) -> np.ndarray:
    """(n,) whether nothing opaque lies between hits and what they look at."""
    seen = np.zeros(position.shape[1], bool)

    def look(rows: np.ndarray) -> int:
        seen[rows] = open_between(scene.tracer, position[:, rows], target[:, rows])
        return len(rows)

    run_tiles(look, tiles(len(seen), tile_size()), threads)
    return seen
