"""The one place that traces rays: a wrapper around embreex.

Comes in: triangles, and rays stored by component, (3, n) float32. Goes out: hits, or which rays are blocked.
embreex checks no bounds and returns an uninitialised record for some queries, so every call goes through here.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from . import warp

MISS = -1
"""`Hits.triangle` of a ray that left the scene."""

SKIP = np.float32(-1)
"""A far distance that makes Embree skip the ray; embreex then says that it is blocked, `blocked` that it is free."""

RELATIVE_OFFSET = np.float32(1e-6)
"""Offset of a ray's origin per metre of its coordinates and of the ray that led there: about eight float32 steps."""

SCENE_OFFSET = 2.5e-7
"""Least offset per metre of the scene's size; a scene of 40 m gets 10 micrometres, where self-hits vanish."""


@dataclass(frozen=True)
class Hits:
    """What rays met; one column for each ray, all float32 but `triangle`.

    triangle : (n,) int32, row of the triangles, `MISS` where there is none
    distance : (n,) [in lengths of the ray's direction]
    u, v : (n,) barycentric coordinates of corners 1 and 2
    normal : (3, n) cross product of the triangle's edges, not of unit length; its length is twice the area
    """

    triangle: np.ndarray
    distance: np.ndarray
    u: np.ndarray
    v: np.ndarray
    normal: np.ndarray

    def take(self, rows: np.ndarray) -> Hits:
        """Some of the rays.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        Hits
            Copies.
        """
        parts = (getattr(self, name)[rows] for name in ("triangle", "distance", "u", "v"))
        return Hits(*parts, self.normal[:, rows])

    def facing(self, direction: np.ndarray) -> np.ndarray:
        """Normals of the sides that rays came to.

        Parameters
        ----------
        direction : (3, n) float32 ndarray
            Where the rays went.

        Returns
        -------
        (3, n) float32 ndarray
            Unit vectors.
        """
        length = np.maximum(np.sqrt(warp.dot(self.normal, self.normal)), np.float32(1e-37))
        return self.normal * (-np.copysign(np.float32(1), warp.dot(self.normal, direction)) / length)


class Tracer:
    """Rays against a fixed set of triangles; safe to call from several threads.

    Parameters
    ----------
    corners : (n, 3, 3) float32 ndarray
        Triangles [m].
    transparent : (n,) bool ndarray
        Triangles that may let light pass. They are left out of `blocked` and are the only ones in
        `intersect_transparent`.
    """

    def __init__(self, corners: np.ndarray, transparent: np.ndarray) -> None:
        self.size = float(np.ptp(corners.reshape(-1, 3), axis=0).max()) if len(corners) else 0.0
        self._all = _commit(corners)
        self._transparent_rows = np.flatnonzero(transparent).astype(np.int32)
        some = len(self._transparent_rows) > 0
        self._opaque_rows = np.flatnonzero(~transparent).astype(np.int32)
        self._opaque = _commit(corners[~transparent]) if some else self._all
        self._transparent = _commit(corners[transparent]) if some else None
        self._lock = threading.Lock()
        self.rays = 0
        self.seconds = 0.0

    @property
    def has_transparent(self) -> bool:
        """Whether any triangle may let light pass."""
        return self._transparent is not None

    def forget(self) -> None:
        """Set the counts of rays and seconds back to 0."""
        self.rays, self.seconds = 0, 0.0

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """First hit of each ray.

        Parameters
        ----------
        origin : (3, n) float32 ndarray
            Where rays start [m]; see `offset`.
        direction : (3, n) float32 ndarray
            Where they go; need not be of unit length.

        Returns
        -------
        Hits
            Transparent triangles count like all others.
        """
        return self._first_hit(self._all, origin, direction, None)

    def intersect_opaque(self, origin: np.ndarray, direction: np.ndarray, far: np.ndarray) -> Hits:
        """First opaque triangle on each ray.

        Parameters
        ----------
        origin, direction : (3, n) float32 ndarray
            Rays [m].
        far : (n,) float32 ndarray
            Where they end, in lengths of `direction`.

        Returns
        -------
        Hits
            `triangle` counts in the full set of triangles.
        """
        return _renumbered(self._first_hit(self._opaque, origin, direction, far), self._opaque_rows)

    def intersect_transparent(self, origin: np.ndarray, direction: np.ndarray, far: np.ndarray) -> Hits:
        """First transparent triangle on each ray.

        Parameters
        ----------
        origin, direction : (3, n) float32 ndarray
            Rays [m].
        far : (n,) float32 ndarray
            Where they end, in lengths of `direction`.

        Returns
        -------
        Hits
            `triangle` counts in the full set of triangles.
        """
        return _renumbered(self._first_hit(self._transparent, origin, direction, far), self._transparent_rows)

    def blocked(self, origin: np.ndarray, direction: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Whether an opaque triangle lies on each segment.

        Parameters
        ----------
        origin, direction : (3, n) float32 ndarray
            Rays [m].
        far : (n,) float32 ndarray
            Where they end, in lengths of `direction`; `SKIP` leaves a ray out, and it counts as free.

        Returns
        -------
        (n,) bool ndarray
            True where something is in the way.
        """
        _check(origin, direction, far)
        start = time.thread_time()
        found = self._opaque.run(origin.T, direction.T, np.ascontiguousarray(far, np.float32), query="OCCLUDED")
        self._count(len(found), start)
        return (found == 0) & (far >= 0)

    def offset(self, position: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """How far to move a ray's origin off the surface so that it doesn't hit that surface again.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Points on surfaces [m].
        distance : (n,) float32 ndarray
            Length of the rays that found them [m]; 0 where they are known exactly.

        Returns
        -------
        (n,) float32 ndarray
            Metres along the facing normal.
        """
        magnitude = warp.largest(np.abs(position))
        return (magnitude + distance) * RELATIVE_OFFSET + np.float32(self.size * SCENE_OFFSET)

    def _first_hit(self, scene: EmbreeScene, origin: np.ndarray, direction: np.ndarray, far: np.ndarray | None) -> Hits:
        """One intersection query; `far` is copied because Embree overwrites it."""
        _check(origin, direction, far)
        start = time.thread_time()
        limit = None if far is None else np.array(far, np.float32)
        found = scene.run(origin.T, direction.T, limit, output=True)
        self._count(origin.shape[1], start)
        return Hits(found["primID"], found["tfar"], found["u"], found["v"], found["Ng"].T)

    def _count(self, rays: int, start: float) -> None:
        """Add to the totals that benchmarks and progress read."""
        spent = time.thread_time() - start
        with self._lock:
            self.rays += rays
            self.seconds += spent


def _commit(corners: np.ndarray) -> EmbreeScene:
    """A scene that is built now: the first query would build it, and that must not happen in two threads."""
    scene = EmbreeScene()
    if len(corners):
        TriangleMesh(scene, np.ascontiguousarray(corners, np.float32))
    nowhere = np.zeros((1, 3), np.float32)
    scene.run(nowhere, np.ones((1, 3), np.float32))
    return scene


def _renumbered(hits: Hits, rows: np.ndarray) -> Hits:
    """Hits on some of the triangles, as rows of all."""
    if not len(rows):
        return hits
    triangle = np.where(hits.triangle >= 0, rows[hits.triangle], np.int32(MISS))
    return Hits(triangle, hits.distance, hits.u, hits.v, hits.normal)


def _check(origin: np.ndarray, direction: np.ndarray, far: np.ndarray | None) -> None:
    """Embree reads out of bounds when these differ."""
    if origin.shape != direction.shape or origin.dtype != np.float32 or direction.dtype != np.float32:
        raise ValueError(f"rays: want equal (3, n) float32, got {origin.shape} {direction.shape}")
    if origin.ndim != 2 or len(origin) != 3 or (far is not None and far.shape != origin.shape[1:]):
        ends = "" if far is None else f" ending at {far.shape}"
        raise ValueError(f"rays: want (3, n) origins and directions, and (n,) ends, got {origin.shape}{ends}")
