"""What one place sees all around, texel by texel of an octahedral map: radiance, and the surfaces behind the texels.

Comes in: a scene, a place. Goes out: sums of radiance over rays that are spread over each texel, all transports from
the same paths; distance, normal and reflectance where a ray through a texel's middle ends. Surfaces that shine and the
sky are seen as they are; lamps are no surfaces, and the sun's disk isn't there: engines show both by themselves. Direct
light is looked for where a ray ends, as mirrors show the edges of shadows; a surface cache is asked one bounce further
on, where its grain doesn't show.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..tree import octahedral
from . import paths
from .gather import seeded
from .parallel import tile_size
from .paths import CERTAIN, Cache, Numbers, Radiance, Vertex, Wave
from .rays import MISS
from .scene import Scene
from .sobol import Sampler, scramble
from .visibility import meet

__all__ = ["Panorama", "Seen"]

TEXEL_USE, PLACE_USE = 0x7E8E1, 0x91ACE
"""Tell keys of texels and of places from other keys."""

SEEN_THROUGH = np.float32(0.5)
"""Surfaces that let more light pass than this are not what a texel shows the distance of."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces behind the middles of n texels.

    distance : (n,) float32 [m], inf where the sky is seen
    normal : (3, n) float32, unit vectors of the sides that are seen; 0 of the sky
    albedo : (3, n) float32, reflectance, 0 to 1; 0 of the sky
    """

    distance: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray


class Panorama:
    """All directions around a place.

    Parameters
    ----------
    scene : Scene
        What is seen.
    place : (3,) ndarray
        Where [m], relative to the scene's origin.
    size : int
        Texels along an edge of the map, without border.
    bounces : int
        Reflections that light may undergo.
    seed : int
        Another one gives independent noise.
    """

    def __init__(self, scene: Scene, place: np.ndarray, size: int, bounces: int, seed: int) -> None:
        cache = None if scene.cache is None else _Beyond(scene.cache)
        self._scene, self._size, self._bounces = dataclasses.replace(scene, cache=cache), size, bounces
        self._place, self._seed = np.asarray(place, np.float32)[:, None] + np.float32(0), seed
        self._keys = _keys(self._place, size)

    def sums(self, half: int, first: int, count: int) -> np.ndarray:
        """Add up the radiance that rays bring.

        Parameters
        ----------
        half : int
            Sums of different halves are independent.
        first, count : int
            Which rays of each texel: sums of successive ones add up to those of all.

        Returns
        -------
        (size * size, functions, 3) float32 ndarray
            By texel; local light where there is any, suns, sky, as `probe_maps.part_names` names them.
        """
        keys, skipped = seeded(self._keys, self._seed, half), 0 if self._scene.has_local else 1
        step = max(1, tile_size(1 + len(self._scene.model.suns.toward) + self._scene.model.sky_count) // count)
        parts = []
        for start in range(0, len(keys), step):
            texel = np.arange(start, min(start + step, len(keys)))
            light = self._light(texel, Sampler(keys[texel], first, count), count)
            parts.append(light.stacked()[skipped:].reshape(-1, 3, len(texel), count).sum(axis=3).transpose(2, 0, 1))
        return np.concatenate(parts)

    def surfaces(self) -> Seen:
        """Look through the middle of each texel.

        Returns
        -------
        Seen
            Of size * size texels.
        """
        texel = np.arange(len(self._keys))
        direction = self._toward(texel, np.float32(0.5), np.float32(0.5))
        start, beta = np.repeat(self._place, len(texel), axis=1), np.ones_like(direction)
        hits, travelled = meet(self._scene, start, direction, beta, lambda rows, _: np.full(len(rows), SEEN_THROUGH))
        met = np.flatnonzero(hits.triangle != MISS)
        normal, albedo = np.zeros((2, 3, len(texel)), np.float32)
        hits, distance = hits.take(met), np.full(len(texel), np.inf, np.float32)
        distance[met], normal[:, met] = travelled[met], hits.facing(direction[:, met])
        albedo[:, met] = self._scene.surfaces.reflectance(hits.triangle, hits.u, hits.v)
        return Seen(distance, normal, albedo)

    def _light(self, texel: np.ndarray, sampler: Sampler, count: int) -> Radiance:
        """Radiance along `count` rays of each texel."""
        point, sample = np.divmod(np.arange(len(texel) * count), count)
        numbers, lanes = Numbers(sampler, point, sample), np.arange(len(point))
        direction = self._toward(texel[point], *numbers.draw(lanes, 0, 2))
        start, certain = np.repeat(self._place, len(lanes), axis=1), np.full(len(lanes), CERTAIN)
        wave = Wave(lanes, start, direction, np.ones_like(direction), certain)
        return paths.trace(self._scene, wave, numbers, self._bounces)

    def _toward(self, texel: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) directions of places in texels, each 0 to 1."""
        row, column = np.divmod(texel, self._size)
        uv = np.stack([column + u, row + v], axis=-1).astype(np.float32) / np.float32(self._size)
        return np.ascontiguousarray(octahedral.decode(uv).T)


class _Beyond:
    """A cache that is not asked where rays from the place itself end."""

    def __init__(self, cache: Cache) -> None:
        self._cache = cache

    def finish(self, wave: Wave, vertex: Vertex, travelled: np.ndarray, light: Radiance) -> tuple:
        if wave.pdf[0] < CERTAIN:
            return self._cache.finish(wave, vertex, travelled, light)
        rows = np.arange(len(wave.lane))
        return rows, rows

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        return self._cache.leaves(position, normal, travelled)


def _keys(place: np.ndarray, size: int) -> np.ndarray:
    """(size * size,) uint32 random keys of a place's texels."""
    key = np.zeros(1, np.uint32)
    for bits in place.view(np.uint32):
        key = scramble(key ^ bits, PLACE_USE)
    return scramble(np.arange(size * size, dtype=np.uint32), TEXEL_USE) ^ key
