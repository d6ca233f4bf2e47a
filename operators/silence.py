"""Standard output belongs to the caller: what Blender prints goes to standard error.

Blender 5 prints already when it is imported, so the front imports it from here.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDOUT, STDERR = 1, 2


@contextmanager
def quiet() -> Iterator[None]:
    """Send everything printed on standard output to standard error, what C++ prints as well."""
    try:
        sys.stdout.flush()
        saved = os.dup(STDOUT)
    except (OSError, AttributeError):  # a desktop Blender may have no output at all
        yield
        return
    try:
        os.dup2(STDERR, STDOUT)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, STDOUT)
        os.close(saved)


with quiet():
    import bpy

__all__ = ["bpy", "quiet"]
