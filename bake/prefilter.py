"""Blurs octahedral maps by the GGX lobe, level by level, by matrices that integrate over all texels.

Comes in: maps of radiance. Goes out: their mip levels; see `tree/ggx.py` for the lobe and each level's roughness.
Row i of a level's matrix holds the lobe about the centre of texel i, integrated over each texel of the map. The map is
symmetric to three planes of the octahedron, x = 0, y = 0, x = y, so the rows of an eighth of it stand for all: they are
applied to the map's eight mirror images at once. No sampling, no noise; only the light within a texel is even.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tree import ggx, octahedral
from ..tree.probe_atlas import Layout

__all__ = ["Prefilter", "prefilter"]

PARTS = 2
"""Texels are cut into this many parts along either axis, where the lobe is evaluated: see `docs/accuracy.md`."""

BLOCK = 1 << 22
"""Numbers of a block of rows while a matrix is made: 32 MB."""

ROWS, TERMS = 64, 256
"""Rows and columns of a block of a matrix, which is multiplied by 8 columns: 2^17 products. OpenBLAS starts threads for
more than 2^18, and these change the last bits of sums."""

BALANCING = 20
"""Rounds that make rows and columns sum to one; about ten reach rounding."""


@dataclass(frozen=True, eq=False)
class Level:
    """One level's blur.

    roughness : what it shows
    size : texels along an edge of its maps
    matrix : (a, b, TERMS, ROWS) float32, block (a, b), transposed, of the rows, for texels of an eighth of the map, and
        columns, for texels of the first level, both filled up with zeros; rows sum to 1
    target : (8, rows) int64, texel that each row gives of each mirror image
    """

    roughness: float
    size: int
    matrix: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Prefilter:
    """What makes mip levels of maps of one size.

    Parameters
    ----------
    size : int
        Texels along an edge of the first level, without border.
    mirrored : (8, size * size) int64
        Texels in the order of each mirror image.
    levels : tuple of Level
        All but the first, which is the map itself.
    """

    size: int
    mirrored: np.ndarray
    levels: tuple[Level, ...]

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        """Make a map's mip levels.

        Parameters
        ----------
        image : (size, size, channels) float32 ndarray
            Radiance, or anything else that is mixed linearly.

        Returns
        -------
        list of (size_l, size_l, channels) float32 ndarray
            The map itself, then blurred more and more.

        Raises
        ------
        ValueError
            The map has another size.

        Notes
        -----
        Error: a constant stays constant, and the integral over the sphere what it is, to float32 rounding, about 1e-6;
        against the exact lobe see `docs/accuracy.md`. The result depends on this map alone.
        """
        if image.ndim != 3 or image.shape[:2] != (self.size, self.size):
            raise ValueError(f"a map of shape {image.shape}; this blurs ({self.size}, {self.size}, channels)")
        image = image.astype(np.float32)
        images = _filled(image.reshape(-1, image.shape[2]).T[:, self.mirrored], (1, 1, TERMS))
        images = np.ascontiguousarray(images.reshape(*images.shape[:2], -1, TERMS).transpose(0, 2, 1, 3))
        return [image, *(_blurred(level, images) for level in self.levels)]


def _blurred(level: Level, images: np.ndarray) -> np.ndarray:
    """(size, size, channels) one level, of (channels, b, 8, TERMS) mirror images."""
    out = np.empty((level.size**2, len(images)), np.float32)
    for channel, image in enumerate(images):
        rows = np.matmul(image, level.matrix).sum(axis=1).transpose(1, 0, 2).reshape(8, -1)
        out[level.target, channel] = rows[:, : level.target.shape[1]]
    return out.reshape(level.size, level.size, -1)


def prefilter(layout: Layout) -> Prefilter:
    """Make the matrices for the maps of an atlas.

    Parameters
    ----------
    layout : Layout
        Sizes of its levels.

    Returns
    -------
    Prefilter
        About 50 MB and 2 s at a pitch of 128; both grow with its fourth power.

    Notes
    -----
    Rows and columns are balanced (Sinkhorn and Knopp 1967): constants stay constant, and no texel's light is lost or
    counted twice, whatever the lattice of centres does to a lobe.
    """
    size, levels = layout.sizes[0], ggx.ladder(layout.sizes)
    mirrored = _mirrored(size)
    found = [_level(size, mirrored, out, rough) for out, rough in zip(layout.sizes[1:], levels[1:], strict=True)]
    return Prefilter(size, mirrored, tuple(found))


def _level(size: int, mirrored: np.ndarray, out: int, roughness: float) -> Level:
    """The matrix of one level."""
    rows = _eighth(out)
    matrix = _integrated(octahedral.centers(out).reshape(-1, 3)[rows], size, roughness)
    target = _mirrored(out)[:, rows]
    times = np.bincount(target.reshape(-1), minlength=out * out)[rows]
    area = octahedral.solid_angles(out).reshape(-1)[rows] / times
    _balance(matrix, area, octahedral.solid_angles(size).reshape(-1), mirrored)
    matrix = _filled(matrix.astype(np.float32), (ROWS, TERMS))
    blocks = matrix.reshape(len(matrix) // ROWS, ROWS, -1, TERMS).transpose(0, 2, 3, 1)
    return Level(float(roughness), out, np.ascontiguousarray(blocks), target)


def _filled(array: np.ndarray, multiple: tuple[int, ...]) -> np.ndarray:
    """An array with zeros at the ends of its axes, so that their lengths are multiples."""
    return np.pad(array, [(0, -length % step) for length, step in zip(array.shape, multiple, strict=True)])


def _integrated(center: np.ndarray, size: int, roughness: float) -> np.ndarray:
    """(rows, size * size) integrals of the lobe about each centre over each texel."""
    part = octahedral.centers(PARTS * size).reshape(-1, 3).T
    area = octahedral.solid_angles(PARTS * size)
    matrix = np.empty((len(center), size * size))
    step = max(1, BLOCK // part.shape[1])
    for first in range(0, len(center), step):
        lobe = ggx.density(center[first : first + step] @ part, roughness).reshape(-1, *area.shape) * area
        parts = lobe.reshape(-1, size, PARTS, size, PARTS)
        matrix[first : first + step] = parts.sum(axis=(2, 4)).reshape(len(parts), -1)
    return matrix


def _balance(matrix: np.ndarray, area: np.ndarray, wanted: np.ndarray, mirrored: np.ndarray) -> None:
    """Scale rows to a sum of 1, and columns so that all rows' areas together give each texel its own, in turn.

    `area` is that of a row's texel, divided by how often the row gives it.
    """
    for _ in range(BALANCING):
        given = area @ matrix
        given = given[mirrored].sum(axis=0)
        matrix *= wanted / given
        matrix /= matrix.sum(axis=1, keepdims=True)


def _eighth(size: int) -> np.ndarray:
    """(rows,) texels with 0 < y <= x."""
    column, row = np.meshgrid(np.arange(size), np.arange(size), indexing="xy")
    return np.flatnonzero(((column >= row) & (row >= size // 2)).reshape(-1))


def _mirrored(size: int) -> np.ndarray:
    """(8, size * size) texels of the map's mirror images, in the order of the map."""
    texel = np.arange(size * size).reshape(size, size)
    images = [turned[::y, ::x] for turned in (texel, texel.T) for y in (1, -1) for x in (1, -1)]
    return np.stack([image.reshape(-1) for image in images])
