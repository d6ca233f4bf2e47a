"""The path tracer: wavefronts of paths that carry all three transports at once.

Comes in: rays and their random numbers. Goes out: for each ray the radiance that comes back along it, apart for
local light, for every sun key and for every function of the sky. Unbiased but for the bounce limit, and for the surface
cache where the scene has one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..tree import harmonics
from . import lit_spots, warp
from .parallel import check
from .rays import MISS, Hits
from .scene import Scene
from .sobol import Sampler
from .visibility import FAR, TARGET_SHORTENED, meet, unblocked

ROULETTE_START = 3
"""Bounces before Russian roulette may end a path: earlier ends cost more noise than they save time."""

GRAZING = np.float32(1e-6)
"""Least cosine of a density, so that no weight divides zero by zero."""

CERTAIN = np.float32(1e30)
"""Density of a direction that was not drawn by chance but looked in: what lies there counts in full."""

# Dimensions of the random numbers. The first two choose the path's first direction.
FIRST_VERTEX = 2
SCATTER, LAMP, EMITTER, SKY, PER_VERTEX = 0, 2, 6, 9, 12
HASHED = 1 << 16
"""Dimensions from here on are hashed, not Sobol points: roulette, transparency, the sun's disk, lit spots."""
ROULETTE, SUN_DISK, PASS, SPOT, HASHED_PER_VERTEX = 0, 1, 3, 40, 64


@dataclass
class Radiance:
    """Radiance that comes back along rays, for n rays.

    local : (3, n) float32 [W/(m2 sr)]
    sun : (keys, 3, n) float32, per W/m2 of sun irradiance [1/sr]
    sky : (functions, 3, n) float32, [W/(m2 sr)] of a fixed sky, or per unit of each harmonic
    """

    local: np.ndarray
    sun: np.ndarray
    sky: np.ndarray

    @classmethod
    def zeros(cls, scene: Scene, lanes: int) -> Radiance:
        """No light yet.

        Parameters
        ----------
        scene : Scene
            Says which transports there are.
        lanes : int
            Number of rays.

        Returns
        -------
        Radiance
            Zeros.
        """
        suns, functions = len(scene.model.suns.toward), scene.model.sky_count
        shapes = ((3, lanes), (suns, 3, lanes), (functions, 3, lanes))
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))

    def stacked(self) -> np.ndarray:
        """Join all functions.

        Returns
        -------
        (1 + keys + functions, 3, n) float32 ndarray
            Local light, suns, sky; a copy.
        """
        return np.concatenate([self.local[None], self.sun, self.sky])


@dataclass
class Wave:
    """The paths that are still alive, stored by component.

    lane : (n,) int64, the ray that each path belongs to
    origin : (3, n) float32 [m]
    direction : (3, n) float32, unit length
    beta : (3, n) float32, throughput
    pdf : (n,) float32 [1/sr], density of `direction`, to weigh emitters and sky found by chance
    """

    lane: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    beta: np.ndarray
    pdf: np.ndarray

    def take(self, rows: np.ndarray) -> Wave:
        """Some of the paths.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        Wave
            Copies.
        """
        return Wave(self.lane[rows], self.origin[:, rows], self.direction[:, rows], self.beta[:, rows], self.pdf[rows])


class Numbers:
    """Random numbers of the rays.

    Parameters
    ----------
    sampler : Sampler
        Where they come from.
    point, sample : (n,) int64 ndarray
        Ray i is sample `sample[i]` of point `point[i]`.
    """

    def __init__(self, sampler: Sampler, point: np.ndarray, sample: np.ndarray) -> None:
        self._sampler, self._point, self._sample = sampler, point, sample

    def draw(self, lane: np.ndarray, first: int, count: int) -> tuple[np.ndarray, ...]:
        """Take numbers for some rays.

        Parameters
        ----------
        lane : (m,) int64 ndarray
            The rays.
        first, count : int
            Dimensions `first` to `first + count - 1`.

        Returns
        -------
        tuple of (m,) float32 ndarray
            Uniform in [0, 1), one array for each dimension.
        """
        point, sample = self._point[lane], self._sample[lane]
        return tuple(self._sampler.uniform(point, sample, first + k) for k in range(count))


class Cache(Protocol):
    """What ends paths early, as it knows the light that surfaces send back."""

    def finish(self, wave: Wave, vertex: Vertex, travelled: np.ndarray, light: Radiance) -> tuple:
        """Add the light that some paths' vertices send back.

        Parameters
        ----------
        wave : Wave
            Paths.
        vertex : Vertex
            Where they are.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].
        light : Radiance
            What they bring is added here.

        Returns
        -------
        left : (m,) int64 ndarray
            Rows of the paths for which direct light is still to be looked for.
        on : (k,) int64 ndarray
            Which of these go on after that.
        """

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        """Say for which paths direct light is still to be looked for where they arrive.

        Parameters
        ----------
        position, normal : (3, n) float32 ndarray
            Where they arrive [m], and unit normals there.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].

        Returns
        -------
        (m,) int64 ndarray
            The rows that `finish` would return first.
        """


def trace(scene: Scene, wave: Wave, numbers: Numbers, bounces: int) -> Radiance:
    """Follow paths until they leave, are absorbed, end in a cache, or have been reflected `bounces` times.

    Parameters
    ----------
    scene : Scene
        What they travel through; its `cache`, where it has one, ends paths.
    wave : Wave
        One path for each ray, `lane` counting from 0, `beta` 1; used up.
    numbers : Numbers
        Their random numbers.
    bounces : int
        Reflections that light may undergo; 0 sees emitters and sky only.

    Returns
    -------
    Radiance
        Direct light of lamps and suns along the rays is not part of it: they are no surfaces. Where the scene has
        `lit_spots`, what paths find of them at their first hit is weighed against `spots` at their start,
        which is the caller's to add.

    Notes
    -----
    Error: unbiased up to the bounce limit without a cache; noise only. Tested against closed forms in `tests/bake`.
    Source: Kajiya 1986; Veach 1997, section 9.2, balance heuristic for emitters, an uneven sky and lit spots.
    """
    light = Radiance.zeros(scene, len(wave.lane))
    _follow(scene, wave, numbers, (0, bounces), light, scene.cache)
    return light


def look(scene: Scene, wave: Wave, numbers: Numbers) -> tuple[Radiance, np.ndarray, Vertex]:
    """See what rays end on.

    Parameters
    ----------
    scene : Scene
        What they travel through.
    wave : Wave
        One path for each ray, `lane` counting from 0, `beta` 1, `pdf` `CERTAIN` where they were not drawn by chance;
        used up.
    numbers : Numbers
        Their random numbers.

    Returns
    -------
    light : Radiance
        The sky, and what surfaces emit.
    lane : (m,) int64 ndarray
        Rays that meet a surface.
    vertex : Vertex
        Where they do, with the reflectance that they see there.
    """
    light = Radiance.zeros(scene, len(wave.lane))
    wave, hits, travelled = _advance(scene, wave, numbers, 0, light)
    _add_emission(scene, wave, hits, travelled, light)
    vertex = _arrive(scene, wave, hits, travelled)
    vertex.reflectance = vertex.reflectance * wave.beta
    return light, wave.lane, vertex


def shine(scene: Scene, vertex: Vertex, numbers: Numbers) -> tuple[Radiance, np.ndarray]:
    """Direct light on surfaces, of all that can be looked for there; emitters and a sky that paths find by chance
    are weighed against that.

    Parameters
    ----------
    scene : Scene
        What shines; without lit spots.
    vertex : Vertex
        Points on surfaces, one for each lane.
    numbers : Numbers
        Their random numbers.

    Returns
    -------
    light : Radiance
        Irradiance there [W/m2], where the reflectance is pi.
    of_lamps : (3, n) float32 ndarray
        What of its local light comes from lamps.
    """
    light = Radiance.zeros(scene, len(vertex.triangle))
    travelled = np.zeros(len(vertex.triangle), np.float32)
    wave = _leaving(vertex)
    _add_lamps(scene, wave, vertex, numbers, 0, travelled, light)
    of_lamps = light.local.copy()
    _shine(scene, wave, vertex, numbers, 0, light)
    return light, of_lamps


def arriving(scene: Scene, vertex: Vertex, numbers: Numbers, bounces: int, cache: Cache | None) -> Radiance:
    """Light that paths from surfaces find by chance: all but what `shine` looks for.

    Parameters
    ----------
    scene : Scene
        What they travel through.
    vertex : Vertex
        Points on surfaces, one for each lane.
    numbers : Numbers
        Their random numbers.
    bounces : int
        Reflections on the way, the points' own among them.
    cache : Cache, optional
        What ends paths.

    Returns
    -------
    Radiance
        Irradiance there [W/m2], where the reflectance is pi.
    """
    light = Radiance.zeros(scene, len(vertex.triangle))
    wave = _leaving(vertex)
    if bounces > 1:
        _add_lit_spots(scene, wave, vertex, numbers, (0, cache), light)
    _follow(scene, _scatter(wave, vertex, numbers, 0), numbers, (1, bounces), light, cache)
    return light


def _leaving(vertex: Vertex) -> Wave:
    """Paths that begin on surfaces."""
    count = len(vertex.triangle)
    ones = np.ones((3, count), np.float32)
    return Wave(np.arange(count), vertex.position, ones, ones.copy(), np.ones(count, np.float32))


def _follow(
    scene: Scene, wave: Wave, numbers: Numbers, limits: tuple[int, int], light: Radiance, cache: Cache | None
) -> None:
    """Follow paths from one vertex to another, these included."""
    first, last = limits
    for bounce in range(first, last + 1):
        check()
        wave, hits, travelled = _advance(scene, wave, numbers, bounce, light)
        if not len(wave.lane):
            break
        _add_emission(scene, wave, hits, travelled, light)
        if bounce == last:
            break
        vertex = _arrive(scene, wave, hits, travelled)
        on = None
        if cache is not None:
            left, on = cache.finish(wave, vertex, travelled, light)
            wave, vertex, travelled = wave.take(left), vertex.take(left), travelled[left]
        _add_lamps(scene, wave, vertex, numbers, bounce, travelled, light)
        _shine(scene, wave, vertex, numbers, bounce, light)
        if on is not None:
            wave, vertex = wave.take(on), vertex.take(on)
        if bounce + 1 < last:
            _add_lit_spots(scene, wave, vertex, numbers, (bounce, cache), light)
        wave = _scatter(wave, vertex, numbers, bounce)


def _shine(scene: Scene, wave: Wave, vertex: Vertex, numbers: Numbers, bounce: int, light: Radiance) -> None:
    """Look for light at vertices besides that of lamps: emitters, suns, an uneven sky."""
    _add_emitters(scene, wave, vertex, numbers, bounce, light)
    _add_suns(scene, wave, vertex, numbers, bounce, light)
    _add_sky(scene, wave, vertex, numbers, bounce, light)


@dataclass
class Vertex:
    """Where paths meet surfaces: triangles, points [m] off them, facing unit normals, reflectance; by component."""

    triangle: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    reflectance: np.ndarray

    def take(self, rows: np.ndarray) -> Vertex:
        """Some of them.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        Vertex
            Copies.
        """
        return Vertex(self.triangle[rows], self.position[:, rows], self.normal[:, rows], self.reflectance[:, rows])


def _advance(scene: Scene, wave: Wave, numbers: Numbers, bounce: int, light: Radiance):
    """Trace to the next opaque hit; paths that leave collect the sky. Returns (paths, hits, metres travelled)."""
    hits, travelled = meet(scene, wave.origin, wave.direction, wave.beta, passing(numbers, wave.lane, bounce))
    alive = hits.triangle != MISS
    if not alive.all():
        _add_escaped(scene, wave.take(np.flatnonzero(~alive)), light)
        rows = np.flatnonzero(alive)
        wave, hits, travelled = wave.take(rows), hits.take(rows), travelled[rows]
    return wave, hits, travelled


def passing(numbers: Numbers, lane: np.ndarray, bounce: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """Choose the numbers that decide where rays end.

    Parameters
    ----------
    numbers : Numbers
        Where they come from.
    lane : (n,) int64 ndarray
        The rays.
    bounce : int
        How many vertices came before.

    Returns
    -------
    callable
        As `visibility.meet` takes it.
    """
    first = HASHED + bounce * HASHED_PER_VERTEX + PASS
    return lambda rows, step: numbers.draw(lane[rows], first + step, 1)[0]


def _add_escaped(scene: Scene, wave: Wave, light: Radiance) -> None:
    """Sky that paths find by leaving the scene."""
    if scene.model.sky == "harmonics":
        basis = harmonics.basis(wave.direction.T)
        light.sky[:, :, wave.lane] += basis.T[:, None, :] * wave.beta
    elif scene.model.sky == "fixed" and not scene.sky.dark:
        radiance = wave.beta * scene.sky.radiance(wave.direction)
        if scene.sky.uneven:
            radiance = radiance * (wave.pdf / (wave.pdf + scene.sky.pdf_solid_angle(wave.direction)))
        light.sky[0][:, wave.lane] += radiance


def _add_emission(scene: Scene, wave: Wave, hits: Hits, travelled: np.ndarray, light: Radiance) -> None:
    """Emissive surfaces that paths find by chance."""
    if not scene.model.local or not scene.emitters.count:
        return
    rows = np.flatnonzero(scene.surfaces.emissive[hits.triangle])
    if not len(rows):
        return
    triangle, normal, direction = hits.triangle[rows], hits.normal[:, rows], wave.direction[:, rows]
    cosine = np.abs(warp.dot(normal, direction)) / np.sqrt(warp.dot(normal, normal))
    other = scene.emitters.pdf_solid_angle(triangle, travelled[rows], cosine)
    weight = wave.pdf[rows] / (wave.pdf[rows] + other)
    radiance = scene.surfaces.emission(triangle, hits.u[rows], hits.v[rows])
    light.local[:, wave.lane[rows]] += wave.beta[:, rows] * radiance * weight


def _arrive(scene: Scene, wave: Wave, hits: Hits, travelled: np.ndarray) -> Vertex:
    """Points off the surface on the side that the path came from."""
    normal = hits.facing(wave.direction)
    position = wave.origin + wave.direction * hits.distance
    position += normal * scene.tracer.offset(position, travelled)
    reflectance = scene.surfaces.reflectance(hits.triangle, hits.u, hits.v)
    return Vertex(hits.triangle, position, normal, reflectance)


def _add_lamps(scene: Scene, wave, vertex: Vertex, numbers: Numbers, bounce: int, travelled, light: Radiance) -> None:
    """One shadow ray to one lamp, weighed against coming from the lamp where it lights a spot."""
    if not scene.model.local or not scene.lamps.count:
        return
    u = numbers.draw(wave.lane, FIRST_VERTEX + bounce * PER_VERTEX + LAMP, 4)
    sample = scene.lamps.sample(vertex.position, vertex.normal, u)
    length = np.sqrt(warp.dot(sample.toward, sample.toward))
    cosine = np.maximum(warp.dot(sample.toward, vertex.normal), 0) / np.maximum(length, np.float32(1e-30))
    useful = sample.lit & (cosine > 0)
    rows, tint = unblocked(scene, vertex.position, sample.toward, TARGET_SHORTENED, useful, sample.shadow)
    weight = cosine[rows]
    if scene.lit_spots.count:
        way = wave.direction[:, rows] * travelled[rows]
        at = (sample.source[:, rows], vertex.position[:, rows], vertex.normal[:, rows])
        other = scene.lit_spots.pdf_solid_angle(sample.lamp[rows], *at, way)
        other[scene.surfaces.transparent[vertex.triangle[rows]] & scene.lit_spots.is_soft[sample.lamp[rows]]] = 0
        weight = weight * (wave.pdf[rows] / (wave.pdf[rows] + other))
    _collect(light.local, wave, vertex, rows, sample.irradiance[:, rows] * weight * tint)


def _add_lit_spots(scene: Scene, wave: Wave, vertex: Vertex, numbers: Numbers, when: tuple, light: Radiance) -> None:
    """One shadow ray from some paths to what a lamp's ray meets, weighed against finding it by chance."""
    if not scene.model.local or not scene.lit_spots.count:
        return
    bounce, cache = when
    u = numbers.draw(wave.lane, HASHED + bounce * HASHED_PER_VERTEX + SPOT, lit_spots.NUMBERS)
    ends = passing(numbers, wave.lane, bounce + 1)  # as the path's own next leg: what either brings is only added
    some, toward, radiance, density = spots(scene, vertex.position, u, ends, cache)
    position, normal = vertex.position[:, some], vertex.normal[:, some]
    length = np.sqrt(warp.dot(toward, toward))
    cosine = np.maximum(warp.dot(toward, normal), 0) / np.maximum(length, np.float32(1e-30))
    value = radiance * (cosine / (density + cosine * np.float32(1 / np.pi)))
    rows, tint = unblocked(scene, position, toward, TARGET_SHORTENED, cosine > 0)
    _collect(light.local, wave, vertex, some[rows], value[:, rows] * tint)


def spots(scene: Scene, position: np.ndarray, u: tuple[np.ndarray, ...], ends, cache: Cache | None) -> tuple:
    """Ways to lit spots; those whose light a cache brings to paths are left out.

    Parameters
    ----------
    scene : Scene
        With lit spots.
    position, u, ends
        As for `LitSpots.sample`.
    cache : Cache, optional
        What ends paths.

    Returns
    -------
    rows, toward, radiance, pdf_solid_angle
        As of `LitSpots.sample`.
    """
    some, toward, radiance, density, normal = scene.lit_spots.sample(position, u, ends)
    if cache is None:
        return some, toward, radiance, density
    kept = cache.leaves(position[:, some] + toward, normal, np.sqrt(warp.dot(toward, toward)))
    return some[kept], toward[:, kept], radiance[:, kept], density[kept]


def _add_emitters(scene: Scene, wave: Wave, vertex: Vertex, numbers: Numbers, bounce: int, light: Radiance) -> None:
    """One shadow ray to one emissive triangle, weighed against finding it by chance."""
    if not scene.model.local or not scene.emitters.count:
        return
    u = numbers.draw(wave.lane, FIRST_VERTEX + bounce * PER_VERTEX + EMITTER, 3)
    toward, radiance, density = scene.emitters.sample(vertex.position, u)
    length = np.sqrt(warp.dot(toward, toward))
    cosine = np.maximum(warp.dot(toward, vertex.normal), 0) / np.maximum(length, np.float32(1e-30))
    total = density + cosine / np.float32(np.pi)
    useful = (cosine > 0) & (density > 0)
    value = radiance * np.divide(cosine, total, out=np.zeros_like(cosine), where=useful)
    rows, tint = unblocked(scene, vertex.position, toward, TARGET_SHORTENED, useful)
    _collect(light.local, wave, vertex, rows, value[:, rows] * tint)


def _add_suns(scene: Scene, wave: Wave, vertex: Vertex, numbers: Numbers, bounce: int, light: Radiance) -> None:
    """One shadow ray to every sun key: choosing one of many is far noisier than it is cheap."""
    keys, u = scene.model.suns, None
    if (keys.diameter > 0).any():
        u = numbers.draw(wave.lane, HASHED + bounce * HASHED_PER_VERTEX + SUN_DISK, 2)
    for key, diameter in enumerate(keys.diameter):
        toward = sun_direction(keys.toward[key], diameter, u if diameter > 0 else None, len(wave.lane))
        cosine = np.maximum(warp.dot(toward, vertex.normal), 0)
        rows, tint = unblocked(scene, vertex.position, toward, FAR, cosine > 0)
        _collect(light.sun[key], wave, vertex, rows, cosine[rows] * tint)


def _add_sky(scene: Scene, wave: Wave, vertex: Vertex, numbers: Numbers, bounce: int, light: Radiance) -> None:
    """One shadow ray to a bright part of an uneven sky, weighed against leaving the scene by chance."""
    if scene.model.sky != "fixed" or not scene.sky.uneven:
        return
    u = numbers.draw(wave.lane, FIRST_VERTEX + bounce * PER_VERTEX + SKY, 3)
    toward, radiance, density = scene.sky.sample(u)
    cosine = np.maximum(warp.dot(toward, vertex.normal), 0)
    value = radiance * (cosine / (density + cosine / np.float32(np.pi)))
    rows, tint = unblocked(scene, vertex.position, toward, FAR, cosine > 0)
    _collect(light.sky[0], wave, vertex, rows, value[:, rows] * tint)


def _collect(target: np.ndarray, wave: Wave, vertex: Vertex, rows: np.ndarray, irradiance: np.ndarray) -> None:
    """Reflect irradiance back along the paths; a lane occurs once, so plain indexing adds it."""
    reflected = vertex.reflectance[:, rows] * wave.beta[:, rows] * np.float32(1 / np.pi)
    target[:, wave.lane[rows]] += reflected * irradiance


def _scatter(wave: Wave, vertex: Vertex, numbers: Numbers, bounce: int) -> Wave:
    """Choose the next direction by the cosine, and end dim paths by chance."""
    beta = wave.beta * vertex.reflectance
    brightest = warp.largest(beta)
    rows = np.flatnonzero(brightest > 0)
    if bounce >= ROULETTE_START:
        survival = np.minimum(brightest, 1)
        u = numbers.draw(wave.lane, HASHED + bounce * HASHED_PER_VERTEX + ROULETTE, 1)[0]
        rows = np.flatnonzero(u < survival)
        beta /= np.maximum(survival, np.float32(1e-30))
    u, v = numbers.draw(wave.lane[rows], FIRST_VERTEX + bounce * PER_VERTEX + SCATTER, 2)
    normal = vertex.normal[:, rows]
    direction = warp.cosine(u, v, normal)
    pdf = np.maximum(warp.dot(direction, normal), GRAZING) * np.float32(1 / np.pi)
    return Wave(wave.lane[rows], vertex.position[:, rows], direction, beta[:, rows], pdf)


def sun_direction(toward: np.ndarray, diameter: float, u: tuple[np.ndarray, ...] | None, lanes: int) -> np.ndarray:
    """Directions to points of the sun's disk.

    Parameters
    ----------
    toward : (3,) float32 ndarray
        Unit vector to its centre.
    diameter : float
        Angular diameter [rad]; 0 for a point.
    u : two (n,) float32 ndarrays, or None
        Uniform numbers; None for a point.
    lanes : int
        n.

    Returns
    -------
    (3, n) float32 ndarray
        Unit vectors.
    """
    center = np.broadcast_to(toward[:, None], (3, lanes))
    if u is None:
        return center
    x, y = warp.disk(*u)
    radius = np.float32(np.tan(diameter / 2))
    tangent, bitangent = warp.frame(toward[:, None])
    direction = center + radius * (tangent * x + bitangent * y)
    return direction / np.sqrt(warp.dot(direction, direction))
