"""Maps from the unit square to directions, each with its density.

Comes in: uniform numbers, one row each. Goes out: unit directions (3, n) and densities by solid angle.
"""

from __future__ import annotations

import numpy as np

TAU = np.float32(2 * np.pi)
SPHERE_PDF = np.float32(1 / (4 * np.pi))
"""Density of `sphere` [1/sr]."""


def sphere(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Uniform directions; their density is `SPHERE_PDF`.

    Parameters
    ----------
    u, v : (n,) float32 ndarray
        Uniform numbers.

    Returns
    -------
    (3, n) float32 ndarray
        Unit directions.
    """
    z = 1 - 2 * u
    radius = np.sqrt(np.maximum(0, 1 - z * z))
    angle = TAU * v
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z])


def cosine(u: np.ndarray, v: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Directions about a normal, by the cosine; their density is cos / pi.

    Parameters
    ----------
    u, v : (n,) float32 ndarray
        Uniform numbers.
    normal : (3, n) float32 ndarray
        Unit normals.

    Returns
    -------
    (3, n) float32 ndarray
        Unit directions, strictly above the surface.

    Notes
    -----
    A point of the unit sphere added to the normal is distributed by the cosine (Malley's projection, seen from
    the tangent sphere). Where the two cancel, the normal itself is returned.
    """
    direction = sphere(u, v) + normal
    length = np.sqrt(dot(direction, direction))
    tiny = length < np.float32(1e-4)
    if tiny.any():
        direction[:, tiny] = normal[:, tiny]
        length[tiny] = 1
    direction /= length
    return direction


def disk(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points of the unit disk.

    Parameters
    ----------
    u, v : (n,) float32 ndarray
        Uniform numbers.

    Returns
    -------
    x, y : (n,) float32 ndarray
        Coordinates.
    """
    radius = np.sqrt(u)
    angle = TAU * v
    return radius * np.cos(angle), radius * np.sin(angle)


def frame(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed basis with each normal.

    Parameters
    ----------
    normal : (3, n) float32 ndarray
        Unit normals.

    Returns
    -------
    tangent, bitangent : (3, n) float32 ndarray
        Unit vectors.

    Notes
    -----
    Source: Duff et al. 2017, "Building an Orthonormal Basis, Revisited", listing 3.
    """
    x, y, z = normal
    sign = np.copysign(np.float32(1), z)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return tangent, bitangent


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products of vectors stored by component.

    Parameters
    ----------
    a, b : (3, n) ndarray
        Vectors.

    Returns
    -------
    (n,) ndarray
        Their products, always summed in the order x, y, z.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def largest(vector: np.ndarray) -> np.ndarray:
    """Largest component of vectors stored by component.

    Parameters
    ----------
    vector : (3, n) ndarray
        Vectors.

    Returns
    -------
    (n,) ndarray
        Several times faster than a reduction over the short axis.
    """
    return np.maximum(np.maximum(vector[0], vector[1]), vector[2])
