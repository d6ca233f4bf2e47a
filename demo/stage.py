"""From solids to Blender: objects, modifiers, collections and their instances.

Comes in: solids of `shapes` and materials. Goes out: objects linked into the open scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
import numpy as np

from .shapes import Solid

Vector = Sequence[float]
SHARP_FROM = math.radians(35)
"""Edges that are steeper stay sharp when a round thing is shaded smoothly."""


def put(
    name: str, solid: Solid, materials: Sequence[bpy.types.Material], at: Vector = (0, 0, 0), turn: float = 0.0
) -> bpy.types.Object:
    """Add a solid to the scene.

    Parameters
    ----------
    name : str
        Of the object and its mesh.
    solid : Solid
        In object space.
    materials : sequence of bpy.types.Material
        One for each slot; the last serves the slots that are left.
    at : (3,) [m]
        Where its origin goes.
    turn : float [rad]
        About z.

    Returns
    -------
    bpy.types.Object
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(solid.vertices.tolist(), [], [face.tolist() for face in solid.faces])
    for material in materials:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", np.minimum(solid.slots, len(materials) - 1).astype(np.int32))
    if solid.uvs is not None:
        mesh.uv_layers.new(name="UVMap").uv.foreach_set("vector", solid.uvs.astype(np.float32).ravel())
    mesh.update()
    return show(name, mesh, at, turn)


def show(name: str, data: bpy.types.ID | None, at: Vector, turn: float = 0.0) -> bpy.types.Object:
    """Add an object for data that may be shared.

    Parameters
    ----------
    name : str
        Of the object.
    data : bpy.types.ID or None
        Mesh, lamp or camera; None for an empty.
    at : (3,) [m]
        Where its origin goes.
    turn : float [rad]
        About z.

    Returns
    -------
    bpy.types.Object
    """
    thing = bpy.data.objects.new(name, data)
    thing.location, thing.rotation_euler = at, (0, 0, turn)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def smooth(thing: bpy.types.Object) -> bpy.types.Object:
    """Shade a round thing smoothly, but for its edges.

    Parameters
    ----------
    thing : bpy.types.Object
        Changed in place.

    Returns
    -------
    bpy.types.Object
        The same.
    """
    thing.data.shade_smooth()
    thing.data.set_sharp_from_angle(angle=SHARP_FROM)
    return thing


def bevel(thing: bpy.types.Object, width: float) -> bpy.types.Object:
    """Round a thing's edges by a modifier.

    Parameters
    ----------
    thing : bpy.types.Object
        Changed in place.
    width : float [m]
        Of the rounding.

    Returns
    -------
    bpy.types.Object
        The same.
    """
    modifier = thing.modifiers.new("bevel", "BEVEL")
    modifier.width, modifier.segments, modifier.limit_method = width, 2, "ANGLE"
    return thing


def repeat(thing: bpy.types.Object, count: int, step: Vector) -> bpy.types.Object:
    """Repeat a thing in a row by a modifier.

    Parameters
    ----------
    thing : bpy.types.Object
        Changed in place.
    count : int
        How many there are in the end.
    step : (3,) [m]
        From one to the next.

    Returns
    -------
    bpy.types.Object
        The same.
    """
    modifier = thing.modifiers.new("array", "ARRAY")
    modifier.count, modifier.use_relative_offset, modifier.use_constant_offset = count, False, True
    modifier.constant_offset_displace = step
    return thing


def kit(name: str, things: Sequence[bpy.types.Object]) -> bpy.types.Collection:
    """Move things into a collection that is seen through its instances only.

    Parameters
    ----------
    name : str
        Of the collection.
    things : sequence of bpy.types.Object
        In its space.

    Returns
    -------
    bpy.types.Collection
    """
    collection = bpy.data.collections.new(name)
    for thing in things:
        bpy.context.scene.collection.objects.unlink(thing)
        collection.objects.link(thing)
    return collection


def place(collection: bpy.types.Collection, at: Vector, turn: float = 0.0, scale: Vector = (1, 1, 1)) -> None:
    """Instance a collection.

    Parameters
    ----------
    collection : bpy.types.Collection
        What to show.
    at : (3,) [m]
        Where.
    turn : float [rad]
        About z.
    scale : (3,)
        A negative factor mirrors.
    """
    instance = show(collection.name, None, at, turn)
    instance.instance_type, instance.instance_collection, instance.scale = "COLLECTION", collection, scale
