"""Files that are either complete or absent.

Comes in: bytes. Goes out: a file that replaces its predecessor in one step, after its content is on the disk.
"""

from __future__ import annotations

import contextlib
import os
import uuid
from pathlib import Path

__all__ = ["write_bytes_atomically"]


def write_bytes_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Replace a file by new content; on any failure the old file stays and no other is left.

    Parameters
    ----------
    path : str or Path
        The file.
    data : bytes
        Its new content.

    Raises
    ------
    OSError
        When the folder is missing, read-only or full; the message names `path`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise OSError(error.errno, f"cannot write: {error.strerror}", os.fspath(path)) from None
        raise


def _sync_folder(folder: Path) -> None:
    """Make the new name durable, where the system lets a folder be opened."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
