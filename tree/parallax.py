"""Where a ray meets what a probe sees: a few fixed steps along the ray, compared with the probe's distances.

Comes in: offsets of points from probes, directions of rays. Goes out: in which directions the probe shows what the
rays meet, with weights. With a = point - probe and s from 0 to 1, the ray runs through v(s) = (1 - s) a + s |a| d as
the probe sees it. Let |v| be the sum of the components' magnitudes and N the reciprocal of the same distance of what
the probe sees there: then m(s) = |v| N(v) is 1 - s where the ray meets it, more behind and less before. Along a plane m
is linear in s, and N is in the map's coordinates: planes are met exactly, at any number of texels. At s = 1 all rays
end, at infinity; the sky lies there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from . import octahedral
from .probe_atlas import Layout, fetch

__all__ = ["Found", "Nearness", "march"]

STEPS = 8
"""Parts of the ray: with six errors are 3 % larger, with twelve they are no smaller (`docs/accuracy.md`)."""

SOFT = 0.03
"""How far behind what the probe sees a point has to be for the ray to have ended, in its distance: no pop where a ray
begins to touch something."""

SLACK = 0.15
"""How far off the point of a ray may be from what the probe sees there, in its distance, to count at all. The probe
does not see what lies behind an edge: there no point of the ray is close to anything that it sees."""

SHORT = 0.05
"""Length of rays below which what they meet cannot be told from where they start, in the probe's distance: two texels.
Behind a thin wall rays seem to end at its other side, at once."""

LOST = 0.3
"""Part of a ray's weight that ends with each step behind what the probe sees: what it meets may well lie there."""

LEAST = 1e-3
"""Weight of a ray that isn't followed any further."""

TINY = np.float32(1e-20)
"""Keeps quotients finite [m]."""


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distances of an atlas of probes, as `march` reads them.

    layout : Layout, where tiles lie
    nearness : (rows, columns, 1) float32 [1/m], reciprocal of the sum of the components of the way to what texels see
    """

    layout: Layout
    nearness: np.ndarray

    @classmethod
    def of(cls, layout: Layout, distance: np.ndarray) -> Nearness:
        """Convert distances.

        Parameters
        ----------
        layout : Layout
            Where tiles lie.
        distance : (rows, columns) float ndarray
            To what the middle of each texel sees, with borders [m]; infinite for the sky.

        Returns
        -------
        Nearness
            0 for the sky.
        """
        size = octahedral.add_border(np.abs(octahedral.centers(layout.sizes[0])).sum(axis=-1)).astype(np.float32)
        tiles = np.tile(size, (layout.rows, layout.columns))
        return cls(layout, (1 / np.maximum(distance.astype(np.float32) * tiles, TINY))[..., None])

    def at(self, probe: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Compare points with what probes see in their directions.

        Parameters
        ----------
        probe : (n,) int64 ndarray
            Numbers of probes.
        way : (n, 3) float32 ndarray
            From the probe to the point [m].

        Returns
        -------
        (n,) float32 ndarray
            The point's distance over that of what is seen; above 1 behind it, 0 before the sky.
        """
        x, y, z = np.abs(way.T)
        return (x + y + z) * fetch(self.nearness, self.layout, 0, probe, way)[:, 0]


@dataclass(frozen=True, eq=False)
class Found:
    """What some rays meet.

    row : (m,) int64, which of the rays; each once
    toward : (m, 3) float32, where the probe shows it, of any length
    weight : (m,) float32, above 0 to 1; those of a ray sum to at most 1 over all that is found
    ratio : (m,) float32, length of the ray over the distance from the probe
    """

    row: np.ndarray
    toward: np.ndarray
    weight: np.ndarray
    ratio: np.ndarray


def march(near: Nearness, probe: np.ndarray, offset: np.ndarray, direction: np.ndarray) -> Iterator[Found]:
    """Follow rays through what probes see.

    Parameters
    ----------
    near : Nearness
        What they see.
    probe : (n,) int64 ndarray
        Probe of each ray.
    offset : (n, 3) float32 ndarray
        From it to the ray's start [m].
    direction : (n, 3) float32 ndarray
        Unit vectors.

    Yields
    ------
    Found
        At most one for each step, from the start on; nothing of rays that end where the probe does not see.

    Notes
    -----
    Error: exact in convex rooms with plane walls; else measured in `docs/accuracy.md`. Continuous in start and way: a
    part of the ray counts by how far its end lies behind what is seen, and by how close what is found lies to it.
    Source: Szirmay-Kalos et al. 2005, "Approximate Ray-Tracing on the GPU with Distance Impostors"; the rest is ours.
    """
    rays = _Rays(near, probe, offset, direction)
    low = rays.gap(0.0)
    left = 1 - LOST * low.hidden
    for step in range(1, STEPS + 1):
        high = rays.gap(step / STEPS)
        yield rays.ends(step, low, high, left)
        rays.pierce(step, low, high, left)
        low = high


@dataclass(frozen=True, eq=False)
class _Gap:
    """How far points of rays are before what probes see: `value` is 1 - s - m(s); how surely before, and behind."""

    value: np.ndarray
    before: np.ndarray
    hidden: np.ndarray


class _Rays:
    """Rays as probes see them."""

    def __init__(self, near: Nearness, probe: np.ndarray, offset: np.ndarray, direction: np.ndarray) -> None:
        length = np.sqrt((offset * offset).sum(axis=1, keepdims=True))
        self._near, self._probe, self._offset = near, probe, offset
        self._length = np.maximum(length, TINY)
        self._way = self._length * direction

    def gap(self, s: float) -> _Gap:
        """Of the points s of all rays; at infinity everything is behind, the sky too."""
        m = self._near.at(self._probe, (1 - s) * self._offset + s * self._way)
        value = np.float32(1 - s) - m
        before = np.clip(value / np.float32(SOFT * max(1 - s, TINY)), 0, 1)
        hidden = np.clip(-value / np.maximum(m, TINY) / np.float32(SOFT), 0, 1)
        return _Gap(value, before, hidden if s < 1 else np.ones_like(m))

    def ends(self, step: int, low: _Gap, high: _Gap, left: np.ndarray) -> Found:
        """What rays meet within a step, from before; what is left of their weight is changed in place."""
        row = np.flatnonzero((high.hidden > 0) & (left > LEAST))
        toward, sure, ratio = self._meet(row, step, low.value[row], high.value[row])
        share = left[row] * high.hidden[row]
        left[row] -= share * (sure + (1 - sure) * np.float32(LOST))
        weight = share * sure * np.minimum(ratio / np.float32(SHORT), 1)
        some = np.flatnonzero(weight > 0)
        return Found(row[some], toward[some], weight[some], ratio[some])

    def pierce(self, step: int, low: _Gap, high: _Gap, left: np.ndarray) -> None:
        """End rays that come through a surface from its other side, where the probe does not see them."""
        strength = np.minimum(low.hidden, high.before)
        row = np.flatnonzero((strength > 0) & (left > LEAST))
        _, sure, _ = self._meet(row, step, low.value[row], high.value[row])
        left[row] *= 1 - strength[row] * sure

    def _meet(self, row: np.ndarray, step: int, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
        """(m, 3) where rays meet what is seen within a step, with gaps at both ends, (m,) how surely, and `ratio`."""
        begin, end = np.float32((step - 1) / STEPS), np.float32(step / STEPS)
        root = np.maximum(_root(begin, end, low, high), 0)
        middle = self._at(row, root)[1]
        first = (middle > 0) == (high > 0)
        ends = np.where(first, begin, root), np.where(first, root, end)
        closer = _root(*ends, np.where(first, low, middle), np.where(first, middle, high))
        root = np.where((low > 0) != (high > 0), closer, root)
        toward, gap, m = self._at(row, root)
        off = np.abs(gap) / np.maximum(np.maximum(1 - root, m), TINY)
        ratio = self._length[row, 0] * root / np.maximum(np.sqrt((toward * toward).sum(axis=1)), TINY)
        return toward, np.maximum(1 - off / np.float32(SLACK), 0), ratio

    def _at(self, row: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points s of some rays, their gaps, and m(s)."""
        toward = (1 - s)[:, None] * self._offset[row] + s[:, None] * self._way[row]
        m = self._near.at(self._probe[row], toward)
        return toward, 1 - s - m, m


def _root(begin: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where the line between two gaps is 0: between them, or up to as far before, as where it rises below 0."""
    fall = low - high
    is_line = (fall > 0) | ((fall < 0) & (high > 0))
    part = np.where(is_line, low / np.where(is_line, fall, 1), -1)
    return begin + np.clip(part, -1, 1) * (end - begin)
