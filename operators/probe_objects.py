"""Objects that show a bake's reflection probes: made, kept and removed, in a collection of their own.

Comes in: the probes of a bake. Goes out: an empty, drawn as a sphere, for each. Pinned objects are the artist's and
stay as they are; the others follow the bake. What was deleted is remembered before, and not shown again.
"""

from __future__ import annotations

import bpy
import numpy as np

from . import probe_marks
from .baked_probes import Baked
from .probe_properties import PROBE

NAME = "GI Probe"
COLLECTION = "GI Probes"
# Part of a probe's reach that its sphere's radius is: spheres of neighbours stay well apart.
RADIUS = 1 / 4


def show(scene: bpy.types.Scene, baked: Baked) -> None:
    """Make the objects of a scene's probes, or bring them up to date.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.
    baked : Baked
        The probes of its bake.
    """
    settings, old = scene.gi_volumes, probe_marks.probes_of(scene)
    _remember(settings.deleted_probes, probe_marks.missing(scene, old))
    pinned = [object for object in old if probe_marks.is_pinned(object, probe_marks.place_of(object))]
    for object in pinned:
        if baked.made != settings.shown_probes or not object.gi_volumes.reach:
            _keep(object)
    wanted = _wanted(baked, probe_marks.boxes(probe_marks.deleted(scene, old)))
    settings.shown_probes = baked.made
    for object in pinned:
        wanted.pop(tuple(object.gi_volumes.placed), None)
    kept = {object.as_pointer() for object in pinned}
    _follow([object for object in old if object.as_pointer() not in kept], wanted)
    for place, reach in wanted.items():
        add(scene, place, reach)
    if not old:
        for place, reach in zip(baked.place[baked.pinned], baked.reach[baked.pinned], strict=True):
            add(scene, tuple(place), float(reach)).gi_volumes.kept = True
    shown = [object.gi_volumes for object in probe_marks.probes_of(scene)]
    _note(settings.placed_probes, {tuple(probe.placed): probe.reach for probe in shown})


def add(scene: bpy.types.Scene, place: tuple[float, ...], reach: float) -> bpy.types.Object:
    """Add an object for a probe.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.
    place : tuple of float [m]
        World space.
    reach : float [m]
        Half the distance to the nearest other one.

    Returns
    -------
    bpy.types.Object
        It stands for a probe that the bake has placed there, until it is moved or pinned.
    """
    object = bpy.data.objects.new(NAME, None)
    object.empty_display_type = "SPHERE"
    object.empty_display_size = reach * RADIUS
    object.location = place
    settings = object.gi_volumes
    settings.role, settings.placed, settings.reach = PROBE, place, reach
    _collection(scene).objects.link(object)
    return object


def usual_reach(scene: bpy.types.Scene) -> float:
    """Return a reach for a probe that an artist adds.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.

    Returns
    -------
    float [m]
        The median of those that the bake has placed; 1 without any.
    """
    return float(np.median([item.reach for item in scene.gi_volumes.placed_probes] or [probe_marks.USUAL_REACH]))


def forget_deleted(scene: bpy.types.Scene) -> int:
    """Allow probes again where some were deleted.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.

    Returns
    -------
    int
        How many places there were.
    """
    settings, found = scene.gi_volumes, probe_marks.probes_of(scene)
    count = len(probe_marks.deleted(scene, found))
    lost = {tuple(item.place) for item in probe_marks.missing(scene, found)}
    left = {tuple(item.place): item.reach for item in settings.placed_probes if tuple(item.place) not in lost}
    _note(settings.placed_probes, left)
    settings.deleted_probes.clear()
    return count


def _remember(places, items) -> None:
    """Add places to a list; they are read before, as both may be parts of one scene."""
    for place, reach in [(tuple(item.place), item.reach) for item in items]:
        item = places.add()
        item.place, item.reach = place, reach


def _note(places, wanted: dict[tuple[float, ...], float]) -> None:
    """Replace a list of places."""
    places.clear()
    for place, reach in wanted.items():
        item = places.add()
        item.place, item.reach = place, reach


def _keep(object: bpy.types.Object) -> None:
    """Pin a probe where it is: of the bake that is shown from now on no place is its home."""
    object.gi_volumes.kept = True
    probe_marks.adopt(object)


def _wanted(baked: Baked, boxes: np.ndarray) -> dict[tuple[float, ...], float]:
    """Reach by place, as Blender stores it, of the probes that the bake chose and that are not deleted."""
    place = baked.place.astype(np.float32).astype(np.float64)
    inside = ((place[:, None] >= boxes[:, 0]) & (place[:, None] <= boxes[:, 1])).all(axis=2).any(axis=1)
    rows = np.flatnonzero(~baked.pinned & ~inside)
    return {tuple(place[row].tolist()): float(baked.reach[row]) for row in rows}


def _follow(objects: list[bpy.types.Object], wanted: dict[tuple[float, ...], float]) -> None:
    """Keep objects whose places are wanted still, and remove the others; no longer wanted is what has an object."""
    gone = [object for object in objects if wanted.pop(tuple(object.gi_volumes.placed), None) is None]
    bpy.data.batch_remove(gone)


def _collection(scene: bpy.types.Scene) -> bpy.types.Collection:
    """The scene's collection for probes; it is made where there is none."""
    for collection in scene.collection.children_recursive:
        if collection.name.partition(".")[0] == COLLECTION and collection.library is None:
            return collection
    collection = bpy.data.collections.new(COLLECTION)
    scene.collection.children.link(collection)
    return collection
