"""Which voxels of a level are worth subdividing, by the geometry in and around them.

Comes in: the solid voxels of a level and the triangles in each. Goes out: whether to subdivide, and how needy
each voxel is. A voxel stays whole where all triangles in it and in its 26 neighbours lie in one plane: light
then varies slowly, as on an open field. Triangles without area are ignored: no light falls on them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .region import finder

__all__ = ["FLAT", "Surfaces", "Voxels", "assess", "bounds", "surfaces_of"]

FLAT = 1e-3
"""Distance from a common plane, in voxel sizes, within which geometry counts as flat."""
REACH = 2.0
"""Corners farther from a voxel's centre than this many sizes count by their angle, not by their distance."""
NEIGHBOURS = [offset for offset in itertools.product((-1, 0, 1), repeat=3) if any(offset)]


@dataclass(frozen=True)
class Surfaces:
    """Triangles with what planarity needs.

    corners : (t, 3, 3) float64 [m]
    normal : (t, 3) float64, unit length, zero where there is no area
    area : (t,) float64 [m2]
    low, high : (t, 3) float64, corners of their boxes [m]
    """

    corners: np.ndarray
    normal: np.ndarray
    area: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Voxels:
    """The solid voxels of one level, in the order of their indices, and the triangles that overlap them.

    coords : (m, 3) int64, global coordinates of the level
    size : float [m]
    triangle, row : (p,) int64, pairs of a triangle and a voxel; rows ascend
    """

    coords: np.ndarray
    size: float
    triangle: np.ndarray
    row: np.ndarray


def bounds(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of each triangle.

    Parameters
    ----------
    triangles : (n, 3, d) float
        Corners [m].

    Returns
    -------
    low, high : (n, d) float64
        Lowest and highest corner [m].
    """
    first, second, third = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    low, high = np.minimum(np.minimum(first, second), third), np.maximum(np.maximum(first, second), third)
    return low.astype(np.float64), high.astype(np.float64)


def surfaces_of(corners: np.ndarray) -> Surfaces:
    """Compute normals and areas.

    Parameters
    ----------
    corners : (t, 3, 3) float64
        Triangles [m].

    Returns
    -------
    Surfaces
        The same triangles.
    """
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return Surfaces(corners, cross / np.where(length > 0, length, 1.0)[:, None], 0.5 * length, *bounds(corners))


def assess(surfaces: Surfaces, voxels: Voxels, flat: float = FLAT) -> tuple[np.ndarray, np.ndarray]:
    """Say which voxels to subdivide, and in which order when not all can be.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    voxels : Voxels
        Solid voxels of one level.
    flat : float
        Tolerance of planarity, in voxel sizes; negative subdivides every voxel.

    Returns
    -------
    wanted : (m,) bool
        Whether a voxel's surroundings are not flat.
    need : (m,) float64
        0 (one plane) to 1.5; the spread of the planes in the voxel, and half the largest one next to it.
    """
    normal, height, has_plane = _main_planes(surfaces, voxels)
    deviation = _deviations(surfaces, voxels, normal, height)
    own_flat = deviation <= flat * voxels.size
    spread = _spreads(surfaces, voxels)
    centers = (voxels.coords + 0.5) * voxels.size
    wanted, near = ~own_flat, np.zeros(len(spread))
    find = finder(voxels.coords)
    for offset in NEIGHBOURS:
        other = find(voxels.coords + offset)
        row = np.flatnonzero(other >= 0)
        other = other[row]
        foot = centers[other] + normal[other] * height[other, None] - centers[row]
        apart = np.abs(np.einsum("ni,ni->n", normal[row], foot) - height[row])
        turned = np.linalg.norm(np.cross(normal[row], normal[other]), axis=1) * REACH * voxels.size
        bent = has_plane[row] & has_plane[other] & (np.maximum(apart, turned) > 2.0 * flat * voxels.size)
        wanted[row] |= ~own_flat[other] | bent
        near[row] = np.maximum(near[row], spread[other])
    return wanted | (flat < 0), np.round(spread + 0.5 * near, 6)


def _main_planes(surfaces: Surfaces, voxels: Voxels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plane of each voxel's largest triangle: unit normal, height above the voxel's centre, whether there is one."""
    order = np.lexsort((voxels.triangle, -surfaces.area[voxels.triangle], voxels.row))
    first = order[np.searchsorted(voxels.row, np.arange(len(voxels.coords)))]
    largest = voxels.triangle[first]
    normal = surfaces.normal[largest]
    arm = surfaces.corners[largest, 0] - (voxels.coords + 0.5) * voxels.size
    return normal, np.einsum("ni,ni->n", normal, arm), surfaces.area[largest] > 0


def _deviations(surfaces: Surfaces, voxels: Voxels, normal: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Largest distance of a voxel's triangles from its main plane; far corners count by their angle."""
    arms = surfaces.corners[voxels.triangle] - ((voxels.coords + 0.5) * voxels.size)[voxels.row, None]
    distance = np.abs(np.einsum("pci,pi->pc", arms, normal[voxels.row]) - height[voxels.row, None])
    reach = REACH * voxels.size
    distance *= reach / np.maximum(np.linalg.norm(arms, axis=2), reach)
    distance[surfaces.area[voxels.triangle] == 0] = 0.0
    return np.maximum.reduceat(distance.max(axis=1), np.searchsorted(voxels.row, np.arange(len(voxels.coords))))


def _spreads(surfaces: Surfaces, voxels: Voxels) -> np.ndarray:
    """How far each voxel's planes are from being one: 1 - tr(P^2) / tr(P)^2.

    P is the second moment of (normal, height / size), weighted by area: of rank 1 exactly for one plane, and blind
    to the sign of the normal.
    """
    centers = (voxels.coords + 0.5) * voxels.size
    normal = surfaces.normal[voxels.triangle]
    arm = surfaces.corners[voxels.triangle, 0] - centers[voxels.row]
    height = np.clip(np.einsum("ni,ni->n", normal, arm) / voxels.size, -1.0, 1.0)
    plane = np.concatenate([normal, height[:, None]], axis=1)
    weight = np.minimum(surfaces.area[voxels.triangle], voxels.size**2)
    moments = np.empty((4, 4, len(centers)))
    for i, j in itertools.combinations_with_replacement(range(4), 2):
        moments[i, j] = np.bincount(voxels.row, weight * plane[:, i] * plane[:, j], len(centers))
        moments[j, i] = moments[i, j]
    trace = np.trace(moments)
    return np.where(trace > 0, 1.0 - (moments**2).sum(axis=(0, 1)) / np.where(trace > 0, trace, 1.0) ** 2, 0.0)
