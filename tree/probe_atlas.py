"""Where probes lie in the atlas, and how they are looked up: many octahedral maps with mip levels in one texture.

Comes in: maps of each level. Goes out: atlas levels, and what a look-up finds there. Each probe owns a square tile.
Tiles of level l are pitch / 2**l texels wide, so that atlas levels are ordinary mip levels, and always have a border of
one texel: the map itself is two texels smaller. No level of a map nests in another, which doesn't matter, because each
is filtered from the first; but u, v are not the same texture coordinates on two levels.

    pitch      128  64  32  16   8      tile (row, column) of level l begins at texel (row, column) * pitch / 2**l
    the map    126  62  30  14   6      its map one texel further right and up
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from . import octahedral

__all__ = ["BORDER", "SMALLEST_PITCH", "Layout", "fetch", "fetch_between", "put"]

BORDER = 1
"""Texels around each map, on every level: what bilinear look-ups reach."""

SMALLEST_PITCH = 8
"""Pitch of the last level: 6 x 6 texels show what the widest lobe, a cosine, leaves to see."""


@dataclass(frozen=True)
class Layout:
    """Sizes of an atlas.

    Parameters
    ----------
    pitch : int
        Width of a tile of the first level, a power of two [texels].
    columns, rows : int
        Tiles along either axis; probe k lies in column k % columns of row k // columns.

    Raises
    ------
    ValueError
        The pitch is no power of two, or below `SMALLEST_PITCH`; there is no tile.
    """

    pitch: int
    columns: int
    rows: int

    def __post_init__(self):
        if self.pitch < SMALLEST_PITCH or self.pitch & (self.pitch - 1):
            raise ValueError(f"a pitch of {self.pitch} texels; use a power of two from {SMALLEST_PITCH} on")
        if self.columns < 1 or self.rows < 1:
            raise ValueError(f"an atlas of {self.columns} x {self.rows} tiles; it needs one at least")

    @classmethod
    def of(cls, count: int, pitch: int) -> Layout:
        """Lay out probes in as square an atlas as holds them.

        Parameters
        ----------
        count : int
            Probes; for none there is one tile.
        pitch : int
            Width of a tile [texels].

        Returns
        -------
        Layout
            With fewer than one row too many.
        """
        columns = max(1, math.isqrt(max(count - 1, 0)) + 1)
        return cls(pitch, columns, max(1, -(-count // columns)))

    @property
    def levels(self) -> int:
        """Mip levels; tiles of the last one are `SMALLEST_PITCH` wide."""
        return self.pitch.bit_length() - SMALLEST_PITCH.bit_length() + 1

    @property
    def sizes(self) -> tuple[int, ...]:
        """Texels along an edge of the map itself, by level."""
        return tuple((self.pitch >> level) - 2 * BORDER for level in range(self.levels))

    @property
    def texels(self) -> int:
        """Texels of one probe on all levels, borders included."""
        return sum((self.pitch >> level) ** 2 for level in range(self.levels))

    def shape(self, level: int) -> tuple[int, int]:
        """Size of an atlas level.

        Parameters
        ----------
        level : int
            0 is the finest one.

        Returns
        -------
        (2,) int
            Rows and columns of texels.
        """
        return self.rows * (self.pitch >> level), self.columns * (self.pitch >> level)

    def corner(self, probe: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Find tiles.

        Parameters
        ----------
        probe : (n,) int64 ndarray
            Numbers of probes.
        level : int
            Mip level.

        Returns
        -------
        row, column : (n,) int64 ndarray
            First texel of each tile, a corner of its border.

        Raises
        ------
        IndexError
            There is no such tile.
        """
        probe = np.asarray(probe)
        if len(probe) and not (probe.min() >= 0 and probe.max() < self.columns * self.rows):
            raise IndexError(f"probes {probe.min()} to {probe.max()}; the atlas has {self.columns * self.rows} tiles")
        pitch = self.pitch >> level
        return probe // self.columns * pitch, probe % self.columns * pitch


def put(atlas: np.ndarray, layout: Layout, level: int, probe: int, image: np.ndarray) -> None:
    """Write a probe's map and its border into an atlas level.

    Parameters
    ----------
    atlas : (rows, columns, channels) ndarray
        The level; changed in place.
    layout : Layout
        Where tiles lie.
    level : int
        Mip level.
    probe : int
        Number of the probe.
    image : (size, size, channels) ndarray
        Its map.

    Raises
    ------
    ValueError
        The map is not of the level's size.
    IndexError
        There is no such tile.
    """
    if image.shape[:2] != (layout.sizes[level],) * 2:
        raise ValueError(f"a map of {image.shape[:2]} texels on level {level}, whose maps have {layout.sizes[level]}")
    (row,), (column,) = layout.corner(np.array([probe]), level)
    pitch = layout.pitch >> level
    atlas[row : row + pitch, column : column + pitch] = octahedral.add_border(image)


def fetch(atlas: np.ndarray, layout: Layout, level: int, probe: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Look up directions on one level, bilinearly.

    Parameters
    ----------
    atlas : (rows, columns, channels) ndarray
        The level.
    layout : Layout
        Where tiles lie.
    level : int
        Mip level.
    probe : (n,) int64 ndarray
        Numbers of probes.
    direction : (n, 3) ndarray
        Vectors of any length.

    Returns
    -------
    (n, channels) ndarray
        Continuous in the direction; of a constant map exactly its value. Of half-precision texels float32.

    Raises
    ------
    IndexError
        There is no such tile.

    Notes
    -----
    Reads the tile's own texels alone: the map's half texel and its border make each square of four complete.
    """
    row, column = layout.corner(probe, level)
    size, pitch = layout.sizes[level], layout.pitch >> level
    place = octahedral.encode(direction) * size + np.float32(BORDER - 0.5)
    base = np.clip(np.floor(place).astype(np.int64), 0, pitch - 2)
    kind = np.result_type(atlas.dtype, np.float32)
    u, v = np.moveaxis(place - base, -1, 0)[..., None].astype(kind)
    column, row = column + base[:, 0], row + base[:, 1]
    a, b, c, d = (atlas[row + y, column + x].astype(kind) for y in (0, 1) for x in (0, 1))
    return _mix(_mix(a, b, u), _mix(c, d, u), v)


def fetch_between(
    levels: tuple[np.ndarray, ...], layout: Layout, level: np.ndarray, probe: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Look up directions on the two levels around a number, mixed by its fraction.

    Parameters
    ----------
    levels : tuple of (rows_l, columns_l, channels) ndarray
        Of the atlas.
    layout : Layout
        Where tiles lie.
    level : (n,) float ndarray
        0 to the number of levels less 1.
    probe : (n,) int64 ndarray
        Numbers of probes.
    direction : (n, 3) ndarray
        Vectors of any length.

    Returns
    -------
    (n, channels) float32 ndarray
        Continuous in level and direction.

    Raises
    ------
    IndexError
        There is no such tile.
    """
    below = np.floor(level).astype(np.int64)
    part = (level - below).astype(np.float32)[:, None]
    found = np.zeros((len(probe), levels[0].shape[2]), np.float32)
    for number, atlas in enumerate(levels):
        for is_meant, share in ((below == number, 1 - part), (below == number - 1, part)):
            some = np.flatnonzero(is_meant & (share[:, 0] > 0))
            if len(some):
                found[some] += share[some] * fetch(atlas, layout, number, probe[some], direction[some])
    return found


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Interpolate so that equal ends give exactly that value."""
    return a + t * (b - a)
