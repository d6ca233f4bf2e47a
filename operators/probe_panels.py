"""Panels of reflection probes: in the render properties, in the sidebar of the 3D view, in the object's properties."""

from __future__ import annotations

import bpy

from . import baked_probes, dependencies, job, probe_marks, properties


class _Probes:
    """What the render properties and the sidebar share."""

    bl_label = "Reflection Probes"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, settings = self.layout, context.scene.gi_volumes
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.enabled = job.current is None
        column.prop(settings, "probes")
        if settings.probes == "count":
            column.prop(settings, "probe_count")
        if settings.probes != "none":
            column.prop(settings, "probe_megabytes")
        row = layout.row(align=True)
        row.operator("gi_volumes.place_probes", icon="HIDE_OFF")
        row.operator("gi_volumes.add_probe", icon="ADD")
        row = layout.row(align=True)
        row.operator("gi_volumes.pin_probes", icon="PINNED").pin = True
        row.operator("gi_volumes.pin_probes", text="Release", icon="UNPINNED").pin = False
        found = probe_marks.probes_of(context.scene)
        column = layout.column(align=True)
        for line in status(context.scene, found):
            column.label(text=line)
        if probe_marks.deleted(context.scene, found):
            layout.operator("gi_volumes.forget_deleted_probes", icon="LOOP_BACK")


class GIVOLUMES_PT_render_probes(_Probes, bpy.types.Panel):
    """Reflection probes, in the render properties."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_parent_id = "GIVOLUMES_PT_render"


class GIVOLUMES_PT_sidebar_probes(_Probes, bpy.types.Panel):
    """Reflection probes, in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GI Volumes"
    bl_parent_id = "GIVOLUMES_PT_sidebar"


class GIVOLUMES_PT_object(bpy.types.Panel):
    """Settings of an object that stands for a reflection probe."""

    bl_label = "GI Volumes"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "object"

    @classmethod
    def poll(cls, context):
        return context.object is not None and probe_marks.is_probe(context.object)

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        self.layout.prop(context.object.gi_volumes, "pinned")


def status(scene: bpy.types.Scene, found: list[bpy.types.Object]) -> list[str]:
    """Say what there is of reflection probes.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.
    found : list of bpy.types.Object
        Its probes' objects.

    Returns
    -------
    list of str
        A line about the bake's, where there is a bake; a line about what the next one is told.
    """
    pinned = sum(probe_marks.is_pinned(object, probe_marks.place_of(object)) for object in found)
    gone = len(probe_marks.deleted(scene, found))
    lines = [_baked(scene)] if not dependencies.complaint() else []
    return [*filter(None, lines), f"Next bake: {pinned} pinned, {gone} deleted"]


def _baked(scene: bpy.types.Scene) -> str:
    """Number and size of the bake's probes; empty without a bake that can be read."""
    try:
        baked = baked_probes.read(properties.output_folder(scene))
    except (OSError, ValueError):
        return ""
    if baked is None:
        return ""
    if not len(baked.place):
        return "The bake has none"
    return f"The bake has {len(baked.place)}: {job.size(baked.texture_bytes)}, file {job.size(baked.file_bytes)}"


CLASSES = (GIVOLUMES_PT_render_probes, GIVOLUMES_PT_sidebar_probes, GIVOLUMES_PT_object)
