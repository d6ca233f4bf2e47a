"""Fills the surface cache of a cell: finds its surfels, lights them, and lets light bounce between them.

Comes in: a scene, receivers in the cell. Goes out: the scene with a cache. Paths from the receivers meet the surfaces
that matter; those surfels are kept. Each one's irradiance is

    E = direct light + what rays bring that end elsewhere + sum over rays of (weight * E of the surfel that it met)

with all rays traced once, and solved for all transports together by iterating over what they met.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from ..tree.grid import Grid
from ..tree.topology import Topology
from . import paths, receivers
from .discovery import Places, Spending, find, numbers, vertex
from .gather import Effort
from .lamps import luminance
from .lit_spots import LitSpots
from .parallel import run_tiles, tile_size, tiles
from .paths import Numbers, Radiance, Vertex, Wave
from .rays import MISS
from .receivers import Receivers
from .scene import Scene
from .sobol import scramble
from .surfels import NONE, Known, Lattice, Surfels, Table, reflected

__all__ = ["around", "cached", "is_shared", "of_cell", "whole"]

FOUND = 0.3
"""Part of the progress that finding surfels takes."""

BLOCK = 1 << 20
"""Numbers that are read at a time."""

UNEVEN = 0.1
"""Standard deviation of the mean direct light of lamps on a surfel, relative to it, above which paths look for that
light themselves, with the help of lit spots. An edge through the middle of 16 places has 0.25, at a tenth 0.08."""

BEAMS, MOST_BEAMS = 1 << 10, 1 << 18
"""Rays from each lamp, and from all, that look for what it lights."""

LEFT = 1e-4
"""Light that is still under way when the bounces end, on every surfel and of every function, in what arrived there."""

CUBES = 32
"""Least cubes along a first-level voxel: 0.25 m at human scale."""

RECEIVERS = 2
"""Receivers along a second-level voxel: a metre apart at human scale."""


def cached(
    scene: Scene,
    at: Receivers,
    lattice: Lattice,
    effort: Effort,
    spending: Spending,
    progress: Callable[[float], bool] | None = None,
) -> Scene:
    """Give a scene a surface cache.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    at : Receivers
        Where the surfels that matter are seen from.
    lattice : Lattice
        Cubes around the cell.
    effort : Effort
        Bounces, seed, threads.
    spending : Spending
        Sizes.
    progress : callable, optional
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Scene
        With a cache.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Error: light is even over a surfel, as the receivers' paths see it; see `docs/accuracy.md`.
    Source: Arvo and Kirk 1990; Christensen 2008, "Point-based approximate global illumination".
    """
    scene = dataclasses.replace(scene, cache=None)
    show = progress or (lambda share: True)
    lattice, places = find(scene, at, lattice, effort, spending, lambda share: show(FOUND * share))
    work = _Work(scene, lattice, places, effort, spending)
    work.run(lambda share: show(FOUND + (1 - FOUND) * share))
    return dataclasses.replace(scene, cache=Surfels(work.known, *_solve(work)))


def around(
    scene: Scene, grid: Grid, box: np.ndarray, effort: Effort, progress: Callable[[float], bool] | None = None
) -> Scene:
    """Give a scene a surface cache for what lies in a box.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    grid : Grid
        The lattice of the bake.
    box : (2, 3) float64 ndarray
        Lowest and highest corner of what is baked, relative to the scene's origin [m].
    effort : Effort
        Seed, threads; light bounces until hardly any is left.
    progress : callable, optional
        As for `cached`.

    Returns
    -------
    Scene
        As `cached` returns it.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    spacing = float(grid.voxel_size(min(1, grid.levels - 1))) / RECEIVERS
    at = receivers.spread(scene, *box, spacing, threads=effort.threads)
    low, high = np.maximum(box[0], scene.soup.bounds[0]), np.minimum(box[1], scene.soup.bounds[1])
    lattice = Lattice(low.astype(np.float32), high.astype(np.float32), grid.first_size / CUBES)
    return cached(scene, at, lattice, effort, Spending(), progress)


def is_shared(scene: Scene, grid: Grid) -> bool:
    """Say whether all cells of a scene have the same surface cache.

    Parameters
    ----------
    scene : Scene
        Its surfaces.
    grid : Grid
        The lattice of the bake.

    Returns
    -------
    bool
        Whether it is no larger than a cell.
    """
    return bool(np.ptp(scene.soup.bounds[:, :2], axis=0).max() <= grid.cell_size)


def whole(scene: Scene) -> np.ndarray:
    """Box of a surface cache that all cells share.

    Parameters
    ----------
    scene : Scene
        Its surfaces.

    Returns
    -------
    (2, 3) float64 ndarray
        As `around` takes it.
    """
    return np.stack([scene.soup.bounds[0], np.nextafter(scene.soup.bounds[1], np.inf)])


def of_cell(grid: Grid, tree: Topology) -> np.ndarray:
    """Box of the surface cache of a single cell.

    Parameters
    ----------
    grid : Grid
        The lattice of the bake.
    tree : Topology
        The cell.

    Returns
    -------
    (2, 3) float64 ndarray
        As `around` takes it.
    """
    low = np.array(tree.grid_min)
    return np.stack([low, low + tree.grid_shape]) * grid.first_size


class _Recorder:
    """A cache that ends paths on surfels, and remembers which and how much they count."""

    def __init__(self, known: Known, lanes: int) -> None:
        self.known = known
        self.number = np.full(lanes, NONE, np.int32)
        self.near = np.zeros(lanes, bool)
        self.weight = np.zeros((3, lanes), np.float32)

    def finish(self, wave: Wave, vertex: Vertex, travelled: np.ndarray, light: Radiance) -> tuple:
        number, near = self.known.which(vertex.position, vertex.normal, travelled)
        rows = np.flatnonzero(number >= 0)
        self.number[wave.lane[rows]], self.near[wave.lane[rows]] = number[rows], near[rows]
        self.weight[:, wave.lane[rows]] = reflected(wave, vertex, rows)
        left = np.flatnonzero((number < 0) | near)
        return left, np.flatnonzero(number[left] < 0)

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        return self.known.leaves(position, normal, travelled)


class _Work:
    """Everything that rays are traced for, surfel by surfel."""

    def __init__(self, scene: Scene, lattice: Lattice, places: Places, effort: Effort, spending: Spending) -> None:
        self.scene, self.places, self.effort, self.spending = scene, places, effort, spending
        count, functions = len(places.key), 1 + len(scene.model.suns.toward) + scene.model.sky_count
        self.uneven, self.dark = np.zeros((2, count), bool)
        spots = LitSpots(scene.lamps, scene.tracer, scene.surfaces, wanted=False)
        self.without_spots = dataclasses.replace(scene, lit_spots=spots)
        self.known = Known(lattice, Table(places.key), places.middle, places.crowded, self.uneven, scene.tracer)
        self.direct, self.found = np.zeros((2, 3, count, functions), np.float32)
        self.number = np.zeros((count, spending.rays), np.int32)
        self.near = np.zeros((count, spending.rays), bool)
        self.weight = np.zeros((3, count, spending.rays), np.float32)

    def run(self, show: Callable[[float], bool]) -> None:
        """Trace in tiles: direct light everywhere, then rays, for which it matters where that is uneven."""
        count = len(self.places.key)
        for stage, (work, lanes) in enumerate(((self.light, self.spending.places), (self.send, self.spending.rays))):
            parts = tiles(count, max(1, tile_size(self.direct.shape[2]) // lanes))
            run_tiles(work, parts, self.effort.threads, lambda done, stage=stage: show((stage + done / count) / 2))
            self.uneven[self.lit_unseen() if stage == 0 else []] = True
            self.known = dataclasses.replace(self.known, uneven=self.uneven)

    def lit_unseen(self) -> np.ndarray:
        """(m,) surfels that lamps shine on, though none of their places is lit: beams that are narrower than they."""
        lamps = self.scene.lamps
        if not (self.scene.has_local and lamps.count):
            return np.zeros(0, np.int64)
        lamp = np.repeat(np.arange(lamps.count), max(1, min(BEAMS, MOST_BEAMS // lamps.count)))
        keys = scramble(lamp.astype(np.uint32), self.effort.seed & 0xFFFFFFFF)
        random = numbers(scramble(np.arange(len(lamp), dtype=np.uint32), 5) ^ keys, self.effort.seed, 3, 1)
        start, direction = (np.array(part) for part in lamps.emit(lamp, random.draw(np.arange(len(lamp)), 0, 4)))
        hits = self.scene.tracer.intersect(start, direction)
        met = np.flatnonzero(hits.triangle != MISS)
        place = start[:, met] + direction[:, met] * hits.distance[met]
        number = self.known.table.find(self.known.lattice.keys(place, hits.facing(direction)[:, met])[0])
        number = np.unique(number[number >= 0])
        return number[self.dark[number]]

    def light(self, rows: np.ndarray) -> int:
        """Direct light of some surfels."""
        places = self.spending.places
        direct, of_lamps = paths.shine(self.without_spots, self.at(rows, places), self.numbers(rows, 1, places))
        self.direct[:, rows] = _mean(direct, places)
        seen = luminance(of_lamps).reshape(-1, places)
        self.uneven[rows], self.dark[rows] = _is_uneven(seen), ~seen.any(axis=1)
        return len(rows)

    def send(self, rows: np.ndarray) -> int:
        """Rays from some surfels: what they find by chance, and where they end."""
        rays = self.spending.rays
        recorder = _Recorder(self.known, len(rows) * rays)
        numbers = self.numbers(rows, 2, rays)
        found = paths.arriving(self.scene, self.at(rows, rays), numbers, self.effort.bounces, recorder)
        self.found[:, rows] = _mean(found, rays)
        self.number[rows] = recorder.number.reshape(-1, rays)
        self.near[rows] = recorder.near.reshape(-1, rays)
        self.weight[:, rows] = recorder.weight.reshape(3, -1, rays) / np.float32(rays)
        return len(rows)

    def numbers(self, rows: np.ndarray, stage: int, count: int) -> Numbers:
        """Random numbers of surfels, `count` lanes for each."""
        low, high = (self.places.key[rows] >> shift & 0xFFFFFFFF for shift in (0, 32))
        return numbers(scramble(low.astype(np.uint32), 0) ^ high.astype(np.uint32), self.effort.seed, stage, count)

    def at(self, rows: np.ndarray, count: int) -> Vertex:
        """Places on surfels, `count` on each."""
        place = (rows[:, None] * self.spending.places + np.arange(count) % self.spending.places).reshape(-1)
        return vertex(self.places.position[:, place], self.places.normal[:, place])


def _mean(light: Radiance, count: int) -> np.ndarray:
    """(3, n, functions) mean over `count` lanes for each surfel."""
    stacked = light.stacked()
    return stacked.reshape(*stacked.shape[:2], -1, count).mean(axis=3).transpose(1, 2, 0)


def _is_uneven(light: np.ndarray) -> np.ndarray:
    """(n,) whether the mean of light at (n, places) is not known to within a part of itself: lamps that are close."""
    deviation = light.std(axis=1) / np.sqrt(light.shape[1])
    return deviation > UNEVEN * light.mean(axis=1)


def _solve(work: _Work) -> tuple[np.ndarray, np.ndarray]:
    """(n, functions, 3) irradiance after all bounces, and what of it is indirect: E = direct + found + links (E - near
    direct), as rays that end near by have looked for direct light themselves."""
    total = work.found - _passed(work, work.direct, work.near)
    last = total = total + work.direct
    for _ in range(work.effort.bounces - 1):
        last = _passed(work, last)
        total = total + last
        if (np.abs(last).sum(axis=0) <= LEFT * np.abs(total).sum(axis=0)).all():
            break
    return tuple(np.ascontiguousarray(part.transpose(1, 2, 0)) for part in (total, total - work.direct))


def _passed(work: _Work, light: np.ndarray, only: np.ndarray | None = None) -> np.ndarray:
    """(3, n, functions) what rays bring of the irradiance of the surfels that they met."""
    passed, number = np.empty_like(light), np.maximum(work.number, 0)
    step = max(1, BLOCK // (number.shape[1] * max(light.shape[2], 1)))
    for first in range(0, light.shape[1], step):
        part = slice(first, first + step)
        for channel in range(3):
            weight = work.weight[channel, part] if only is None else work.weight[channel, part] * only[part]
            read = light[channel].take(number[part], axis=0, mode="clip")
            passed[channel, part] = np.matmul(weight[:, None], read)[:, 0]
    return passed
