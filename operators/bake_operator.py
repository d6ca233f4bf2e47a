"""The operators *Bake GI* and *Cancel*.

In the background, and from scripts, *Bake GI* blocks until the bake is done. In a window it is modal: a timer
follows the worker, Esc cancels, and everything else goes on working.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from . import dependencies, job, probe_operators, properties

TICK_S = 0.2


class GIVOLUMES_OT_bake(bpy.types.Operator):
    """Bake the light of this scene into the output folder. Esc cancels and keeps what is finished"""

    bl_idname = "gi_volumes.bake"
    bl_label = "Bake GI"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        if job.current is not None:
            cls.poll_message_set("A bake is running: wait for it or cancel it")
        return job.current is None and context.scene is not None

    def execute(self, context):
        complaint = dependencies.complaint()
        if complaint:
            self.report({"ERROR"}, complaint)
            return {"CANCELLED"}
        try:
            started = job.begin(context.scene)
        except properties.SettingsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._steps, self._scene = started.steps(), context.scene.name
        if bpy.app.background or not self.options.is_invoke:
            return self._run_to_end(started)
        self._shown = None
        self._timer = context.window_manager.event_timer_add(TICK_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if job.current is None:  # the extension was disabled and enabled again
            return self._finish(context)
        if event.type == "ESC" and event.value == "PRESS" and not job.current.stopping:
            job.current.stop()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL", "PASS_THROUGH"}
        try:
            progress = next(self._steps, None)
        except Exception:  # a defect of ours: leave the window usable, then let Blender show it
            self._finish(context)
            raise
        if progress is None:
            return self._finish(context)
        if progress != self._shown:
            self._shown = progress
            context.workspace.status_text_set(f"GI Volumes: {progress.text} | Esc cancels")
            redraw_panels()
        return {"RUNNING_MODAL", "PASS_THROUGH"}

    def cancel(self, context):
        if job.current is not None:
            job.current.abandon()
            self._steps.close()
            self._finish(context)

    def _run_to_end(self, started):
        """For scripts: progress to standard error, once per stage."""
        stage = None
        try:
            with interrupts(started.stop):
                for progress in self._steps:
                    if progress.stage != stage:
                        stage = progress.stage
                        print(f"GI Volumes: {stage}", file=sys.stderr)
                    time.sleep(TICK_S / 2)
        finally:
            outcome = job.end()
        return self._tell(outcome)

    def _finish(self, context):
        """Leave the window as it was."""
        context.window_manager.event_timer_remove(self._timer)
        for workspace in bpy.data.workspaces:
            workspace.status_text_set(None)
        outcome = self._tell(job.end())
        redraw_panels()
        return outcome

    def _tell(self, outcome):
        """One report for the end, one for what was left out, one for what may be a mistake in the scene."""
        levels = {"done": "INFO", "stopped": "WARNING", "failed": "ERROR"}
        if outcome.left_out:
            self.report({"INFO"}, f"Left out: {'; '.join(outcome.left_out)}")
        if outcome.warnings:
            self.report({"WARNING"}, "; ".join(outcome.warnings))
        self.report({levels[outcome.kind]}, outcome.message)
        if outcome.kind == "done" and probe_operators.refresh(bpy.data.scenes.get(self._scene)):
            bpy.ops.ed.undo_push(message="Show Probes")
        return {"FINISHED"} if outcome.kind == "done" else {"CANCELLED"}


class GIVOLUMES_OT_cancel(bpy.types.Operator):
    """Stop the bake that runs; finished cells are kept and are not baked again"""

    bl_idname = "gi_volumes.cancel"
    bl_label = "Cancel Bake"

    @classmethod
    def poll(cls, context):
        if job.current is None:
            cls.poll_message_set("No bake is running")
        return job.current is not None

    def execute(self, context):
        job.current.stop()
        return {"FINISHED"}


def redraw_panels() -> None:
    """Redraw the places where the panels are."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"PROPERTIES", "VIEW_3D"}:
                for region in area.regions:
                    if region.type in {"UI", "WINDOW"} and (area.type, region.type) != ("VIEW_3D", "WINDOW"):
                        region.tag_redraw()


@contextmanager
def interrupts(stop) -> Iterator[None]:
    """Call a function on Ctrl-C, while the block runs.

    Parameters
    ----------
    stop : callable
        Takes no arguments.

    Yields
    ------
    None
        Once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)


CLASSES = (GIVOLUMES_OT_bake, GIVOLUMES_OT_cancel)
