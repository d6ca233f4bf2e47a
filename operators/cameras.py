"""Cameras of a scene, as pinholes and orthographic views."""

from __future__ import annotations

import math

import bpy
import numpy as np

from ..bake.snapshot import Camera
from .notes import Notes

MAX_PERCENTAGE = 100


def read(depsgraph: bpy.types.Depsgraph, active: bpy.types.Object | None, size: tuple[int, int], notes: Notes):
    """Return the cameras of an evaluated scene, the active one first.

    Parameters
    ----------
    depsgraph : bpy.types.Depsgraph
        The evaluated scene.
    active : bpy.types.Object or None
        The scene's camera, not evaluated.
    size : tuple of int
        Width and height of the picture [px].
    notes : Notes
        Gathers what cannot be represented.

    Returns
    -------
    tuple of Camera
        Every camera object of the view layer, and the active camera wherever it is.
    """
    found = {object.original.name: object for object in depsgraph.objects if object.type == "CAMERA"}
    if active is not None and active.type == "CAMERA":
        found.setdefault(active.name, active.evaluated_get(depsgraph))
    first = active.name if active is not None else ""
    names = sorted(found, key=lambda name: (name != first, name))
    return tuple(_camera(found[name], name, size, notes) for name in names)


def picture_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Return the size of a scene's pictures.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.

    Returns
    -------
    tuple of int
        Width and height [px].
    """
    render = scene.render
    scale = render.resolution_percentage / MAX_PERCENTAGE
    return max(int(render.resolution_x * scale), 1), max(int(render.resolution_y * scale), 1)


def _camera(object: bpy.types.Object, name: str, size: tuple[int, int], notes: Notes) -> Camera:
    """One camera; Blender's shift is in units of the fitted side, ours in units of the width."""
    data = object.data
    width, height = size
    fit_width = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= height)
    widths_per_fit = 1.0 if fit_width else width / height
    orthographic = data.type == "ORTHO"
    if orthographic:
        half_fit = data.ortho_scale / 2
    else:
        sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
        half_fit = sensor / (2 * data.lens)
    if data.type not in ("PERSP", "ORTHO"):
        notes.add(f"{data.type.lower()} camera", "a perspective camera of the same lens", f"'{name}'")
    return Camera(
        name=name,
        world_from_camera=tuple(_rigid(object).ravel().tolist()),
        half_width=half_fit * widths_per_fit,
        shift=(data.shift_x / widths_per_fit, data.shift_y / widths_per_fit),
        orthographic=orthographic,
        resolution=size,
    )


def _rigid(object: bpy.types.Object) -> np.ndarray:
    """(3, 4) world_from_camera without scale, which cameras ignore."""
    matrix = np.array(object.matrix_world, np.float64)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    rotation = matrix[:3, :3] / np.where(lengths > 0, lengths, 1)
    if not math.isfinite(matrix.sum()) or (lengths == 0).any():
        rotation = np.eye(3)
    return np.column_stack([rotation, matrix[:3, 3]])
