"""Blockers: the planes that could hide receivers from a data point, merged where triangles are coplanar.

Comes in: pairs of receivers and data points with the triangles between them. Goes out: a table of planes, and for each
data point the few that stand before the most of what it must not light.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .scene import Scene
from .sight import Pairs

CANDIDATES = 16
"""Planes that are tried for a data point: those that block the most weight."""

BLOCK = 8
"""Coplanar triangles are merged within blocks of this many finest voxels: farther apart, rounding tilts them."""

PAIRS = 1 << 20
"""Pairs whose blockers are looked at together: about 100 MB."""

SAME = 4e-4
"""Two planes are the same when their normals, and their distances in finest voxels, round to the same multiple."""


@dataclass(frozen=True)
class Candidates:
    """Planes to try for data points; sorted by data point, then the most promising first.

    point : (c,) int64, row of the data points
    plane : (c, 4) float64, unit normal towards the data point, and the distance along it [m]
    """

    point: np.ndarray
    plane: np.ndarray

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
        return Candidates(self.point[rows], self.plane[rows])


def find(scene: Scene, pairs: Pairs, weight: np.ndarray, position: np.ndarray, finest: float) -> Candidates:
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
    Candidates
        At most `CANDIDATES` a data point; none that a data point lies on.
    """
    hidden = np.flatnonzero(~pairs.visible)
    triangle = np.unique(pairs.blocker[hidden])
    planes, plane = _merge(scene.soup.corners[triangle].astype(np.float64), finest)
    found = [Candidates(np.zeros(0, np.int64), planes[:0])]
    for rows in _tiles(pairs.point[hidden]):
        part = pairs.take(hidden[rows])
        before = plane[np.searchsorted(triangle, part.blocker)]
        found.append(_best((planes, before), part.point, weight[hidden[rows]], position, finest))
    return Candidates(np.concatenate([part.point for part in found]), np.concatenate([part.plane for part in found]))


def _tiles(point: np.ndarray) -> list[slice]:
    """Rows of some data points each, about as many as are looked at together, of ascending data points."""
    ends = np.searchsorted(point, point[PAIRS::PAIRS])
    ends = np.unique(np.concatenate([[0], ends, [len(point)]])).tolist()
    return [slice(start, end) for start, end in itertools.pairwise(ends)]


def _best(
    blocking: tuple[np.ndarray, np.ndarray], point: np.ndarray, weight: np.ndarray, position: np.ndarray, finest: float
) -> Candidates:
    """Candidates of data points, from all planes and the two that stand before each of their hidden pairs."""
    planes, before = blocking
    both = before[:, 1] != before[:, 0]
    point = np.concatenate([point, point[both]]).astype(np.int64)
    code = point * max(len(planes), 1) + np.concatenate([before[:, 0], before[both, 1]])
    code, place = np.unique(code, return_inverse=True)
    sums = np.bincount(place.reshape(-1), np.concatenate([weight, weight[both]]), len(code))
    point, row = np.divmod(code, max(len(planes), 1))
    height = (planes[row, :3] * position[point]).sum(axis=1) - planes[row, 3]
    order = np.lexsort((-sums, point))
    order = order[(np.abs(height) > SAME * finest)[order]]
    order = order[np.arange(len(order)) - np.searchsorted(point[order], point[order]) < CANDIDATES]
    return Candidates(point[order], planes[row[order]] * np.sign(height[order])[:, None])


def _merge(triangles: np.ndarray, finest: float) -> tuple[np.ndarray, np.ndarray]:
    """(q, 4) distinct planes of triangles, each through the largest of its triangles, and the plane of each triangle.

    Normals point along their largest component's axis, so that front and back have one plane; a triangle without
    area has a normal of 0, which no data point lies above.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.sqrt((cross * cross).sum(axis=1))
    normal = cross / np.maximum(area, 1e-300)[:, None]
    largest = np.abs(normal).argmax(axis=1)
    normal *= np.where(normal[np.arange(len(normal)), largest] < 0, -1.0, 1.0)[:, None]
    middle = triangles.mean(axis=1)
    block = np.round(middle / (BLOCK * finest))
    above = (normal * (middle - block * (BLOCK * finest))).sum(axis=1) / finest
    code = np.concatenate([block, np.round(normal / SAME), np.round(above / SAME)[:, None]], axis=1)
    order = np.argsort(-area, kind="stable")
    _, first, place = np.unique(code[order], axis=0, return_index=True, return_inverse=True)
    plane = np.empty(len(order), np.int64)
    plane[order] = place.reshape(-1)
    rows = order[first]
    distance = (normal[rows] * middle[rows]).sum(axis=1)
    return np.concatenate([normal[rows], distance[:, None]], axis=1), plane
