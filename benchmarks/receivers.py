"""Surface points where light can arrive, chosen the same way every time, from triangles or from a camera.

Comes in: triangles or a prepared scene, a seed. Goes out: points and unit normals, spread evenly over the area of all
faces that have free space before them, and a surface in sight: without one there is nothing indirect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gi_volumes.bake import compare
from gi_volumes.bake.rays import MISS, Hits, Tracer
from gi_volumes.bake.scene import Scene
from gi_volumes.bake.snapshot import Snapshot

LIFT = 1e-3
"""Distance from their surface of the points that are judged [m]."""

FEELERS = 64
"""Rays that look whether there is free space before a point."""

MOST_BACK_FACES = 0.25
"""Part of the feelers that may meet the back of a surface: more do inside a solid, fewer near open cloth or leaves."""

CLEARANCE = 0.02
"""At least half of the feelers go as far [m]; what is squeezed between two surfaces is nobody's concern."""

CANDIDATES_PER_POINT = 4
WITNESSES = 16
"""Feelers of a back side whose ends are judged in their turn."""

PIECE = 0.1
"""Size of the pieces that large triangles are cut into where only a neighbourhood counts, as a share of its radius."""

ROUNDS = 8
"""Times that candidates are drawn: many back sides see nothing but backs."""


@dataclass(frozen=True)
class Receivers:
    """Points on surfaces.

    point : (n, 3) float64 [m], world space, on the surface
    normal : (n, 3) float64, unit, away from the side that is meant
    front : (n,) bool, whether that side is the front of its triangle
    """

    point: np.ndarray
    normal: np.ndarray
    front: np.ndarray

    def take(self, rows: np.ndarray) -> Receivers:
        """Some of the points.

        Parameters
        ----------
        rows : (m,) int64 or (n,) bool ndarray
            Which.

        Returns
        -------
        Receivers
            Copies.
        """
        return Receivers(self.point[rows], self.normal[rows], self.front[rows])


def draw(triangles: np.ndarray, count: int, generator: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw points evenly over the area.

    Parameters
    ----------
    triangles : (t, 3, 3) ndarray
        Corners [m].
    count : int
        How many points.
    generator : numpy.random.Generator
        Where the numbers come from.

    Returns
    -------
    row : (count,) int64 ndarray
        Triangles.
    point, normal : (count, 3) float64 ndarray
        On them [m], and the unit normals of their fronts.

    Raises
    ------
    ValueError
        The triangles have no area.
    """
    triangles = np.asarray(triangles, np.float64)
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    cross = np.cross(edge_1, edge_2)
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        raise ValueError("the scene has no surface to choose points on")
    row = generator.choice(len(area), count, p=area / area.sum())
    u, v = generator.random((2, count, 1))
    root = np.sqrt(u)
    point = triangles[row, 0] + root * (1 - v) * edge_1[row] + root * v * edge_2[row]
    return row, point, cross[row] / area[row, None]


def have_space(tracer: Tracer, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Judge points: they see other surfaces, and lie in front of their own, not inside a solid or a crack.

    Parameters
    ----------
    tracer : Tracer
        All triangles.
    points : (n, 3) float64 ndarray
        In the tracer's space, `LIFT` off their surface [m].
    normals : (n, 3) float64 ndarray
        Unit vectors.

    Returns
    -------
    (n,) bool ndarray
        True where light can arrive.
    """
    distance, back, met = feel(tracer, points, normals)
    far = ~met | (distance > CLEARANCE)
    return met.any(axis=1) & (back.mean(axis=1) <= MOST_BACK_FACES) & (far.mean(axis=1) >= 0.5)


def feel(tracer: Tracer, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Look around from points.

    Parameters
    ----------
    tracer : Tracer
        All triangles.
    points : (n, 3) float64 ndarray
        Off their surface, in the tracer's space [m].
    normals : (n, 3) float64 ndarray
        Middle of the hemisphere that is looked at.

    Returns
    -------
    distance : (n, FEELERS) float32 ndarray
        To what was met [m].
    back, met : (n, FEELERS) bool ndarray
        Whether that was the back of a triangle, and whether there was anything.
    """
    direction, hits = _look(tracer, points, normals)
    met = hits.triangle != MISS
    back = (np.einsum("cn,cn->n", hits.normal, direction) > 0) & met
    return tuple(values.reshape(-1, FEELERS) for values in (hits.distance, back, met))


def spread(scene: Scene, count: int, seed: int = 0, near: float | None = None) -> Receivers:
    """Choose points evenly over the area of all sides that light can reach.

    Parameters
    ----------
    scene : Scene
        A prepared scene.
    count : int
        How many.
    seed : int
        Another one chooses other points.
    near : float, optional
        Only within this distance of where the triangles are, the median of their centres [m].

    Returns
    -------
    Receivers
        In world space.

    Raises
    ------
    ValueError
        There are too few such points.
    """
    generator = np.random.default_rng(seed)
    source, corners = _near(scene.soup.corners.astype(np.float64), near)
    parts, total = [], 0
    for _ in range(ROUNDS):
        row, point, normal = draw(corners, CANDIDATES_PER_POINT * count, generator)
        front = generator.random(len(row)) < 0.5
        parts.append(_judged(scene, source[row], point, normal * np.where(front, 1.0, -1.0)[:, None], front))
        total += len(parts[-1].point)
        if total >= count:
            return _join(parts).take(np.arange(count))
    raise ValueError(f"only {total} of {ROUNDS * CANDIDATES_PER_POINT * count} candidates have free space before them")


def seen(scene: Scene, snapshot: Snapshot, count: int) -> Receivers:
    """Choose what the scene's cameras see, pixel by pixel, as many points for each camera.

    Parameters
    ----------
    scene : Scene
        A prepared scene.
    snapshot : Snapshot
        Its cameras.
    count : int
        About how many points.

    Returns
    -------
    Receivers
        In world space; `front` says nothing here. No points where the scene has no cameras.
    """
    parts = [Receivers(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))]
    for camera in snapshot.cameras:
        width = max(1, round(np.sqrt(count / len(snapshot.cameras) * 16 / 9)))
        size = (width, max(1, round(width * 9 / 16)))
        points, normals, _ = compare.surface_points(scene, camera, size)
        parts.append(Receivers(points, normals.astype(np.float64), np.ones(len(points), bool)))
    return _join(parts)


def _near(corners: np.ndarray, near: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and their rows, cut into pieces of which only those that lie in the neighbourhood are kept."""
    rows = np.arange(len(corners))
    if near is None:
        return rows, corners
    middle = np.median(corners.mean(axis=1), axis=0)
    done_rows, done = [], []
    while len(rows):
        low, high = corners.min(axis=1), corners.max(axis=1)
        reached = np.linalg.norm(np.clip(middle, low, high) - middle, axis=1) <= near
        small = np.linalg.norm(high - low, axis=1) <= near * PIECE
        inside = np.linalg.norm(corners.mean(axis=1) - middle, axis=1) <= near
        done_rows.append(rows[small & inside])
        done.append(corners[small & inside])
        large = reached & ~small
        rows, corners = np.tile(rows[large], 4), _quarters(corners[large])
    return np.concatenate(done_rows), np.concatenate(done)


def _quarters(corners: np.ndarray) -> np.ndarray:
    """(4 n, 3, 3) triangles, cut at the middles of their edges."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def _judged(scene: Scene, row: np.ndarray, point: np.ndarray, normal: np.ndarray, front: np.ndarray) -> Receivers:
    """The candidates that light can reach and that are more there than not."""
    kept = np.ones(len(row), bool)
    clear = np.flatnonzero(scene.surfaces.transparent[row])
    coordinates = _barycentric(scene.soup.corners[row[clear]].astype(np.float64), point[clear])
    kept[clear] = scene.surfaces.through(row[clear], *coordinates)[0].mean(axis=0) <= 0.5
    kept = np.flatnonzero(kept)
    free = kept[have_space(scene.tracer, point[kept] + LIFT * normal[kept], normal[kept])]
    back = np.flatnonzero(~front[free])
    hidden = back[~_are_seen(scene.tracer, point[free[back]] + LIFT * normal[free[back]], normal[free[back]])]
    free = np.delete(free, hidden)
    return Receivers(point[free] + scene.origin, normal[free], front[free])


def _are_seen(tracer: Tracer, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) whether most front faces around back sides have free space themselves: nobody is beneath the ground."""
    direction, hits = _look(tracer, points, normals)
    facing = (hits.triangle != MISS) & (np.einsum("cn,cn->n", hits.normal, direction) < 0)
    rows = np.flatnonzero(facing)
    rows = rows[(rows % FEELERS) % (FEELERS // WITNESSES) == 0]
    normal = (hits.normal[:, rows] / np.linalg.norm(hits.normal[:, rows], axis=0)).T.astype(np.float64)
    met = points[rows // FEELERS] + (direction[:, rows] * hits.distance[rows]).T
    free = have_space(tracer, met + LIFT * normal, normal)
    counts = (np.bincount(rows // FEELERS, part, len(points)) for part in (free, ~free))
    return np.greater(*counts)


def _look(tracer: Tracer, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, Hits]:
    """(3, n * FEELERS) directions over hemispheres, and what they meet."""
    direction = np.repeat(sphere(FEELERS)[None], len(points), axis=0)
    direction *= np.where(np.einsum("nfc,nc->nf", direction, normals) < 0, -1.0, 1.0)[..., None]
    direction = np.ascontiguousarray(direction.reshape(-1, 3).T, np.float32)
    origin = np.ascontiguousarray(np.repeat(points, FEELERS, axis=0).T, np.float32)
    return direction, tracer.intersect(origin, direction)


def _barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(2, n) float32 coordinates of corners 1 and 2."""
    edges = corners[:, 1:] - corners[:, :1]
    solved = np.einsum("nji,nj->ni", np.linalg.pinv(edges), point - corners[:, 0])
    return np.ascontiguousarray(solved.T.astype(np.float32))


def _join(parts: list[Receivers]) -> Receivers:
    """All of them."""
    return Receivers(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("point", "normal", "front")))


def sphere(count: int) -> np.ndarray:
    """Spread directions evenly, on a Fibonacci spiral.

    Parameters
    ----------
    count : int
        How many.

    Returns
    -------
    (count, 3) float64 ndarray
        Unit vectors, from the top down.
    """
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
