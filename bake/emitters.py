"""Surfaces that emit: sampled by power, and weighed against the rays that find them by chance.

Comes in: points. Goes out: for each a vector to a point of one emissive triangle, its radiance, and its density.
"""

from __future__ import annotations

import numpy as np

from . import warp
from .lamps import luminance
from .soup import Soup
from .surfaces import Surfaces

PROBES = ((1 / 3, 1 / 3), (0.6, 0.2), (0.2, 0.6), (0.2, 0.2))
"""Barycentrics where a triangle's emission is looked up to estimate its power (Strang and Fix, degree 3)."""

PROBE_WEIGHTS = (-27 / 48, 25 / 48, 25 / 48, 25 / 48)


class Emitters:
    """The emissive triangles of a scene.

    Parameters
    ----------
    soup : Soup
        All triangles.
    surfaces : Surfaces
        Their materials.
    """

    def __init__(self, soup: Soup, surfaces: Surfaces) -> None:
        self._rows = np.flatnonzero(surfaces.emissive)
        self._surfaces = surfaces
        corners = soup.corners[self._rows]
        self._corner = np.ascontiguousarray(corners[:, 0].T)
        self._edges = np.ascontiguousarray((corners[:, 1:] - corners[:, :1]).transpose(1, 2, 0))
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        self._normal = np.ascontiguousarray((normal / np.maximum(length, 1e-30)[:, None]).T.astype(np.float32))
        power = _mean_emission(surfaces, self._rows) * length / 2
        if not power.any():
            power = length / 2  # a texture's bright spots lie between the probes: still emitters, found by area
        total = float(power.sum())
        self.count = len(self._rows) if total > 0 else 0
        self._cdf = np.cumsum(power / total) if self.count else np.zeros(0)
        self.pdf_area = np.zeros(len(soup.corners), np.float32)
        if self.count:
            pmf = np.diff(self._cdf, prepend=0)
            self.pdf_area[self._rows] = np.where(length > 0, pmf / np.maximum(length / 2, 1e-30), 0)

    def sample(self, position: np.ndarray, u: tuple[np.ndarray, ...]):
        """Choose an emissive triangle by power, and a point on it uniformly.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Points that are lit [m].
        u : three (n,) float32 ndarrays
            Uniform numbers: which triangle, where on it.

        Returns
        -------
        toward : (3, n) float32 ndarray
            From the point to the emitter [m], not of unit length.
        radiance : (3, n) float32 ndarray
            What the emitter sends back [W/(m2 sr)].
        pdf_solid_angle : (n,) float32 ndarray
            Density of the direction [1/sr]; 0 where the triangle is seen from its edge.
        """
        chosen = np.minimum(np.searchsorted(self._cdf, u[0], side="right"), len(self._rows) - 1)
        triangle = self._rows[chosen]
        root = np.sqrt(u[1])
        b1, b2 = root * (1 - u[2]), root * u[2]
        edges = self._edges[:, :, chosen]
        toward = self._corner[:, chosen] + edges[0] * b1 + edges[1] * b2 - position
        radiance = self._surfaces.emission(triangle, b1, b2)
        if self._surfaces.transparent.any():
            radiance = radiance * self._surfaces.through(triangle, b1, b2)[1]
        squared = warp.dot(toward, toward)
        cosine = np.abs(warp.dot(toward, self._normal[:, chosen])) / np.sqrt(np.maximum(squared, 1e-30))
        density = np.divide(self.pdf_area[triangle] * squared, cosine, out=np.zeros_like(squared), where=cosine > 1e-6)
        return toward, radiance, density

    def pdf_solid_angle(self, triangle: np.ndarray, distance: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Density with which `sample` would have chosen a point that a ray hit.

        Parameters
        ----------
        triangle : (n,) int ndarray
            Hits.
        distance : (n,) float32 ndarray
            From the point that is lit [m].
        cosine : (n,) float32 ndarray
            Between the ray and the triangle's normal, positive.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr]; 0 on triangles that `sample` never chooses.
        """
        return self.pdf_area[triangle] * distance * distance / np.maximum(cosine, np.float32(1e-6))


def _mean_emission(surfaces: Surfaces, rows: np.ndarray) -> np.ndarray:
    """(n,) luminance of each triangle's emission, averaged over its textures by quadrature."""
    total = np.zeros(len(rows))
    for (b1, b2), weight in zip(PROBES, PROBE_WEIGHTS, strict=True):
        u, v = np.full(len(rows), b1, np.float32), np.full(len(rows), b2, np.float32)
        total += weight * luminance(surfaces.emission(rows, u, v))
    return np.maximum(total, 0)
