"""Triangle-box overlap against exact clipping in rational numbers."""

from fractions import Fraction

import numpy as np
import pytest
from gi_volumes.tree import boxes


def clipped(triangle, low, high):
    """Whether a triangle shares a point with a closed box: Sutherland-Hodgman, in rational numbers."""
    polygon = [tuple(Fraction(float(x)) for x in corner) for corner in triangle]
    for axis in range(3):
        for sign, limit in ((1, Fraction(float(low[axis]))), (-1, -Fraction(float(high[axis])))):
            result = []
            for start, end in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                a, b = sign * start[axis] - limit, sign * end[axis] - limit
                if a >= 0:
                    result.append(start)
                if (a > 0 > b) or (a < 0 < b):
                    t = a / (a - b)
                    result.append(tuple(s + t * (e - s) for s, e in zip(start, end, strict=True)))
            polygon = result
            if not polygon:
                return False
    return True


def compare(triangles, centers, half):
    got = boxes.overlap(triangles, centers, half)
    expected = [clipped(t, c - half, c + half) for t, c in zip(triangles, centers, strict=True)]
    return got, np.array(expected)


def test_overlap_agrees_with_clipping_on_lattice_triangles_that_often_touch():
    """Corners on a lattice: touching, segments and points are common, and nothing rounds."""
    rng = np.random.default_rng(1)
    triangles = rng.integers(-4, 5, (2500, 3, 3)).astype(np.float64)
    centers = rng.integers(-1, 2, (2500, 3)).astype(np.float64)
    got, expected = compare(triangles, centers, 1.0)
    np.testing.assert_array_equal(got, expected)
    assert 0.2 < expected.mean() < 0.8


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_overlap_agrees_with_clipping_on_segments_and_points(axis):
    rng = np.random.default_rng(axis)
    triangles = rng.integers(-3, 4, (600, 3, 3)).astype(np.float64)
    triangles[:300, 2] = triangles[:300, axis % 2]
    triangles[300:500, 2] = 2 * triangles[300:500, 1] - triangles[300:500, 0]
    triangles[500:] = triangles[500:, :1]
    got, expected = compare(triangles, np.zeros((600, 3)), 1.0)
    np.testing.assert_array_equal(got, expected)


def test_overlap_agrees_with_clipping_on_random_slivers():
    """The only disagreement allowed is a gap that rounding cannot see, and it must count as touching."""
    rng = np.random.default_rng(2)
    triangles = rng.normal(size=(1500, 3, 3)) * 2
    triangles[:750, 2] = triangles[:750, 1] + rng.normal(size=(750, 3)) * 1e-7
    got, expected = compare(triangles, rng.normal(size=(1500, 3)) * 0.5, 1.0)
    np.testing.assert_array_equal(got, expected)


def test_large_triangles_far_from_the_origin_keep_touching_exact():
    corner = np.array([4096.0, -8192.0, 512.0])
    triangle = np.array([[[0.0, 0.0, 0.0], [2048.0, 0.0, 0.0], [0.0, 2048.0, 0.0]]]) + corner
    center = corner + np.array([100.25, 100.25, -0.25])
    assert boxes.overlap(triangle, center[None], 0.25)
    assert not boxes.overlap(triangle, center[None] - [0.0, 0.0, 1e-9], 0.25)
    center = corner + np.array([1024.25, 1024.25, 0.0])
    assert boxes.overlap(triangle, center[None], 0.25)
    assert not boxes.overlap(triangle, center[None] + [1e-9, 0.0, 0.0], 0.25)


def test_the_edge_axes_are_needed_and_tested():
    """A triangle that passes a box's edge diagonally: neither the box's sides nor its plane separate it."""
    triangle = np.array([[[2.2, 0.0, -9.0], [0.0, 2.2, 9.0], [9.0, 9.0, 0.0]]])
    assert not boxes.overlap(triangle, np.zeros((1, 3)), 1.0)
    assert not clipped(triangle[0], -np.ones(3), np.ones(3))


def test_no_pairs_give_no_result():
    assert boxes.overlap(np.zeros((0, 3, 3)), np.zeros((0, 3)), 1.0).shape == (0,)
