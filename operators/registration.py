"""What Blender is given when the extension is enabled, and takes back when it is disabled."""

from __future__ import annotations

import bpy

from . import (
    bake_operator,
    clear_operator,
    command,
    job,
    panels,
    probe_operators,
    probe_panels,
    properties,
)

CLASSES = (
    *properties.CLASSES,
    *bake_operator.CLASSES,
    *clear_operator.CLASSES,
    *probe_operators.CLASSES,
    *panels.CLASSES,
    *probe_panels.CLASSES,
)

_register_classes, _unregister_classes = bpy.utils.register_classes_factory(CLASSES)
_commands: list[object] = []


def register() -> None:
    """Add classes, properties and the command."""
    _register_classes()
    properties.attach()
    bpy.app.handlers.load_post.append(job.forget)
    _commands.append(bpy.utils.register_cli_command(command.NAME, command.main))


def unregister() -> None:
    """Stop a bake that runs and remove everything."""
    if job.current is not None:
        job.current.abandon()
        job.end()
    if job.forget in bpy.app.handlers.load_post:
        bpy.app.handlers.load_post.remove(job.forget)
    while _commands:
        bpy.utils.unregister_cli_command(_commands.pop())
    properties.detach()
    _unregister_classes()
