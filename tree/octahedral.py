"""Octahedral maps: all directions on one square, without poles and with little distortion.

Comes in: unit vectors, or points of the square. Goes out: the other of the two; directions and solid angles of texels;
maps with a border. The upper half of the octahedron |x| + |y| + |z| = 1 is the square's inner diamond, seen from
above; the lower half's faces are folded out to its four corners, which all show -z. Beyond an edge the map goes on at
the same edge, mirrored about its middle:

    v   +---+---+    texel (row, column) of n x n has its centre at u = (column + 1/2) / n, v = (row + 1/2) / n;
    ^   | /   \\ |    outside of column 0 lies column 0 of row n - 1 - row, beyond a corner the opposite corner
    |   +   +   +    +z is the middle, +x lies to the right of it, +y above
    |   | \\   / |    a border of one texel all around therefore makes bilinear look-ups seamless
    +-> +---+---+ u
"""

from __future__ import annotations

import numpy as np

__all__ = ["add_border", "centers", "decode", "encode", "solid_angles"]

TINY = 1e-30
"""Least sum of a vector's components; below it a direction is +z."""


def encode(direction: np.ndarray) -> np.ndarray:
    """Map directions to the unit square.

    Parameters
    ----------
    direction : (..., 3) float ndarray
        Vectors of any length; the zero vector counts as +z.

    Returns
    -------
    (..., 2) ndarray
        u, v in [0, 1], float32 of float32, else float64.

    Notes
    -----
    Error: with `decode` at most 12 * 2**-24 in float32, as a chord; `test_directions_survive_the_round_trip`.
    Source: Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors".

    Examples
    --------
    >>> encode([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    array([[0.5, 0.5],
           [1. , 0.5]])
    """
    x, y, z = np.moveaxis(_floating(direction), -1, 0)
    total = np.maximum(np.abs(x) + np.abs(y) + np.abs(z), x.dtype.type(TINY))
    u, v = x / total, y / total
    below = z < 0
    folded_u, folded_v = _signed(1 - np.abs(v), u), _signed(1 - np.abs(u), v)
    return np.stack([np.where(below, folded_u, u), np.where(below, folded_v, v)], axis=-1) * u.dtype.type(0.5) + (
        u.dtype.type(0.5)
    )


def decode(uv: np.ndarray) -> np.ndarray:
    """Map points of the unit square to directions.

    Parameters
    ----------
    uv : (..., 2) float ndarray
        Points in [0, 1].

    Returns
    -------
    (..., 3) ndarray
        Unit vectors, float32 of float32, else float64.

    Notes
    -----
    Source: as of `encode`.

    Examples
    --------
    >>> decode([[0.5, 0.5], [1.0, 0.5]])
    array([[0., 0., 1.],
           [1., 0., 0.]])
    """
    point = _on_octahedron(uv)
    return point / np.sqrt((point * point).sum(axis=-1, keepdims=True))


def centers(size: int) -> np.ndarray:
    """Directions of texel centres.

    Parameters
    ----------
    size : int
        Texels along an edge of the map, without border.

    Returns
    -------
    (size, size, 3) float64 ndarray
        Unit vectors by row and column.

    Raises
    ------
    ValueError
        The size is odd, or below 2.
    """
    _check(size)
    step = (np.arange(size) + 0.5) / size
    return decode(np.stack(np.meshgrid(step, step, indexing="xy"), axis=-1))


def solid_angles(size: int) -> np.ndarray:
    """Solid angles of texels: exact, as texels are spherical triangles and quadrangles.

    Parameters
    ----------
    size : int
        Texels along an edge of the map, without border.

    Returns
    -------
    (size, size) float64 ndarray
        Steradians by row and column; their sum is 4 pi.

    Raises
    ------
    ValueError
        The size is odd, or below 2.

    Notes
    -----
    Texels that the fold runs through are cut along it; the edges of the pieces are parts of great circles.
    Source: Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle", equation 8.
    """
    _check(size)
    step = np.arange(size // 2 + 1) / size + 0.5
    corner = _on_octahedron(np.stack(np.meshgrid(step, step, indexing="xy"), axis=-1))
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    quadrant = _solid_angle(a, b, c) + _solid_angle(b, d, c)
    half = np.concatenate([quadrant[::-1], quadrant])
    return np.concatenate([half[:, ::-1], half], axis=1)


def add_border(image: np.ndarray) -> np.ndarray:
    """Surround maps with the texels that lie beyond their edges.

    Parameters
    ----------
    image : (size, size, ...) ndarray
        A map by row and column.

    Returns
    -------
    (size + 2, size + 2, ...) ndarray
        Bilinear look-ups anywhere in the inner square are continuous on the sphere.

    Raises
    ------
    ValueError
        The map is not square.
    """
    if image.ndim < 2 or image.shape[0] != image.shape[1]:
        raise ValueError(f"an octahedral map is square; this one has the shape {image.shape}")
    sides = np.concatenate([image[::-1, :1], image, image[::-1, -1:]], axis=1)
    return np.concatenate([sides[:1, ::-1], sides, sides[-1:, ::-1]])


def _floating(values: np.ndarray) -> np.ndarray:
    """Single precision stays what it is; all else becomes double."""
    values = np.asarray(values)
    return values if values.dtype == np.float32 else values.astype(np.float64)


def _check(size: int) -> None:
    """The axes must lie between texels, or a texel would have parts on four faces."""
    if size < 2 or size % 2:
        raise ValueError(f"an octahedral map of {size} texels along an edge; use an even number")


def _signed(magnitude: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Magnitudes with another number's sign; zero counts as positive, as in the shader."""
    return np.where(like >= 0, magnitude, -magnitude)


def _on_octahedron(uv: np.ndarray) -> np.ndarray:
    """(..., 3) points |x| + |y| + |z| = 1 of points of the square."""
    u, v = np.moveaxis(_floating(uv) * 2 - 1, -1, 0)
    z = 1 - np.abs(u) - np.abs(v)
    beyond = np.maximum(-z, 0)
    return np.stack([u - _signed(beyond, u), v - _signed(beyond, v), z], axis=-1)


def _solid_angle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(...) solid angles of triangles seen from the origin [sr]."""
    la, lb, lc = (np.sqrt((p * p).sum(axis=-1)) for p in (a, b, c))
    ab, bc, ca = ((p * q).sum(axis=-1) for p, q in ((a, b), (b, c), (c, a)))
    volume = np.abs((a * np.cross(b, c)).sum(axis=-1))
    return 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
