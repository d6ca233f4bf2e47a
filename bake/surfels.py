"""The surface cache: irradiance on small pieces of surfaces, surfels, which ends paths early.

Comes in: hits. Goes out: the surfel that each lies on, and the light that its surface sends back. A surfel is all of a
surface within one cube of a lattice that faces one way and lies in one plane, as far as it is one open piece:

    key    doublings of the cube's size | cube x, y, z | which way it faces | height of its plane in the cube

Where other surfels share the cube, walls may part it: hits belong to the surfel if they see its middle. Cubes grow with
the distance to the cell that is baked. What no surfel is known of, or what is too close to be seen as even, is left to
the path tracer: the path goes on, so nothing is lost and nothing leaks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .paths import Radiance, Vertex, Wave
from .rays import Tracer

__all__ = ["NONE", "Known", "Lattice", "Surfels", "Table", "are_crowded", "open_between", "reflected"]

NONE = -1
"""Number of a hit that lies on no surfel."""

GROWTH = 1 / 16
"""Size of cubes over their distance to the cell, where that is more than the least size."""

LIFT = np.float32(1 / 8)
"""Hits are moved so far off their surface [cubes], so that walls on the lattice lie in one row of cubes."""

FACES = 5
"""Steps of either slope of a normal; odd, so that normals along an axis lie in the middle of one."""

HEIGHTS = 8
"""Steps of a plane's height in its cube."""

REACH = 2048
"""Cubes on either side of the cell's centre that a key can hold."""

FAR, NEAR = np.float32(1), np.float32(1 / 4)
"""Rays longer than the first many cubes see a surfel as even; shorter ones look for direct light where they end, and
those shorter than the second go on from there."""

LOAD = 4
"""Slots of the table for each surfel."""

SPREAD = np.int64(0x9E3779B97F4A7C15 - (1 << 64))
"""Golden ratio times 2**64, modulo that: spreads keys over the table (Knuth, volume 3, 6.4)."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cubes around a cell.

    low, high : (3,) float32, corners of the cell [m], relative to the scene's origin
    size : least size of a cube [m]
    """

    low: np.ndarray
    high: np.ndarray
    size: float

    def keys(self, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Name the surfels that hits lie on.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Hits [m].
        normal : (3, n) float32 ndarray
            Unit normals, towards where the rays came from.

        Returns
        -------
        key : (n,) int64 ndarray
            `NONE` for hits out of reach.
        size : (n,) float32 ndarray
            Sizes of their cubes [m].
        """
        outside = np.maximum(self.low[:, None] - position, position - self.high[:, None]).max(axis=0)
        doublings = np.maximum(np.frexp(np.maximum(outside, 0) * np.float32(GROWTH / self.size))[1], 0).astype(np.int64)
        size = np.ldexp(np.float32(self.size), doublings).astype(np.float32)
        place = (position - ((self.low + self.high) / 2)[:, None]) / size + normal * LIFT
        cube = np.floor(place)
        height = (normal * (place - cube - np.float32(0.5))).sum(axis=0)
        step = np.clip(((height + 1) * np.float32(HEIGHTS / 2)).astype(np.int64), 0, HEIGHTS - 1)
        key = doublings
        for axis in range(3):
            key = key * (2 * REACH) + np.clip(cube[axis].astype(np.int64) + REACH, 0, 2 * REACH - 1)
        key = (key * (6 * FACES * FACES) + _facing(normal)) * HEIGHTS + step
        return np.where((np.abs(cube) < REACH - 1).all(axis=0), key, NONE), size


def are_crowded(keys: np.ndarray) -> np.ndarray:
    """Whether other surfels share the cubes of surfels.

    Parameters
    ----------
    keys : (n,) int64 ndarray
        Keys of all that are known, ascending.

    Returns
    -------
    (n,) bool ndarray
        Of each.
    """
    same = np.diff(keys // (6 * FACES * FACES * HEIGHTS)) == 0
    return np.append(same, False) | np.append(False, same)


def open_between(tracer: Tracer, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether nothing opaque lies between points.

    Parameters
    ----------
    tracer : Tracer
        The surfaces.
    start, end : (3, n) float32 ndarray
        Points off surfaces [m].

    Returns
    -------
    (n,) bool ndarray
        Of each pair.
    """
    return ~tracer.blocked(start, end - start, np.ones(start.shape[1], np.float32))


def _facing(normal: np.ndarray) -> np.ndarray:
    """(n,) int64 which of the 6 faces of a cube, and of its squares, a direction points to."""
    axis = np.abs(normal).argmax(axis=0)
    lanes = np.arange(normal.shape[1])
    main = normal[axis, lanes]
    code = axis * 2 + (main < 0)
    for turn in (1, 2):
        slope = normal[(axis + turn) % 3, lanes] / np.maximum(np.abs(main), np.float32(1e-30))
        code = code * FACES + np.clip(((slope + 1) * np.float32(FACES / 2)).astype(np.int64), 0, FACES - 1)
    return code


class Table:
    """Numbers of keys: open addressing, all at once.

    Parameters
    ----------
    keys : (n,) int64 ndarray
        Each once, none negative; key i gets number i.
    """

    def __init__(self, keys: np.ndarray) -> None:
        bits = max(4, int(np.ceil(np.log2(max(len(keys), 1) * LOAD))))
        self._shift, self._mask = 64 - bits, (1 << bits) - 1
        self._key, self._number = np.full(1 << bits, NONE, np.int64), np.full(1 << bits, NONE, np.int32)
        number, slot = np.arange(len(keys)), self._first(keys)
        while len(number):
            free = self._key[slot] == NONE
            _, winner = np.unique(np.where(free, slot, -1 - np.arange(len(slot))), return_index=True)
            winner = winner[free[winner]]
            self._key[slot[winner]], self._number[slot[winner]] = keys[number[winner]], number[winner]
            left = np.ones(len(number), bool)
            left[winner] = False
            number, slot = number[left], slot[left] + 1 & self._mask

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Look keys up.

        Parameters
        ----------
        keys : (n,) int64 ndarray
            Any.

        Returns
        -------
        (n,) int32 ndarray
            Their numbers, `NONE` for unknown ones.
        """
        slot = self._first(keys)
        found = self._key.take(slot)
        number = np.where(found == keys, self._number.take(slot), np.int32(NONE))
        rows = np.flatnonzero((found != keys) & (found != NONE))
        slot = slot.take(rows)
        while len(rows):
            slot = slot + 1 & self._mask
            found = self._key.take(slot)
            match = found == keys.take(rows)
            number[rows[match]] = self._number.take(slot[match])
            left = ~match & (found != NONE)
            rows, slot = rows[left], slot[left]
        return number

    def _first(self, keys: np.ndarray) -> np.ndarray:
        """(n,) int64 slots where to look first."""
        return keys * SPREAD >> self._shift & self._mask


@dataclass(frozen=True, eq=False)
class Known:
    """Surfels, and how to find them.

    lattice : Lattice
    table : Table, numbers of the surfels' keys
    middle : (3, n) float32 [m], a little above the middle of each
    crowded : (n,) bool, whether hits must see it to belong to the surfel
    uneven : (n,) bool, whether direct light has to be looked for from any distance
    tracer : Tracer
    """

    lattice: Lattice
    table: Table
    middle: np.ndarray
    crowded: np.ndarray
    uneven: np.ndarray
    tracer: Tracer

    def which(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the surfels that end paths.

        Parameters
        ----------
        position, normal : (3, n) float32 ndarray
            Where paths are [m], and unit normals towards where they came from.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].

        Returns
        -------
        number : (n,) int32 ndarray
            Their numbers, `NONE` where the path has to go on.
        near : (n,) bool ndarray
            Where direct light has to be looked for.
        """
        key, size = self.lattice.keys(position, normal)
        number = np.where(travelled > NEAR * size, self.table.find(key), np.int32(NONE))
        rows = np.flatnonzero(number >= 0)
        crowd = rows[self.crowded[number[rows]]]
        seen = open_between(self.tracer, position[:, crowd], self.middle[:, number[crowd]])
        near = travelled <= FAR * size
        near[rows] |= self.uneven[number[rows]]
        number[crowd[~seen]] = NONE
        return number, near

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        """Say for which paths direct light is still to be looked for.

        Parameters
        ----------
        position, normal : (3, n) float32 ndarray
            Where paths are [m], and unit normals towards where they came from.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].

        Returns
        -------
        (m,) int64 ndarray
            Rows of `position`.
        """
        number, near = self.which(position, normal, travelled)
        return np.flatnonzero((number < 0) | near)


@dataclass(frozen=True, eq=False)
class Surfels:
    """Light on the surfels around a cell.

    known : Known, the surfels
    light : (n, functions, 3) float32, irradiance of local light, sun keys and functions of the sky, direct light too
        [W/m2, or as the transport's unit says]
    indirect : (n, functions, 3) float32, the same less what `paths.shine` looks for
    """

    known: Known
    light: np.ndarray
    indirect: np.ndarray

    def finish(self, wave: Wave, vertex: Vertex, travelled: np.ndarray, light: Radiance) -> tuple:
        """End paths on surfels, with the light that these reflect.

        Parameters
        ----------
        wave : Wave
            Paths.
        vertex : Vertex
            Where they are.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].
        light : Radiance
            What they bring is added here.

        Returns
        -------
        left : (m,) int64 ndarray
            Rows of the paths for which direct light is still to be looked for.
        on : (k,) int64 ndarray
            Which of these go on after that.
        """
        number, near = self.known.which(vertex.position, vertex.normal, travelled)
        for rows, source in ((number >= 0) & ~near, self.light), ((number >= 0) & near, self.indirect):
            rows = np.flatnonzero(rows)
            if len(rows):
                _add(light, wave.lane[rows], reflected(wave, vertex, rows), source.take(number[rows], axis=0))
        left = np.flatnonzero((number < 0) | near)
        return left, np.flatnonzero(number[left] < 0)

    def leaves(self, position: np.ndarray, normal: np.ndarray, travelled: np.ndarray) -> np.ndarray:
        """Say for which paths direct light is still to be looked for, as `Known.leaves`.

        Parameters
        ----------
        position, normal : (3, n) float32 ndarray
            Where paths are [m], and unit normals towards where they came from.
        travelled : (n,) float32 ndarray
            Length of their last leg [m].

        Returns
        -------
        (m,) int64 ndarray
            Rows of `position`.
        """
        return self.known.leaves(position, normal, travelled)


def _add(light: Radiance, lane: np.ndarray, factor: np.ndarray, found: np.ndarray) -> None:
    """Add (n, functions, 3) irradiance times (3, n) factors to lanes, each of which occurs once."""
    suns = len(light.sun)
    light.local[:, lane] += factor * found[:, 0].T
    for function in range(1, found.shape[1]):
        target = light.sun[function - 1] if function <= suns else light.sky[function - 1 - suns]
        target[:, lane] += factor * found[:, function].T


def reflected(wave: Wave, vertex: Vertex, rows: np.ndarray) -> np.ndarray:
    """What of a surfel's irradiance paths bring back.

    Parameters
    ----------
    wave, vertex : Wave, Vertex
        Paths and where they are.
    rows : (m,) int64 ndarray
        Which of them.

    Returns
    -------
    (3, m) float32 ndarray
        [1/sr].
    """
    return wave.beta[:, rows] * vertex.reflectance[:, rows] * np.float32(1 / np.pi)
