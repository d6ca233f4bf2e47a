"""Suns and skies as factors: how much of each stored function of a transport there is.

Comes in: what the bake's functions stand for; a sun, a sky. Goes out: factors of the functions, the same for irradiance
and for what reflection probes show. A bake of fixed suns refuses other directions.
"""

from __future__ import annotations

import numpy as np

from .suns import SunKeys

__all__ = ["TRANSPORTS", "Sources"]

TRANSPORTS = ("all", "local", "sun", "sky")
FIXED_SUN = np.radians(1.0)
"""How far from a baked direction a fixed sun may be asked for [rad]: two disks of the sun."""


class Sources:
    """What the light of a bake comes from.

    Parameters
    ----------
    transports : dict
        Of `world.json`.
    functions : dict of str to int
        Number of functions of each transport that the bake has.
    """

    def __init__(self, transports: dict, functions: dict[str, int]):
        sun = transports.get("sun") or {}
        self._functions, self._sky = functions, transports.get("sky") or {}
        self._keys = SunKeys(np.array(sun["directions"])) if sun.get("directions") else None
        self._sun_is_free = bool(sun.get("free", True))
        own = sun.get("scene") or []
        self._own_direction = np.array([entry["direction"] for entry in own], np.float64).reshape(-1, 3)
        self._own_irradiance = np.array([entry["irradiance"] for entry in own], np.float64).reshape(-1, 3)

    @property
    def sun_irradiance(self) -> np.ndarray:
        """(3,) float64 irradiance of the scene's own suns together, on surfaces that face them [W/m2]."""
        return self._own_irradiance.sum(axis=0) if len(self._own_irradiance) else np.ones(3)

    def factors(self, sun: tuple | None, sky: np.ndarray | float | None, transport: str) -> dict[str, np.ndarray]:
        """Weigh the functions for a sun and a sky.

        Parameters
        ----------
        sun, sky, transport
            As of `World.irradiance`.

        Returns
        -------
        dict of str to (K, 3) float64 ndarray
            Of each transport that counts.

        Raises
        ------
        ValueError
            For an unknown transport, a sun or a sky that the bake cannot represent.
        """
        if transport not in TRANSPORTS:
            raise ValueError(f"transport {transport!r}; one of {', '.join(TRANSPORTS)} is needed")
        sun_factor, sky_factor = self._sun_factor(sun, transport == "sun"), self._sky_factor(sky)
        chosen = {"local": np.ones((1, 3)), "sun": sun_factor, "sky": sky_factor}
        return {k: v for k, v in chosen.items() if k in self._functions and transport in ("all", k)}

    def _sun_factor(self, sun: tuple | None, per_unit: bool) -> np.ndarray | None:
        """Weights of the sun keys; relative to the suns' irradiance if asked for."""
        if sun is None:
            direction, irradiance = self._own_direction, self._own_irradiance
        else:
            if not isinstance(sun, tuple | list) or len(sun) != 2 or np.size(sun[0]) % 3:
                raise ValueError("sun is a pair of direction and irradiance: ((x, y, z), 2.0)")
            direction = _finite(sun[0], "sun direction").reshape(-1, 3)
            irradiance = np.broadcast_to(_finite(sun[1], "sun irradiance"), (len(direction), 3))
            self._check_sun(direction)
        if (irradiance < 0).any():
            raise ValueError("the sun's irradiance is negative")
        if "sun" not in self._functions or self._keys is None:
            return None
        if per_unit and not len(direction):
            raise ValueError("the bake has no sun of its own; name its direction")
        if per_unit:
            total = irradiance.sum(axis=0)
            irradiance = np.where(total > 0, irradiance / np.where(total > 0, total, 1.0), 1.0 / len(direction))
        index, weight = self._keys.interpolate(direction)
        factor = np.zeros((len(self._keys.directions), 3))
        for corner in range(3):
            for channel in range(3):
                part = weight[:, corner] * irradiance[:, channel]
                factor[:, channel] += np.bincount(index[:, corner], part, len(factor))
        return factor

    def _check_sun(self, direction: np.ndarray) -> None:
        """A bake of fixed suns knows no other direction; to answer as if it did would be a guess."""
        if self._sun_is_free or self._keys is None or not len(direction):
            return
        length = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        nearest = (direction / length @ self._keys.directions.T).max(axis=1)
        if (nearest < np.cos(FIXED_SUN)).any():
            known = "; ".join(",".join(f"{value:.3g}" for value in key) for key in self._keys.directions)
            raise ValueError(
                f"the bake holds the sun at {known} only; bake with --sun hemisphere or arc:FILE to move it"
            )

    def _sky_factor(self, sky: np.ndarray | float | None) -> np.ndarray | None:
        """Weights of the sky's functions."""
        given = None if sky is None else _finite(sky, "sky")
        if "sky" not in self._functions:
            return None
        count = self._functions["sky"]
        own = self._sky.get("radiance") if count > 1 else [[1.0, 1.0, 1.0]]
        if given is None:
            return np.array(own, np.float64)
        if given.shape in ((), (1,), (3,)):
            return np.array(own, np.float64) * given
        if given.shape != (count, 3) or count == 1:
            raise ValueError(f"a sky of shape {given.shape}; this bake takes a factor" + " or (9, 3)" * (count > 1))
        return given


def _finite(value: object, what: str) -> np.ndarray:
    """A finite float64 array."""
    value = np.asarray(value, np.float64)
    if not np.isfinite(value).all():
        raise ValueError(f"the {what} is not finite")
    return value
