"""Pairs of a triangle and a voxel that it overlaps, touching included.

Comes in: triangles, boxes of candidate voxels. Goes out: the pairs that overlap. Pairs go from coarse to fine: the
parts of a pair's voxel are tested only against its own triangle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from . import boxes
from .need import Surfaces

__all__ = ["in_boxes", "split", "voxels_in"]

CHUNK = 1 << 18
"""Pairs tested at a time: about 100 MB of temporaries."""


def voxels_in(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """List the voxels of many boxes in chunks of bounded size.

    Parameters
    ----------
    first, last : (n, d) int64
        Voxels at the corners of each box, inclusive; a box that ends before it starts is empty.

    Yields
    ------
    item : (m,) int64
        Box of each voxel.
    coords : (m, d) int64
        Voxels.
    """
    extent = np.maximum(last - first + 1, 0)
    ends = np.cumsum(np.prod(extent, axis=1))
    total = int(ends[-1]) if len(ends) else 0
    for start in range(0, total, CHUNK):
        flat = np.arange(start, min(start + CHUNK, total))
        item = np.searchsorted(ends, flat, side="right")
        rest = flat - (ends[item] - np.prod(extent[item], axis=1))
        coords = np.empty((len(flat), first.shape[1]), np.int64)
        for axis in range(first.shape[1]):
            coords[:, axis] = first[item, axis] + rest % extent[item, axis]
            rest = rest // extent[item, axis]
        yield item, coords


def in_boxes(
    surfaces: Surfaces,
    triangle: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    size: float,
    keep: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the voxels that triangles overlap, each within a box of its own.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    triangle : (n,) int64
        Which triangle to test.
    box : two (n, 3) int64
        First and last voxel to test.
    size : float
        Size of the voxels [m].
    keep : callable, optional
        From (m,) rows and (m, 3) voxels to (m,) bool: what is worth a test.

    Returns
    -------
    row : (p,) int64
        Which of the n.
    coords : (p, 3) int64
        Voxels.
    """
    low, high = surfaces.low[triangle], surfaces.high[triangle]
    first = np.maximum(np.ceil(low / size).astype(np.int64) - 1, box[0])
    last = np.minimum(np.floor(high / size).astype(np.int64), box[1])
    found = [(np.zeros(0, np.int64), np.zeros((0, 3), np.int64))]
    for row, coords in voxels_in(first, last):
        if keep is not None:
            worth = np.flatnonzero(keep(row, coords))
            row, coords = row[worth], coords[worth]
        hit = np.flatnonzero(_overlap(surfaces, triangle[row], coords, size))
        found.append((row[hit], coords[hit]))
    row, coords = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return row, coords


def split(
    surfaces: Surfaces,
    triangle: np.ndarray,
    coords: np.ndarray,
    size: float,
    ratio: int,
    keep: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the parts of voxels that triangles overlap.

    Parameters
    ----------
    surfaces : Surfaces
        Triangles.
    triangle : (n,) int64
        Triangle of each pair.
    coords : (n, 3) int64
        Voxel of each pair.
    size : float
        Size of the voxels [m].
    ratio : int
        Parts along each axis.
    keep : callable, optional
        As for `in_boxes`.

    Returns
    -------
    row : (p,) int64
        Which of the n.
    coords : (p, 3) int64
        Parts: voxels of `size / ratio`.
    """
    return in_boxes(surfaces, triangle, (coords * ratio, coords * ratio + ratio - 1), size / ratio, keep)


def _overlap(surfaces: Surfaces, triangle: np.ndarray, coords: np.ndarray, size: float) -> np.ndarray:
    """Whether each triangle overlaps its voxel; one that lies inside needs no test of axes."""
    low, high = surfaces.low[triangle], surfaces.high[triangle]
    x, y, z = ((low >= coords * size) & (high <= (coords + 1) * size)).T
    result = x & y & z
    rest = np.flatnonzero(~result)
    result[rest] = boxes.overlap(surfaces.corners[triangle[rest]], (coords[rest] + 0.5) * size, 0.5 * size)
    return result
