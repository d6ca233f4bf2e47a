"""The operator *Clear Bake*: removes the files that a bake wrote, and nothing else."""

from __future__ import annotations

import contextlib

import bpy

from . import job, properties
from .snapshot_command import one_line


class GIVOLUMES_OT_clear(bpy.types.Operator):
    """Delete this scene's bake from its output folder; other files in that folder are left alone"""

    bl_idname = "gi_volumes.clear"
    bl_label = "Clear Bake"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        if job.current is not None:
            cls.poll_message_set("A bake is running: wait for it or cancel it")
        return job.current is None and context.scene is not None

    def invoke(self, context, event):
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context):
        from ..bake import memory
        from ..tree import folder

        try:
            place = properties.output_folder(context.scene)
            files = folder.files(place)
            if place / folder.WORLD in files:
                folder.load_header(place)  # refuses another program's file of that name
            files += memory.files(place)
            for file in files:
                file.unlink(missing_ok=True)
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        for emptied in (place / memory.FOLDER, place):
            with contextlib.suppress(OSError):
                emptied.rmdir()
        self.report({"INFO"}, f"Removed {len(files)} files from {place}" if files else f"No bake in {place}")
        job.last = None
        return {"FINISHED"}


CLASSES = (GIVOLUMES_OT_clear,)
