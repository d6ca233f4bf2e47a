"""Points on the surfaces of the open Blender scene where light can arrive, chosen the same way every time.

Comes in: the evaluated scene, a seed. Goes out: points [m] and normals, spread evenly over the area of all front
faces that have free space before them, and a surface in sight: without one there is nothing indirect.
"""

from __future__ import annotations

import bpy
import numpy as np
from gi_volumes.bake.rays import Tracer
from gi_volumes.benchmarks.receivers import CANDIDATES_PER_POINT, LIFT, draw, have_space


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
    _, point, normals = draw(triangles, CANDIDATES_PER_POINT * count, np.random.default_rng(seed))
    points = point + LIFT * normals
    centre = triangles.reshape(-1, 3).mean(axis=0)
    tracer = Tracer((triangles - centre).astype(np.float32), np.zeros(len(triangles), bool))
    free = np.flatnonzero(have_space(tracer, points - centre, normals))[:count]
    if len(free) < count:
        raise ValueError(f"only {len(free)} of {len(points)} candidates have free space before them; ask for fewer")
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
