"""Exact overlap of triangles with boxes, by separating axes; touching counts.

Comes in: pairs of a triangle and a box. Goes out: one bool a pair. Two convex bodies are disjoint exactly when
their projections onto one of 13 axes are: 3 box normals, the triangle's normal, 9 products of edges. Any axis
that separates is a proof, so an inexact one (of a sliver) cannot drop an overlap; axes that vanish separate
nothing, and for segments and points the remaining ones are all that is needed.
"""

from __future__ import annotations

import numpy as np

__all__ = ["overlap"]

TOLERANCE = 8.0 * np.finfo(np.float64).eps
"""Relative slack of a projection: the rounding of a few float64 products, so that touching counts."""


def overlap(triangles: np.ndarray, centers: np.ndarray, half: np.ndarray | float) -> np.ndarray:
    """Say which triangles overlap their boxes, both closed.

    Parameters
    ----------
    triangles : (n, 3, 3) float
        Corners [m].
    centers : (n, 3) float64
        Centre of each triangle's box [m].
    half : float or (3,) or (n, 3) float64
        Half the size of the boxes [m].

    Returns
    -------
    (n,) bool
        Whether they share a point.

    Notes
    -----
    Error: a gap below about 1e-15 of the coordinates relative to the box counts as touching;
    `test_overlap_agrees_with_clipping_*`.
    Source: Akenine-Moller 2001, "Fast 3D Triangle-Box Overlap Testing".
    """
    corners = np.asarray(triangles, np.float64) - np.asarray(centers, np.float64)[:, None, :]
    half = np.broadcast_to(np.asarray(half, np.float64), (len(corners), 3))
    low, high = _extremes(corners[:, 0], corners[:, 1], corners[:, 2])
    scale = _extremes(*np.maximum(high, -low).T)[1] + _extremes(*half.T)[1]
    x, y, z = ((low > half) | (high < -half)).T
    apart = x | y | z
    near = np.flatnonzero(~apart)
    corners, half, scale = corners[near], half[near], scale[near]
    edges = np.roll(corners, -1, axis=1) - corners
    separated = _separates(np.cross(edges[:, 0], edges[:, 1]), corners, half, scale)
    for edge in range(3):
        for axis in range(3):
            separated |= _separates(_cross_unit(edges[:, edge], axis), corners, half, scale)
    result = np.zeros(len(apart), bool)
    result[near] = ~separated
    return result


def _cross_unit(edges: np.ndarray, axis: int) -> np.ndarray:
    """Cross product of edges with a coordinate axis, without its three multiplications by zero."""
    result = np.zeros_like(edges)
    result[:, (axis + 1) % 3] = edges[:, (axis + 2) % 3]
    result[:, (axis + 2) % 3] = -edges[:, (axis + 1) % 3]
    return result


def _separates(axes: np.ndarray, corners: np.ndarray, half: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Whether the projections onto an axis are disjoint by more than their own rounding; never for a zero axis."""
    projections = np.einsum("nij,nj->ni", corners, axes)
    length = np.abs(axes)
    radius = np.einsum("nj,nj->n", half, length)
    slack = TOLERANCE * scale * (length[:, 0] + length[:, 1] + length[:, 2])
    low, high = _extremes(*projections.T)
    return (low > radius + slack) | (high < -radius - slack)


def _extremes(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest of three, item by item: numpy is slow along a short axis."""
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
