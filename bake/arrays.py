"""Points, normals and results of the command line as .npy files.

Comes in: files that anybody may have made. Goes out: checked numbers, and files that are whole or absent.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..tree.atomic import write_bytes_atomically
from .settings import SettingsError, unit


def one_line(error: BaseException) -> str:
    """Say an error in one line.

    Parameters
    ----------
    error : BaseException
        What was raised.

    Returns
    -------
    str
        Its message without line breaks.
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}"
    if isinstance(error, MemoryError):
        return "out of memory; use fewer samples or threads, or coarser voxels (--finest)"
    return " ".join(str(error).split()) or type(error).__name__


def read_points(points_path: Path, normals_path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read points and normals of equal number.

    Parameters
    ----------
    points_path, normals_path : Path
        .npy files of (n, 3) finite numbers; n may be 0.

    Returns
    -------
    points : (n, 3) float64 ndarray
        As they are.
    normals : (n, 3) float64 ndarray
        Made unit vectors.

    Raises
    ------
    SettingsError
        A file holds something else, a normal has no length, or the numbers of rows differ.
    OSError
        A file is missing or cannot be read.
    """
    points, normals = read_array(points_path), read_array(normals_path)
    if len(points) != len(normals):
        raise SettingsError(f"{points_path} has {len(points)} rows and {normals_path} {len(normals)}: want the same")
    return points, unit(normals, str(normals_path))


def read_array(path: Path) -> np.ndarray:
    """Read (n, 3) numbers; nothing in the file is executed.

    Parameters
    ----------
    path : Path
        A .npy file.

    Returns
    -------
    (n, 3) float64 ndarray
        Finite numbers.

    Raises
    ------
    SettingsError
        The file holds something else.
    OSError
        The file is missing or cannot be read.
    """
    array = _mapped(path)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise SettingsError(f"{path}: want numbers of shape (n, 3)")
    array = np.array(array, np.float64)
    if not np.isfinite(array).all():
        raise SettingsError(f"{path}: row {int(np.argmax(~np.isfinite(array).all(axis=1)))} holds NaN or infinity")
    return array


def read_roughness(path: Path) -> np.ndarray:
    """Read one number from 0 to 1 for each ray.

    Parameters
    ----------
    path : Path
        A .npy file of (n,) numbers.

    Returns
    -------
    (n,) float64 ndarray
        As they are.

    Raises
    ------
    SettingsError
        The file holds something else.
    OSError
        The file is missing or cannot be read.
    """
    array = _mapped(path)
    if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in "fiu":
        raise SettingsError(f"{path}: want numbers of shape (n,)")
    array = np.array(array, np.float64)
    if not ((array >= 0) & (array <= 1)).all():
        raise SettingsError(f"{path}: row {int(np.argmin((array >= 0) & (array <= 1)))} is not between 0 and 1")
    return array


def _mapped(path: Path) -> object:
    """What a .npy file holds, mapped, so that no more memory is taken than it has bytes, whatever its header says."""
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # numpy's reader of headers lets any error of Python's own parser through
        raise SettingsError(f"{path}: not a .npy file of numbers ({one_line(error)})") from error


def write_array(path: Path, array: np.ndarray) -> None:
    """Write a .npy file, whole or not at all.

    Parameters
    ----------
    path : Path
        The file; its name is taken as it is.
    array : ndarray
        Numbers; stored as float32.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    buffer = io.BytesIO()
    np.save(buffer, array.astype(np.float32), allow_pickle=False)
    write_bytes_atomically(path, buffer.getvalue())


def check_output(path: Path) -> None:
    """Refuse a file that cannot be created, before hours of work.

    Parameters
    ----------
    path : Path
        A file to write.

    Raises
    ------
    SettingsError
        It is a folder, or its folder is missing.
    """
    if path.is_dir():
        raise SettingsError(f"{path}: this is a folder; -o needs the name of a file")
    if not path.parent.is_dir():
        raise SettingsError(f"{path}: there is no folder {path.parent}")
