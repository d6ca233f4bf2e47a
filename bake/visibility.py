"""Rays among transparent surfaces: what they meet by chance, and what is left of light on its way.

Comes in: rays, or segments. Goes out: hits, where transparent surfaces let rays through by chance; or the segments that
nothing opaque blocks, each with a tint.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from . import warp
from .rays import MISS, SKIP, Hits, Tracer
from .surfaces import Surfaces

__all__ = ["FAR", "PASS_LIMIT", "TARGET_SHORTENED", "Space", "meet", "unblocked"]

PASS_LIMIT = 32
"""Transparent surfaces that one ray may cross; the next one is taken as opaque."""

TARGET_SHORTENED = np.float32(0.9999)
"""Shadow rays stop short of the surface they aim at by this share."""

FAR = np.float32(1e30)
"""Length of a ray to the sun or the sky, in lengths of its direction."""


MET_WHERE_EMISSIVE = np.float32(0.5)
"""Rays stop at an emissive surface at least this often, times its coverage: clear glass may shine."""


class Space(Protocol):
    """What may be in the way: `tracer`, and `surfaces` that tint."""

    tracer: Tracer
    surfaces: Surfaces


def meet(
    scene: Space,
    origin: np.ndarray,
    direction: np.ndarray,
    beta: np.ndarray,
    uniform: Callable[[np.ndarray, int], np.ndarray],
) -> tuple[Hits, np.ndarray]:
    """Find what rays meet; transparent surfaces let them through by chance.

    Parameters
    ----------
    scene : Space
        What may be in the way.
    origin : (3, n) float32 ndarray
        Where rays start [m]; moved past the surfaces that they cross.
    direction : (3, n) float32 ndarray
        Unit vectors.
    beta : (3, n) float32 ndarray
        Throughput; weighed so that its expectation is right.
    uniform : callable
        Uniform numbers for rays (m,) at their step-th transparent surface.

    Returns
    -------
    hits : Hits
        Distances count from the moved origins.
    travelled : (n,) float32 ndarray
        Whole way to the hit [m].
    """
    travelled = np.zeros(origin.shape[1], np.float32)
    hits = scene.tracer.intersect(origin, direction)
    active = _transparent_rows(scene, hits, np.arange(len(travelled))) if scene.tracer.has_transparent else ()
    for step in range(PASS_LIMIT):
        if not len(active):
            break
        triangle, u, v = hits.triangle[active], hits.u[active], hits.v[active]
        passed, covered = scene.surfaces.through(triangle, u, v)
        chance = np.minimum(passed.mean(axis=0), 1 - MET_WHERE_EMISSIVE * covered * scene.surfaces.emissive[triangle])
        passes = uniform(active, step) < chance
        stays = active[~passes]
        beta[:, stays] *= (covered / np.maximum(1 - chance, np.float32(1e-6)))[~passes]
        goes = active[passes]
        beta[:, goes] *= (passed / np.maximum(chance, np.float32(1e-6)))[:, passes]
        travelled[goes] += _step_past(scene, origin, direction, hits, goes)
        _put_hits(hits, goes, scene.tracer.intersect(origin[:, goes], direction[:, goes]))
        active = _transparent_rows(scene, hits, goes)
    return hits, travelled + hits.distance


def unblocked(
    scene: Space,
    position: np.ndarray,
    toward: np.ndarray,
    far: np.float32,
    useful: np.ndarray,
    shadow: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Which lanes see what they look at, and what transparent surfaces leave of it.

    Parameters
    ----------
    scene : Space
        What may be in the way.
    position, toward : (3, n) float32 ndarray
        Start [m], and the way to the target.
    far : float32
        Where to stop, in lengths of `toward`.
    useful : (n,) bool ndarray
        Lanes worth a ray.
    shadow : (n,) bool ndarray, optional
        Lanes that anything can block; the others always see their target.

    Returns
    -------
    rows : (m,) int64 ndarray
        Lanes that are useful and see their target.
    tint : (3, m) or (1, 1) float32 ndarray
        Light that is left; all of it when the scene has nothing transparent.
    """
    traced = useful if shadow is None else useful & shadow
    limit = np.where(traced, far, SKIP)
    blocked = scene.tracer.blocked(position, np.ascontiguousarray(toward), limit)
    rows = np.flatnonzero(useful & ~blocked)
    if not scene.tracer.has_transparent:
        return rows, np.ones((1, 1), np.float32)
    return rows, _transmittance(scene, position[:, rows], toward[:, rows], limit[rows])


def _transmittance(scene: Space, position: np.ndarray, toward: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """(3, n) light that transparent surfaces leave on each segment."""
    tint = np.ones_like(position)
    length = np.sqrt(warp.dot(toward, toward))
    start, left = position.copy(), limit.copy()
    active = np.flatnonzero(limit > 0)
    for _ in range(PASS_LIMIT):
        if not len(active):
            break
        hits = scene.tracer.intersect_transparent(start[:, active], toward[:, active], left[active])
        met = np.flatnonzero(hits.triangle != MISS)
        active, hits = active[met], hits.take(met)
        tint[:, active] *= scene.surfaces.through(hits.triangle, hits.u, hits.v)[0]
        here = start[:, active] + toward[:, active] * hits.distance
        step = hits.distance + scene.tracer.offset(here, hits.distance * length[active]) / length[active]
        start[:, active] += toward[:, active] * step
        left[active] -= step
        active = active[(left[active] > 0) & (warp.largest(tint[:, active]) > 0)]
    tint[:, active] = 0
    return tint


def _step_past(scene: Space, origin: np.ndarray, direction: np.ndarray, hits: Hits, rows: np.ndarray) -> np.ndarray:
    """Move origins beyond the surfaces that rays hit; returns the metres moved."""
    distance = hits.distance[rows]
    position = origin[:, rows] + direction[:, rows] * distance
    step = distance + scene.tracer.offset(position, distance)
    origin[:, rows] += direction[:, rows] * step
    return step


def _transparent_rows(scene: Space, hits: Hits, rows: np.ndarray) -> np.ndarray:
    """Those of `rows` that hit something transparent."""
    triangle = hits.triangle[rows]
    return rows[(triangle != MISS) & scene.surfaces.transparent[triangle]]


def _put_hits(hits: Hits, rows: np.ndarray, new: Hits) -> None:
    """Overwrite some hits in place."""
    for name in ("triangle", "distance", "u", "v"):
        getattr(hits, name)[rows] = getattr(new, name)
    hits.normal[:, rows] = new.normal
