"""Spherical harmonics: identities and closed forms, no pictures."""

import numpy as np
import pytest
from gi_volumes.tree import harmonics


def sphere_rule(count=16):
    """Gauss-Legendre in z times a uniform rule around it: exact for polynomials up to degree 2 * count - 1."""
    z, wz = np.polynomial.legendre.leggauss(count)
    phi = 2 * np.pi * np.arange(2 * count) / (2 * count)
    z, phi = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1), np.repeat(wz, 2 * count) * np.pi / count


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_the_basis_is_orthonormal():
    directions, weights = sphere_rule()
    values = harmonics.basis(directions).astype(np.float64)
    np.testing.assert_allclose(values.T @ (values * weights[:, None]), np.eye(9), atol=5e-7)


def test_a_wrong_constant_would_break_orthonormality():
    directions, weights = sphere_rule()
    values = harmonics.basis(directions).astype(np.float64)
    values[:, 6] *= 1.001
    assert abs((values.T @ (values * weights[:, None]) - np.eye(9)).max()) > 1e-3


def test_the_signs_are_the_documented_ones():
    x, y, z = np.eye(3)
    assert (harmonics.basis(np.array([y, z, x]))[[0, 1, 2], [1, 2, 3]] > 0).all()
    diagonal = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1]]) / np.sqrt(2)
    assert (harmonics.basis(diagonal)[[0, 1, 2], [4, 5, 7]] > 0).all()
    assert harmonics.basis(z)[6] > 0
    assert harmonics.basis(x)[8] > 0 > harmonics.basis(y)[8]


def test_shapes_follow_the_input():
    assert harmonics.basis(np.zeros((0, 3))).shape == (0, 9)
    assert harmonics.basis(np.array([0.0, 0.0, 1.0])).shape == (9,)
    assert harmonics.basis(np.zeros((4, 5, 3))).dtype == np.float32


def test_uniform_radiance_gives_pi():
    coefficients = np.zeros((9, 3))
    coefficients[0] = np.sqrt(4 * np.pi) * np.array([1.0, 2.0, 3.0])
    got = harmonics.irradiance(harmonics.COSINE[:, None] * coefficients, random_directions(20))
    np.testing.assert_allclose(got, np.tile(np.pi * np.array([1.0, 2.0, 3.0]), (20, 1)), rtol=1e-6)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_cosine_convolution_matches_quadrature_of_the_clamped_cosine(order):
    """In the frame of the normal, the factor of order l is 2 pi times the integral of P_l(z) z over [0, 1]."""
    z, w = np.polynomial.legendre.leggauss(8)
    z, w = (z + 1) / 2, w / 2
    legendre = [np.ones_like(z), z, 1.5 * z * z - 0.5][order]
    expected = 2 * np.pi * (w * legendre * z).sum()
    assert harmonics.COSINE[order * order : (order + 1) ** 2] == pytest.approx(expected, rel=1e-12)


def test_irradiance_of_low_order_radiance_is_exact():
    """Radiance 1 + a.w + b (3 z^2 - 1) has irradiance pi + 2 pi / 3 a.n + pi / 4 b (3 nz^2 - 1)."""
    directions, weights = sphere_rule()
    a, b = np.array([0.3, -0.2, 0.4]), 0.1
    radiance = 1 + directions @ a + b * (3 * directions[:, 2] ** 2 - 1)
    coefficients = harmonics.basis(directions).astype(np.float64).T @ (radiance * weights)
    n = random_directions(50)
    expected = np.pi + 2 * np.pi / 3 * n @ a + np.pi / 4 * b * (3 * n[:, 2] ** 2 - 1)
    got = harmonics.irradiance((harmonics.COSINE * coefficients)[:, None], n)[:, 0]
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_a_distant_light_is_reproduced_within_the_known_error_of_order_2_and_never_negative():
    light = np.array([0.0, 0.6, 0.8])
    coefficients = harmonics.COSINE * harmonics.basis(light)
    n = random_directions(2000)
    got = harmonics.irradiance(np.broadcast_to(coefficients[None, :, None], (2000, 9, 1)), n)[:, 0]
    cosine = n @ light
    series = 0.25 + 0.5 * cosine + 5 / 32 * (3 * cosine**2 - 1)
    np.testing.assert_allclose(got, np.maximum(series, 0), atol=1e-6)
    assert np.abs(got - np.maximum(cosine, 0)).max() < 0.095
    assert got.min() == 0.0
