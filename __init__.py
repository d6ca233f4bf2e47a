"""GI Volumes: bakes and previews global-illumination volumes.

The folder of this file is both a Blender extension and the Python package
`gi_volumes`. Importing it is cheap and needs neither Blender nor numpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from .tree.world import World

VERSION = "0.1.0"


def register() -> None:
    """Add the panels, operators and settings to Blender."""
    from . import operators

    operators.register()


def unregister() -> None:
    """Remove everything that `register` added, and stop a bake that runs."""
    from . import operators

    operators.unregister()


def load(folder: Path | str) -> World:
    """Open a baked folder for look-ups.

    Parameters
    ----------
    folder : Path or str
        The folder that a bake wrote.

    Returns
    -------
    World
        The bake, read whole and checked.

    Raises
    ------
    FileError
        A file is damaged or of a newer version; the message names file, offset and reason.
    OSError
        A file is missing or cannot be read.
    """
    from .tree.world import load as load_world

    return load_world(folder)
