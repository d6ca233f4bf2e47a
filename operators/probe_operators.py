"""Operators for reflection probes: show those of the bake, add, pin and release some, allow deleted ones again."""

from __future__ import annotations

import bpy

from . import baked_probes, dependencies, job, probe_marks, probe_objects, properties
from .snapshot_command import one_line

# Modal operators that would be left with objects that are gone.
HOLDING = ("TRANSFORM_OT", "OBJECT_OT")


class GIVOLUMES_OT_place_probes(bpy.types.Operator):
    """Show the bake's reflection probes as objects. Moved ones are pinned, deleted ones stay away from the next bake"""

    bl_idname = "gi_volumes.place_probes"
    bl_label = "Show Probes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return _in_object_mode(cls, context)

    def execute(self, context):
        try:
            baked = _baked(context.scene)
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        probe_objects.show(context.scene, baked)
        if len(baked.place):
            self.report({"INFO"}, f"{len(baked.place)} reflection probes, {job.size(baked.texture_bytes)} as textures")
        else:
            self.report({"WARNING"}, "This bake has no reflection probes: its summary says why; see also Probes")
        return {"FINISHED"}


class GIVOLUMES_OT_add_probe(bpy.types.Operator):
    """Add a reflection probe at the 3D cursor; the next bake makes it there"""

    bl_idname = "gi_volumes.add_probe"
    bl_label = "Add Probe"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return _in_object_mode(cls, context)

    def execute(self, context):
        scene = context.scene
        object = probe_objects.add(scene, tuple(scene.cursor.location), probe_objects.usual_reach(scene))
        object.gi_volumes.kept = True
        for other in context.selected_objects:
            other.select_set(False)
        if object.name in context.view_layer.objects:
            object.select_set(True)
            context.view_layer.objects.active = object
        return {"FINISHED"}


class GIVOLUMES_OT_pin_probes(bpy.types.Operator):
    """Pin the selected reflection probes where they are: the next bake makes them in any case"""

    bl_idname = "gi_volumes.pin_probes"
    bl_label = "Pin"
    bl_options = {"REGISTER", "UNDO"}

    pin: bpy.props.BoolProperty(
        name="Pin",
        description="Without it they are released: they go back to where the bake had put them (on by default)",
        default=True,
    )

    @classmethod
    def poll(cls, context):
        chosen = any(map(probe_marks.is_probe, context.selected_objects))
        if not chosen:
            cls.poll_message_set("Select reflection probes")
        return chosen

    def execute(self, context):
        for object in filter(probe_marks.is_probe, context.selected_objects):
            object.gi_volumes.pinned = self.pin
        return {"FINISHED"}


class GIVOLUMES_OT_forget_deleted_probes(bpy.types.Operator):
    """Allow reflection probes again where some were deleted; the next bake may make some there"""

    bl_idname = "gi_volumes.forget_deleted_probes"
    bl_label = "Allow Deleted Again"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        count = probe_objects.forget_deleted(context.scene)
        if not count:
            self.report({"WARNING"}, "No reflection probe has been deleted")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Probes are allowed again at {count} places")
        return {"FINISHED"}


def refresh(scene: bpy.types.Scene | None) -> bool:
    """Bring the objects of a scene's probes up to date after a bake, where some are shown.

    Parameters
    ----------
    scene : bpy.types.Scene or None
        The scene that was baked, if it is still there.

    Returns
    -------
    bool
        Whether it was done; not while something else is edited, or an object is moved and so is held by an operator.
    """
    if scene is None or not probe_marks.probes_of(scene) or bpy.context.mode != "OBJECT" or _is_busy():
        return False
    try:
        probe_objects.show(scene, _baked(scene))
    except (OSError, ValueError):  # the button says why
        return False
    return True


def _in_object_mode(operator: type, context: bpy.types.Context) -> bool:
    """Whether objects can be added and removed, and be back when that is undone."""
    if context.mode != "OBJECT":
        operator.poll_message_set("Probes are shown and added in Object Mode")
    return context.mode == "OBJECT"


def _baked(scene: bpy.types.Scene) -> baked_probes.Baked:
    """The probes of a scene's bake."""
    complaint = dependencies.complaint()
    if complaint:
        raise ValueError(complaint)
    folder = properties.output_folder(scene)
    baked = baked_probes.read(folder)
    if baked is None:
        raise ValueError(f"No bake in {folder} yet: press Bake GI first")
    return baked


def _is_busy() -> bool:
    """Whether an operator in a window holds objects."""
    windows = bpy.context.window_manager.windows
    return any(running.bl_idname.startswith(HOLDING) for window in windows for running in window.modal_operators)


CLASSES = (
    GIVOLUMES_OT_place_probes,
    GIVOLUMES_OT_add_probe,
    GIVOLUMES_OT_pin_probes,
    GIVOLUMES_OT_forget_deleted_probes,
)
