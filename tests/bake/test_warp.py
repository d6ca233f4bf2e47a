"""Maps from the unit square: each against its density, by chi-square; frames at every direction."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import warp
from statistics_checks import is_uniform

SAMPLES = 200_000
ROUNDING = 4e-7
"""A few float32 steps at one: what sums of three rounded products lose."""

NORMALS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (0.6, 0, -0.8), (1e-4, 1e-4, -1), (-0.3, 0.5, 0.7)]


def uniform(seed: int, rows: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).random((rows, SAMPLES), np.float32)


def turn(x, y) -> np.ndarray:
    """Angle as a share of the full circle."""
    return np.arctan2(y, x) / (2 * np.pi) % 1.0


def unit(vectors) -> np.ndarray:
    """(3, n) float32 unit vectors of (n, 3)."""
    vectors = np.array(vectors, float).reshape(-1, 3)
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).T.astype(np.float32)


def own_frame(normal: np.ndarray) -> np.ndarray:
    """(3, 3) rows: two tangents and the normal, by another construction than the one under test."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    tangent = np.cross(helper, normal)
    tangent /= np.linalg.norm(tangent)
    return np.stack([tangent, np.cross(normal, tangent), normal])


def test_directions_of_the_sphere_are_uniform_of_unit_length_and_a_slight_slope_is_caught():
    u, v = uniform(1)
    x, y, z = warp.sphere(u, v)
    assert np.abs(x * x + y * y + z * z - 1).max() < 2 * ROUNDING
    assert is_uniform((z + 1) / 2, turn(x, y))
    x, y, z = warp.sphere(u**1.03, v)
    assert not is_uniform((z + 1) / 2, turn(x, y))
    assert pytest.approx(1 / (4 * np.pi)) == warp.SPHERE_PDF


@pytest.mark.parametrize("normal", NORMALS)
def test_directions_about_a_normal_follow_the_cosine_and_another_density_is_caught(normal):
    normal = unit(normal)
    u, v = uniform(2)
    direction = warp.cosine(u, v, np.repeat(normal, SAMPLES, axis=1))
    assert np.abs(warp.dot(direction, direction) - 1).max() < ROUNDING
    x, y, z = own_frame(normal[:, 0].astype(float)) @ direction
    assert (z > 0).all()
    assert is_uniform(np.minimum(z * z, 1), turn(x, y))
    assert not is_uniform(np.abs(warp.sphere(u, v)[2]) ** 2, turn(x, y))


def test_directions_by_the_cosine_never_point_into_the_surface_even_from_its_antipode():
    normal = warp.sphere(*uniform(3))
    antipode = -normal.astype(np.float64)
    u = ((1 - antipode[2]) / 2).astype(np.float32)
    v = turn(antipode[0], antipode[1]).astype(np.float32)
    direction = warp.cosine(u, v, normal)
    assert np.isfinite(direction).all()
    assert np.abs(warp.dot(direction, direction) - 1).max() < 1e-6
    assert (warp.dot(direction, normal) > 0).all()


def test_points_of_the_disk_are_uniform_and_another_density_is_caught():
    u, v = uniform(4)
    x, y = warp.disk(u, v)
    squared = x * x + y * y
    assert squared.max() <= 1 + ROUNDING
    assert is_uniform(np.minimum(squared, 1), turn(x, y))
    assert not is_uniform(np.minimum(np.sqrt(squared), 1), turn(x, y))


def test_frames_are_orthonormal_and_right_handed_at_the_poles_and_everywhere_else():
    corners = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, -0.0, 0.0, 1) if x or y or z]
    near = [(s * e, t * e, p) for e in (1e-8, 1e-5, 1e-3) for s in (-1, 1) for t in (-1, 1) for p in (-1, 1)]
    normal = np.concatenate([warp.sphere(*uniform(5)), unit(corners), unit(near)], axis=1)
    tangent, bitangent = warp.frame(normal)
    for a, b, truth in (
        (tangent, tangent, 1),
        (bitangent, bitangent, 1),
        (tangent, bitangent, 0),
        (tangent, normal, 0),
        (bitangent, normal, 0),
    ):
        assert np.abs(warp.dot(a, b) - truth).max() < 2 * ROUNDING
    volume = warp.dot(np.cross(tangent.T, bitangent.T).T, normal)
    assert np.abs(volume - 1).max() < 3 * ROUNDING


def test_dot_is_the_sum_of_the_products():
    a, b = np.random.default_rng(6).normal(size=(2, 3, 1000))
    assert np.allclose(warp.dot(a, b), np.einsum("kn,kn->n", a, b), atol=1e-12)
