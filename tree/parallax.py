"""Where a ray meets what a probe sees: a few fixed steps along the ray, compared with the probe's distances.

Comes in: offsets of points from probes, directions of rays. Goes out: in which directions the probe shows what the
rays meet, with weights. With a = point - probe and r from 1 to 0, the ray runs through v(r) = r a + (1 - r) |a| d as
the probe sees it, 0 being infinity. Let |v| be the sum of the components' magnitudes and N the reciprocal of the same
distance of what the probe sees there: m(r) = |v| N(v) is r where the ray meets it, more behind and less before. Along a
plane m is linear in r, and N is in the map's coordinates: planes are met exactly, at any number of texels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from . import octahedral
from .probe_atlas import BORDER, Layout, fetch_between

__all__ = ["Found", "Nearness", "march"]

STEPS = 8
"""Parts of the ray: with six errors are 5 % larger, with twelve 5 % smaller (`docs/accuracy.md`)."""

SOFT = 0.03
"""Distance from what the probe sees within which it is open whether a point lies before or behind, in its distance: no
pop where a ray begins to touch something."""

SLACK = 0.15
"""How far off the point of a ray may be from what the probe sees there, in its distance, to count at all. The probe
does not see what lies behind an edge: there no point of the ray is close to anything that it sees."""

REFINED = 1
"""Times that a step is cut where the ray meets something. The more often, the more edges look like surfaces."""

ASIDE = 0.5
"""How far beside a step the line between its ends may meet what is seen, in steps."""

SHORT = 0.05
"""Length of rays below which what they meet cannot be told from where they start, in the probe's distance: two texels.
Behind a thin wall rays seem to end at its other side, at once."""

LOST = 0.5
"""Part of a ray that ends with each step behind what the probe sees: what it meets may well lie there."""

LEAST = 1e-3
"""Part of a ray that isn't followed any further."""

SHORTEST = np.float32(1e-20)
"""Least distance from a probe [m]: any is right there, as all directions are that of the ray."""

TINY = np.float32(1e-30)
"""Keeps quotients finite."""


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distances of an atlas of probes, as `march` reads them.

    layout : Layout, where tiles lie
    levels : tuple of (rows_l, columns_l, 1) float32 [1/m], reciprocal of the sum of the components of the way to what
        texels see; on levels after the first the mean over what a texel covers
    """

    layout: Layout
    levels: tuple[np.ndarray, ...]

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
        first = 1 / np.maximum(distance.astype(np.float32) * tiles, TINY)
        rest = (_averaged(first, layout, level) for level in range(1, layout.levels))
        return cls(layout, (first[..., None], *rest))

    def at(self, probe: np.ndarray, way: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Compare points with what probes see in their directions.

        Parameters
        ----------
        probe : (n,) int64 ndarray
            Numbers of probes.
        way : (n, 3) float32 ndarray
            From the probe to the point [m].
        level : (n,) float64 ndarray
            How blurred.

        Returns
        -------
        (n,) float32 ndarray
            The point's distance over that of what is seen; above 1 behind it, 0 before the sky.
        """
        x, y, z = np.abs(way.T)
        return (x + y + z) * fetch_between(self.levels, self.layout, level, probe, way)[:, 0]


def _averaged(first: np.ndarray, layout: Layout, level: int) -> np.ndarray:
    """One level: means over what its texels cover. As means of planes they lie on them again."""
    pitch, small, inner = layout.pitch, layout.pitch >> level, slice(BORDER, -BORDER)
    weight = _covering(layout.sizes[level], layout.sizes[0])
    tiles = first.reshape(layout.rows, pitch, layout.columns, pitch).transpose(0, 2, 1, 3)[:, :, inner, inner]
    out = np.empty((layout.rows * small, layout.columns * small, 1), np.float32)
    for row, column in np.ndindex(layout.rows, layout.columns):
        image = weight @ tiles[row, column] @ weight.T
        out[row * small :, column * small :][:small, :small, 0] = octahedral.add_border(image)
    return out


def _covering(coarse: int, fine: int) -> np.ndarray:
    """(coarse, fine) float32 parts of coarse texels that fine ones cover, along one axis."""
    begin, other = np.arange(coarse)[:, None] / coarse, np.arange(fine) / fine
    part = np.minimum(begin + 1 / coarse, other + 1 / fine) - np.maximum(begin, other)
    return (np.maximum(part, 0) * coarse).astype(np.float32)


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


def march(
    near: Nearness, probe: np.ndarray, offset: np.ndarray, direction: np.ndarray, level: np.ndarray
) -> Iterator[Found]:
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
    level : (n,) float64 ndarray
        How blurred what probes see is to be, as of `Nearness.at`.

    Yields
    ------
    Found
        At most one for each step, from the start on; nothing of rays that end where the probe does not see.

    Notes
    -----
    Error: exact in convex rooms with plane walls; else measured in `docs/accuracy.md`. Continuous in start and way:
    parts of the ray are before what is seen, or behind it, and change sides as far as the end of a step is surely
    before or behind. Of those that go behind only what meets a surface on the way is found.
    Source: Szirmay-Kalos et al. 2005, "Approximate Ray-Tracing on the GPU with Distance Impostors"; the rest is ours.
    """
    rays = _Rays(near, probe, offset, direction, level)
    low = rays.gap(1.0)
    behind = np.clip(low.value / np.maximum(low.m, TINY) * np.float32(-1 / SOFT), 0, 1)
    before, behind = 1 - behind, behind * np.float32(1 - LOST)
    for step in range(1, STEPS + 1):
        high = rays.gap(1 - step / STEPS)
        goes, comes = before * high.hidden, behind * (1 - high.hidden)
        found, unsure = rays.met(low, high, goes)
        yield found
        before = before - goes + rays.through(low, high, comes)
        behind = (behind - comes + unsure) * np.float32(1 - LOST)
        low = high


@dataclass(frozen=True, eq=False)
class _Gap:
    """How far points r of rays are before what probes see: `value` is r - `m`; how surely they are behind it."""

    r: float
    value: np.ndarray
    m: np.ndarray

    @property
    def hidden(self) -> np.ndarray:
        """(n,) 0 to 1; a half at the surface. At infinity everything is behind, the sky too."""
        off = self.value / np.maximum(np.maximum(self.m, np.float32(self.r)), TINY)
        return np.clip((1 - off * np.float32(1 / SOFT)) / 2, 0, 1) if self.r > 0 else np.ones_like(off)


class _Rays:
    """Rays as probes see them."""

    def __init__(self, near: Nearness, probe: np.ndarray, offset: np.ndarray, direction: np.ndarray, level) -> None:
        length = np.sqrt((offset * offset).sum(axis=1, keepdims=True))
        self._near, self._probe, self._offset, self._level = near, probe, offset, level
        self._length = np.maximum(length, SHORTEST)
        self._way = self._length * direction

    def gap(self, r: float) -> _Gap:
        """Of the points r of all rays."""
        m = self._near.at(self._probe, r * self._offset + (1 - r) * self._way, self._level)
        return _Gap(r, np.float32(r) - m, m)

    def met(self, low: _Gap, high: _Gap, goes: np.ndarray) -> tuple[Found, np.ndarray]:
        """What the parts of rays meet that go behind within a step, and (n,) what of them meets nothing."""
        row = np.flatnonzero(goes > LEAST)
        toward, sure, ratio = self._meet(row, low, high, 1)
        weight, unsure = goes[row] * sure, np.zeros_like(goes)
        unsure[row] = goes[row] - weight
        weight *= np.minimum(ratio / np.float32(SHORT), 1)
        some = np.flatnonzero(weight > 0)
        return Found(row[some], toward[some], weight[some], ratio[some]), unsure

    def through(self, low: _Gap, high: _Gap, comes: np.ndarray) -> np.ndarray:
        """(n,) parts of rays that come forward within a step, less those that would have to come through a surface."""
        row = np.flatnonzero(comes > LEAST)
        left = comes.copy()
        left[row] *= 1 - self._meet(row, low, high, -1)[1]
        return left

    def _meet(self, row: np.ndarray, low: _Gap, high: _Gap, side: int) -> tuple[np.ndarray, ...]:
        """(m, 3) where some rays meet what is seen within a step or close to it, from before (1) or from behind (-1),
        (m,) how surely, and `ratio`."""
        ends = np.float32(low.r), np.float32(high.r)
        gaps = low.value[row] * side, high.value[row] * side
        root, aside = _line(ends, gaps)
        is_between = (gaps[0] > 0) != (gaps[1] > 0)
        for _ in range(REFINED):
            root = np.where(is_between, self._closer(row, ends, gaps, root, side), root)
        toward, gap, m = self._at(row, root)
        off = np.abs(gap) / np.maximum(np.maximum(root, m), TINY)
        sure = np.maximum(1 - off / np.float32(SLACK), 0) * np.clip(4 * (1 - aside / np.float32(ASIDE)), 0, 1)
        ratio = self._length[row, 0] * (1 - root) / np.maximum(np.sqrt((toward * toward).sum(axis=1)), TINY)
        return toward, sure, ratio

    def _closer(self, row: np.ndarray, ends: tuple, gaps: tuple, root: np.ndarray, side: int) -> np.ndarray:
        """Where the line meets what is seen in the part of a step that is left after a first try."""
        gap = self._at(row, root)[1] * side
        is_later = (gap > 0) == (gaps[0] > 0)
        ends = np.where(is_later, root, ends[0]), np.where(is_later, ends[1], root)
        return _line(ends, (np.where(is_later, gap, gaps[0]), np.where(is_later, gaps[1], gap)))[0]

    def _at(self, row: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points r of some rays, their gaps, and m(r)."""
        toward = r[:, None] * self._offset[row] + (1 - r)[:, None] * self._way[row]
        m = self._near.at(self._probe[row], toward, self._level[row])
        return toward, r - m, m


def _line(ends: tuple, gaps: tuple) -> tuple[np.ndarray, np.ndarray]:
    """(m,) r where the line between the gaps at two ends is 0, 0 to 1, and how far that is beside them, in their
    distance; far beside where it does not fall.

    Counted from the end, as that is where precision is needed: close to a probe all that it sees is close to r = 0.
    """
    fall, length = gaps[0] - gaps[1], ends[0] - ends[1]
    part = np.where(fall > 0, -gaps[1] / np.where(fall > 0, fall, 1), -1)
    aside = np.maximum(np.maximum(-part, part - 1), 0)
    return np.clip(ends[1] + np.clip(part, -ASIDE, 1 + ASIDE) * length, 0, 1), aside
