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
from . import paths, receivers, warp
from .discovery import OPEN, Places, Spending, find, numbers, tiles, vertex
from .gather import TILE_LANES, Effort, run_tiles
from .lamps import luminance
from .lit_spots import LitSpots
from .paths import Numbers, Radiance, Vertex, Wave
from .rays import MISS
from .receivers import Receivers
from .scene import Scene
from .sobol import scramble
from .surfels import NONE, Known, Lattice, Surfels, Table, reflected

__all__ = ["around", "cached"]

FOUND = 0.3
"""Part of the progress that they take."""

BLOCK = 1 << 20
"""Numbers that are read at a time."""

UNEVEN = 0.2
"""Standard deviation of the mean direct light of lamps on a surfel, relative to it, above which paths look for that
light themselves, with the help of lit spots. An edge through the middle of 16 places has 0.25; a lamp a sixth of a cube
off a wall as much, though none of them may lie in its spot."""

MANY = 256
"""Places where these are lit directly."""

LEFT = 1e-4
"""Light that is still under way when the bounces end, in all light."""

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
    spots = LitSpots(scene.lamps, scene.tracer, scene.surfaces, wanted=False)
    whole, scene = scene, dataclasses.replace(scene, lit_spots=spots, cache=None)
    show = progress or (lambda share: True)
    lattice, places = find(scene, at, lattice, effort, spending, lambda share: show(FOUND * share))
    work = _Work(scene, lattice, places, effort, spending)
    work.run(lambda share: show(FOUND + (1 - FOUND) * share))
    known = dataclasses.replace(work.known, uneven=work.uneven)
    return dataclasses.replace(whole, cache=Surfels(known, *_solve(work)))


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


class _Work:
    """Everything that rays are traced for, surfel by surfel."""

    def __init__(self, scene: Scene, lattice: Lattice, places: Places, effort: Effort, spending: Spending) -> None:
        self.scene, self.places, self.effort, self.spending = scene, places, effort, spending
        count, functions = len(places.key), 1 + len(scene.model.suns.toward) + scene.model.sky_count
        self.uneven = np.zeros(count, bool)
        self.known = Known(lattice, Table(places.key), places.middle, places.crowded, self.uneven.copy(), scene.tracer)
        self.direct, self.found = np.zeros((2, 3, count, functions), np.float32)
        self.number = np.zeros((count, spending.rays), np.int32)
        self.near = np.zeros((count, spending.rays), bool)
        self.weight = np.zeros((3, count, spending.rays), np.float32)

    def run(self, show: Callable[[float], bool]) -> None:
        """Trace in tiles."""
        count = len(self.places.key)
        parts = tiles(count, TILE_LANES // self.spending.rays)
        run_tiles(self.light, parts, self.effort.threads, lambda done: show(done / count))
        rows = np.flatnonzero(self.uneven)
        run_tiles(self.look_closer, [rows[part] for part in tiles(len(rows), TILE_LANES // MANY)], self.effort.threads)

    def light(self, rows: np.ndarray) -> int:
        """Direct light of some surfels, and where their rays end."""
        places, rays = self.spending.places, self.spending.rays
        near, far = (self.numbers(rows, 1 + k, count) for k, count in enumerate((places, rays)))
        direct = paths.shine(self.scene, self.at(rows, places), near)
        recorder = _Recorder(self.known, len(rows) * rays)
        chance = paths.arriving(self.scene, self.at(rows, rays), far, self.effort.bounces, recorder)
        for target, part, count in (self.direct, direct, places), (self.found, chance, rays):
            target[:, rows] = _stacked(part, count).mean(axis=3).transpose(1, 2, 0)
        self.number[rows] = recorder.number.reshape(-1, rays)
        self.near[rows] = recorder.near.reshape(-1, rays)
        self.uneven[rows] = _is_uneven(luminance(direct.local).reshape(-1, places))
        self.weight[:, rows] = recorder.weight.reshape(3, -1, rays) / np.float32(rays)
        return len(rows)

    def look_closer(self, rows: np.ndarray) -> int:
        """Direct light of uneven surfels again, at many places all over them: as many as their middle sees."""
        lane, random = np.repeat(rows, MANY), self.numbers(rows, 3, MANY)
        position, facing, on = self.beneath(lane, random.draw(np.arange(len(lane)), 0, 2))
        light = _stacked(paths.shine(self.scene, vertex(position, facing), random), MANY)
        on = on.reshape(-1, MANY)
        mean = (light * on).sum(axis=3) / np.maximum(on.sum(axis=1), 1)
        enough = on.sum(axis=1) >= self.spending.places
        self.direct[:, rows[enough]] = mean[:, :, enough].transpose(1, 2, 0)
        return len(rows)

    def beneath(self, lane: np.ndarray, u: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(3, n) places and normals that surfels' middles see around them, and (n,) whether they belong to the surfel;
        a place that is known where they do not."""
        start, first = self.places.middle[:, lane], lane * self.spending.places
        known, normal = self.places.position[:, first], self.places.normal[:, first]
        size = self.known.lattice.keys(known, normal)[1]
        right, up = warp.frame(normal)
        way = (right * (2 * u[0] - 1) + up * (2 * u[1] - 1) - normal * OPEN) * size
        hits = self.scene.tracer.intersect(start, way)
        length = np.sqrt(warp.dot(hits.normal, hits.normal))
        facing = hits.normal * (-np.sign(warp.dot(hits.normal, way)) / np.maximum(length, np.float32(1e-37)))
        place = start + way * np.where(hits.triangle == MISS, np.float32(0), hits.distance)
        place += facing * self.scene.tracer.offset(place, size)
        on = (hits.triangle != MISS) & (self.known.lattice.keys(place, facing)[0] == self.places.key[lane])
        return np.where(on, place, known), np.where(on, facing, normal), on

    def numbers(self, rows: np.ndarray, stage: int, count: int) -> Numbers:
        """Random numbers of surfels, `count` lanes for each."""
        low, high = (self.places.key[rows] >> shift & 0xFFFFFFFF for shift in (0, 32))
        return numbers(scramble(low.astype(np.uint32), 0) ^ high.astype(np.uint32), self.effort.seed, stage, count)

    def at(self, rows: np.ndarray, count: int) -> Vertex:
        """Places on surfels, `count` on each."""
        place = (rows[:, None] * self.spending.places + np.arange(count) % self.spending.places).reshape(-1)
        return vertex(self.places.position[:, place], self.places.normal[:, place])


def _stacked(light: Radiance, count: int) -> np.ndarray:
    """(functions, 3, n, count) light of `count` lanes for each surfel."""
    stacked = np.concatenate([light.local[None], light.sun, light.sky])
    return stacked.reshape(*stacked.shape[:2], -1, count)


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
        if np.abs(last).sum() <= LEFT * np.abs(total).sum():
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
