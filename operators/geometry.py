"""Meshes of a scene, each stored once, and where they stand.

Comes in: evaluated meshes with their materials, and placements. Goes out: `Geometry`. Every attribute is read in
bulk; Blender's member collections (`vertices`, `loops`) are ten to a hundred times slower than attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import bpy
import numpy as np

from ..bake.snapshot import Geometry, SnapshotError
from .materials import Materials
from .mesh_data import corner_colors, corner_uvs, positions_of, values
from .notes import Notes

# A triangle is without area when its height is less than this share of its longest edge: float32 rounding.
FLAT = 1e-7
KILO = 1024.0


@dataclass(frozen=True)
class Mesh:
    """One mesh in its own space: (v, 3) positions, (t, 3) triangles, per-corner data, (t,) materials."""

    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray | None
    colors: np.ndarray | None
    materials: np.ndarray


@dataclass
class Meshes:
    """Meshes and instances gathered so far; `add` one after the other, then `record`."""

    notes: Notes
    materials: Materials
    meshes: list[Mesh] = field(default_factory=list)
    instances: list[tuple[int, np.ndarray, str]] = field(default_factory=list)
    _indices: dict[tuple, int | None] = field(default_factory=dict)
    _flat: int = 0

    def add(self, object: bpy.types.Object, matrix: np.ndarray, name: str) -> None:
        """Add an instance of an evaluated mesh.

        Parameters
        ----------
        object : bpy.types.Object
            Evaluated; its data is a mesh.
        matrix : (4, 4) float64 [m]
            World from mesh.
        name : str
            Its name, for messages.

        Raises
        ------
        SnapshotError
            A vertex or the placement is not finite.
        """
        if not np.isfinite(matrix).all():
            raise SnapshotError(f"object '{name}' has an invalid transform: reset its location, rotation and scale")
        slots = tuple(self.materials.index(slot.material) for slot in object.material_slots)
        key = (object.data.as_pointer(), slots)
        if key not in self._indices:
            with _mesh_data(object) as data:
                self._indices[key] = self._store(data, slots, name)
        index = self._indices[key]
        if index is None:
            return
        if np.linalg.matrix_rank(matrix[:3, :3]) < 2:
            self.notes.add("object scaled to nothing", "left out", f"'{name}'")
            return
        self.instances.append((index, matrix[:3], name))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the box around all instances.

        Returns
        -------
        tuple of (3,) float64 [m]
            Its lower and upper corner in world space; a little too large for turned meshes.
        """
        boxes = np.array([(mesh.positions.min(0), mesh.positions.max(0)) for mesh in self.meshes], np.float64)
        which = np.array([index for index, _, _ in self.instances])
        matrices = np.array([matrix for _, matrix, _ in self.instances])
        middle, half = boxes[which].mean(1), np.ptp(boxes[which], axis=1) / 2
        center = np.einsum("kij,kj->ki", matrices[:, :, :3], middle) + matrices[:, :, 3]
        reach = np.einsum("kij,kj->ki", np.abs(matrices[:, :, :3]), half)
        return (center - reach).min(0), (center + reach).max(0)

    def record(self) -> Geometry:
        """Return all meshes and instances.

        Returns
        -------
        Geometry
            Meshes one after the other.
        """
        if self._flat:
            self.notes.add("triangles without area", "left out", f"{self._flat} of the meshes' triangles")
        starts = np.cumsum([0, *(len(mesh.positions) for mesh in self.meshes)])
        counts = [len(mesh.triangles) for mesh in self.meshes]
        triangles = [mesh.triangles + start for mesh, start in zip(self.meshes, starts[:-1], strict=True)]
        return Geometry(
            positions=self._joined(lambda mesh: mesh.positions),
            triangles=np.concatenate(triangles).astype(np.int32),
            corner_normals=self._joined(lambda mesh: mesh.normals),
            corner_uvs=self._corners(lambda mesh: mesh.uvs, 2),
            corner_colors=self._corners(lambda mesh: mesh.colors, 4),
            materials=self._joined(lambda mesh: mesh.materials).astype(np.int32),
            mesh_first_triangle=np.cumsum([0, *counts], dtype=np.int64),
            instance_mesh=np.array([index for index, _, _ in self.instances], np.int32),
            instance_transform=np.array([matrix for _, matrix, _ in self.instances], np.float64),
            instance_names=tuple(name for _, _, name in self.instances),
        )

    def _joined(self, part: Callable[[Mesh], np.ndarray]) -> np.ndarray:
        """One array of a part of all meshes."""
        return np.ascontiguousarray(np.concatenate([part(mesh) for mesh in self.meshes]))

    def _corners(self, part: Callable[[Mesh], np.ndarray | None], width: int) -> np.ndarray:
        """(t, 3, width) float32 of a part that only some meshes have, zeros elsewhere; (0, 3, width) if none has."""
        if all(part(mesh) is None for mesh in self.meshes):
            return np.zeros((0, 3, width), np.float32)
        empty = (np.zeros((len(mesh.triangles), 3, width), np.float32) for mesh in self.meshes)
        return np.concatenate(
            [
                found if (found := part(mesh)) is not None else blank
                for mesh, blank in zip(self.meshes, empty, strict=True)
            ]
        )

    def _store(self, data: bpy.types.Mesh, slots: tuple[int, ...], name: str) -> int | None:
        """Store a mesh; None when it has no triangles."""
        data.calc_loop_triangles()
        count = len(data.loop_triangles)
        if count == 0:
            return None
        positions = positions_of(data)
        if not np.isfinite(positions).all():
            bad = int((~np.isfinite(positions)).any(1).sum())
            raise SnapshotError(
                f"object '{name}' has {bad} vertices that are not numbers: delete them, or check its modifiers"
            )
        corners = np.empty((count, 3), np.int32)
        data.loop_triangles.foreach_get("loops", corners.ravel())
        triangles = values(data.attributes[".corner_vert"], "value", 1, np.int32)[:, 0][corners]
        keep = _solid(positions, triangles)
        self._flat += count - int(keep.sum())
        if not keep.any():
            return None
        corners, triangles = corners[keep], triangles[keep]
        materials = self._materials(data, slots, keep)
        self.meshes.append(self._mesh(data, name, positions, triangles, corners, materials))
        return len(self.meshes) - 1

    def _mesh(self, data, name, positions, triangles, corners, materials) -> Mesh:
        """Per-corner data of the triangles that are kept, and their vertices alone."""
        used = np.zeros(len(positions), bool)
        used[triangles] = True
        compact = np.cumsum(used) - 1
        geometric = _geometric_normals(positions, triangles)
        worn = sorted(set(np.unique(materials).tolist()))
        reads = [(index, self.materials.reads[index]) for index in worn]
        uvs = colors = None
        for index, need in reads:
            rows = materials == index
            if need.uv is not None:
                uvs = np.zeros((len(triangles), 3, 2), np.float32) if uvs is None else uvs
                uvs[rows] = corner_uvs(data, need.uv, positions, triangles[rows], corners[rows], self.notes, name)
            if need.color is not None:
                colors = np.zeros((len(triangles), 3, 4), np.float32) if colors is None else colors
                colors[rows] = corner_colors(data, need.color, triangles[rows], corners[rows], self.notes, name)
        normals = _corner_normals(data, corners, geometric)
        return Mesh(positions[used], compact[triangles].astype(np.int32), normals, uvs, colors, materials)

    def _materials(self, data: bpy.types.Mesh, slots: tuple[int, ...], keep: np.ndarray) -> np.ndarray:
        """(t,) material of each kept triangle; slots beyond the last count as the last, as in Blender."""
        slot = np.empty(len(keep), np.int32)
        data.loop_triangles.foreach_get("material_index", slot)
        table = np.array(slots if slots else (self.materials.index(None),), np.int32)
        return table[np.clip(slot[keep], 0, len(table) - 1)]


def origin(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the point that a bake works relative to.

    Parameters
    ----------
    low, high : (3,) float64 [m]
        The scene's bounds.

    Returns
    -------
    (3,) float64 [m]
        The multiple of 1024 m nearest to their centre, along each axis.
    """
    return np.rint((low + high) / 2 / KILO) * KILO + 0.0


@contextmanager
def _mesh_data(object: bpy.types.Object) -> Iterator[bpy.types.Mesh]:
    """The arrays of an evaluated mesh; one that is being edited has none until it is converted."""
    if not object.data.is_editmode:
        yield object.data
        return
    try:
        yield object.to_mesh()
    finally:
        object.to_mesh_clear()


def _edges(positions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge vectors in double precision."""
    a, b, c = (positions[triangles[:, corner]].astype(np.float64) for corner in range(3))
    return b - a, c - a, c - b


def _solid(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(t,) whether a triangle has an area."""
    first, second, third = _edges(positions, triangles)
    longest = np.max([np.einsum("ij,ij->i", edge, edge) for edge in (first, second, third)], axis=0)
    doubled = np.cross(first, second)
    return np.einsum("ij,ij->i", doubled, doubled) > (FLAT * longest) ** 2


def _geometric_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(t, 3) unit normals by the order of the corners."""
    first, second, _ = _edges(positions, triangles)
    normal = np.cross(first, second)
    return (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)


def _corner_normals(data: bpy.types.Mesh, corners: np.ndarray, geometric: np.ndarray) -> np.ndarray:
    """(t, 3, 3) shading normals of unit length; the triangle's own where they are invalid."""
    normals = np.empty((len(data.corner_normals), 3), np.float32)
    data.corner_normals.foreach_get("vector", normals.ravel())
    normals = normals[corners]
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    valid = np.isfinite(length) & (length > 0.5)
    return np.where(valid, normals / np.where(valid, length, 1), geometric[:, None, :]).astype(np.float32)
