"""Everything an artist touches: reading the scene, settings, panels, operators, the command in Blender."""

from __future__ import annotations


def register() -> None:
    """Add classes, properties and the command to Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Stop a bake that runs and remove everything that `register` added."""
    from . import registration

    registration.unregister()
