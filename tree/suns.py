"""Interpolates between the sun directions that a bake holds.

Comes in: the key directions and a direction to the sun. Goes out: up to three keys and their weights, which sum to 1.
Keys that enclose an area of the sky are triangulated on the sphere (the faces of their convex hull that a ray from
the centre leaves through); keys along an arc are joined in their order. Outside, the nearest point counts.
"""

from __future__ import annotations

import itertools

import numpy as np

__all__ = ["MAX_KEYS", "SunKeys"]

MAX_KEYS = 64
"""The hull is found by testing all triples, which is instant for this many keys."""
NUDGE = 1e-7
"""Relative radial displacement that decides between the diagonals of four keys on a circle."""
FLAT = 1e-4
"""A face whose plane passes this close to the centre closes the hull below the keys and is no part of the sky."""
INSIDE = -1e-12
"""Barycentric weights above this are inside: rounding must not open gaps between triangles."""
CHUNK = 1 << 14
"""Directions handled at a time."""


class SunKeys:
    """Directions with data.

    Parameters
    ----------
    directions : (K, 3) float
        Unit vectors to the sun, 1 <= K <= 64.

    Raises
    ------
    ValueError
        For another shape or number, or a direction that is not finite or has no length.
    """

    def __init__(self, directions: np.ndarray):
        keys = np.asarray(directions, np.float64)
        if keys.ndim != 2 or keys.shape[1:] != (3,) or not 1 <= len(keys) <= MAX_KEYS:
            raise ValueError(f"sun keys have shape {keys.shape}; (K, 3) with K from 1 to {MAX_KEYS} is needed")
        self.directions = _normalize(keys, "sun key")
        self.triangles = _triangulate(self.directions)
        edges = [self.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]
        chain = np.stack([np.arange(len(keys) - 1), np.arange(1, len(keys))], axis=1)
        self.edges = np.unique(np.sort(np.concatenate(edges), axis=1), axis=0) if len(self.triangles) else chain
        if not len(self.edges):
            self.edges = np.zeros((1, 2), np.int64)
        self._inverse = np.linalg.inv(self.directions[self.triangles].transpose(0, 2, 1))

    def interpolate(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return keys and weights for directions.

        Parameters
        ----------
        directions : (m, 3) float
            Directions to the sun, of any length but 0.

        Returns
        -------
        index : (m, 3) int64
            Keys.
        weight : (m, 3) float32
            Not negative, sum 1; an unused key has weight 0.

        Raises
        ------
        ValueError
            For a direction that is not finite or has no length.

        Notes
        -----
        Error: exact at the keys and continuous, except where two parts of an arc are equally near;
        `test_weights_are_continuous_*`.
        """
        directions = _normalize(np.asarray(directions, np.float64).reshape(-1, 3), "sun direction")
        parts = [self._interpolate(directions[i : i + CHUNK]) for i in range(0, len(directions), CHUNK)]
        parts.append((np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)))
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

    def _interpolate(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles first, the nearest edge for what lies in none of them."""
        index, weight = self._on_edges(d)
        if len(self.triangles):
            solved = np.einsum("tij,mj->mti", self._inverse, d)
            best = np.argmax(solved.min(axis=2), axis=1)
            row = np.arange(len(d))
            inside = solved.min(axis=2)[row, best] >= INSIDE
            index[inside] = self.triangles[best[inside]]
            weight[inside] = np.maximum(solved[row, best][inside], 0.0)
        return index, (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)

    def _on_edges(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights of the ends of the nearest edge, at the point of its arc that is nearest."""
        a, b = self.directions[self.edges[:, 0]], self.directions[self.edges[:, 1]]
        along, cosine = np.einsum("ei,ei->e", a, b), d @ a.T
        other = d @ b.T
        sine2 = np.maximum(1.0 - along * along, np.finfo(np.float64).tiny)
        wa = np.maximum((cosine - along * other) / sine2, 0.0)
        wb = np.maximum((other - along * cosine) / sine2, 0.0)
        nearer_a = cosine >= other
        outside = (wa <= 0) | (wb <= 0) | (self.edges[:, 0] == self.edges[:, 1])
        wa, wb = np.where(outside, nearer_a, wa), np.where(outside, ~nearer_a, wb)
        length = np.sqrt(np.maximum(wa * wa + wb * wb + 2.0 * wa * wb * along, np.finfo(np.float64).tiny))
        best = np.argmax((wa * cosine + wb * other) / length, axis=1)
        row = np.arange(len(d))
        weight = np.stack([wa[row, best], wb[row, best], np.zeros(len(d))], axis=1)
        return self.edges[best][:, [0, 1, 0]].copy(), weight


def _normalize(vectors: np.ndarray, what: str) -> np.ndarray:
    """Unit vectors; the border check of this module."""
    if not np.isfinite(vectors).all():
        raise ValueError(f"a {what} is not finite")
    largest = np.abs(vectors).max(axis=1, keepdims=True, initial=0.0)
    if (largest == 0).any():
        raise ValueError(f"a {what} has no length")
    vectors = vectors / largest
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _triangulate(keys: np.ndarray) -> np.ndarray:
    """(t, 3) faces of the convex hull that the centre lies behind."""
    triples = np.array(list(itertools.combinations(range(len(keys)), 3)), np.int64).reshape(-1, 3)
    nudge = np.random.default_rng(0).random(len(keys))
    points = keys * (1.0 + NUDGE * nudge[:, None])
    a, b, c = (points[triples[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.where(area > 0, area, 1.0)[:, None]
    offset = np.einsum("ti,ti->t", normal, a)
    turned = offset < 0
    normal[turned], offset = -normal[turned], np.abs(offset)
    highest = (normal @ points.T).max(axis=1, initial=-np.inf)
    face = (area > 0) & (offset > FLAT) & (highest <= offset + np.finfo(np.float64).eps * 8)
    return triples[face]
