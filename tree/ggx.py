"""The lobe that prefiltered maps are blurred by, and which mip level shows which roughness.

Comes in: roughness, cosines. Goes out: density of the lobe, its share within a cone, roughness by level and back.
The lobe is that of the split sum: GGX seen along its own normal, view = normal = R, weighted by the cosine,

    K(R, l) = D(h) (R . l) / (4 norm),  h = normalize(R + l),  alpha = roughness^2,  its integral over l being 1.

So it depends on the angle between R and l alone: true lobes also stretch towards grazing view, and end at the surface;
what that changes of the energy is the other factor of the split sum. At roughness 1 it is the cosine lobe, l . R / pi.
"""

from __future__ import annotations

import math

import numpy as np

__all__ = ["density", "ladder", "level_of", "share"]

SMOOTH = 1e-4
"""Least |alpha^2 - 1| for the closed form: there it, and the expansion about 0, are both good to 1e-12."""


def density(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Density of the lobe by solid angle.

    Parameters
    ----------
    cosine : ndarray
        Cosine between R and the direction.
    roughness : float
        Above 0 to 1; alpha is its square.

    Returns
    -------
    ndarray
        [1/sr], in the cosines' precision; 0 from a right angle on.

    Notes
    -----
    Source: Walter et al. 2007, equation 33 (D); Karis 2013, "Real Shading in Unreal Engine 4" (view = normal = R, and
    the cosine as a weight). With t = (n . h)^2 = (1 + cosine) / 2, D is alpha^2 / (pi (1 - t + alpha^2 t)^2).
    """
    squared = roughness**4
    t = (1 + cosine) / 2
    return (
        np.maximum(cosine, 0) * (squared / (4 * math.pi * float(_integral(0.5, squared)))) / (1 - t + squared * t) ** 2
    )


def share(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Part of the lobe within a cone about R: what a disk of light there gives.

    Parameters
    ----------
    cosine : ndarray
        Cosine of the cone's half angle, -1 to 1.
    roughness : float
        Above 0 to 1.

    Returns
    -------
    float64 ndarray
        0 to 1; closed form of the integral of `density`.
    """
    t = (1 + np.maximum(np.asarray(cosine, np.float64), 0)) / 2
    squared = roughness**4
    return _integral(t, squared) / _integral(0.5, squared)


def ladder(sizes: tuple[int, ...]) -> np.ndarray:
    """Roughness that each mip level of a map shows.

    Parameters
    ----------
    sizes : tuple of int
        Texels along an edge, by level.

    Returns
    -------
    (levels,) float64 ndarray
        From that of the unfiltered map, whose texels are as wide as the lobe, to 1, by equal factors.

    Notes
    -----
    A mean texel spans sqrt(4 pi) / size radians, a lobe 2 alpha to either side at half of its height, as directions
    turn twice as far as half vectors: level 0 is as sharp as alpha = sqrt(pi) / size. Equal factors keep lobes 1 to 4
    texels wide on all levels; Karis' own levels, by equal steps, mix a mirror with a lobe of 0.25 at 0.1.

    Examples
    --------
    >>> ladder((126, 62, 30, 14, 6)).round(3)
    array([0.119, 0.202, 0.344, 0.587, 1.   ])
    """
    sharpest = math.pi**0.25 / math.sqrt(sizes[0])
    if len(sizes) == 1:
        return np.array([sharpest])
    return sharpest ** (1 - np.arange(len(sizes)) / (len(sizes) - 1))


def level_of(roughness: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Mip level that shows a roughness; between levels both are mixed by its fraction.

    Parameters
    ----------
    roughness : ndarray
        0 to 1.
    levels : (k,) float64 ndarray
        As from `ladder`.

    Returns
    -------
    ndarray
        0 to k - 1: the shader's (k - 1) * (1 - log(roughness) / log(levels[0])), held at both ends.
    """
    if len(levels) == 1:
        return np.zeros_like(np.asarray(roughness, np.float64))
    held = np.clip(np.asarray(roughness, np.float64), levels[0], levels[-1])
    return (len(levels) - 1) * (1 - np.log(held) / math.log(levels[0]))


def _integral(t: np.ndarray, squared: float) -> np.ndarray:
    """Integral of (2 s - 1) squared / (1 - s + squared s)^2 over s from t to 1: pi times that of D cos over the cone.

    With k = squared - 1 and w = 1 + k s it is squared / k^2 * [2 ln w + (2 + k) / w] between both ends; where k is
    small that cancels, and the integrand's expansion about k = 0 takes its place.
    """
    k = squared - 1
    if abs(k) < SMOOTH:
        return squared * (_expanded(1.0, k) - _expanded(t, k))
    low, high = 1 + k * np.asarray(t, np.float64), squared
    return squared / k**2 * (2 * np.log(high / low) + (2 + k) * (1 / high - 1 / low))


def _expanded(s: np.ndarray, k: float) -> np.ndarray:
    """Integral of (2 s - 1) (1 - 2 k s + 3 k^2 s^2)."""
    return s * s - s - k * (4 / 3 * s**3 - s * s) + k * k * (3 / 2 * s**4 - s**3)
