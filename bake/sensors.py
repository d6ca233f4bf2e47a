"""What is measured at points: harmonics of irradiance in free space, or irradiance on a surface.

Comes in: uniform numbers and directions. Goes out: directions to look in, their density, and the response to
light from there. A measure is the integral of radiance times response over all directions.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..tree import harmonics
from . import warp
from .paths import GRAZING

NOTHING = np.zeros((0, 1, 3))
"""No mixtures to watch."""


class Sensor(Protocol):
    """Sample, density and response of one kind of measure.

    Attributes
    ----------
    responses : int
        Numbers for each point.
    watched : (w, 1 + keys + functions, 3) float64 ndarray
        Mixtures of local light, suns and sky whose noise is wanted, in the first response; often none.
    """

    responses: int
    watched: np.ndarray

    def sample(self, rows: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Directions to look in.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        u, v : (n,) float32 ndarray
            Uniform numbers.

        Returns
        -------
        (3, n) float32 ndarray
            Unit vectors.
        """

    def pdf(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Density of `sample`.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr], above 0.
        """

    def response(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Measure of unit radiance from a direction.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (responses, n) float32 ndarray
            To be integrated over solid angle.
        """


class HarmonicsSensor:
    """Measures the nine harmonics of irradiance around points in free space.

    Parameters
    ----------
    watched : (w, 1 + keys + functions, 3) float64 ndarray
        As in `Sensor`; the first response is the mean over directions, but for a factor.
    """

    responses = harmonics.COUNT

    def __init__(self, watched: np.ndarray = NOTHING) -> None:
        self.watched = watched

    def sample(self, rows: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Uniform directions.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        u, v : (n,) float32 ndarray
            Uniform numbers.

        Returns
        -------
        (3, n) float32 ndarray
            Unit vectors.
        """
        return warp.sphere(u, v)

    def pdf(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """One over the whole sphere.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr].
        """
        return np.full(len(rows), warp.SPHERE_PDF, np.float32)

    def response(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Harmonics of the clamped cosine about every normal at once.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (9, n) float32 ndarray
            Basis functions times the cosine lobe's coefficients.

        Notes
        -----
        Source: Ramamoorthi and Hanrahan 2001, equations 7 and 8.
        """
        return harmonics.basis(direction.T).T * harmonics.COSINE.astype(np.float32)[:, None]


class SurfaceSensor:
    """Measures irradiance on surfaces.

    Parameters
    ----------
    normal : (3, n) float32 ndarray
        Unit normals of all points.
    """

    responses, watched = 1, NOTHING

    def __init__(self, normal: np.ndarray) -> None:
        self._normal = normal

    def sample(self, rows: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Directions by the cosine.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        u, v : (n,) float32 ndarray
            Uniform numbers.

        Returns
        -------
        (3, n) float32 ndarray
            Unit vectors.
        """
        return warp.cosine(u, v, self._normal[:, rows])

    def pdf(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The cosine over pi, held above zero at grazing angles.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr].
        """
        return np.maximum(warp.dot(direction, self._normal[:, rows]), GRAZING) * np.float32(1 / np.pi)

    def response(self, rows: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The cosine, zero below the surface.

        Parameters
        ----------
        rows : (n,) int64 ndarray
            The point of each lane.
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (1, n) float32 ndarray
            Irradiance per unit radiance.
        """
        return np.maximum(warp.dot(direction, self._normal[:, rows]), 0)[None]
