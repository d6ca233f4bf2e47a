"""Lamps: points, spots and area lights, sampled one shadow ray at a time.

Comes in: points on surfaces. Goes out: for each a vector to a point of one lamp, and the irradiance that it
brings on a surface facing it. The lamp is chosen by resampling: candidates are weighed by what they would bring
without shadows, so that one shadow ray follows the light that matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import warp
from .snapshot import LightKind, Lights

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec.709 weights."""

CANDIDATES = 8
"""Up to this many lamps are all weighed; of more, this many are drawn by their power and weighed."""

NEAREST, NEAREST_SHARE = 1e-3, 1e-5
"""Closer than 1 mm, or this share of the scene's size, a lamp's irradiance is held: a point lamp on a surface stays
finite."""

INSIDE = np.float32(0.01)
"""Least of 1 - (r / d)^2: a point on or inside a spherical lamp gets a finite, wide disk."""


@dataclass(frozen=True)
class LampSample:
    """One lamp point for each lane.

    toward : (3, n) float32 [m], from the surface to the lamp; not of unit length
    irradiance : (3, n) float32 [W/m2] on a surface that faces it, over the sample's probability; 0 for none
    shadow : (n,) bool, whether the way has to be free
    lit : (n,) bool, whether there is any light
    lamp : (n,) int64, which lamp
    source : (3, n) float32 [m], from the surface to where `Lamps.emit` starts the lamp's rays
    """

    toward: np.ndarray
    irradiance: np.ndarray
    shadow: np.ndarray
    lit: np.ndarray
    lamp: np.ndarray
    source: np.ndarray


class Lamps:
    """Some lamps of a scene.

    Parameters
    ----------
    lights : Lights
        All lamps.
    rows : (k,) int64 ndarray
        The ones to use; suns are not allowed.
    origin : (3,) float64 ndarray
        The snapshot's origin [m].
    scene_size : float
        Longest side of the scene's bounds [m].
    """

    def __init__(self, lights: Lights, rows: np.ndarray, origin: np.ndarray, scene_size: float) -> None:
        self._nearest = np.float32(min(NEAREST, NEAREST_SHARE * scene_size))
        self.count = len(rows)
        self._kind = lights.kind[rows]
        self._position = (lights.position[rows] - origin).astype(np.float32).T
        frame = lights.frame[rows]
        self._x, self._y, self._z = (np.ascontiguousarray(frame[:, :, axis].T) for axis in range(3))
        self._strength = np.ascontiguousarray(lights.strength[rows].T)
        self._size = np.ascontiguousarray(lights.size[rows].T)
        self._spot = np.ascontiguousarray(lights.spot[rows].T)
        self._shadow = lights.shadow[rows]
        self._luminance = luminance(self._strength)
        self._power = power = _power(self._kind, self._strength, self._size, self._spot)
        total = power.sum()
        self._pmf = (power / total if total > 0 else np.full(self.count, 1 / max(self.count, 1))).astype(np.float32)
        self._cdf = np.cumsum(self._pmf, dtype=np.float64)

    def sample(self, position: np.ndarray, normal: np.ndarray | None, u: tuple[np.ndarray, ...]) -> LampSample:
        """Choose a lamp and a point on it for every lane.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Points [m].
        normal : (3, n) float32 ndarray, or None
            Facing unit normals; None weighs all directions alike.
        u : four (n,) float32 ndarrays
            Uniform numbers: candidates, the choice among them, where on the lamp.

        Returns
        -------
        LampSample
            Unbiased: its expectation is the sum over all lamps.

        Notes
        -----
        Source: Talbot 2005, resampled importance sampling.
        """
        draw, pick, u1, u2 = u
        candidates, weights = self._weigh(position, normal, draw, u1, u2)
        chosen, total = _choose(weights, pick)
        lanes = np.arange(position.shape[1])
        weight = weights[chosen, lanes]
        lamp = chosen if candidates is None else candidates[chosen, lanes]
        toward, falloff = self._evaluate(lamp, position, u1, u2)
        if candidates is not None:
            weight = weight * (CANDIDATES * self._pmf[lamp])
        falloff = falloff * np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        irradiance, lit = self._strength[:, lamp] * falloff, falloff > 0
        source = np.where(self._kind[lamp] <= LightKind.SPOT, self._position[:, lamp] - position, toward)
        return LampSample(toward, irradiance, self._shadow[lamp] & lit, lit, lamp, source)

    def shine(self, lamp: np.ndarray, position: np.ndarray, u: tuple[np.ndarray, ...]):
        """Light of given lamps.

        Parameters
        ----------
        lamp : (n,) int64 ndarray
            The lamp of each lane.
        position : (3, n) float32 ndarray
            Points [m].
        u : two (n,) float32 ndarrays
            Uniform numbers: where on the lamp.

        Returns
        -------
        toward : (3, n) float32 ndarray
            From the point to the lamp [m]; not of unit length.
        irradiance : (3, n) float32 ndarray
            On a surface that faces it, without shadows [W/m2].
        """
        toward, falloff = self._evaluate(lamp, position, *u)
        return toward, self._strength[:, lamp] * falloff

    def emit(self, lamp: np.ndarray, u: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Rays that leave lamps: round ones at their centre, into their cone; area lamps anywhere, by the cosine.

        Parameters
        ----------
        lamp : (n,) int64 ndarray
            The lamp of each ray.
        u : four (n,) float32 ndarrays
            Uniform numbers: where on the lamp, as for `sample`, and the direction.

        Returns
        -------
        start, direction : (3, n) float32 ndarray
            Points [m], unit vectors; their density is `pdf_solid_angle`.
        """
        u1, u2, u3, u4 = u
        z, cone = self._z[:, lamp], np.maximum(self._spot[0, lamp], -1)
        x, y = warp.frame(z)
        cosine = 1 - u3 * (1 - cone)
        sine = np.sqrt(np.maximum(1 - cosine * cosine, 0))
        angle = warp.TAU * u4
        into_cone = z * cosine + (x * np.cos(angle) + y * np.sin(angle)) * sine
        start = self._position[:, lamp]
        is_area = self._kind[lamp] > LightKind.SPOT
        if not is_area.any():
            return start, -into_cone
        place = self._evaluate_area(lamp, start, u1, u2)[0]
        return np.where(is_area, place, start), -np.where(is_area, warp.cosine(u3, u4, z), into_cone)

    def pdf_solid_angle(self, lamp: np.ndarray, toward: np.ndarray) -> np.ndarray:
        """Density of the directions of `emit`.

        Parameters
        ----------
        lamp : (n,) int64 ndarray
            Lamps.
        toward : (3, n) float32 ndarray
            Unit vectors against the direction of light, from what is lit to the start of the ray.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr].
        """
        cosine, cone = warp.dot(toward, self._z[:, lamp]), np.maximum(self._spot[0, lamp], -1)
        within = np.where(cosine >= cone, 1 / (warp.TAU * np.maximum(1 - cone, np.float32(1e-6))), np.float32(0))
        is_area = self._kind[lamp] > LightKind.SPOT
        return np.where(is_area, np.maximum(cosine, 0) * np.float32(1 / np.pi), within)

    def along(self, lamp: int, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Look at a lamp's shape.

        Parameters
        ----------
        lamp : int
            Which one; those of no size are never met.
        origin : (3, n) float32 ndarray
            Where rays start [m].
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        distance : (n,) float32 ndarray
            To the shape [m]; 0 for rays that miss it.
        radiance : (3, n) float32 ndarray
            What it sends back; its integral is the irradiance of `shine` [W/(m2 sr)].
        """
        center = self._position[:, lamp, None] - origin
        is_round = self._kind[lamp] <= LightKind.SPOT
        distance, shines = (self._to_disk if is_round else self._to_area)(lamp, center, direction)
        distance = np.where(shines > 0, distance, np.float32(0))
        return distance, self._strength[:, lamp, None] * shines

    @property
    def power(self) -> np.ndarray:
        """(k,) emitted luminance of each lamp [W]."""
        return self._power

    @property
    def shadow(self) -> np.ndarray:
        """(k,) bool, whether things block each lamp."""
        return self._shadow

    @property
    def is_round(self) -> np.ndarray:
        """(k,) bool, points and spots."""
        return self._kind <= LightKind.SPOT

    @property
    def radius(self) -> np.ndarray:
        """(k,) float32 radius of round lamps, 0 for area lamps [m]."""
        return np.where(self.is_round, self._size[0], np.float32(0))

    def _weigh(self, position, normal, draw, u1, u2) -> tuple[np.ndarray | None, np.ndarray]:
        """(lamp of each candidate, or None when the candidates are all lamps; their weights), (candidates, n)."""
        if self.count <= CANDIDATES:
            rows = [np.array([lamp]) for lamp in range(self.count)]
            return None, np.stack([self._target(lamp, position, normal, u1, u2) for lamp in rows])
        steps = (np.arange(CANDIDATES)[:, None] + draw) / CANDIDATES * self._cdf[-1]
        lamps = np.minimum(np.searchsorted(self._cdf, steps, side="right"), self.count - 1)
        weights = np.stack([self._target(lamp, position, normal, u1, u2) for lamp in lamps])
        return lamps, weights / (CANDIDATES * self._pmf[lamps])

    def _target(self, lamp, position, normal, u1, u2) -> np.ndarray:
        """(n,) luminance that a lamp would bring without shadows, on a surface that faces `normal` or the lamp."""
        toward, falloff = self._evaluate(lamp, position, u1, u2)
        value = self._luminance[lamp] * falloff
        if normal is None:
            return value
        cosine = np.maximum(warp.dot(normal, toward), 0)
        return value * cosine / np.sqrt(np.maximum(warp.dot(toward, toward), self._nearest**2))

    def _evaluate(self, lamp: np.ndarray, position: np.ndarray, u1: np.ndarray, u2: np.ndarray):
        """(vector to a point of the lamp, irradiance on a surface facing it over the lamp's strength)."""
        center = self._position[:, lamp] - position
        round_lamp = self._kind[lamp] <= LightKind.SPOT
        if round_lamp.all():
            return self._evaluate_round(lamp, center, u1, u2)
        if not round_lamp.any():
            return self._evaluate_area(lamp, center, u1, u2)
        first, second = self._evaluate_round(lamp, center, u1, u2), self._evaluate_area(lamp, center, u1, u2)
        return np.where(round_lamp, first[0], second[0]), np.where(round_lamp, first[1], second[1])

    def _evaluate_round(self, lamp, center, u1, u2) -> tuple[np.ndarray, np.ndarray]:
        """Points and spots: a disk that always faces the surface.

        A disk of the lamp's radius brings I / (d^2 + r^2), Blender's soft falloff. The disk that covers as much of
        the hemisphere as a sphere of that radius is wider and brings I / d^2.
        """
        distance = np.maximum(np.sqrt(warp.dot(center, center)), self._nearest)
        axis = center / distance
        toward, wider = center, np.float32(1)
        radius, is_sphere = self._size[:, lamp]
        if radius.any():
            outside = np.maximum(1 - (radius / distance) ** 2, INSIDE)
            wider = np.where(is_sphere > 0, 1 / outside, np.float32(1))
            x, y = warp.disk(u1, u2)
            tangent, bitangent = warp.frame(axis)
            toward = center + (tangent * x + bitangent * y) * (radius * np.sqrt(wider))
        squared = np.maximum(warp.dot(toward, toward), self._nearest**2)
        facing = warp.dot(toward, axis) / np.sqrt(squared)
        return toward, wider * np.maximum(facing, 0) / squared * self._cone(lamp, axis)

    def _to_disk(self, lamp: int, center: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the disk of `_evaluate_round`, and its radiance over the lamp's intensity."""
        radius, is_sphere = self._size[:, lamp]
        apart = np.maximum(np.sqrt(warp.dot(center, center)), self._nearest)
        axis = center / apart
        facing = np.maximum(warp.dot(direction, axis), np.float32(1e-6))
        distance = apart / facing
        wider = 1 / np.maximum(1 - (radius / apart) ** 2, INSIDE) if is_sphere else np.float32(1)
        hit = apart**2 * (1 / facing**2 - 1) <= radius**2 * wider
        area = np.float32(np.pi) * np.maximum(radius, self._nearest) ** 2
        return distance, np.where(hit & (radius > 0), self._cone(np.array([lamp]), axis) / area, np.float32(0))

    def _to_area(self, lamp: int, center: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances to a rectangle or an ellipse, and 1 where its shining side is met."""
        before, facing = (warp.dot(part, self._z[:, lamp, None]) for part in (center, direction))
        shines = (before > 0) & (facing > np.float32(1e-6))
        distance = np.divide(before, facing, out=np.zeros_like(before), where=shines)
        at = direction * distance - center
        x, y = (warp.dot(at, axis[:, lamp, None]) for axis in (self._x, self._y))
        width, height = self._size[:, lamp] / 2
        if self._kind[lamp] == LightKind.ELLIPSE:
            within = (x / width) ** 2 + (y / height) ** 2 <= 1
        else:
            within = (np.abs(x) <= width) & (np.abs(y) <= height)
        return distance, (shines & within).astype(np.float32)

    def _cone(self, lamp: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Blender's spot: a smooth step in the cosine, over the blend."""
        cos_half, blend = self._spot[:, lamp]
        if (cos_half <= -1).all():
            return np.float32(1)
        z = self._z[:, lamp]
        cosine = axis[0] * z[0] + axis[1] * z[1] + axis[2] * z[2]
        t = np.clip((cosine - cos_half) / np.maximum((1 - cos_half) * blend, np.float32(1e-6)), 0, 1)
        return np.where(cos_half <= -1, np.float32(1), t * t * (3 - 2 * t))

    def _evaluate_area(self, lamp, center, u1, u2) -> tuple[np.ndarray, np.ndarray]:
        """Rectangles and ellipses: uniform points of their area, shining to one side by the cosine."""
        ellipse = self._kind[lamp] == LightKind.ELLIPSE
        x, y = u1 - np.float32(0.5), u2 - np.float32(0.5)
        area = self._size[0, lamp] * self._size[1, lamp]
        if ellipse.any():
            disk_x, disk_y = warp.disk(u1, u2)
            x, y = np.where(ellipse, disk_x / 2, x), np.where(ellipse, disk_y / 2, y)
            area = np.where(ellipse, area * np.float32(np.pi / 4), area)
        toward = center + self._x[:, lamp] * (x * self._size[0, lamp]) + self._y[:, lamp] * (y * self._size[1, lamp])
        squared = np.maximum(warp.dot(toward, toward), self._nearest**2)
        z = self._z[:, lamp]
        cosine = (toward[0] * z[0] + toward[1] * z[1] + toward[2] * z[2]) / np.sqrt(squared)
        return toward, area * np.maximum(cosine, 0) / squared


def _choose(weights: np.ndarray, pick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(row chosen for each lane by its share of the weights, their total)."""
    sums = [weights[0]]
    for weight in weights[1:]:
        sums.append(sums[-1] + weight)
    mark = pick * sums[-1]
    chosen = np.zeros(len(pick), np.int64)
    for below in sums[:-1]:
        chosen += below <= mark
    return chosen, sums[-1]


def luminance(color: np.ndarray) -> np.ndarray:
    """Weigh colours by Rec.709; a plain sum, as a matrix product would start threads of its own.

    Parameters
    ----------
    color : (3, n) ndarray
        Linear colours.

    Returns
    -------
    (n,) ndarray
        Luminance.
    """
    red, green, blue = LUMINANCE
    return color[0] * red + color[1] * green + color[2] * blue


def _power(kind: np.ndarray, strength: np.ndarray, size: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """Emitted power, to draw candidates by [W]."""
    area = size[0] * size[1] * np.where(kind == LightKind.ELLIPSE, np.pi / 4, 1)
    return luminance(strength) * np.where(kind <= LightKind.SPOT, 2 * np.pi * (1 - spot[0]), np.pi * area)
