"""The folder that a bake writes to, and the scene that lies in it.

Comes in: finished cells. Goes out: a folder that always holds one bake, the one before or this one. Cells appear
there whole; files of another bake go when this one's first cell is there to replace them.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..tree import container, folder, probe_file
from ..tree.planes import CellPlanes
from ..tree.topology import Topology
from ..tree.verify import Defect
from . import snapshot_file
from .parallel import CancelledError
from .settings import SettingsError
from .snapshot import Snapshot

SNAPSHOT_NAME = "scene.giv"
"""The snapshot inside a bake's folder."""

STAGING = ".gi_volumes_"
"""How the name begins of a folder where a cell's files lie until all of them are written."""


def check_target(target: Path) -> None:
    """Refuse a folder that a bake must not write to.

    Parameters
    ----------
    target : Path
        Folder of a bake; it may be missing.

    Raises
    ------
    SettingsError
        It is a file, cannot be made, or another program's `world.json` or `probes.exr` is in it.
    """
    if target.exists() and not target.is_dir():
        raise SettingsError(f"{target}: this is a file; a bake needs a folder")
    parent = next((path for path in target.absolute().parents if path.exists()), target)
    if not target.exists() and not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        why = "cannot be written to" if parent.is_dir() else "is a file"
        raise SettingsError(f"{target}: {parent} {why}; choose another folder for the bake")
    probes = target / probe_file.PROBES
    if probes.exists() and not probe_file.is_ours(probes):
        raise SettingsError(f"{probes}: another program's file, or a damaged one; move it away, or bake elsewhere")
    if (target / folder.WORLD).is_dir():
        raise SettingsError(f"{target / folder.WORLD}: this is a folder; choose another folder for the bake")
    try:
        content = json.loads((target / folder.WORLD).read_bytes())
    except OSError:
        return
    except (ValueError, RecursionError):
        if any(path.suffix == f".{folder.TREE}" for path in folder.files(target)):
            return  # a damaged list of a bake's cells
        content = None
    if not isinstance(content, dict) or content.get("format") != folder.WORLD_FORMAT:
        raise SettingsError(f"{target / folder.WORLD}: another program's file; choose another folder for the bake")


def scene_defects(target: Path) -> list[Defect]:
    """Find what is wrong with the snapshot that lies in a bake's folder.

    Parameters
    ----------
    target : Path
        Folder of a bake.

    Returns
    -------
    list of Defect
        Empty for the undamaged snapshot of the scene that was baked.
    """
    try:
        found = snapshot_file.digest(snapshot_file.load(target / SNAPSHOT_NAME))
    except FileNotFoundError:
        return [Defect(SNAPSHOT_NAME, "the file is missing")]
    except container.FileError as error:
        return [Defect(SNAPSHOT_NAME, f"byte {error.offset}: {error.reason}")]
    except (OSError, ValueError) as error:
        return [Defect(SNAPSHOT_NAME, str(error))]
    with contextlib.suppress(OSError, container.FileError):
        if folder.load_header(target)["snapshot"] != found:
            return [Defect(SNAPSHOT_NAME, "the snapshot is of another scene than the bake")]
    return []


class Place:
    """The folder of a bake. Another bake in it stays whole until this one has something to put in its place.

    Parameters
    ----------
    target : Path
        The folder; it is made if needed.
    snapshot : Snapshot
        The scene, stored beside the cells.
    header : dict
        For `folder.assemble`.
    patient : bool
        Whether another bake's cells stay, unlisted, until this one ends: `keep_cell` may take them over.

    Attributes
    ----------
    target : Path
        The folder.
    identity : str
        Hash of the bake.
    taken : bool
        Whether the folder holds this bake, with as many cells as there are.

    Raises
    ------
    OSError
        The folder cannot be written; it is as it was before.
    """

    def __init__(self, target: Path, snapshot: Snapshot, header: dict, patient: bool = False) -> None:
        self.target, self.identity, self.taken, self._patient = target, header["bake"], False, patient
        self._snapshot, self._header = snapshot, header
        self._staging: list[Path] = []
        self._lock, self._early, self._closed = threading.RLock(), set(), False
        is_new = not target.exists()
        target.mkdir(parents=True, exist_ok=True)
        try:
            self._check_writable()
            if _bake_in(target) in (None, self.identity):
                self.take()
        except OSError:
            if is_new:
                with contextlib.suppress(OSError):
                    target.rmdir()
            raise

    def take(self) -> None:
        """Make the folder this bake's: its scene, its list of cells, and no files of another bake.

        Raises
        ------
        OSError
            A file cannot be written or removed.
        """
        if self.taken:
            return
        with self._stage() as staging:
            snapshot_file.save(self._snapshot, staging / SNAPSHOT_NAME)
            cells = self.list_cells()
            self.taken = True
            (staging / SNAPSHOT_NAME).replace(self.target / SNAPSHOT_NAME)
        if not self._patient:
            self._remove_others(cells)

    def close(self) -> list[dict]:
        """List the cells that are there, and leave nothing else; no thread can write any more.

        Returns
        -------
        list of dict
            Entries of the cells in `world.json`; empty while the folder holds another bake.

        Raises
        ------
        OSError
            The list cannot be written.
        """
        with self._lock:
            self._closed = True
            for staging in self._staging:
                shutil.rmtree(staging, ignore_errors=True)
            cells = self.list_cells() if self.taken else []
            if self.taken and self._patient:
                self._remove_others(cells)
            return cells

    def write_cell(
        self,
        tree: Topology,
        payloads: dict,
        valid: np.ndarray,
        offset: np.ndarray,
        planes: CellPlanes | None = None,
        limit: int = 0,
        marks: dict[str, bool] | None = None,
    ) -> int:
        """Put all files of a cell into the folder, or none; the tree, which makes a cell count, comes last. Several
        threads may write cells at once.

        Parameters
        ----------
        tree : Topology
            The cell's tree.
        payloads : dict of str to (size, K, 9, 3) float32 ndarray
            As for `folder.write_cell`.
        valid : (size,) bool ndarray
            Which voxels have a data point.
        offset : (size, 3) int8 ndarray
            Data point minus voxel centre, in voxel sizes / 254.
        planes : CellPlanes, optional
            Occluding planes of the data points; none when left out.
        limit : int
            Files that take more bytes than this together are not put there; 0 for no limit.
        marks : dict of str to bool, optional
            What holds of the cell: "early" of a coarse one that will be replaced, "by_paths" where its surface cache
            was too far off.

        Returns
        -------
        int
            Bytes of all files.

        Raises
        ------
        OSError
            A file cannot be written.
        CancelledError
            The folder is closed.
        """
        with self._stage() as staging:
            meta = {"bake": self.identity} | {name: True for name, holds in (marks or {}).items() if holds}
            folder.write_cell(staging, tree, payloads, valid, offset, meta, planes)
            size = sum(path.stat().st_size for path in staging.iterdir())
            if limit and size > limit:
                return size
            self._put(staging, tree.cell)
        return size

    def keep_cell(self, cell: tuple[int, int], content: str) -> folder.Cell | None:
        """Take over a cell of another bake as it is.

        Parameters
        ----------
        cell : (2,) int
            World cell (i, j).
        content : str
            What its files have to hold, as `folder.digest_of_cell` says.

        Returns
        -------
        Cell or None
            The cell; None where its files are not there, not whole, or hold something else.

        Raises
        ------
        OSError
            A file cannot be written.
        CancelledError
            The folder is closed.
        """
        try:
            found = folder.read_cell(self.target, cell)
        except (OSError, container.FileError):
            return None
        if folder.digest_of_cell(found) != content:
            return None
        with self._stage() as staging:
            try:
                folder.copy_cell(self.target, staging, cell, self.identity)
            except (OSError, container.FileError):
                return None  # another process has replaced it
            self._put(staging, cell)
        return found

    def list_cells(self) -> list[dict]:
        """List the cells that are there in `world.json`.

        Returns
        -------
        list of dict
            Their entries.

        Raises
        ------
        OSError
            The list cannot be written.
        """
        cells = folder.assemble(self.target, self._header)["cells"]
        self._early = {tuple(entry["cell"]) for entry in cells if entry.get("early")}
        return cells

    def _put(self, staging: Path, cell: tuple[int, int]) -> None:
        """Move a cell's files to where they belong."""
        with self._lock:
            if self._closed:
                raise CancelledError
            self.take()
            if cell in self._early:
                folder.cell_path(self.target, cell, folder.TREE).unlink(missing_ok=True)
            for path in sorted(staging.iterdir(), key=lambda path: path.suffix == ".tree"):
                path.replace(self.target / path.name)
            if cell in self._early:
                self.list_cells()

    def _remove_others(self, cells: list[dict]) -> None:
        """Remove the files of cells that are not this bake's."""
        listed = {file["name"] for entry in cells for file in entry["files"].values()}
        _remove_other_bakes(self.target, self.identity, listed)

    @contextlib.contextmanager
    def _stage(self) -> Iterator[Path]:
        """A folder for files that nobody may see yet; `close` removes what an interruption leaves of it."""
        with self._lock:
            if self._closed:
                raise CancelledError
            staging = Path(tempfile.mkdtemp(prefix=STAGING, dir=self.target))
            self._staging.append(staging)
        try:
            yield staging
        finally:
            shutil.rmtree(staging, ignore_errors=True)

    def _check_writable(self) -> None:
        """Refuse a folder that nothing can be put into, before hours of work."""
        try:
            with self._stage():
                pass
        except OSError as error:
            raise OSError(error.errno, f"cannot write: {error.strerror}", str(self.target)) from None


def _bake_in(target: Path) -> str | None:
    """Hash of the bake that a folder holds; None without one."""
    try:
        return folder.load_header(target)["bake"]
    except (OSError, container.FileError):
        return None


def _remove_other_bakes(target: Path, identity: str, listed: set[str]) -> None:
    """Remove the files of cells and probes that this bake did not write; of cells only those that it does not list
    are read."""
    for path in folder.files(target):
        if path.name.startswith("cell_") and path.name not in listed and not _belongs(path, identity):
            path.unlink(missing_ok=True)
    if (probe_file.describe(target) or {}).get("bake", identity) != identity:
        (target / probe_file.PROBES).unlink(missing_ok=True)


def _belongs(path: Path, identity: str) -> bool:
    """Whether a cell's file is whole and of this bake."""
    try:
        return container.read(path).meta.get("bake") == identity
    except (OSError, container.FileError):
        return False
