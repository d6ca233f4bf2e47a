"""Points on the surfaces of the open Blender scene where light can arrive, chosen the same way every time.

Comes in: the evaluated scene, a seed. Goes out: points [m] and normals, spread evenly over the area of all front
faces that have free space before them, and a surface in sight: without one there is nothing indirect.
"""

from __future__ import annotations

import bpy
import numpy as np
from gi_volumes.bake.rays import MISS, Tracer

LIFT = 1e-3
"""Distance of the points from their surface [m]."""

FEELERS = 64
"""Rays that look whether there is free space before a point."""

MOST_BACK_FACES = 0.25
"""Part of the feelers that may meet the back of a surface: more do inside a solid, fewer near open cloth or leaves."""

CLEARANCE = 0.02
"""At least half of the feelers go as far [m]; what is squeezed between two surfaces is nobody's concern."""

CANDIDATES_PER_POINT = 4


def world_triangles(instanced: bool = False) -> np.ndarray:
    """Read the triangles of everything that renders.

    Parameters
    ----------
    instanced : bool
        Only of instances that are no objects of their own.

    Returns
    -------
    (t, 3, 3) float64 ndarray
        Corners in world space [m], counter-clockwise from the front also under mirrored transforms.
    """
    parts = [np.zeros((0, 3, 3))]
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "MESH" and not instance.object.hide_render:
            if instanced and not instance.is_instance:
                continue
            matrix = np.array(instance.matrix_world)
            corners = mesh_triangles(instance.object.data) @ matrix[:3, :3].T + matrix[:3, 3]
            parts.append(corners[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else corners)
    return np.concatenate(parts)


def pick(triangles: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose points with free space before them, evenly over the area.

    Parameters
    ----------
    triangles : (t, 3, 3) float64 ndarray
        Corners in world space [m].
    count : int
        How many points.
    seed : int
        Another one chooses other points.

    Returns
    -------
    points : (count, 3) float64 ndarray
        In world space [m], `LIFT` off their surface.
    normals : (count, 3) float64 ndarray
        Unit normals of their triangles.

    Raises
    ------
    ValueError
        The scene has too few surfaces with free space before them.
    """
    generator = np.random.default_rng(seed)
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    cross = np.cross(edge_1, edge_2)
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        raise ValueError("the scene has no surface to choose points on")
    row = generator.choice(len(area), CANDIDATES_PER_POINT * count, p=area / area.sum())
    u, v = generator.random((2, len(row), 1))
    root = np.sqrt(u)
    normals = cross[row] / area[row, None]
    points = triangles[row, 0] + root * (1 - v) * edge_1[row] + root * v * edge_2[row] + LIFT * normals
    free = np.flatnonzero(_have_space(triangles, points, normals))[:count]
    if len(free) < count:
        raise ValueError(f"only {len(free)} of {len(row)} candidates have free space before them; ask for fewer points")
    return points[free], normals[free]


def mesh_triangles(mesh: bpy.types.Mesh) -> np.ndarray:
    """Read the triangles of a mesh.

    Parameters
    ----------
    mesh : bpy.types.Mesh
        Its `loop_triangles` are in the same order afterwards.

    Returns
    -------
    (t, 3, 3) float64 ndarray
        Corners in the mesh's space.
    """
    mesh.calc_loop_triangles()
    rows = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", rows)
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    return vertices.reshape(-1, 3).astype(np.float64)[rows.reshape(-1, 3)]


def _have_space(triangles: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) whether points see other surfaces, and lie in front of their own, not inside a solid or a crack."""
    centre = triangles.reshape(-1, 3).mean(axis=0)
    tracer = Tracer((triangles - centre).astype(np.float32), np.zeros(len(triangles), bool))
    direction = np.repeat(_sphere(FEELERS)[None], len(points), axis=0)
    direction *= np.where(np.einsum("nfc,nc->nf", direction, normals) < 0, -1.0, 1.0)[..., None]
    origin = np.repeat((points - centre)[:, None], FEELERS, axis=1)
    rays = (np.ascontiguousarray(array.reshape(-1, 3).T, np.float32) for array in (origin, direction))
    hits = tracer.intersect(*rays)
    met = (hits.triangle != MISS).reshape(-1, FEELERS)
    back = (np.einsum("cn,nc->n", hits.normal, direction.reshape(-1, 3)) > 0).reshape(-1, FEELERS) & met
    far = ~met | (hits.distance.reshape(-1, FEELERS) > CLEARANCE)
    return met.any(axis=1) & (back.mean(axis=1) <= MOST_BACK_FACES) & (far.mean(axis=1) >= 0.5)


def _sphere(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
