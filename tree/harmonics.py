"""Real spherical harmonics of order 0 to 2, and the cosine convolution that turns radiance into irradiance.

Comes in: unit directions or coefficients. Goes out: basis values, irradiance. Coefficient `l * l + l + m`
belongs to order l, degree m; no Condon-Shortley sign, so that in x, y, z the nine functions are

    0: a        1: b y    2: b z    3: b x        4: c xy   5: c yz   6: d (3 z^2 - 1)   7: c xz   8: e (x^2 - y^2)

with a^2 = 1/4pi, b^2 = 3/4pi, c^2 = 15/4pi, d^2 = 5/16pi, e^2 = 15/16pi.
"""

from __future__ import annotations

import math

import numpy as np

__all__ = ["COSINE", "COUNT", "basis", "irradiance"]

COUNT = 9
"""Number of coefficients."""

COSINE = np.array([math.pi] + 3 * [2.0 * math.pi / 3.0] + 5 * [math.pi / 4.0])
"""(9,) float64: irradiance coefficients = COSINE * radiance coefficients [sr]."""

_A = math.sqrt(1.0 / (4.0 * math.pi))
_B = math.sqrt(3.0 / (4.0 * math.pi))
_C = math.sqrt(15.0 / (4.0 * math.pi))
_D = math.sqrt(5.0 / (16.0 * math.pi))
_E = math.sqrt(15.0 / (16.0 * math.pi))


def basis(directions: np.ndarray) -> np.ndarray:
    """Return the nine basis functions in each direction.

    Parameters
    ----------
    directions : (..., 3) float
        Unit vectors.

    Returns
    -------
    (..., 9) float32
        Orthonormal over the sphere: the integral of Y_i Y_j is 1 where i = j and 0 elsewhere.

    Notes
    -----
    Error: float32 rounding; `test_the_basis_is_orthonormal`.
    Source: Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment Maps", eq. 3.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    columns = [_A, _B * y, _B * z, _B * x]
    columns += [_C * x * y, _C * y * z, _D * (3.0 * z * z - 1.0), _C * x * z, _E * (x * x - y * y)]
    values = np.empty((*x.shape, COUNT), np.float32)
    for term, column in enumerate(columns):
        values[..., term] = column
    return values


def irradiance(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Evaluate irradiance, clamped at 0: the series rings below it opposite to a small bright light.

    Parameters
    ----------
    coefficients : (..., 9, c) float
        Irradiance coefficients [W/m2], that is radiance coefficients times `COSINE`.
    normals : (..., 3) float
        Unit vectors that point away from the surface.

    Returns
    -------
    (..., c) float32
        Irradiance [W/m2].

    Notes
    -----
    Error: order 2 holds at least 99.22 % of the energy of the clamped cosine; `test_a_distant_light_*`.
    Source: Ramamoorthi and Hanrahan 2001, eq. 9.
    """
    sums = np.einsum("...k,...kc->...c", basis(normals), np.asarray(coefficients))
    return np.maximum(sums, 0.0).astype(np.float32)
