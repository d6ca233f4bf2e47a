"""Small meshes for the tests of the tree."""

import numpy as np


def quad(a, b, c, d):
    """Two triangles."""
    return np.array([[a, b, c], [a, c, d]], np.float32)


def ground(half=20.0, z=0.0):
    """A horizontal square."""
    return quad((-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z))


def box(low, high):
    """Twelve triangles."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    p = [(x, y, z) for z in (z0, z1) for y in (y0, y1) for x in (x0, x1)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return np.concatenate([quad(*(p[i] for i in face)) for face in faces])


def soup(count, seed=0, spread=20.0, size=3.0):
    """Random triangles."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(-spread, spread, (count, 1, 3)) + rng.normal(size=(count, 3, 3)) * size).astype(np.float32)
