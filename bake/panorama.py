"""What one place sees all around, texel by texel of an octahedral map: radiance, and the surfaces behind the texels.

Comes in: a scene, a place. Goes out: sums of radiance over rays that are spread over each texel, all transports from
the same paths; distance, normal and reflectance where a ray through a texel's middle ends. Surfaces that shine, lamps
that are marked as reflectors and the sky are seen as they are; other lamps and the sun's disk are the engine's. Direct
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
from .lit_spots import LitSpots
from .parallel import tile_size
from .paths import CERTAIN, Numbers, Radiance, Wave
from .rays import MISS
from .scene import Scene
from .sobol import Sampler, scramble
from .visibility import TARGET_SHORTENED, meet, unblocked

__all__ = ["Light", "Panorama", "Seen"]

TEXEL_USE, PLACE_USE = 0x7E8E1, 0x91ACE
"""Tell keys of texels and of places from other keys."""

SEEN_THROUGH = np.float32(0.5)
"""Surfaces that let more light pass than this are not what a texel shows the distance of."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces behind the middles of n texels.

    direction : (3, n) float32, unit vectors to the middles
    distance : (n,) float32 [m], inf where the sky is seen
    normal : (3, n) float32, unit vectors of the sides that are seen; 0 of the sky
    albedo : (3, n) float32, reflectance, 0 to 1; 0 of the sky
    """

    direction: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray


@dataclass(frozen=True, eq=False)
class Light:
    """Sums over rays through n texels.

    straight : (n, functions, 3) float32, radiance of what shines by itself, or is lit straight by what does
    bounced : (n, functions, 3) float32, radiance of all other light
    reflectance : (n, 3) float32, of what the rays met; 0 of the sky
    """

    straight: np.ndarray
    bounced: np.ndarray
    reflectance: np.ndarray

    def plus(self, other: Light) -> Light:
        """Join the sums over other rays through the same texels.

        Parameters
        ----------
        other : Light
            The others.

        Returns
        -------
        Light
            Of all rays.
        """
        return Light(*(one + two for one, two in zip(self._all(), other._all(), strict=True)))

    def over(self, count: int) -> Light:
        """Turn sums into means.

        Parameters
        ----------
        count : int
            Rays of each texel.

        Returns
        -------
        Light
            Divided by that.
        """
        return Light(*(part / np.float32(count) for part in self._all()))

    def _all(self) -> tuple[np.ndarray, ...]:
        return self.straight, self.bounced, self.reflectance


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
        self._scene, self._size, self._bounces, self._seed = scene, size, bounces, seed
        spots = LitSpots(scene.lamps, scene.tracer, scene.surfaces, wanted=False)
        self._without_spots = dataclasses.replace(scene, lit_spots=spots)
        self._place = np.asarray(place, np.float32)[:, None] + np.float32(0)  # no negative zero
        self._keys = _keys(self._place, size)

    def sums(self, half: int, first: int, count: int) -> Light:
        """Add up the radiance that rays bring.

        Parameters
        ----------
        half : int
            Sums of different halves are independent.
        first, count : int
            Which rays of each texel: sums of successive ones add up to those of all.

        Returns
        -------
        Light
            Of size * size texels; functions are local light where there is any, suns, sky, as
            `probe_maps.part_names` names them.
        """
        keys = seeded(self._keys, self._seed, half)
        step = max(1, tile_size(1 + len(self._scene.model.suns.toward) + self._scene.model.sky_count) // count)
        parts = []
        for start in range(0, len(keys), step):
            texel = np.arange(start, min(start + step, len(keys)))
            found = self._traced(texel, Sampler(keys[texel], first, count), count)
            parts.append([part.reshape(*part.shape[:-1], len(texel), count).sum(axis=-1) for part in found])
        straight, bounced, reflectance = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        skipped = 0 if self._scene.has_local else 1
        return Light(*(part[skipped:].transpose(2, 0, 1) for part in (straight, bounced)), reflectance.T)

    def surfaces(self) -> Seen:
        """Look through the middle of each texel.

        Returns
        -------
        Seen
            Of size * size texels.
        """
        texel = np.arange(len(self._keys))
        wave = self._rays(self._toward(texel, np.float32(0.5), np.float32(0.5)))
        direction, through = wave.direction, lambda rows, step: np.full(len(rows), SEEN_THROUGH)
        hits, travelled = meet(self._scene, wave.origin, direction, wave.beta, through)
        met = np.flatnonzero(hits.triangle != MISS)
        normal, albedo = np.zeros((2, 3, len(texel)), np.float32)
        hits, distance = hits.take(met), np.full(len(texel), np.inf, np.float32)
        distance[met], normal[:, met] = travelled[met], hits.facing(direction[:, met])
        albedo[:, met] = self._scene.surfaces.reflectance(hits.triangle, hits.u, hits.v)
        return Seen(direction, distance, normal, albedo)

    def _traced(self, texel: np.ndarray, sampler: Sampler, count: int) -> tuple[np.ndarray, ...]:
        """(functions, 3, rays) straight and bounced light, (3, rays) reflectance along rays of each texel."""
        point, sample = np.divmod(np.arange(len(texel) * count), count)
        numbers, lanes = Numbers(sampler, point, sample), np.arange(len(point))
        direction = self._toward(texel[point], *numbers.draw(lanes, 0, 2))
        light, lane, vertex = paths.look(self._scene, self._rays(direction), numbers)
        self._add_reflectors(light, direction)
        straight, reflectance = light.stacked(), np.zeros((3, len(lanes)), np.float32)
        reflectance[:, lane] = vertex.reflectance
        bounced = np.zeros_like(straight)
        if self._bounces and len(lane):
            numbers = Numbers(sampler, point[lane], sample[lane])
            straight[:, :, lane] += paths.shine(self._without_spots, vertex, numbers)[0].stacked()
            found = paths.arriving(self._scene, vertex, numbers, self._bounces, self._scene.cache)
            bounced[:, :, lane] = found.stacked()
        return straight, bounced, reflectance

    def _add_reflectors(self, light: Radiance, direction: np.ndarray) -> None:
        """Lamps that are baked only: no engine shows them."""
        reflectors = self._scene.reflectors if self._scene.model.local else None
        for lamp in range(reflectors.count if reflectors else 0):
            origin = np.repeat(self._place, direction.shape[1], axis=1)
            distance, radiance = reflectors.along(lamp, origin, direction)
            met = np.flatnonzero(distance)
            shadow = np.full(len(met), reflectors.shadow[lamp])
            segments = origin[:, met], direction[:, met] * distance[met]
            rows, tint = unblocked(self._scene, *segments, TARGET_SHORTENED, distance[met] > 0, shadow)
            light.local[:, met[rows]] += radiance[:, met[rows]] * tint

    def _rays(self, direction: np.ndarray) -> Wave:
        """Paths from the place."""
        count = direction.shape[1]
        start, certain = np.repeat(self._place, count, axis=1), np.full(count, CERTAIN)
        return Wave(np.arange(count), start, direction, np.ones_like(direction), certain)

    def _toward(self, texel: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) directions of places in texels, each 0 to 1."""
        row, column = np.divmod(texel, self._size)
        uv = np.stack([column + u, row + v], axis=-1).astype(np.float32) / np.float32(self._size)
        return np.ascontiguousarray(octahedral.decode(uv).T)


def _keys(place: np.ndarray, size: int) -> np.ndarray:
    """(size * size,) uint32 random keys of a place's texels."""
    key = np.zeros(1, np.uint32)
    for bits in place.view(np.uint32):
        key = scramble(key ^ bits, PLACE_USE)
    return scramble(np.arange(size * size, dtype=np.uint32), TEXEL_USE) ^ key
