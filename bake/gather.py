"""Light gathered at points, in parallel, the same however the work is split.

Comes in: points and a sensor, which says what is measured there (nine harmonics of irradiance around a data
point, or irradiance on a surface). Goes out: that measure for each transport. A point's samples are always
summed in the same order and blocks, so results do not depend on tiles or threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import lit_spots, paths, warp
from .parallel import run_tiles, tile_size, tiles
from .paths import Numbers, Wave
from .scene import Scene
from .sensors import Sensor
from .sobol import Sampler, scramble
from .visibility import FAR, TARGET_SHORTENED, unblocked

BLOCK_SAMPLES = 1024
"""Most samples of a point in one wavefront; part of the result's definition, as it orders the sums."""

SUMMED_SAMPLES = 32
"""Most samples in one matrix product; larger products start threads of OpenBLAS, which change the last bits of sums."""

PARTS = 8
"""Products that a point's samples are split into at least, where there are as many: their scatter says how noisy the
point is."""

DIRECT_DIMENSIONS = paths.HASHED - 64
"""Random numbers of the direct light at the point itself, apart from every path vertex's."""


@dataclass(frozen=True)
class Effort:
    """How much work to spend.

    samples : paths per point
    bounces : reflections that light may undergo before it arrives
    seed : any integer; another seed gives an independent result
    threads : worker threads; 0 uses every core
    """

    samples: int
    bounces: int = 8
    seed: int = 0
    threads: int = 0


@dataclass
class Gathered:
    """Measures at n points; an array has no rows where that light is not modelled.

    local : (n, responses, 3) float32
    sun : (n, keys, responses, 3) float32, per W/m2 of sun irradiance
    sky : (n, functions, responses, 3) float32
    noise : (n, watched) float32, standard errors of what the sensor watches; larger than that, as samples are spread
        evenly
    """

    local: np.ndarray
    sun: np.ndarray
    sky: np.ndarray
    noise: np.ndarray


def gather(
    scene: Scene,
    sensor: Sensor,
    position: np.ndarray,
    keys: np.ndarray,
    effort: Effort,
    progress: Callable[[int], bool] | None = None,
) -> Gathered:
    """Measure light at points.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    sensor : Sensor
        What is measured; its rows are those of `position`.
    position : (3, n) float32 ndarray
        Points [m], relative to the scene's origin.
    keys : (n,) uint32 ndarray
        Random key of each point.
    effort : Effort
        Samples, bounces, threads.
    progress : callable, optional
        Called with the number of points done so far, from the calling thread; returns False to stop.

    Returns
    -------
    Gathered
        Unbiased up to the bounce limit, where the scene has no cache.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    count = position.shape[1]
    suns, functions = len(scene.model.suns.toward), scene.model.sky_count
    shape = (sensor.responses, 3)
    out = Gathered(
        np.zeros((count if scene.has_local else 0, *shape), np.float32),
        np.zeros((count if suns else 0, suns, *shape), np.float32),
        np.zeros((count if functions else 0, functions, *shape), np.float32),
        np.zeros((count, len(sensor.watched)), np.float32),
    )
    if not (scene.has_local or suns or functions):
        return out
    keys = seeded(keys, effort.seed)

    def work(rows: np.ndarray) -> int:
        tile, noise = _gather_tile(scene, sensor, position[:, rows], rows, keys[rows], effort)
        if scene.has_local:
            out.local[rows] = tile[:, 0]
        if suns:
            out.sun[rows] = tile[:, 1 : 1 + suns]
        if functions:
            out.sky[rows] = tile[:, 1 + suns :]
        out.noise[rows] = noise
        return len(rows)

    size = max(1, tile_size(1 + suns + functions) // min(effort.samples, BLOCK_SAMPLES))
    run_tiles(work, tiles(count, size), effort.threads, progress)
    return out


def _gather_tile(scene: Scene, sensor: Sensor, position, rows, keys, effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """(points, channels, responses, 3) measures of a tile, block by block of samples, and (points, watched) noise."""
    channels = 1 + len(scene.model.suns.toward) + scene.model.sky_count
    total = np.zeros((len(rows), sensor.responses, 3 * channels))
    squared = np.zeros((len(rows), len(sensor.watched)))
    for first in range(0, effort.samples, BLOCK_SAMPLES):
        count = min(BLOCK_SAMPLES, effort.samples - first)
        sampler = Sampler(keys, first, count)
        sums, variance = _gather_block(scene, sensor, position, rows, sampler, count, effort.bounces)
        total += sums
        squared += variance
    mean = (total / effort.samples).astype(np.float32)
    noise = np.sqrt(squared) / effort.samples
    return mean.reshape(len(rows), sensor.responses, channels, 3).transpose(0, 2, 1, 3), noise


def _variance(parts: np.ndarray, sizes: np.ndarray, watched: np.ndarray) -> np.ndarray:
    """(points, watched) variances of the sum over all (parts, points, channels) of a block; 0 where one can't tell."""
    found = parts @ watched.reshape(len(watched), -1).T if len(watched) else np.zeros((*parts.shape[:2], 0))
    mean = found.sum(axis=0) / sizes.sum()
    return ((found - mean * sizes[:, None, None]) ** 2).sum(axis=0) * len(parts) / max(len(parts) - 1, 1)


def _gather_block(scene: Scene, sensor: Sensor, position, rows, sampler: Sampler, count: int, bounces: int):
    """(points, responses, channels * 3) sums over one block of samples, and (points, watched) their variances."""
    point, sample = np.divmod(np.arange(len(rows) * count), count)
    numbers = Numbers(sampler, point, sample)
    lanes = np.arange(len(point))
    direction = sensor.sample(rows[point], *numbers.draw(lanes, 0, 2))
    pdf = sensor.pdf(rows[point], direction)
    start = np.ascontiguousarray(position[:, point])
    wave = Wave(lanes, start.copy(), direction, np.ones_like(direction), pdf)
    light = paths.trace(scene, wave, numbers, bounces)
    stacked = light.stacked()
    stacked /= pdf
    weights = sensor.response(rows[point], direction)
    ends = _ends(count, bool(len(sensor.watched)))
    total, parts = _project(weights, stacked.reshape(-1, len(lanes)), len(rows), ends)
    for channel, toward, value in _direct(scene, sensor, start, rows[point], numbers, lanes, bounces):
        own, weights = slice(3 * channel, 3 * channel + 3), sensor.response(rows[point], toward)
        for whole, found in zip((total, parts), _project(weights, value, len(rows), ends), strict=True):
            whole[..., own] += found
    return total, _variance(parts, np.diff(ends), sensor.watched)


def _ends(count: int, watched: bool) -> np.ndarray:
    """Where the parts of a block of samples end, the first one's beginning first: parts of equal size but for one."""
    parts = max(-(-count // SUMMED_SAMPLES), min(PARTS, count) if watched else 1)
    return np.arange(parts + 1) * count // parts


def _project(weights: np.ndarray, values: np.ndarray, points: int, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(points, responses, channels) sums over samples, as matrix products of a few samples of each point, and
    (parts, points, channels) what each adds to the first response."""
    left = np.ascontiguousarray(weights.reshape(-1, points, ends[-1]).transpose(1, 0, 2))
    right = np.ascontiguousarray(values.reshape(-1, points, ends[-1]).transpose(1, 2, 0))
    total = np.zeros((points, left.shape[1], right.shape[2]))
    parts = np.empty((len(ends) - 1, points, right.shape[2]))
    for number, part in enumerate(map(slice, ends[:-1], ends[1:])):
        found = left[:, :, part] @ right[:, part]
        parts[number] = found[:, 0]
        total += found
    return total, parts


def _direct(scene: Scene, sensor: Sensor, position, rows, numbers: Numbers, lanes, bounces: int):
    """Direct light at the points themselves: (channel, directions, radiance over density) for each source.

    Emissive surfaces and an uneven sky are also found by chance; the balance heuristic shares them out.
    """
    functions_start = 1 + len(scene.model.suns.toward)
    if scene.model.local and scene.reflectors.count:
        sample = scene.reflectors.sample(position, None, numbers.draw(lanes, DIRECT_DIMENSIONS, 4))
        direction = _unit(sample.toward)
        seen = (position, sample.toward, TARGET_SHORTENED, sample.lit, sample.shadow)
        yield 0, direction, _visible(scene, sample.irradiance, *seen)
    if scene.model.local and scene.emitters.count:
        toward, radiance, density = scene.emitters.sample(position, numbers.draw(lanes, DIRECT_DIMENSIONS + 4, 3))
        direction = _unit(toward)
        value = radiance / (density + sensor.pdf(rows, direction))
        yield 0, direction, _visible(scene, value, position, toward, TARGET_SHORTENED, density > 0)
    if scene.model.local and scene.lit_spots.count and bounces:
        u = numbers.draw(lanes, DIRECT_DIMENSIONS + 10, lit_spots.NUMBERS)
        ends = paths.passing(numbers, lanes, 0)
        some, toward, radiance, density = paths.spots(scene, position, u, ends, scene.cache)
        direction = _unit(toward)
        value = radiance / (density + sensor.pdf(rows[some], direction))
        seen, tint = unblocked(scene, position[:, some], toward, TARGET_SHORTENED, density > 0)
        yield 0, *_scattered(position.shape, some[seen], direction[:, seen], value[:, seen] * tint)
    if scene.model.sky == "fixed" and scene.sky.uneven:
        direction, radiance, density = scene.sky.sample(numbers.draw(lanes, DIRECT_DIMENSIONS + 7, 3))
        value = radiance / (density + sensor.pdf(rows, direction))
        yield functions_start, direction, _visible(scene, value, position, direction, FAR, density > 0)


def _scattered(shape: tuple[int, int], rows: np.ndarray, *parts: np.ndarray) -> list[np.ndarray]:
    """Columns at their rows, among zeros."""
    out = [np.zeros(shape, np.float32) for _ in parts]
    for target, part in zip(out, parts, strict=True):
        target[:, rows] = part
    return out


def _visible(scene: Scene, value: np.ndarray, position, toward, far, useful, shadow=None) -> np.ndarray:
    """(3, n) values where the way is free, zero elsewhere."""
    rows, tint = unblocked(scene, position, toward, far, useful, shadow)
    out = np.zeros_like(value)
    out[:, rows] = value[:, rows] * tint
    return out


def _unit(vector: np.ndarray) -> np.ndarray:
    """(3, n) unit vectors."""
    return vector / np.maximum(np.sqrt(warp.dot(vector, vector)), np.float32(1e-30))


def seeded(keys: np.ndarray, seed: int, use: int = 0) -> np.ndarray:
    """Keys that another seed, or another use, makes unrelated.

    Parameters
    ----------
    keys : (n,) uint32 ndarray
        Random keys.
    seed, use : int
        What they are for.

    Returns
    -------
    (n,) uint32 ndarray
        A bijection of `keys`.
    """
    return scramble(scramble(keys, use), (seed & 0xFFFFFFFF) + 1)
