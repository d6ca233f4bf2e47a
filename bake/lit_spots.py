"""Lit spots: what lamps shine on from close by, found from the lamps' side.

Comes in: points that are lit. Goes out: for each a way to a point that a lamp's ray has met, the radiance that it
reflects, and the density of that way. A lamp beside a wall lights a small spot of it far more than all else: paths
find it by rare chance, and it blinds them then. Rays from the lamp find it as often as it is bright. Either way
counts by the balance heuristic, so that nothing is counted twice and no path is blinded.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from . import warp
from .lamps import Lamps
from .rays import MISS, Hits, Tracer
from .sobol import Sampler
from .surfaces import Surfaces
from .visibility import FAR, TARGET_SHORTENED, meet, unblocked

__all__ = ["NUMBERS", "LitSpots"]

NUMBERS = 7
"""Random numbers of `LitSpots.sample`: whether and which lamp, its ray (4), where on a round lamp light comes from."""

SHARE = 0.25
"""Part of the path vertices that follow a lamp's ray."""

FEELERS = 1024
"""Rays that tell how close a lamp's surroundings are."""

AROUND = 0.75
"""Quantile of the free ways from a lamp that tells from how far its spots are seen: one wall may be close, not all."""

CONCENTRATED = 8.0
"""Lamps light spots when their light is this many times as concentrated as from the middle of a sphere."""

GRAZING = np.float32(1e-6)
"""Least cosine that a density is divided by."""


class LitSpots:
    """The lamps of a scene that shine on something close.

    Parameters
    ----------
    lamps : Lamps
        All lamps but suns.
    tracer : Tracer
        What they shine on.
    surfaces : Surfaces
        Its materials.
    wanted : bool
        Whether light of lamps is modelled at all.

    Attributes
    ----------
    count : int
        Number of such lamps.
    is_soft : (k,) bool
        Of all lamps, those that are round and no points.
    """

    def __init__(self, lamps: Lamps, tracer: Tracer, surfaces: Surfaces, wanted: bool = True) -> None:
        self.lamps, self.tracer, self.surfaces = lamps, tracer, surfaces
        chosen = (
            lamps.shadow & (_concentration(lamps, tracer) > CONCENTRATED) if wanted else np.zeros(lamps.count, bool)
        )
        power = np.where(chosen, lamps.power, 0)
        total = power.sum()
        self.count = int((power > 0).sum())
        self._pmf = (SHARE * power / total if self.count else power).astype(np.float32)
        self._cdf = np.cumsum(self._pmf, dtype=np.float64)
        self.is_soft = lamps.radius > 0

    def sample(self, position: np.ndarray, u: tuple[np.ndarray, ...], passing: Callable[[np.ndarray, int], np.ndarray]):
        """Follow a lamp's ray for some of the points, and look at where it ends.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Points that are lit [m].
        u : `NUMBERS` (n,) float32 ndarrays
            Uniform numbers.
        passing : callable
            As `visibility.meet` takes it, for points.

        Returns
        -------
        rows : (m,) int64 ndarray
            Points for which there is a lit spot; it may be hidden from them.
        toward : (3, m) float32 ndarray
            From the point to the spot [m], not of unit length.
        radiance : (3, m) float32 ndarray
            What the spot reflects of the lamp's light [W/(m2 sr)].
        pdf_solid_angle : (m,) float32 ndarray
            Density of the way there [1/sr].
        normal : (3, m) float32 ndarray
            Unit normal of the spot, towards the point.
        """
        rows = np.flatnonzero(u[0] < self._cdf[-1])
        lamp = np.searchsorted(self._cdf, u[0][rows], side="right")
        start, direction = (np.array(part) for part in self.lamps.emit(lamp, tuple(part[rows] for part in u[1:5])))
        hits, light, ends = self._shine(lamp, start, direction, lambda some, step: passing(rows[some], step))
        spot, normal = self._arrive(start, direction, hits, ends)
        toward = spot - position[:, rows]
        facing = -warp.dot(toward, normal)
        density = self._pdf_area(lamp, start - spot, normal) * _steradians(toward, facing)
        on = np.flatnonzero((hits.triangle != MISS) & (density > 0) & (facing > 0))
        numbers = [part[on] for part in self._on_lamp(lamp, u, rows)]
        light = light[:, on] * self._reflected(lamp[on], spot[:, on], normal[:, on], hits.take(on), numbers)
        return rows[on], toward[:, on], light, density[on], normal[:, on]

    def pdf_solid_angle(self, lamp, source, spot, normal, toward: np.ndarray) -> np.ndarray:
        """Density with which `sample` would have gone to where paths met a surface that a lamp shines on.

        Parameters
        ----------
        lamp : (n,) int64 ndarray
            The lamps.
        source : (3, n) float32 ndarray
            From the surface to the lamp, as in `LampSample` [m].
        spot, normal : (3, n) float32 ndarray
            Points off the surface [m], and unit normals towards the lamp.
        toward : (3, n) float32 ndarray
            From where the paths come to the surface [m].

        Returns
        -------
        (n,) float32 ndarray
            [1/sr]; 0 where the lamp's ray would have ended before.
        """
        density = self._pdf_area(lamp, source, normal) * _steradians(toward, -warp.dot(toward, normal))
        some = np.flatnonzero(density > 0)
        start = self._off_lamp((spot + source)[:, some], -source[:, some])
        seen, tint = unblocked(self, start, spot[:, some] - start, TARGET_SHORTENED, np.ones(len(some), bool))
        seen = seen[(warp.largest(np.broadcast_to(tint, (3, len(seen)))) > 0) | ~self.is_soft[lamp[some[seen]]]]
        out = np.zeros_like(density)
        out[some[seen]] = density[some[seen]]
        return out

    def _shine(self, lamp: np.ndarray, origin: np.ndarray, direction: np.ndarray, passing):
        """Follow lamps' rays to what they meet: hits, what light is left, the whole ways [m].

        Soft lamps are seen whole or in part, so that what stands before the middle says nothing of the light: their
        rays pass all that is transparent, and end in nothing where it is not.
        """
        soft, light, origin = self.is_soft[lamp], np.ones_like(origin), self._off_lamp(origin, direction)

        def uniform(some: np.ndarray, step: int) -> np.ndarray:
            return np.where(soft[some], np.float32(0), passing(some, step))

        hits, travelled = meet(self, origin, direction, light, uniform)
        light[:, soft] = 1
        hits.triangle[soft & self.surfaces.transparent[hits.triangle]] = MISS
        return hits, light, travelled

    def _off_lamp(self, start: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Starts of lamps' rays, off a surface that a lamp may lie on."""
        length = np.maximum(np.sqrt(warp.dot(way, way)), np.float32(1e-30))
        return start + way * (self.tracer.offset(start, np.zeros(start.shape[1], np.float32)) / length)

    def _arrive(self, start: np.ndarray, direction: np.ndarray, hits: Hits, travelled: np.ndarray):
        """Points off the surfaces that rays meet, and unit normals towards where they come from."""
        normal = hits.facing(direction)
        way = np.where(hits.triangle == MISS, np.float32(0), travelled)
        spot = start + direction * way
        return spot + normal * self.tracer.offset(spot, way), normal

    def _pdf_area(self, lamp: np.ndarray, source: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n,) density of a lamp's rays on surfaces, by the share that follows them [1/m2]."""
        squared = np.maximum(warp.dot(source, source), np.float32(1e-30))
        axis = source / np.sqrt(squared)
        cosine = np.maximum(warp.dot(axis, normal), 0)
        return self._pmf[lamp] * self.lamps.pdf_solid_angle(lamp, axis) * cosine / squared

    def _on_lamp(self, lamp: np.ndarray, u: tuple[np.ndarray, ...], rows: np.ndarray) -> list[np.ndarray]:
        """Numbers for where light comes from: of area lamps where the ray started, of round ones new ones."""
        is_round = self.lamps.is_round[lamp]
        return [np.where(is_round, u[new][rows], u[old][rows]) for new, old in ((5, 1), (6, 2))]

    def _reflected(self, lamp, spot, normal, hits, u: list[np.ndarray]) -> np.ndarray:
        """(3, n) radiance of the spots."""
        toward, irradiance = self.lamps.shine(lamp, spot, tuple(u))
        length = np.sqrt(np.maximum(warp.dot(toward, toward), np.float32(1e-30)))
        cosine = np.maximum(warp.dot(toward, normal), 0) / length
        seen, tint = unblocked(self, spot, toward, TARGET_SHORTENED, cosine > 0, self.is_soft[lamp])
        radiance = np.zeros_like(spot)
        reflectance = self.surfaces.reflectance(hits.triangle[seen], hits.u[seen], hits.v[seen])
        radiance[:, seen] = reflectance * irradiance[:, seen] * (cosine[seen] * np.float32(1 / np.pi)) * tint
        return radiance


def _steradians(toward: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(n,) what turns a density by area into one by solid angle; `facing` is the way's length times its cosine."""
    squared = warp.dot(toward, toward)
    return squared / np.maximum(facing / np.sqrt(np.maximum(squared, np.float32(1e-30))), GRAZING)


def _concentration(lamps: Lamps, tracer: Tracer) -> np.ndarray:
    """(k,) mean density of each lamp's rays on what they meet, relative to a sphere as large as its surroundings."""
    out = np.zeros(lamps.count)
    sampler, sample = Sampler(np.zeros(1, np.uint32), 0, FEELERS), np.arange(FEELERS)
    u = tuple(sampler.uniform(np.zeros(FEELERS, np.int64), sample, dimension) for dimension in range(4))
    everywhere = warp.sphere(u[2], u[3])
    for number in range(lamps.count):
        lamp = np.full(FEELERS, number)
        start, direction = lamps.emit(lamp, u)
        cosine, squared = _feel(tracer, start, direction)
        density = lamps.pdf_solid_angle(lamp, -direction) * cosine / squared
        around = _feel(tracer, start, everywhere)[1]
        around = around[np.isfinite(around)]
        if len(around):
            out[number] = 4 * np.pi * density.mean() * np.quantile(around, AROUND)
    return out


def _feel(tracer: Tracer, start: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) cosines at what rays meet, and squared distances, infinite where there is nothing."""
    rays = (np.ascontiguousarray(part) for part in (start, direction))
    hits = tracer.intersect_opaque(*rays, np.full(start.shape[1], FAR))
    normal, met = hits.normal.astype(np.float64), hits.triangle != MISS
    cosine = np.abs(warp.dot(normal, direction)) / np.maximum(np.sqrt(warp.dot(normal, normal)), 1e-37)
    squared = np.maximum(np.where(met, hits.distance, np.inf).astype(np.float64) ** 2, 1e-30)
    return np.where(met, cosine, 0), squared
