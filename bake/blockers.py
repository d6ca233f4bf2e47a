"""Blockers: the planes that could hide receivers from a data point, merged where triangles are coplanar.

Comes in: pairs of receivers and data points with the triangles between them. Goes out: a table of planes, and for each
data point the few that stand before the most of what it must not light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .scene import Scene
from .sight import Pairs

CANDIDATES = 16
"""Planes that are tried for a data point: those that block the most weight."""

BLOCK = 8
"""Coplanar triangles are merged within blocks of this many finest voxels: farther apart, rounding tilts them."""

SAME = 4e-4
"""Two planes are the same when their normals, and their distances in finest voxels, round to the same multiple."""


@dataclass(frozen=True)
class Planes:
    """Planes of blockers, without orientation.

    normal : (q, 3) float64, unit length
    distance : (q,) float64 [m], normal . p of the points p on the plane, relative to the scene's origin
    """

    normal: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True)
class Candidates:
    """Planes to try for data points; sorted by data point, then the most promising first.

    point : (c,) int64, row of the data points
    plane : (c,) int64, row of the planes
    side : (c,) float64, 1 or -1: the plane's normal times this points to the data point
    """

    point: np.ndarray
    plane: np.ndarray
    side: np.ndarray

    def take(self, rows: np.ndarray) -> Candidates:
        """Some of them.

        Parameters
        ----------
        rows : (k,) int64, (c,) bool ndarray or slice
            Which.

        Returns
        -------
        Candidates
            In the order of `rows`.
        """
        return Candidates(self.point[rows], self.plane[rows], self.side[rows])


def find(
    scene: Scene, pairs: Pairs, weight: np.ndarray, position: np.ndarray, finest: float
) -> tuple[Planes, Candidates]:
    """Find the planes that stand between data points and receivers.

    Parameters
    ----------
    scene : Scene
        The triangles.
    pairs : Pairs
        Who sees whom.
    weight : (m,) float64 ndarray
        How much each pair matters.
    position : (n, 3) float64 ndarray
        Data points, relative to the scene's origin [m].
    finest : float
        Size of the finest voxels [m].

    Returns
    -------
    planes : Planes
        Of all blocking triangles.
    candidates : Candidates
        At most `CANDIDATES` a data point; none that a data point lies on.
    """
    hidden = np.flatnonzero(~pairs.visible)
    triangle, place = np.unique(pairs.blocker[hidden], return_inverse=True)
    planes, plane = _merge(scene.soup.corners[triangle].astype(np.float64), finest)
    plane = plane[place.reshape(-1, 2)]
    both = plane[:, 1] != plane[:, 0]
    point = np.concatenate([pairs.point[hidden], pairs.point[hidden][both]])
    code = point * len(planes.distance) + np.concatenate([plane[:, 0], plane[both, 1]])
    code, place = np.unique(code, return_inverse=True)
    sums = np.bincount(place.reshape(-1), np.concatenate([weight[hidden], weight[hidden][both]]), len(code))
    point, plane = np.divmod(code, max(len(planes.distance), 1))
    height = (planes.normal[plane] * position[point]).sum(axis=1) - planes.distance[plane]
    kept = (np.abs(height) > SAME * finest) & np.isfinite(height)
    point, plane, side, sums = point[kept], plane[kept], np.sign(height[kept]), sums[kept]
    order = np.lexsort((-sums, point))
    rank = np.arange(len(order)) - np.searchsorted(point[order], point[order])
    return planes, Candidates(point, plane, side).take(order[rank < CANDIDATES])


def _merge(triangles: np.ndarray, finest: float) -> tuple[Planes, np.ndarray]:
    """Distinct planes of triangles, each through the largest of its triangles, and the plane of each triangle."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.sqrt((cross * cross).sum(axis=1))
    normal = cross / np.maximum(area, 1e-300)[:, None]
    normal[area == 0] = np.nan
    largest = np.abs(normal).argmax(axis=1)
    normal *= np.where(normal[np.arange(len(normal)), largest] < 0, -1.0, 1.0)[:, None]
    middle = triangles.mean(axis=1)
    block = np.round(middle / (BLOCK * finest))
    above = (normal * (middle - block * (BLOCK * finest))).sum(axis=1) / finest
    code = np.concatenate([block, np.round(normal / SAME), np.round(above / SAME)[:, None]], axis=1)
    order = np.argsort(-area, kind="stable")
    _, first, place = np.unique(np.nan_to_num(code[order]), axis=0, return_index=True, return_inverse=True)
    plane = np.empty(len(order), np.int64)
    plane[order] = place.reshape(-1)
    rows = order[first]
    return Planes(normal[rows], (normal[rows] * middle[rows]).sum(axis=1)), plane
