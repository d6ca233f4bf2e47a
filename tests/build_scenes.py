"""Small scenes made of plain arrays, for tests that know the right answer."""

from __future__ import annotations

import numpy as np
from gi_volumes.bake.snapshot import Geometry, LightKind, Lights, Material, Snapshot

BOX_FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
"""Quads of a box whose corner k has coordinates (k & 1, k >> 1 & 1, k >> 2 & 1), seen from outside."""


def quad(a, b, c, d) -> np.ndarray:
    """(2, 3, 3) triangles of a quad, counter-clockwise from its front."""
    return np.array([[a, b, c], [a, c, d]], float)


def box(low, high, inward: bool = False) -> np.ndarray:
    """(12, 3, 3) triangles of a box with outward, or inward, faces."""
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) * (np.array(high) - low) + low
    triangles = np.concatenate([quad(*corners[face]) for face in BOX_FACES])
    return triangles[:, ::-1] if inward else triangles


def plane(half: float, z: float = 0.0) -> np.ndarray:
    """(2, 3, 3) triangles of a horizontal square that faces up."""
    return quad((-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z))


def lamps(*rows: dict) -> Lights:
    """Lamps from dictionaries; what a row leaves out gets a harmless value."""
    count = len(rows)
    frames = [row.get("frame", np.eye(3)) for row in rows]
    return Lights(
        kind=np.array([row.get("kind", LightKind.POINT) for row in rows], np.uint8),
        position=np.array([row.get("position", (0, 0, 0)) for row in rows], np.float64).reshape(count, 3),
        frame=np.array(frames, np.float32).reshape(count, 3, 3),
        strength=np.array([row.get("strength", (1, 1, 1)) for row in rows], np.float32).reshape(count, 3),
        size=np.array([row.get("size", (0, 0)) for row in rows], np.float32).reshape(count, 2),
        spot=np.array([row.get("spot", (-1, 0)) for row in rows], np.float32).reshape(count, 2),
        reflector=np.array([row.get("reflector", False) for row in rows], bool),
        shadow=np.array([row.get("shadow", True) for row in rows], bool),
        names=tuple(row.get("name", f"lamp {i}") for i, row in enumerate(rows)),
    )


def sun_frame(toward) -> np.ndarray:
    """(3, 3) rotation whose z axis points to the sun."""
    z = np.array(toward, float) / np.linalg.norm(toward)
    x = np.cross([0.3, 0.9, 0.2], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def snapshot(
    parts: list[tuple[np.ndarray, Material]],
    lights: Lights | None = None,
    sky=(0.0, 0.0, 0.0),
    origin=(0.0, 0.0, 0.0),
    uvs: np.ndarray | None = None,
    images: tuple = (),
) -> Snapshot:
    """One mesh, one instance; `parts` are triangles with their material."""
    corners = np.concatenate([triangles for triangles, _ in parts]) if parts else np.zeros((0, 3, 3))
    count = len(corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    material = np.concatenate([np.full(len(t), i) for i, (t, _) in enumerate(parts)]) if parts else np.zeros(0)
    transform = np.eye(3, 4)
    transform[:, 3] = origin
    geometry = Geometry(
        positions=corners.reshape(-1, 3).astype(np.float32),
        triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        corner_normals=np.repeat(normal[:, None], 3, axis=1).astype(np.float32),
        corner_uvs=np.zeros((0, 3, 2), np.float32) if uvs is None else uvs.astype(np.float32),
        corner_colors=np.zeros((0, 3, 4), np.float32),
        materials=material.astype(np.int32),
        mesh_first_triangle=np.array([0, count], np.int64),
        instance_mesh=np.zeros(1, np.int32),
        instance_transform=transform[None],
        instance_names=("thing",),
    )
    sky = np.asarray(sky, np.float32)
    return Snapshot(
        origin=np.array(origin, np.float64),
        geometry=geometry,
        materials=tuple(material for _, material in parts),
        images=images,
        lights=lamps() if lights is None else lights,
        sky=sky.reshape(1, 1, 3) if sky.ndim == 1 else sky,
    )
