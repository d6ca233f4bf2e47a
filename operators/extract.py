"""A Blender scene as a snapshot: the one door between Blender's data and the bake.

Comes in: a context, a dependency graph or a file. Goes out: a `Snapshot` of what *renders*: objects, modifiers
and visibility with their render settings, whatever the viewport shows. The scene is not changed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from .silence import bpy, quiet  # isort: split

from ..bake.snapshot import Snapshot, SnapshotError
from . import cameras, render_depsgraph, scene_file, sky
from .evaluate import Evaluator
from .geometry import Meshes, origin
from .images import Images
from .lights import Lamps
from .materials import Materials
from .node_values import VALUES
from .notes import Notes
from .placement import Placements
from .probe_marks import Marks, is_probe

REC709 = "Linear Rec.709"
# What renders but has no surface made of triangles.
WITHOUT_MESH = {
    "CURVES": "hair curves",
    "POINTCLOUD": "point cloud",
    "VOLUME": "volume",
    "GREASEPENCIL": "grease pencil",
    "GPENCIL": "grease pencil",
}


def extract(context_or_depsgraph: bpy.types.Context | bpy.types.Depsgraph) -> Snapshot:
    """Return a snapshot of a scene.

    Parameters
    ----------
    context_or_depsgraph : bpy.types.Context or bpy.types.Depsgraph
        Names the scene and the view layer; whatever a graph was made for, what renders is read.

    Returns
    -------
    Snapshot
        The scene.

    Raises
    ------
    SnapshotError
        There is nothing to bake, or it holds invalid numbers; the message names the object and the remedy.
    """
    if isinstance(context_or_depsgraph, bpy.types.Depsgraph):
        scene = context_or_depsgraph.scene.original
        view_layer = scene.view_layers[context_or_depsgraph.view_layer.name]
    else:
        scene, view_layer = context_or_depsgraph.scene, context_or_depsgraph.view_layer
    notes = Notes()
    with quiet():
        snapshot = render_depsgraph.read(scene, view_layer, lambda depsgraph: _read(depsgraph, scene, notes))
        panorama = sky.read(scene, notes)
    _note_colors(notes)
    return replace(snapshot, sky=panorama, notes=notes.record())


def from_file(path: Path | str) -> Snapshot:
    """Return a snapshot of a scene file, which replaces what is open in this Blender.

    Parameters
    ----------
    path : Path or str
        A .blend, .glb or .gltf file.

    Returns
    -------
    Snapshot
        The scene.

    Raises
    ------
    SnapshotError
        The file cannot be read, or there is nothing to bake; the message is one line.
    """
    with quiet():
        scene_file.open_scene(Path(path))
        return replace(extract(bpy.context), source=str(path))


def _read(depsgraph: bpy.types.Depsgraph, scene: bpy.types.Scene, notes: Notes) -> Snapshot:
    """Everything but the sky, which Blender cannot render at the same time."""
    images = Images(notes)
    evaluator = Evaluator(images, notes, VALUES)
    meshes, lamps, probes = Meshes(notes, Materials(evaluator)), Lamps(notes, evaluator), Marks()
    _gather(depsgraph, meshes, lamps, probes, notes)
    if not meshes.instances:
        raise SnapshotError(_nothing(scene, lamps))
    return Snapshot(
        origin=origin(*meshes.bounds()),
        geometry=meshes.record(),
        materials=tuple(meshes.materials.records),
        images=tuple(images.records),
        lights=lamps.record(),
        sky=np.zeros((1, 1, 3), np.float32),
        cameras=cameras.read(depsgraph, scene.camera, cameras.picture_size(scene), notes),
        probes=probes.record(scene),
        source=bpy.data.filepath,
    )


def _gather(depsgraph: bpy.types.Depsgraph, meshes: Meshes, lamps: Lamps, probes: Marks, notes: Notes) -> None:
    """Walk everything that renders."""
    placements = Placements()
    for instance in depsgraph.object_instances:
        object = instance.object
        name = object.name
        if not instance.show_self:
            continue
        if is_probe(object):
            probes.add(object, placements.matrix(instance)[:3, 3], name)
        elif isinstance(object.data, bpy.types.Mesh):
            if _lights_others(object, notes):
                meshes.add(object, placements.matrix(instance), name)
        elif object.type == "LIGHT":
            lamps.add(object, placements.matrix(instance), name)
        elif object.type in WITHOUT_MESH:
            notes.add(WITHOUT_MESH[object.type], "left out", f"'{name}'")


def _lights_others(object: bpy.types.Object, notes: Notes) -> bool:
    """Whether bounced light can meet an object, by its ray visibility; partly visible ones count as visible."""
    seen = object.visible_diffuse, object.visible_shadow
    if not any(seen):
        notes.add("object hidden from diffuse and shadow rays", "left out", f"'{object.name}'")
    elif not all(seen):
        notes.add("object partly hidden from rays", "visible to all", f"'{object.name}'")
    return any(seen)


def _nothing(scene: bpy.types.Scene, lamps: Lamps) -> str:
    """What to do about a scene without surfaces."""
    found = f"{len(lamps.rows)} lamps but no" if lamps.rows else "no"
    return (
        f"scene '{scene.name}' has {found} mesh that renders: add one, or enable its render visibility "
        "(camera icon in the outliner)"
    )


def _note_colors(notes: Notes) -> None:
    """From Blender 5 on a file may mix colours in another space than ours."""
    space = getattr(getattr(bpy.data, "colorspace", None), "working_space", REC709)
    if space != REC709:
        notes.add(f"working space '{space}'", "its numbers as Linear Rec.709", "all colours")
