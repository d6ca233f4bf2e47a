"""The sky: radiance from every direction, sampled by importance where it is uneven.

Comes in: an equirectangular map. Goes out: radiance for directions; directions for uniform numbers, with their
density. Texels are constant patches, so that density and radiance agree exactly.
"""

from __future__ import annotations

import numpy as np

from ..tree import harmonics
from .lamps import luminance

UNEVEN = 8.0
"""A sky whose brightest texel exceeds its mean this many times gets shadow rays of its own; a smoother one is
found well enough by the rays that leave the scene."""

PROJECTION_STEPS = 256
"""Parts of each axis of a map whose harmonics are wanted: a constant sky may be a single texel."""


class Sky:
    """A fixed sky.

    Parameters
    ----------
    radiance : (h, w, 3) float32 ndarray
        Map as in `Snapshot.sky` [W/(m2 sr)].
    """

    def __init__(self, radiance: np.ndarray) -> None:
        self._height, self._width = radiance.shape[:2]
        self._texels = np.ascontiguousarray(radiance.reshape(-1, 3).T)
        edges = np.sin(np.linspace(-np.pi / 2, np.pi / 2, self._height + 1))
        solid_angle = np.repeat(np.diff(edges), self._width) * (2 * np.pi / self._width)
        self._edges = edges
        power = luminance(self._texels.astype(np.float64)) * solid_angle
        total = float(power.sum())
        self.mean = (self._texels.astype(np.float64) @ solid_angle) / (4 * np.pi)
        self.dark = total <= 0
        mean = total / (4 * np.pi)
        self.uneven = not self.dark and float(luminance(self._texels).max()) > UNEVEN * mean
        self._cdf = np.cumsum(power) / total if self.uneven else np.zeros(0)
        self._pdf = (power / solid_angle / total).astype(np.float32) if self.uneven else np.zeros(0, np.float32)

    def radiance(self, direction: np.ndarray) -> np.ndarray:
        """Radiance that arrives from a direction.

        Parameters
        ----------
        direction : (3, n) float32 ndarray
            Unit vectors that point to the sky.

        Returns
        -------
        (3, n) float32 ndarray
            [W/(m2 sr)].
        """
        if self._texels.shape[1] == 1:
            return np.broadcast_to(self._texels, direction.shape)
        return self._texels[:, self._texel(direction)]

    def pdf_solid_angle(self, direction: np.ndarray) -> np.ndarray:
        """Density of `sample` in a direction.

        Parameters
        ----------
        direction : (3, n) float32 ndarray
            Unit vectors.

        Returns
        -------
        (n,) float32 ndarray
            [1/sr].
        """
        return self._pdf[self._texel(direction)]

    def sample(self, u: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions by the sky's luminance; only for an uneven sky.

        Parameters
        ----------
        u : three (n,) float32 ndarrays
            Uniform numbers: which texel, where in it.

        Returns
        -------
        direction : (3, n) float32 ndarray
            Unit vectors.
        radiance : (3, n) float32 ndarray
            [W/(m2 sr)].
        pdf_solid_angle : (n,) float32 ndarray
            [1/sr].
        """
        texel = np.minimum(np.searchsorted(self._cdf, u[0], side="right"), len(self._cdf) - 1)
        row, column = np.divmod(texel, self._width)
        z = self._edges[row] + (self._edges[row + 1] - self._edges[row]) * u[1]
        angle = (0.5 - (column + u[2]) / self._width) * 2 * np.pi
        radius = np.sqrt(np.maximum(0, 1 - z * z))
        direction = np.stack([radius * np.cos(angle), radius * np.sin(angle), z]).astype(np.float32)
        return direction, self._texels[:, texel], self._pdf[texel]

    def harmonics(self) -> np.ndarray:
        """Project the map onto the nine real harmonics.

        Returns
        -------
        (9, 3) float64 ndarray
            Radiance coefficients [W/(m2 sr)].

        Notes
        -----
        Error: texels count at the centres of at least `PROJECTION_STEPS` parts of each axis: 2e-3 of the brightest
        coefficient; `test_a_constant_sky_has_one_harmonic_whatever_the_size_of_its_map`.
        """
        height, width = self._height, self._width
        rows, columns = (-(-PROJECTION_STEPS // size) for size in (height, width))
        edges = np.interp(np.arange(height * rows + 1) / rows, np.arange(height + 1), self._edges)
        z = (edges[1:] + edges[:-1]) / 2
        angle = (0.5 - (np.arange(width * columns) + 0.5) / (width * columns)) * 2 * np.pi
        radius = np.sqrt(1 - z * z)[:, None]
        parts = (radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(z[:, None], (len(z), len(angle))))
        values = harmonics.basis(np.stack(parts, axis=-1)).astype(np.float64)
        values *= (np.diff(edges) * (2 * np.pi / len(angle)))[:, None, None]
        per_texel = values.reshape(height, rows, width, columns, harmonics.COUNT).sum(axis=(1, 3))
        return (self._texels @ per_texel.reshape(-1, harmonics.COUNT)).T

    def _texel(self, direction: np.ndarray) -> np.ndarray:
        """Which texel a direction falls in; rows are equal angles of elevation."""
        x, y, z = direction
        u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
        v = 0.5 + np.arctan2(z, np.hypot(x, y)) / np.pi
        column = np.minimum((u * self._width).astype(np.int64), self._width - 1)
        return np.minimum((v * self._height).astype(np.int64), self._height - 1) * self._width + column
