"""Closed solids as arrays: walls with openings, arcades, turned columns, and cards for leaves.

Comes in: sizes in metres. Goes out: a `Solid` in its own coordinates. Faces are counter-clockwise seen from
outside, and neighbours share vertices, so that every solid but the cards is watertight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FRONT, BACK, EDGE = 0, 1, 2
"""Material slots of a flat solid: its face towards -y (top, for a slab), the opposite one, and the rest."""

Opening = tuple[float, float, float, float]


@dataclass(frozen=True)
class Solid:
    """A mesh of polygons.

    Parameters
    ----------
    vertices : (v, 3) float64 [m]
        Corners.
    faces : list of (k,) int64
        Rows of `vertices`, k may differ.
    slots : (f,) int64
        Material slot of each face.
    uvs : (c, 2) float64 or None
        One for each corner of each face, where a texture is used.
    """

    vertices: np.ndarray
    faces: list[np.ndarray]
    slots: np.ndarray
    uvs: np.ndarray | None = None


def wall(length: float, height: float, depth: float, openings: Sequence[Opening] = ()) -> Solid:
    """Make an upright wall with rectangular openings.

    Parameters
    ----------
    length : float [m]
        Along x, from 0.
    height : float [m]
        Along z, from 0.
    depth : float [m]
        Along y, centred.
    openings : sequence of (x0, x1, z0, z1) [m]
        May touch the wall's border.

    Returns
    -------
    Solid
        Slots `FRONT`, `BACK` and `EDGE`.
    """
    holes = np.array([(0, length, 0, height), *openings], float)
    x, z = np.unique(holes[:, :2]), np.unique(holes[:, 2:])
    middle_x, middle_z = (x[1:] + x[:-1]) / 2, (z[1:] + z[:-1]) / 2
    filled = np.ones((len(middle_x), len(middle_z)), bool)
    for x0, x1, z0, z1 in openings:
        filled &= ~np.outer((middle_x > x0) & (middle_x < x1), (middle_z > z0) & (middle_z < z1))
    return _grid_solid(x, z, filled, depth)


def slab(low: Sequence[float], high: Sequence[float], holes: Sequence[Opening] = ()) -> Solid:
    """Make a horizontal slab with rectangular holes.

    Parameters
    ----------
    low, high : (3,) [m]
        Corners of its bounding box.
    holes : sequence of (x0, x1, y0, y1) [m]
        Through its whole thickness.

    Returns
    -------
    Solid
        Slot `FRONT` is the top.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    size = high - low
    moved = [(x0 - low[0], x1 - low[0], y0 - low[1], y1 - low[1]) for x0, x1, y0, y1 in holes]
    upright = wall(size[0], size[1], size[2], moved)
    x, y, z = upright.vertices.T
    lying = np.stack([x, z, size[2] / 2 - y], axis=1) + low
    return Solid(lying, upright.faces, upright.slots)


def box(low: Sequence[float], high: Sequence[float]) -> Solid:
    """Make a box of one material.

    Parameters
    ----------
    low, high : (3,) [m]
        Opposite corners.

    Returns
    -------
    Solid
        All faces in slot 0.
    """
    plain = slab(low, high)
    return Solid(plain.vertices, plain.faces, np.zeros_like(plain.slots))


def arcade(length: float, bays: int, radius: float, height: float, depth: float, segments: int = 16) -> Solid:
    """Make the wall above a row of columns: semicircular arches that spring from z = 0.

    Parameters
    ----------
    length : float [m]
        Along x, from 0.
    bays : int
        Arches.
    radius : float [m]
        Of an arch; less than half a bay.
    height : float [m]
        Of the wall, above the springing.
    depth : float [m]
        Along y, centred.
    segments : int
        Faces of one arch.

    Returns
    -------
    Solid
        Slots `FRONT`, `BACK` and `EDGE`; the soffits are edges.
    """
    angle = np.linspace(np.pi, 0, segments + 1)
    centres = (np.arange(bays) + 0.5) * length / bays
    x = np.concatenate([[0.0], (centres[:, None] + radius * np.cos(angle)).ravel(), [length]])
    low = np.concatenate([[0.0], np.tile(radius * np.sin(angle), bays), [0.0]])
    bottom, top = np.stack([x, low], axis=1), np.stack([x, np.full_like(x, height)], axis=1)
    return _strip_solid(bottom, top, depth)


def turned(profile: Sequence[tuple[float, float]], segments: int = 24) -> Solid:
    """Make a solid of revolution about z.

    Parameters
    ----------
    profile : sequence of (radius, z) [m]
        From bottom to top; radii above 0.
    segments : int
        Around the axis.

    Returns
    -------
    Solid
        All faces in slot 0.
    """
    radius, z = np.array(profile, float).T
    angle = np.arange(segments) * 2 * np.pi / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(z[:, None, None], (len(z), segments, 1))], 2
    )
    here = np.arange(segments)
    along = (here + 1) % segments
    low = np.arange(len(z) - 1)[:, None] * segments
    sides = np.stack([low + here, low + along, low + segments + along, low + segments + here], axis=2).reshape(-1, 4)
    faces = [*sides, here[::-1], (len(z) - 1) * segments + here]
    return Solid(vertices.reshape(-1, 3), faces, np.zeros(len(faces), np.int64))


def cards(centres: np.ndarray, size: float, seed: int) -> Solid:
    """Make square, open cards in all directions, each with the whole texture.

    Parameters
    ----------
    centres : (n, 3) [m]
        Their middles.
    size : float [m]
        Edge.
    seed : int
        Of their directions.

    Returns
    -------
    Solid
        With UVs; it encloses nothing.
    """
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(centres), 3, 3)))[0]
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2
    vertices = np.asarray(centres)[:, None] + np.einsum("ck,nka->nca", corner, axes[:, :2])
    faces = list(np.arange(4 * len(centres)).reshape(-1, 4))
    return Solid(
        vertices.reshape(-1, 3), faces, np.zeros(len(faces), np.int64), np.tile(corner / size + 0.5, (len(centres), 1))
    )


def signed_volume(triangles: np.ndarray) -> float:
    """Volume inside closed triangles: positive if they face outwards.

    Parameters
    ----------
    triangles : (t, 3, 3) float64 [m]
        Corners.

    Returns
    -------
    float [m3]
    """
    a, b, c = np.moveaxis(triangles - triangles.reshape(-1, 3).mean(axis=0), 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


def _grid_solid(x: np.ndarray, z: np.ndarray, filled: np.ndarray, depth: float) -> Solid:
    """Extrude the filled cells of a grid; faces between two filled cells are left out."""
    nx, nz = len(x), len(z)
    grid = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    sheets = [np.stack([grid[:, 0], np.full(len(grid), y), grid[:, 1]], axis=1) for y in (-depth / 2, depth / 2)]
    index = np.arange(nx * nz).reshape(nx, nz)
    cell = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)[filled]
    frame = np.pad(filled, 1).astype(int)
    across = frame[1:, 1:-1] - frame[:-1, 1:-1]
    upwards = frame[1:-1, 1:] - frame[1:-1, :-1]
    edges = [
        _ribs(index[:, :-1], index[:, 1:], across == -1),
        _ribs(index[:, 1:], index[:, :-1], across == 1),
        _ribs(index[1:], index[:-1], upwards == -1),
        _ribs(index[:-1], index[1:], upwards == 1),
    ]
    return _sandwich(np.concatenate(sheets), cell, np.concatenate(edges))


def _ribs(start: np.ndarray, end: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(n, 2) outline edges of the front sheet where `wanted`, with the solid on their left seen from -y."""
    return np.stack([start[wanted], end[wanted]], axis=1)


def _strip_solid(bottom: np.ndarray, top: np.ndarray, depth: float) -> Solid:
    """Extrude the strip between two polylines of (x, z) that run towards +x."""
    count = len(bottom)
    outline = np.concatenate([bottom, top])
    sheets = [np.stack([outline[:, 0], np.full(2 * count, y), outline[:, 1]], axis=1) for y in (-depth / 2, depth / 2)]
    here = np.arange(count - 1)
    cell = np.stack([here, here + 1, count + here + 1, count + here], axis=1)
    rim = np.concatenate([np.arange(count), count + np.arange(count)[::-1]])
    return _sandwich(np.concatenate(sheets), cell, np.stack([rim, np.roll(rim, -1)], axis=1))


def _sandwich(vertices: np.ndarray, cell: np.ndarray, rim: np.ndarray) -> Solid:
    """Close two equal sheets of quads, the front one first, along the rim of the front one."""
    second = len(vertices) // 2
    sides = np.stack([rim[:, 1], rim[:, 0], rim[:, 0] + second, rim[:, 1] + second], axis=1)
    quads = np.concatenate([cell, cell[:, ::-1] + second, sides])
    slots = np.repeat([FRONT, BACK, EDGE], [len(cell), len(cell), len(sides)])
    used, faces = np.unique(quads, return_inverse=True)
    return Solid(vertices[used], list(faces.reshape(-1, 4)), slots)
