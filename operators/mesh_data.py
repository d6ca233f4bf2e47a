"""Bulk reads of a mesh's attributes.

Comes in: an evaluated mesh. Goes out: arrays for vertices or for triangles' corners, whatever domain the
attribute is stored on.
"""

from __future__ import annotations

import bpy
import numpy as np

from .notes import Notes
from .texture_mapping import GENERATED, OBJECT

PROPERTIES = {
    "FLOAT": ("value", 1),
    "FLOAT2": ("vector", 2),
    "FLOAT_VECTOR": ("vector", 3),
    "FLOAT_COLOR": ("color", 4),
    "BYTE_COLOR": ("color", 4),
}


def values(attribute: bpy.types.Attribute, name: str, width: int, kind: type) -> np.ndarray:
    """Return an attribute's data.

    Parameters
    ----------
    attribute : bpy.types.Attribute
        The attribute.
    name : str
        The property of its elements: "value", "vector" or "color".
    width : int
        Components of an element.
    kind : type
        numpy's scalar type of the data, which makes reading a plain copy.

    Returns
    -------
    (n, width)
        One row for each element of its domain.
    """
    found = np.empty((len(attribute.data), width), kind)
    attribute.data.foreach_get(name, found.ravel())
    return found


def positions_of(data: bpy.types.Mesh) -> np.ndarray:
    """Return the vertices of a mesh.

    Parameters
    ----------
    data : bpy.types.Mesh
        An evaluated mesh.

    Returns
    -------
    (v, 3) float32 [m]
        In mesh space.
    """
    return values(data.attributes["position"], "vector", 3, np.float32)


def corner_uvs(
    data: bpy.types.Mesh,
    source: str,
    positions: np.ndarray,
    triangles: np.ndarray,
    corners: np.ndarray,
    notes: Notes,
    name: str,
) -> np.ndarray:
    """Return texture coordinates.

    Parameters
    ----------
    data : bpy.types.Mesh
        An evaluated mesh.
    source : str
        A UV map's name, "" for the one that renders, or a source computed from positions.
    positions : (v, 3) float32 [m]
        Vertices.
    triangles : (t, 3) int32
        Rows of `positions`.
    corners : (t, 3) int32
        The mesh's corners of the same triangles.
    notes : Notes
        Gathers what is missing.
    name : str
        Of the object, for notes.

    Returns
    -------
    (t, 3, 2) float32
        Zeros where the mesh has no such map, as in Blender.
    """
    if source == OBJECT:
        return positions[triangles][..., :2]
    if source == GENERATED:
        low, span = positions.min(0), np.ptp(positions, axis=0)
        return ((positions - low) / np.where(span > 0, span, 1))[triangles][..., :2]
    if not source:
        source = next((layer.name for layer in data.uv_layers if layer.active_render), "")
    found = _on_corners(data, source, triangles, corners)
    if found is None or found.shape[2] < 2:
        notes.add("texture on a mesh without that UV map", "one texel of it", f"'{name}'")
        return np.zeros((len(triangles), 3, 2), np.float32)
    finite = np.nan_to_num(found[..., :2], posinf=0.0, neginf=0.0)
    return np.ascontiguousarray(finite, np.float32)


def corner_colors(
    data: bpy.types.Mesh, source: str, triangles: np.ndarray, corners: np.ndarray, notes: Notes, name: str
) -> np.ndarray:
    """Return vertex colours.

    Parameters
    ----------
    data : bpy.types.Mesh
        An evaluated mesh.
    source : str
        A colour attribute's name, "" for the one that renders.
    triangles : (t, 3) int32
        Vertices of the triangles.
    corners : (t, 3) int32
        The mesh's corners of the same triangles.
    notes : Notes
        Gathers what is missing.
    name : str
        Of the object, for notes.

    Returns
    -------
    (t, 3, 4) float32
        Linear; white where the mesh has no such attribute.
    """
    attributes = data.color_attributes
    if not source and 0 <= attributes.render_color_index < len(attributes):
        source = attributes[attributes.render_color_index].name
    found = _on_corners(data, source, triangles, corners)
    if found is None:
        notes.add("vertex colour on a mesh that has none", "white", f"'{name}'")
        return np.ones((len(triangles), 3, 4), np.float32)
    width = found.shape[2]
    colors = np.ones((len(triangles), 3, 4), np.float32)
    colors[..., :3] = found if width == 1 else 0
    colors[..., :width] = colors[..., :1] if width == 1 else found
    return np.maximum(np.nan_to_num(colors), 0)


def _on_corners(data: bpy.types.Mesh, name: str, triangles: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """(t, 3, c) float32 of a named attribute of any domain; None when there is no such attribute."""
    attribute = data.attributes.get(name) if name else None
    if attribute is None or attribute.data_type not in PROPERTIES:
        return None
    found = values(attribute, *PROPERTIES[attribute.data_type], np.float32)
    if attribute.domain == "CORNER":
        return found[corners]
    if attribute.domain == "POINT":
        return found[triangles]
    if attribute.domain == "FACE":
        face = np.empty(len(data.loop_triangles), np.int32)
        data.loop_triangles.foreach_get("polygon_index", face)
        first = np.empty(len(data.loop_triangles) * 3, np.int32)
        data.loop_triangles.foreach_get("loops", first)
        of_corner = np.zeros(len(data.loops), np.int32)
        of_corner[first] = np.repeat(face, 3)
        return found[of_corner[corners]]
    return None
