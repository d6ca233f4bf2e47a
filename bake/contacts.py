"""Contacts: points on surfaces close before whatever stands on them, where light leaks first.

Comes in: receivers. Goes out: more of them, found by feeling along the surface, and then once more along the line
that was met, towards its end. Close to a wall a data point behind it counts most, and only points there show it.
"""

from __future__ import annotations

import numpy as np

from . import warp
from .rays import MISS
from .receivers import Receivers, join
from .scene import Scene
from .sobol import scramble

WAYS = 4
"""Directions from a receiver, at right angles to each other."""

FARTHER = 1.5
"""How far the ways go [side of the receiver's area]: lines between receivers are met from some of them."""

SHARE = 1 / 4
"""Area of a contact, as a part of its receiver's: one of four ways led there."""

ROUNDS = 2
"""From a receiver to a wall, and from there to a corner."""

BENT = 0.9
"""Cosine between normals of one surface, at least."""


def find(scene: Scene, receivers: Receivers, gap: float) -> Receivers:
    """Find points close before what stands on the surfaces that receivers lie on.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    receivers : Receivers
        Where to start.
    gap : float
        Distance from what is met, and height of the ways above the surface [m].

    Returns
    -------
    Receivers
        Only the new points; each depends on its own receiver alone.
    """
    found = [receivers]
    reach = FARTHER * np.sqrt(receivers.area)
    for _ in range(ROUNDS):
        new, owner = _met(scene, found[-1], reach, gap)
        reach = reach[owner]
        found.append(new)
    return join(found[1:])


def _met(scene: Scene, start: Receivers, reach: np.ndarray, gap: float) -> tuple[Receivers, np.ndarray]:
    """Points close before what the ways of some receivers meet, and the rows of these."""
    owner, number = np.divmod(np.arange(len(start.key) * WAYS), WAYS)
    normal, way = start.normal[owner], _tangents(start, owner, number)
    origin = start.position[owner] + gap * normal
    hits = scene.tracer.intersect_opaque(_columns(origin), _columns(way), reach[owner].astype(np.float32))
    some = np.flatnonzero((hits.triangle != MISS) & (hits.distance > 2 * gap))
    above = origin[some] + way[some] * (hits.distance[some, None] - gap)
    height, is_on = _height(scene, above, normal[some], gap)
    owner, number, place = owner[some][is_on], number[some][is_on], above[is_on] - height[:, None] * normal[some][is_on]
    key = scramble(scramble(start.key[owner], 9) ^ number.astype(np.uint32), 10)
    return Receivers(place, start.normal[owner], start.area[owner] * np.float32(SHARE), key, start.front[owner]), owner


def _tangents(start: Receivers, owner: np.ndarray, number: np.ndarray) -> np.ndarray:
    """(n, 3) directions along the surfaces, turned at random."""
    angle = 2 * np.pi * (scramble(start.key, 11)[owner] * 2.0**-32 + number / WAYS)
    tangent, bitangent = warp.frame(np.ascontiguousarray(start.normal[owner].T))
    return (np.cos(angle) * tangent + np.sin(angle) * bitangent).T


def _height(scene: Scene, above: np.ndarray, normal: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """(k,) heights above the surface, and (n,) whether there still is one, of k."""
    hits = scene.tracer.intersect_opaque(_columns(above), _columns(-normal), np.full(len(above), 2 * gap, np.float32))
    there = hits.normal / np.sqrt(np.maximum(warp.dot(hits.normal, hits.normal), 1e-30))
    is_on = (hits.triangle != MISS) & (np.abs((there.T * normal).sum(axis=1)) > BENT)
    return hits.distance[is_on].astype(np.float64), is_on


def _columns(rows: np.ndarray) -> np.ndarray:
    """(3, n) float32."""
    return np.ascontiguousarray(rows.T.astype(np.float32))
