"""Shares bounced light between texels that see the same plane: it is even over surfaces, and noisy.

Comes in: radiance of texels, in two parts, and the surfaces behind them. Goes out: radiance whose bounced part is

    reflectance of the texel * sum of (weight * bounced radiance) / sum of (weight * reflectance)

over the texels around it that see a surface in the same plane. Textures, shadows and lit spots stay sharp, edges of
things too. What that does to the map is measured (`capture.py`), and it is left out where it does harm.
"""

from __future__ import annotations

import functools

import numpy as np

from . import warp
from .panorama import Light, Seen

__all__ = ["alike", "around", "smoothed"]

WEIGHTS = np.array([1, 4, 6, 4, 1], np.float32)
"""Of texels along either axis; alone on a plane, 25 of them take 13 times as many rays' noise away."""

REACH = len(WEIGHTS) // 2
"""Texels to either side."""

SAME_NORMAL = np.float32(0.9)
"""Least cosine between normals of one plane: columns are planes, too."""

SAME_PLANE = np.float32(0.02)
"""Farthest that a surface may lie off the plane of another, over its distance from the probe: less than a texel."""

LEAST = np.float32(1e-6)
"""Least reflectance, so that black divides nothing by zero."""


@functools.lru_cache(maxsize=4)
def around(size: int) -> np.ndarray:
    """Find the texels around each texel of an octahedral map.

    Parameters
    ----------
    size : int
        Texels along an edge, without border.

    Returns
    -------
    (25, size * size) int64 ndarray
        Texels in 5 x 5 around each, row by row; across an edge as `octahedral` describes it.
    """
    row, column = np.divmod(np.arange(size * size), size)
    reach = range(-REACH, REACH + 1)
    return np.stack([_wrapped(row + down, column + right, size) for down in reach for right in reach])


def alike(seen: Seen) -> np.ndarray:
    """Weigh the texels around each.

    Parameters
    ----------
    seen : Seen
        Surfaces behind n texels of a square map.

    Returns
    -------
    (25, n) float32 ndarray
        0 for those that see something else; the texel itself always counts.
    """
    size = round(len(seen.distance) ** 0.5)
    is_met = np.isfinite(seen.distance)
    distance = np.where(is_met, seen.distance, 0)
    position = seen.direction * distance
    weights = np.empty((len(WEIGHTS) ** 2, size * size), np.float32)
    for number, rows in enumerate(around(size)):
        off = np.abs(warp.dot(position[:, rows] - position, seen.normal))
        same = warp.dot(seen.normal[:, rows], seen.normal) > SAME_NORMAL
        same &= is_met & is_met[rows] & (off <= SAME_PLANE * distance)
        weights[number] = np.outer(WEIGHTS, WEIGHTS).reshape(-1)[number] * same
    weights[len(weights) // 2] = WEIGHTS[REACH] ** 2
    return weights


def smoothed(light: Light, weights: np.ndarray) -> np.ndarray:
    """Share bounced light.

    Parameters
    ----------
    light : Light
        Means over rays.
    weights : (25, n) float32 ndarray
        As from `alike`.

    Returns
    -------
    (n, functions, 3) float32 ndarray
        Radiance.
    """
    size = round(len(light.reflectance) ** 0.5)
    bounced, reflectance = np.zeros_like(light.bounced), np.zeros_like(light.reflectance)
    for rows, weight in zip(around(size), weights, strict=True):
        bounced += weight[:, None, None] * light.bounced[rows]
        reflectance += weight[:, None] * light.reflectance[rows]
    share = light.reflectance / np.maximum(reflectance, LEAST)
    return light.straight + share[:, None] * bounced


def _wrapped(row: np.ndarray, column: np.ndarray, size: int) -> np.ndarray:
    """Numbers of texels that may lie beyond edges, where the map goes on mirrored about the edge's middle."""
    beyond = (row < 0) | (row >= size)
    row, column = _folded(row, size), np.where(beyond, size - 1 - column, column)
    beyond = (column < 0) | (column >= size)
    return np.where(beyond, size - 1 - row, row) * size + _folded(column, size)


def _folded(index: np.ndarray, size: int) -> np.ndarray:
    """Numbers beyond an edge as far from it on this side."""
    return np.where(index < 0, -1 - index, np.where(index >= size, 2 * size - 1 - index, index))
