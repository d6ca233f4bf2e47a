"""Panels: in the render properties and in the sidebar of the 3D view, in the lamp's properties, in the preferences."""

from __future__ import annotations

import textwrap

import bpy

from . import dependencies, job

ROOT_PACKAGE = __package__.rpartition(".")[0]
MOST_NOTES = 5
# Mean width of a character of Blender's interface font at a scale of 1, and of a panel's borders and an icon.
CHARACTER_PX = 7.0
MARGIN_PX = 75.0
FEWEST_CHARACTERS = 20


class _Main:
    """What the render properties and the sidebar share."""

    bl_label = "GI Volumes"

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.gi_volumes
        draw_complaint(layout)
        column = layout.column()
        column.enabled = job.current is None
        column.prop(settings, "quality")
        column.prop(settings, "output_folder")
        draw_job(layout)


class _Details:
    """Settings that most scenes leave alone."""

    bl_label = "Settings"
    bl_options = {"DEFAULT_CLOSED"}
    bl_order = 1  # below reflection probes

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = job.current is None
        for name in ("sun", "sky", "finest", "threads", "seed"):
            layout.prop(context.scene.gi_volumes, name)
        layout.operator("gi_volumes.clear", icon="TRASH")


class GIVOLUMES_PT_render(_Main, bpy.types.Panel):
    """The bake, in the render properties, for any render engine."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}


class GIVOLUMES_PT_render_details(_Details, bpy.types.Panel):
    """More settings, in the render properties."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_parent_id = "GIVOLUMES_PT_render"


class GIVOLUMES_PT_sidebar(_Main, bpy.types.Panel):
    """The bake, in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GI Volumes"


class GIVOLUMES_PT_sidebar_details(_Details, bpy.types.Panel):
    """More settings, in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GI Volumes"
    bl_parent_id = "GIVOLUMES_PT_sidebar"


class GIVOLUMES_PT_light(bpy.types.Panel):
    """Settings of a lamp."""

    bl_label = "GI Volumes"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return context.light is not None

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.prop(context.light.gi_volumes, "reflector")


class GIVOLUMES_AP_preferences(bpy.types.AddonPreferences):
    """Says which libraries are missing."""

    bl_idname = ROOT_PACKAGE

    def draw(self, context):
        if not draw_complaint(self.layout):
            self.layout.label(text="All libraries are there", icon="CHECKMARK")


def draw_complaint(layout: bpy.types.UILayout) -> bool:
    """Draw what to do when libraries are missing.

    Parameters
    ----------
    layout : bpy.types.UILayout
        Where to draw.

    Returns
    -------
    bool
        Whether there was something to say.
    """
    complaint = dependencies.complaint()
    if complaint:
        draw_text(layout.column(align=True), complaint, "ERROR")
    return bool(complaint)


def draw_job(layout: bpy.types.UILayout) -> None:
    """Draw the Bake button, or the progress of the bake that runs, and how the last one ended.

    Parameters
    ----------
    layout : bpy.types.UILayout
        Where to draw.
    """
    if job.current is None:
        layout.operator("gi_volumes.bake", icon="LIGHT_HEMI")
        draw_outcome(layout, job.last)
        return
    progress = job.current.progress
    row = layout.row(align=True)
    row.progress(factor=progress.fraction, text=progress.text, type="BAR")
    row.operator("gi_volumes.cancel", text="", icon="CANCEL")


def draw_outcome(layout: bpy.types.UILayout, outcome: job.Outcome | None) -> None:
    """Draw how the last bake ended.

    Parameters
    ----------
    layout : bpy.types.UILayout
        Where to draw.
    outcome : Outcome or None
        The last outcome of this session, if any.
    """
    if outcome is None:
        return
    icons = {"done": "CHECKMARK", "stopped": "INFO", "failed": "ERROR"}
    column = layout.column(align=True)
    draw_text(column, outcome.message, icons[outcome.kind])
    notes = [(text, "ERROR") for text in outcome.warnings]
    notes += [(f"Left out: {text}", "DOT") for text in outcome.left_out]
    for text, icon in notes[:MOST_NOTES]:
        draw_text(column, text, icon)
    if len(notes) > MOST_NOTES:
        draw_text(column, f"and {len(notes) - MOST_NOTES} more: see the Info editor", "BLANK1")


def draw_text(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """Draw text over as many lines as the region's width asks for.

    Parameters
    ----------
    layout : bpy.types.UILayout
        An aligned column.
    text : str
        What to say.
    icon : str
        Name of the icon before the first line.
    """
    scale = bpy.context.preferences.system.ui_scale
    width = int((bpy.context.region.width / scale - MARGIN_PX) / CHARACTER_PX) if bpy.context.region else 0
    for number, line in enumerate(textwrap.wrap(text, max(width, FEWEST_CHARACTERS))):
        layout.label(text=line, icon="BLANK1" if number else icon)


CLASSES = (
    GIVOLUMES_PT_render,
    GIVOLUMES_PT_render_details,
    GIVOLUMES_PT_sidebar,
    GIVOLUMES_PT_sidebar_details,
    GIVOLUMES_PT_light,
    GIVOLUMES_AP_preferences,
)
