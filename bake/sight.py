"""Sight: which data points of its stencil a receiver sees, and what stands before the others.

Comes in: a scene, data points, receivers. Goes out: one pair for each receiver and data point that matters to it, with
the opaque triangles that block it, seen from either end. Transparent surfaces hide nothing, as for shadow rays.
Receivers that see too little of their stencil will be lit by coarser levels, so they have pairs with those too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..tree import interpolate
from ..tree.blend import ENOUGH
from .parallel import run_tiles, tile_size, tiles
from .rays import MISS
from .receivers import Receivers, lifted
from .scene import Scene

NEGLIGIBLE = 2.5e-4
"""Weights up to this are not looked at."""

SHORTENED = np.float32(0.9999)
"""Rays end before their target: a data point may lie close to a surface, a receiver lies on one."""

TAPS = 8
"""Taps that a tile's receivers have at most, in the mean: 16 where levels meet, less those behind the surface."""


FIELDS = ("receiver", "point", "weight", "blocker", "reach")


@dataclass(frozen=True)
class Pairs:
    """Receivers and data points with some weight there; sorted by data point, then by receiver.

    receiver : (m,) int32, row of the receivers
    point : (m,) int32, row of the data points
    weight : (m,) float32, stencil weight times the cosine at the receiver
    blocker : (m, 2) int32, the first opaque triangle seen from the receiver, and from the data point; -1 for none
    reach : (m,) float32, part of the way from the receiver to the first one; 1 for none
    """

    receiver: np.ndarray
    point: np.ndarray
    weight: np.ndarray
    blocker: np.ndarray
    reach: np.ndarray

    @property
    def visible(self) -> np.ndarray:
        """(m,) bool, whether nothing is between."""
        return self.blocker[:, 0] == MISS

    def take(self, rows: np.ndarray) -> Pairs:
        """Some of the pairs.

        Parameters
        ----------
        rows : (k,) int64, (m,) bool ndarray or slice
            Which.

        Returns
        -------
        Pairs
            In the order of `rows`.
        """
        return Pairs(*(getattr(self, name)[rows] for name in FIELDS))


def look(
    scene: Scene,
    data: interpolate.DataPoints,
    receivers: Receivers,
    threads: int = 0,
    progress: Callable[[int], bool] | None = None,
) -> Pairs:
    """Trace a shadow ray for each receiver and data point of its stencil.

    Parameters
    ----------
    scene : Scene
        What stands in the way.
    data : DataPoints
        Data points; occluding planes that they have already do not count.
    receivers : Receivers
        Points on surfaces.
    threads : int
        Worker threads; 0 uses every core.
    progress : callable, optional
        As in `parallel.run_tiles`, counting receivers.

    Returns
    -------
    Pairs
        Those in front of the receiver's surface, with valid data points.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    data, found = replace(data, planes=np.full_like(data.planes, -1)), {}

    def work(rows: np.ndarray) -> int:
        found[int(rows[0])] = _join([*_levels(scene, data, receivers.take(rows), rows)])
        return len(rows)

    run_tiles(work, tiles(len(receivers.key), tile_size() // TAPS), threads, progress)
    return _sorted([found.pop(first) for first in sorted(found)])


def _levels(scene: Scene, data: interpolate.DataPoints, receivers: Receivers, rows: np.ndarray) -> Iterator[Pairs]:
    """Pairs of the whole stencil, then for receivers that see too little of it those of the next coarser one."""
    seen = np.zeros(len(rows))
    for finest in range(data.grid.levels - 1, -1, -1):
        low = np.flatnonzero(seen < ENOUGH)
        receiver, point, weight = _taps(data, receivers.take(low), finest)
        start = np.ascontiguousarray(lifted(scene, receivers)[:, low[receiver]])
        blocker, reach = _blockers(scene, start, data.position[point].T.astype(np.float32))
        seen[low] += np.bincount(receiver, weight * (blocker[:, 0] == MISS), len(low))
        yield Pairs(rows[low[receiver]].astype(np.int32), point.astype(np.int32), weight, blocker, reach)


def _taps(data: interpolate.DataPoints, receivers: Receivers, finest: int):
    """(receiver, point, weight) of the taps that matter."""
    position, normal = (np.ascontiguousarray(column.T) for column in (receivers.position, receivers.normal))
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))]
    for taps in interpolate.layers(data, position, normal, finest):
        corner, column = np.nonzero(taps.weight > NEGLIGIBLE)
        parts.append((taps.point[column], taps.row[corner, column].astype(np.int64), taps.weight[corner, column]))
    return (np.concatenate(columns) for columns in zip(*parts, strict=True))


def _blockers(scene: Scene, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 2) first opaque triangles from start to end and from end to start, and how far the former ones are."""
    way = np.ascontiguousarray(end - start)
    blocker = np.full((way.shape[1], 2), MISS, np.int32)
    blocker[:, 0], reach = _first(scene, start, way)
    hidden = np.flatnonzero(blocker[:, 0] != MISS)
    back, _ = _first(scene, np.ascontiguousarray(end[:, hidden]), -way[:, hidden])
    blocker[hidden, 1] = np.where(back == MISS, blocker[hidden, 0], back)
    return blocker, np.where(blocker[:, 0] == MISS, np.float32(1), reach)


def _first(scene: Scene, origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m,) first opaque triangle on each segment, and what part of it lies before."""
    hits = scene.tracer.intersect_opaque(origin, way, np.full(way.shape[1], SHORTENED))
    return hits.triangle.astype(np.int32), hits.distance


def _join(parts: list[Pairs]) -> Pairs:
    """All pairs."""
    return Pairs(*(np.concatenate([getattr(part, name) for part in (_none(), *parts)]) for name in FIELDS))


def _sorted(parts: list[Pairs]) -> Pairs:
    """All pairs in their order, and no parts any more: field after field, so that only one is held twice."""
    fields = [[getattr(part, name) for part in (_none(), *parts)] for name in FIELDS]
    parts.clear()
    for number, field in enumerate(fields):
        fields[number] = np.concatenate(field)
        field.clear()
    order = np.lexsort((fields[0], fields[1]))
    for number, field in enumerate(fields):
        fields[number] = field[order]
    return Pairs(*fields)


def _none() -> Pairs:
    """No pairs."""
    none = np.zeros(0, np.int32)
    return Pairs(none, none, np.zeros(0, np.float32), np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
