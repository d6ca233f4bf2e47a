"""The dependency graph that renders, for a moment.

Blender hands out a graph with *render* settings (modifiers' render levels, render visibility, objects that are
hidden in the viewport alone) to render engines only. So a temporary engine renders a temporary copy of the
scene: it gets the graph, reads it, and draws nothing. The copy shares all objects; everything temporary is
removed also when reading fails, and the user's scene, selection, mode and undo stack are never touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from ..bake.snapshot import SnapshotError

ENGINE = "GI_VOLUMES_READER"
RENDER_RESULT = "Render Result"
# The picture is thrown away; Blender allows no smaller one.
PICTURE_PX = 4


def read(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, reader: Callable[[Any], Any]) -> Any:
    """Call a function with the graph of a scene as it renders.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene, not evaluated.
    view_layer : bpy.types.ViewLayer
        Which of its view layers.
    reader : callable
        `reader(depsgraph)`; nothing of the graph may be kept after it returns.

    Returns
    -------
    Any
        What the reader returned.

    Raises
    ------
    SnapshotError
        Blender did not evaluate the scene, for example because a render is running.
    """
    outcome: dict[str, Any] = {}

    class Reader(bpy.types.RenderEngine):
        bl_idname = ENGINE
        bl_label = "GI Volumes Reader"

        def render(self, depsgraph: bpy.types.Depsgraph) -> None:
            try:
                outcome["value"] = reader(depsgraph)
            except Exception as error:  # Blender would print and forget it
                outcome["error"] = error

    bpy.utils.register_class(Reader)
    try:
        with _copy(scene, view_layer) as copy:
            render(copy)
    finally:
        bpy.utils.unregister_class(Reader)
    if "error" in outcome:
        raise outcome["error"]
    if "value" not in outcome:
        raise SnapshotError(
            f"scene '{scene.name}' could not be evaluated: wait until the running render ends, try again"
        )
    return outcome["value"]


def render(scene: bpy.types.Scene, write: bool = False) -> None:
    """Render a temporary scene on this thread, unseen by handlers and leaving no render result behind.

    Parameters
    ----------
    scene : bpy.types.Scene
        A temporary scene.
    write : bool
        Whether to write its picture to its file.

    Raises
    ------
    SnapshotError
        Blender refused, for example because a render is running.
    """
    before = RENDER_RESULT in bpy.data.images
    with _without_handlers():
        try:
            bpy.ops.render.render(scene=scene.name, write_still=write)
        except RuntimeError as error:
            raise SnapshotError(f"the scene could not be evaluated: {str(error).strip()}") from error
        finally:
            image = bpy.data.images.get(RENDER_RESULT)
            if image is not None and not before:
                bpy.data.images.remove(image)


@contextmanager
def _without_handlers() -> Iterator[None]:
    """Keep scripts that wait for the user's renders from hearing of this one."""
    lists = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers) if name.startswith("render_")]
    kept = [list(handlers) for handlers in lists]
    for handlers in lists:
        handlers.clear()
    try:
        yield
    finally:
        for handlers, functions in zip(lists, kept, strict=True):
            handlers.extend(functions)


@contextmanager
def _copy(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> Iterator[bpy.types.Scene]:
    """A scene with the same objects and one view layer, which renders with the reader and into nothing."""
    name = view_layer.name
    camera = bpy.data.cameras.new("GI Volumes")
    copy = scene.copy()
    try:
        _keep_only(copy, name)
        if copy.camera is None:
            copy.camera = bpy.data.objects.new("GI Volumes", camera)
        settings = copy.render
        settings.engine = ENGINE
        settings.resolution_x = settings.resolution_y = PICTURE_PX
        settings.resolution_percentage = 100
        settings.use_compositing = settings.use_sequencer = settings.use_multiview = False
        settings.use_border = False
        yield copy
    finally:
        bpy.data.scenes.remove(copy)
        bpy.data.cameras.remove(camera)


def _keep_only(scene: bpy.types.Scene, name: str) -> None:
    """Drop the other view layers: each would render."""
    for layer in [layer for layer in scene.view_layers if layer.name != name]:
        scene.view_layers.remove(layer)
    scene.view_layers[name].use = True
