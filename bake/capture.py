"""Captures reflection probes: maps of radiance with as many rays as their noise asks for, blurred level by level.

Comes in: a scene, places. Goes out: `tree/probe_maps.py`'s record. Two halves of the rays of a texel are independent:
what sets them apart says how far off a map is, with bounced light shared between texels (`smoothing.py`) and without;
the better one counts, and rays go on, twice as many each time, until that is good enough. Every level is blurred from
the sharpest one (`prefilter.py`). Maps depend on a probe's place alone: not on its number, other probes, or threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree import octahedral, probe_maps
from ..tree.probe_atlas import put
from ..tree.probe_maps import ProbeMaps, rounded
from .gather import Effort
from .lamps import LUMINANCE
from .panorama import Panorama, Seen
from .parallel import run_tiles, tiles
from .prefilter import Prefilter, prefilter
from .scene import Scene
from .smoothing import alike, smoothed

__all__ = ["PITCH", "Spending", "Studio", "capture", "shoot"]

PITCH = 128
"""Width of a tile: a map of 126 x 126 texels is as sharp as roughness 0.12, a texel 1.6 degrees wide."""

FIRST_RAYS = 8
"""Rays of each half in the first round: fewer make edges of things rough, and may by chance miss what is rare."""

HALVES = 2
"""Independent halves of a texel's rays."""

FAINT = 2.0**-14
"""Radiance below which half precision becomes coarse [W/(m2 sr)]: noise is relative to no less."""

FARTHEST = np.float32(65504)
"""Longest distance of half precision [m]; beyond, all is as far as the sky."""


@dataclass(frozen=True)
class Spending:
    """How good maps are to be.

    error : standard error of texels of the sharpest level, root mean square over all directions, each relative to its
        own light plus the map's mean, of all transports together
    most : most rays of a texel
    pitch : width of a tile [texels]
    """

    error: float = 0.05
    most: int = 256
    pitch: int = PITCH


@dataclass(frozen=True, eq=False)
class Studio:
    """What all probes of a bake share.

    maps : ProbeMaps, filled by `shoot`
    mixture : (parts, 3) float64, how bright each part of radiance shines when nobody says otherwise
    spending : Spending
    effort : Effort, bounces, seed, threads
    blur : Prefilter
    rays, noise : (k,) float32, rays of each texel, and the standard error that they left, as `Spending` has it
    """

    maps: ProbeMaps
    mixture: np.ndarray
    spending: Spending
    effort: Effort
    blur: Prefilter
    rays: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, maps: ProbeMaps, mixture: np.ndarray, spending: Spending, effort: Effort) -> Studio:
        """Prepare to fill maps.

        Parameters
        ----------
        maps : ProbeMaps
            As from `probe_maps.empty`.
        mixture, spending, effort
            As above.

        Returns
        -------
        Studio
            With nothing done.
        """
        rays, noise = np.zeros((2, len(maps.position)), np.float32)
        return cls(maps, mixture, spending, effort, prefilter(maps.layout), rays, noise)


def capture(
    scene: Scene,
    position: np.ndarray,
    mixture: np.ndarray,
    spending: Spending,
    effort: Effort,
    progress: Callable[[int], bool] | None = None,
) -> Studio:
    """Capture probes that one scene holds.

    Parameters
    ----------
    scene : Scene
        What they see; a surface cache, where it has one, ends paths.
    position : (k, 3) float64 ndarray
        Places [m], relative to the scene's origin.
    mixture : (parts, 3) float64 ndarray
        As in `Studio`; for example `survey.Judge.mean`.
    spending : Spending
        How good.
    effort : Effort
        Bounces, seed, threads.
    progress : callable, optional
        Called with the probes that are done, from the calling thread; returns False to stop.

    Returns
    -------
    Studio
        Whose maps are filled; none is pinned.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    parts = probe_maps.part_names(scene.has_local, len(scene.model.suns.toward), scene.model.sky_count)
    pinned = np.zeros(len(position), bool)
    maps = probe_maps.empty(position + scene.origin, pinned, spending.pitch, parts)
    studio = Studio.of(maps, mixture, spending, effort)
    shoot(scene, studio, np.arange(len(position)), progress)
    return studio


def shoot(scene: Scene, studio: Studio, rows: np.ndarray, progress: Callable[[int], bool] | None = None) -> None:
    """Fill the maps of some probes.

    Parameters
    ----------
    scene : Scene
        What they see, with the studio's parts of radiance.
    studio : Studio
        Whose maps are filled.
    rows : (m,) int64 ndarray
        Which probes.
    progress : callable, optional
        Called with the probes that are done, from the calling thread; returns False to stop.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Error: noise as `Spending` says, where that takes no more than `most` rays; what a surface cache is off by, one
    bounce on; rounding (`probe_maps.rounded`). Tested against closed forms and plain path tracing in
    `tests/bake/test_capture.py`.
    """
    size = studio.maps.layout.sizes[0]

    def work(tile: np.ndarray) -> int:
        for row in tile:
            place = studio.maps.position[row] - scene.origin
            around = Panorama(scene, place, size, studio.effort.bounces, studio.effort.seed)
            seen = around.surfaces()
            if studio.maps.radiance:
                _put_radiance(studio, row, _radiance(studio, row, around, alike(seen)))
            _put_surfaces(studio.maps, row, seen)
        return len(tile)

    run_tiles(work, [rows[tile] for tile in tiles(len(rows), 1)], studio.effort.threads, progress)


def _radiance(studio: Studio, row: int, around: Panorama, weights: np.ndarray) -> np.ndarray:
    """(size * size, parts, 3) mean radiance of texels, by as many rays as it takes."""
    mixture = (studio.mixture * LUMINANCE).astype(np.float32)
    halves, count = [around.sums(half, 0, FIRST_RAYS) for half in range(HALVES)], FIRST_RAYS
    while True:
        means = [half.over(count) for half in halves]
        plain, smooth = [mean.straight + mean.bounced for mean in means], [smoothed(mean, weights) for mean in means]
        errors = _errors(*(np.einsum("htpc,pc->ht", np.stack(pair), mixture) for pair in (plain, smooth)))
        if min(errors) <= studio.spending.error or 2 * HALVES * count > studio.spending.most:
            break
        halves = [total.plus(around.sums(half, count, count)) for half, total in enumerate(halves)]
        count *= 2
    studio.rays[row], studio.noise[row] = HALVES * count, min(errors)
    better = plain if errors[0] <= errors[1] else smooth
    return sum(better) / np.float32(HALVES)


def _errors(plain: np.ndarray, smooth: np.ndarray) -> tuple[float, float]:
    """Standard errors of the means of both halves (2, n), of a map as it is and smoothed: root mean square over all
    directions, each over the texel's light plus the map's mean.

    What a smoothed half and the other plain one differ by is noise of both, and what smoothing is off by.
    """
    area = octahedral.solid_angles(round(plain.shape[1] ** 0.5)).reshape(-1) / (4 * np.pi)
    light = np.abs(smooth.sum(axis=0, dtype=np.float64)) / 2
    share = area / (light + (area * light).sum() + FAINT) ** 2
    noise, left = ((share * (pair[0] - pair[1]) ** 2).sum() / 4 for pair in (plain, smooth))
    both = sum((share * (smooth[half] - plain[1 - half]) ** 2).sum() for half in range(HALVES)) / 2
    bias = max(both - 2 * noise - 2 * left, 0.0)
    return float(np.sqrt(noise)), float(np.sqrt(left + bias))


def _put_radiance(studio: Studio, row: int, light: np.ndarray) -> None:
    """Blur a probe's maps and write all levels."""
    maps, size = studio.maps, studio.blur.size
    for level, image in enumerate(studio.blur(light.reshape(size, size, -1))):
        image = rounded(image)
        for part, atlases in enumerate(maps.radiance.values()):
            put(atlases[level], maps.layout, level, row, image[:, :, 3 * part : 3 * part + 3])


def _put_surfaces(maps: ProbeMaps, row: int, seen: Seen) -> None:
    """Write what lies behind a probe's texels."""
    size = maps.layout.sizes[0]
    distance = np.where(seen.distance > FARTHEST, np.float32(np.inf), seen.distance)
    put(maps.distance, maps.layout, 0, row, distance.reshape(size, size).astype(np.float16))
    put(maps.normal, maps.layout, 0, row, seen.normal.T.reshape(size, size, 3).astype(np.float16))
    put(maps.albedo, maps.layout, 0, row, rounded(seen.albedo.T).reshape(size, size, 3))
