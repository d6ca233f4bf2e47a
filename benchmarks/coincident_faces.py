"""Faces that lie in other faces: found, and removed from the open Blender scene.

Comes in: triangles in world space, or the open scene. Goes out: which of them others cover, or a scene without
them. The idea: Cycles lets a ray that leaves a triangle ignore that one triangle, so that a second one in the same
place blocks all light; whoever compares with it has to keep each surface once.
"""

from __future__ import annotations

from collections.abc import Iterator

import bmesh
import bpy
import numpy as np

from . import surface_points

REACH = 1e-4
"""Faces this far apart [m] are in the same place: Cycles' rays do not leave that gap reliably."""

NORMAL_STEPS = 512
"""Parts of a unit normal's components that are told apart: 0.1 degrees."""

INSET = 0.02
"""Outermost test points lie this far inside their triangle, in barycentric coordinates."""

GRID = 8
"""Test points along an edge: what covers them all and leaves a hole is a face of less than an eighth the size."""

HEIGHT_STEP = 1e-3
"""Planes of one tilt are told apart by steps of this height [m]: more than `REACH` and what rounding does to it."""

SWEEP = np.array((0.62, 0.53, 0.58))
"""A direction that the planes of buildings do not stand upright on: along it few triangles of a plane overlap."""

PAIRS = 1_000_000
"""Pairs of triangles that are compared at once, to bound memory."""


def covered(triangles: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Find triangles that lie in others which stay, the smaller ones first.

    Parameters
    ----------
    triangles : (t, 3, 3) float64 ndarray
        Corners [m].
    keep : (t,) bool ndarray
        Triangles that must stay.

    Returns
    -------
    (t,) bool ndarray
        True for what can go: all its test points lie in triangles that stay.
    """
    stays, rank = np.ones(len(triangles), bool), _ranks(triangles, keep)
    inner, point, outer = _containments(triangles)
    while True:
        there = stays[inner] & stays[outer]
        inner, point, outer = inner[there], point[there], outer[there]
        can_go = _held(inner, point, len(triangles)).all(axis=1) & ~keep & stays
        # Of two that hold points of each other only one may go in one round, or nobody would hold them.
        both = can_go[inner] & can_go[outer]
        first = rank[inner[both]] < rank[outer[both]]
        can_go[np.where(first, inner[both], outer[both])] = False
        if not can_go.any():
            return ~stays
        stays &= ~can_go


def remove_coincident() -> tuple[int, float]:
    """Remove faces of the open scene's meshes that lie in other faces.

    Returns
    -------
    removed : int
        Number of faces.
    left : float
        Part of the scene's area that still lies in other triangles, because it does so only in part.

    Notes
    -----
    Modifiers of changed objects are applied. Instances stay whole, as do faces of which a triangle is needed.
    """
    objects = _objects()
    parts = [_world_triangles(item) for item in objects]
    fixed = surface_points.world_triangles(instanced=True)
    triangles = np.concatenate([*(corners for corners, _ in parts), fixed])
    keep = np.zeros(len(triangles), bool)
    keep[len(triangles) - len(fixed) :] = True
    gone = covered(triangles, keep)
    removed, start = 0, 0
    for item, (corners, polygon) in zip(objects, parts, strict=True):
        mine = gone[start : start + len(corners)]
        start += len(corners)
        whole = np.ones(polygon.max(initial=-1) + 1, bool)
        whole[polygon[~mine]] = False
        faces = np.flatnonzero(whole)
        if len(faces):
            _remove_faces(item, faces)
            removed += len(faces)
    return removed, _overlap(triangles[~gone])


def _overlap(triangles: np.ndarray) -> float:
    """Part of the area whose test points lie in other triangles."""
    inner, point, _ = _containments(triangles)
    area = _areas(triangles)
    return float((_held(inner, point, len(triangles)).mean(axis=1) * area).sum() / max(area.sum(), 1e-30))


def _containments(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of triangles, their test points, and the other triangle that each lies in."""
    points = _test_points(triangles)
    found = [np.zeros((3, 0), np.int64)]
    for first, second in _coplanar_pairs(triangles):
        row, point = np.nonzero(_inside(points[first], triangles[second]))
        found.append(np.stack([first[row], point, second[row]]))
    return tuple(np.concatenate(found, axis=1))


def _held(inner: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    """(count, k) whether a test point lies in any other triangle."""
    held = np.zeros((count, GRID * (GRID + 1) // 2), bool)
    held[inner, point] = True
    return held


def _areas(triangles: np.ndarray) -> np.ndarray:
    """(t,) areas [m2]."""
    edges = triangles[:, 1:] - triangles[:, :1]
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2


def _ranks(triangles: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """(t,) order of importance: what must stay, then by area, in steps that rounding does not reach."""
    step = np.round(np.log(np.maximum(_areas(triangles), 1e-12)), 3)
    order = np.lexsort((np.arange(len(triangles)), -step, ~keep))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank


def _test_points(triangles: np.ndarray) -> np.ndarray:
    """(t, k, 3) points spread over each triangle's inside."""
    u, v = (k.ravel() for k in np.meshgrid(*2 * [np.arange(GRID)]))
    weights = np.stack([u, v, GRID - 1 - u - v], axis=1)[u + v < GRID] / (GRID - 1)
    weights = INSET + (1 - 3 * INSET) * weights
    return np.einsum("kc,tcx->tkx", weights, triangles)


def _coplanar_pairs(triangles: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows (m,), (m,) of different triangles of about one plane whose boxes overlap, both ways round."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(cross, axis=1)
    solid = np.flatnonzero(length > 0)
    normal = cross[solid] / length[solid, None]
    normal *= np.sign(np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1))
    tilt = np.rint(normal * NORMAL_STEPS)
    height = np.einsum("tx,tx->t", normal, triangles[solid].mean(axis=1)) / HEIGHT_STEP
    low, high = triangles.min(axis=1) - REACH, triangles.max(axis=1) + REACH
    # Two sets of steps, half a step apart: close heights share a step of one or of both.
    for shift in (0.0, 0.5):
        planes = np.unique(np.column_stack([tilt, np.floor(height + shift)]), axis=0, return_inverse=True)[1].ravel()
        for first, second in _swept_pairs(triangles[solid] @ SWEEP, planes):
            one, other = solid[first], solid[second]
            rows = ((low[one] <= high[other]) & (low[other] <= high[one])).all(axis=1)
            yield one[rows], other[rows]
            yield other[rows], one[rows]


def _swept_pairs(extent: np.ndarray, planes: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows (m,), (m,) of one plane whose intervals (t, 3) along a line overlap, each pair once, in bounded parts."""
    low, high = extent.min(axis=1) - REACH, extent.max(axis=1) + REACH
    apart = planes * (high.max() - low.min() + 1)
    order = np.argsort(low + apart)
    start = (low + apart)[order]
    last = np.searchsorted(start, (high + apart)[order], side="right")
    count = last - np.arange(len(order)) - 1
    total = np.concatenate([[0], np.cumsum(count)])
    cuts = np.unique(np.searchsorted(total, np.arange(0, total[-1] + PAIRS, PAIRS)))
    for begin, end in zip(cuts[:-1], np.minimum(cuts[1:], len(order)), strict=True):
        first = np.repeat(np.arange(begin, end), count[begin:end])
        second = first + 1 + np.arange(len(first)) - (total[first] - total[begin])
        yield order[first], order[second]


def _inside(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m, k) whether points (m, k, 3) lie in triangle m, to `REACH`."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    inside = np.abs(np.einsum("mkx,mx->mk", points - triangles[:, :1], normal)) < REACH
    for corner in range(3):
        edge = triangles[:, (corner + 1) % 3] - triangles[:, corner]
        inward = np.cross(normal, edge)
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-30)
        inside &= np.einsum("mkx,mx->mk", points - triangles[:, None, corner], inward) > -REACH
    return inside


def _objects() -> list[bpy.types.Object]:
    """Objects of the scene whose meshes render and can be changed."""
    return [item for item in bpy.context.view_layer.objects if item.type == "MESH" and not item.hide_render]


def _world_triangles(item: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """(t, 3, 3) corners of an object's evaluated mesh in world space [m], and the face (t,) of each."""
    evaluated = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.data
    corners = surface_points.mesh_triangles(mesh)
    polygon = np.empty(len(corners), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygon)
    matrix = np.array(evaluated.matrix_world)
    return corners @ matrix[:3, :3].T + matrix[:3, 3], polygon


def _remove_faces(item: bpy.types.Object, faces: np.ndarray) -> None:
    """Give an object a mesh of its own without some faces; its vertices and their normals stay."""
    mesh = bpy.data.meshes.new_from_object(item.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    item.modifiers.clear()
    item.data = mesh
    geometry = bmesh.new()
    geometry.from_mesh(mesh)
    geometry.faces.ensure_lookup_table()
    bmesh.ops.delete(geometry, geom=[geometry.faces[row] for row in faces], context="FACES_ONLY")
    geometry.to_mesh(mesh)
    geometry.free()
