"""How much light the specular layer of a dielectric reflects, over all directions.

Comes in: index of refraction, specular level, roughness. Goes out: the share of diffuse light that the layer
reflects; the rest goes to what is below. A rough layer has half of a smooth one's share at Blender's default of
0.5 and a fifth at 1: its facets hide each other, and few of them face light that grazes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from .snapshot import Material

COSINE_NODES = 64
"""Gauss-Legendre nodes of the average over the hemisphere; 32 already agree with 64 to 1e-7."""

ROUGHNESS = np.linspace(0.0, 1.0, 17)
"""Values that shares are computed for; between them they are interpolated, to 3e-4."""

FACETS = 32
"""Facets in each of two dimensions, for each of as many directions; more change the share by less than 5e-4."""


def layer_shares(materials: tuple[Material, ...]) -> np.ndarray:
    """Tabulate what the specular layers of materials reflect.

    Parameters
    ----------
    materials : tuple of Material
        Any.

    Returns
    -------
    (m, r) float32 ndarray
        Share of diffuse light, in [0, 1), for each roughness of `ROUGHNESS`; between them it is to be interpolated.
    """
    rows = [_shares(material.ior, material.specular_level) for material in materials]
    return np.array(rows, np.float32).reshape(-1, len(ROUGHNESS))


def rough_share(ior: float, specular_level: float, roughness: float) -> float:
    """Share of diffuse light that a rough dielectric's surface reflects.

    Parameters
    ----------
    ior : float
        Index of refraction, at least 1.
    specular_level : float
        As in `average_fresnel`.
    roughness : float
        Principled's, in (0, 1]: the square root of the width of the facets' distribution.

    Returns
    -------
    float
        In [0, 1).

    Notes
    -----
    Error: 1e-3 against Cycles; tests/judge measures it.
    Source: Trowbridge and Reitz 1975 (GGX) with Smith's shadowing; facets by Heitz 2018, "Sampling the GGX
    distribution of visible normals", on a grid instead of by chance; several reflections by Turquin 2019,
    "Practical multiple scattering compensation for microfacet models", as Cycles has them, but on average.
    """
    eta = _index(ior, specular_level)
    if eta == 1:
        return 0.0
    width = roughness**2
    node, weight = np.polynomial.legendre.leggauss(FACETS)
    u = (np.arange(FACETS) + 0.5) / FACETS
    cosine, u1, u2 = np.meshgrid((node + 1) / 2, u, u, indexing="ij")
    facet = _visible_facets(cosine, u1, u2, width)
    toward_facet = np.sqrt(1 - cosine**2) * facet[0] + cosine * facet[2]
    leaving = 2 * toward_facet * facet[2] - cosine
    hidden = _hidden(cosine, width), _hidden(np.maximum(leaving, 1e-9), width)
    free = np.where((leaving > 0) & (toward_facet > 0), (1 + hidden[0]) / (1 + hidden[0] + hidden[1]), 0)
    mirror, layer = (
        np.sum(weight * (free * share).mean(axis=(1, 2)) * cosine[:, 0, 0])
        for share in (1, _fresnel(np.maximum(toward_facet, 1e-9), eta))
    )
    # What the facets of a mirror would reflect to each other comes back after another reflection, or more.
    once = average_fresnel(ior, specular_level)
    again = once * mirror / (1 - once * (1 - mirror))
    return float(layer * (1 + again * (1 - mirror) / mirror))


def average_fresnel(ior: float, specular_level: float) -> float:
    """Share of diffuse light that a smooth dielectric's surface reflects.

    Parameters
    ----------
    ior : float
        Index of refraction, at least 1.
    specular_level : float
        Blender's scale of the reflectance at normal incidence; 0.5 leaves it as it is, 0 removes the layer.

    Returns
    -------
    float
        Cosine-weighted average of Fresnel's equations over the hemisphere.

    Notes
    -----
    Source: Fresnel's equations for unpolarised light, integrated numerically; the level scales the reflectance at
    normal incidence, and with it the index of refraction, the way Blender's Principled shader does.
    """
    eta = _index(ior, specular_level)
    if eta == 1:
        return 0.0
    node, weight = np.polynomial.legendre.leggauss(COSINE_NODES)
    cosine = (node + 1) / 2
    return float(np.sum(weight * _fresnel(cosine, eta) * cosine))


@lru_cache(maxsize=1024)
def _shares(ior: float, specular_level: float) -> tuple[float, ...]:
    """Shares at `ROUGHNESS`."""
    rough = (rough_share(ior, specular_level, float(roughness)) for roughness in ROUGHNESS[1:])
    return (average_fresnel(ior, specular_level), *rough)


def _index(ior: float, specular_level: float) -> float:
    """Index of refraction that has the reflectance at normal incidence which was asked for."""
    root = np.sqrt(min(((ior - 1) / (ior + 1)) ** 2 * 2 * specular_level, 0.99))
    return float((1 + root) / (1 - root))


def _fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Reflectance for unpolarised light."""
    refracted = np.sqrt(1 - (1 - cosine**2) / eta**2)
    across = (cosine - eta * refracted) / (cosine + eta * refracted)
    along = (refracted - eta * cosine) / (refracted + eta * cosine)
    return (across**2 + along**2) / 2


def _hidden(cosine: np.ndarray, width: float) -> np.ndarray:
    """Smith's lambda: the part of facets that others hide, over the part that is seen."""
    return (np.sqrt(1 + width**2 * (1 / cosine**2 - 1)) - 1) / 2


def _visible_facets(cosine: np.ndarray, u1: np.ndarray, u2: np.ndarray, width: float) -> np.ndarray:
    """(3, ...) normals of the facets that a direction (sine, 0, cosine) sees, as often as it sees them."""
    x, z = width * np.sqrt(1 - cosine**2), cosine
    x, z = x / np.hypot(x, z), z / np.hypot(x, z)
    radius, angle = np.sqrt(u1), 2 * np.pi * u2
    across, along = radius * np.cos(angle), radius * np.sin(angle)
    along = (1 - z) / 2 * np.sqrt(1 - across**2) + (1 + z) / 2 * along
    up = np.sqrt(np.maximum(1 - across**2 - along**2, 0))
    normal = np.stack([width * (x * up - z * along), width * across, np.maximum(x * along + z * up, 1e-9)])
    return normal / np.sqrt((normal**2).sum(axis=0))
