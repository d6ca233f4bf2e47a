"""Half-spaces: the choice, for a tile of data points, of the planes that hide the most of what they must not light.

Comes in: pairs with what hiding them gains, and candidate planes. Goes out: up to three planes for each data point and
how wide each falls off. Candidates are taken greedily (filling slots again gains nothing); separators fill the rest.

    height     > -moved          -moved ... -moved - width       below
    factor     1                 1 + (height + moved) / width    0
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .blockers import Candidates
from .separators import first_of_best, separate

SLOTS = 3
"""Planes of a data point."""

WORTH = 1e-4
"""Part of a data point's weight that a plane must gain. A data point of 2 m has 1e-3 of its weight in a strip of 3 cm
below the floor that it stands on, and lights it visibly."""

WORTH_PARTING = 2e-3
"""The same for planes that no face lies in: they part clutter, and would part noise."""

WIDER = 0.98
"""A wider plane is taken when it gains at least this part of the best one's gain."""


THIN = 0.5
"""Part of a wall's thickness within which its plane falls off."""

UNSURE = 0.1
"""Part of the weight behind a plane for which the wall may be thinner than that."""

TOUCHING = 1e-3
"""How far before a plane what is met still belongs to its wall [voxels]."""


@dataclass(frozen=True)
class Falloff:
    """Widths that planes may have, from wide to narrow.

    width : (k,) float64 [m], over which the factor falls to 0
    moved : (k,) float64 [m], how far behind the plane it starts to fall
    """

    width: np.ndarray
    moved: np.ndarray

    def factor(self, height: np.ndarray, code: np.ndarray | int) -> np.ndarray:
        """What passes.

        Parameters
        ----------
        height : (n,) float64 ndarray
            Above the plane [m].
        code : (n,) int64 ndarray or int
            Which width.

        Returns
        -------
        (n,) float64 ndarray
            From 0 to 1.
        """
        return np.clip(1 + (height + self.moved[code]) / self.width[code], 0, 1)

    @property
    def least(self) -> float:
        """Depth below which the narrowest plane hides everything [m]."""
        return float(self.moved[-1] + self.width[-1])


class Trial:
    """A tile of data points with their pairs, and the choice so far.

    Parameters
    ----------
    position : (n, 3) float64 ndarray
        The data points [m].
    size : (n,) float64 ndarray
        Their voxels [m].
    owner : (m,) int64 ndarray
        Row of each pair's data point, ascending.
    place : (m, 3) float64 ndarray
        Each pair's receiver [m].
    reach : (m,) float32 ndarray
        Part of the way from each receiver to its data point where something is in the way, 1 for nothing.
    value : (m,) float64 ndarray
        What hiding the pair gains, negative where it must not be hidden.
    falloff : Falloff
        Widths to choose from.

    Attributes
    ----------
    plane : (SLOTS, n, 4) float64 ndarray
        Unit normal towards the data point and distance [m].
    code : (SLOTS, n) int64 ndarray
        Width of each plane, -1 for no plane.
    """

    def __init__(self, position, size, owner, place, reach, value, falloff: Falloff) -> None:
        self._position, self._size, self._falloff = position, size, falloff
        self._owner, self._place, self._reach, self._value = owner, place, reach, value
        self._least = WORTH * np.bincount(owner, np.abs(value), len(size))
        self._hides = np.zeros((SLOTS, len(owner)), bool)
        self.plane = np.zeros((SLOTS, len(size), 4))
        self.code = np.full((SLOTS, len(size)), -1)

    def choose(self, candidates: Candidates) -> None:
        """Fill the slots with the candidates that gain the most, one after the other.

        Parameters
        ----------
        candidates : Candidates
            Sorted by `point`, which counts within the tile.
        """
        candidate, pair = _combine(candidates.point, self._owner, len(self._size))
        out = np.flatnonzero(heights(candidates.plane, self._place, candidate, pair) < -self._falloff.least)
        candidate, pair = candidate.take(out), pair.take(out)
        for slot in range(SLOTS):
            gain = np.bincount(candidate, self._open().take(pair), len(candidates.point))
            best, row = first_of_best(candidates.point, len(self._size), gain)
            taken = best > self._least
            self.code[slot] = np.where(taken, 0, -1)
            self.plane[slot, taken] = candidates.plane[row[taken]]
            held = np.zeros(len(gain), bool)
            held[row[taken]] = True
            self._hides[slot, pair[held.take(candidate)]] = True

    def separate(self) -> None:
        """Fill empty slots with planes that part what is still lit wrongly from the rest."""
        least = self._least * (WORTH_PARTING / WORTH)
        for slot in range(SLOTS):
            value, free = self._open(), self.code[slot] < 0
            rows = np.flatnonzero((free & (np.bincount(self._owner, np.maximum(value, 0)) > self._least))[self._owner])
            points, owner = np.unique(self._owner[rows], return_inverse=True)
            around = (self._place[rows] - self._position[points[owner]]) / self._size[points[owner], None]
            found = separate(owner, len(points), around, value[rows])
            worth = found.gain > least[points]
            points, normal = points[worth], found.normal[worth]
            distance = (normal * self._position[points]).sum(axis=1) + found.distance[worth] * self._size[points]
            self.plane[slot, points] = np.concatenate([normal, distance[:, None]], axis=1)
            self.code[slot, points] = 0
            self._hides[slot] |= self._heights(slot) < -self._falloff.least

    def widen(self) -> None:
        """Give each plane the widest falloff that costs next to nothing; drop those that are not worth it."""
        for slot in range(SLOTS):
            alone, height = self._open(slot), self._heights(slot)
            codes = range(len(self._falloff.width))
            parts = [(1 - self._falloff.factor(height, code)) * alone for code in codes]
            gain = np.stack([np.bincount(self._owner, part, len(self._size)) for part in parts])
            best = gain.max(axis=0)
            fits = (gain >= WIDER * best) & self._fits_walls(slot, height)
            fits[-1] |= ~fits.any(axis=0)
            kept = (self.code[slot] >= 0) & (best > self._least)
            self.code[slot] = np.where(kept, fits.argmax(axis=0), -1)

    def _fits_walls(self, slot: int, height: np.ndarray) -> np.ndarray:
        """(codes, n) whether each width ends within the wall that stands between a data point and what is hidden.

        A ray from the receiver meets the wall's far side: its depth behind the plane is the thickness there. What is
        met before the plane is no part of the wall.
        """
        rows = np.flatnonzero((height < -self._falloff.least) & (self._value > 0))
        owner, reach = self._owner[rows], self._reach[rows]
        own = heights(self.plane[slot], self._position)[owner]
        depth = -(height[rows] + reach * (own - height[rows]))
        wall = depth > -TOUCHING * self._size[owner]
        owner, depth, weight = owner[wall], depth[wall], self._value[rows[wall]]
        total = UNSURE * np.bincount(owner, weight, len(self._size))
        ends = self._falloff.moved + self._falloff.width
        thin = [np.bincount(owner, weight * (THIN * depth < end), len(self._size)) for end in ends]
        return np.stack(thin) <= total

    def _open(self, slot: int = -1) -> np.ndarray:
        """(m,) values of pairs that no plane hides, or none but that in a slot."""
        hidden = self._hides.any(axis=0) if slot < 0 else np.delete(self._hides, slot, axis=0).any(axis=0)
        return np.where(hidden, 0.0, self._value)

    def _heights(self, slot: int) -> np.ndarray:
        """(m,) heights of receivers above the planes in a slot [m]; far above where there is none."""
        height = heights(self.plane[slot], self._place, self._owner)
        return np.where((self.code[slot] < 0).take(self._owner), np.inf, height)


def heights(
    plane: np.ndarray, place: np.ndarray, planes: np.ndarray | None = None, places: np.ndarray | None = None
) -> np.ndarray:
    """Heights of points above planes.

    Parameters
    ----------
    plane : (n, 4) float64 ndarray
        Unit normals and distances [m].
    place : (m, 3) float64 ndarray
        Points [m].
    planes, places : (k,) int64 ndarray, optional
        Rows of both that belong together; all in their order when left out.

    Returns
    -------
    (k,) float64 ndarray
        Along the normal [m].
    """
    columns = (_column(plane, axis, planes) for axis in range(3))
    return sum(column * _column(place, axis, places) for axis, column in enumerate(columns)) - _column(plane, 3, planes)


def _column(table: np.ndarray, number: int, rows: np.ndarray | None) -> np.ndarray:
    """(k,) some rows of a column: read from a copy, as every line of memory that a table's rows share holds others."""
    return table[:, number] if rows is None else np.ascontiguousarray(table[:, number]).take(rows)


def _combine(point: np.ndarray, owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(candidate, pair) of every candidate with each pair of its data point."""
    first = np.searchsorted(owner, np.arange(count + 1))
    return np.repeat(np.arange(len(point)), np.diff(first)[point]), ranges(first, point)[0]


def ranges(first: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Enumerate what belongs to each of some rows.

    Parameters
    ----------
    first : (n + 1,) int64 ndarray
        Row i owns the numbers from first[i] to first[i + 1].
    rows : (m,) int64 ndarray
        Which rows.

    Returns
    -------
    number : (k,) int64 ndarray
        Those of the first row, then those of the second, ...
    count : (m,) int64 ndarray
        How many each has.
    """
    count = first[rows + 1] - first[rows]
    return np.repeat(first[rows] - np.cumsum(count) + count, count) + np.arange(count.sum()), count
