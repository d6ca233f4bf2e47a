"""A bake as Blender sees it: read the scene here, on the main thread, then follow a worker.

A job is an iterator of progress. The operator runs it to the end in the background, or one step per timer
tick in a window. One job runs at a time; `current` and `last` are what the panels show.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from . import properties
from .snapshot_command import one_line
from .worker import Progress, Worker, duration

# Blender is closing or loading another file: do not make people wait longer than this.
CLOSING_PATIENCE_S = 5.0


@dataclass(frozen=True)
class Outcome:
    """How a job ended: "done", "failed" or "stopped"; one line for people; what they should know besides."""

    kind: str
    message: str
    warnings: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


class Job:
    """A bake of one scene.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene; its settings are read now.

    Raises
    ------
    SettingsError
        The settings cannot be used; the message holds the remedy.
    """

    def __init__(self, scene: bpy.types.Scene) -> None:
        self.folder = properties.output_folder(scene)
        self.progress = Progress("Reading the scene")
        self.outcome: Outcome | None = None
        self._options = properties.arguments(scene)
        self._worker: Worker | None = None
        self._stopping = False

    def steps(self) -> Iterator[Progress]:
        """Run the job; afterwards `outcome` is set. The scene is read in the second step.

        Yields
        ------
        Progress
            After each step.
        """
        yield self.progress
        try:
            with tempfile.TemporaryDirectory(prefix="gi_volumes_", dir=bpy.app.tempdir) as scratch:
                snapshot = Path(scratch) / "scene.giv"
                write_snapshot(snapshot)
                yield from self._follow(self._command(snapshot), Path(scratch))
        except (OSError, ValueError) as error:
            self.outcome = Outcome("failed", one_line(error))

    def stop(self) -> None:
        """Ask for an early end; finished cells are kept."""
        self._stopping = True

    def abandon(self) -> None:
        """End the worker now, because Blender closes, loads a file or disables the extension."""
        self._stopping = True
        if self._worker is not None:
            self._worker.wait(CLOSING_PATIENCE_S)

    @property
    def stopping(self) -> bool:
        """Whether an early end was asked for."""
        return self._stopping

    def _command(self, snapshot: Path) -> list[str]:
        """The arguments of the worker."""
        options = [text for pair in self._options.items() for text in pair]
        return ["bake", str(snapshot), "-o", str(self.folder), "--early", "--incremental", *options]

    def _follow(self, arguments: list[str], scratch: Path) -> Iterator[Progress]:
        """Until the worker ends, however it or this iterator ends."""
        self._worker = worker = Worker(arguments, scratch)
        try:
            while worker.poll():
                if self._stopping:
                    worker.stop()
                self.progress = Progress("Stopping") if self._stopping else worker.progress
                yield self.progress
        finally:
            worker.wait(CLOSING_PATIENCE_S)
        self.outcome = _outcome(worker)


def write_snapshot(path: Path) -> None:
    """Read the open scene and write its snapshot.

    Parameters
    ----------
    path : Path
        File to create.

    Raises
    ------
    ValueError
        There is nothing to bake, or the scene holds invalid numbers.
    OSError
        A file cannot be read or written.
    """
    # Imported here, since without the libraries the extension must still start, to say which are missing.
    from ..bake import snapshot_file
    from . import extract

    snapshot_file.save(extract.extract(bpy.context), path)


def _outcome(worker: Worker) -> Outcome:
    """What the worker left, in words."""
    if worker.result is not None:
        warnings = tuple(str(text) for text in worker.result.get("warnings", []))
        left_out = tuple(f"{left['what']}: {left['why']}" for left in worker.result.get("left_out", []))
        return Outcome("done", summary(worker.result), warnings, left_out)
    if worker.stopped:
        return Outcome("stopped", "Bake cancelled; finished cells are kept")
    return Outcome("failed", worker.error)


def summary(result: dict) -> str:
    """Return one line about a finished bake.

    Parameters
    ----------
    result : dict
        The JSON object of the command `bake`.

    Returns
    -------
    str
        Data points, size and time, as far as the result names them.
    """
    parts = []
    if "data_points" in result:
        parts.append(f"{result['data_points']:,} data points")
    if result.get("bytes"):
        parts.append(size(sum(result["bytes"].values())))
    text = ", ".join(parts)
    seconds = result.get("seconds") or {}
    if seconds:
        text += f" in {duration(sum(seconds.values()))}"
    return f"Baked {text}".strip()


def size(count: int) -> str:
    """Return an amount of data as people say it.

    Parameters
    ----------
    count : int
        Bytes.

    Returns
    -------
    str
        For example "12 kB" or "3.4 MB".

    Examples
    --------
    >>> size(12_345), size(3_400_000)
    ('12 kB', '3.4 MB')
    """
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"


current: Job | None = None
last: Outcome | None = None


def begin(scene: bpy.types.Scene) -> Job:
    """Make a job the current one.

    Parameters
    ----------
    scene : bpy.types.Scene
        What to bake.

    Returns
    -------
    Job
        Not yet started: iterate over its `steps`.

    Raises
    ------
    SettingsError
        The settings cannot be used, or a bake runs already.
    """
    global current
    if current is not None:
        raise properties.SettingsError("A bake is running: wait for it or cancel it")
    current = Job(scene)
    return current


def end() -> Outcome:
    """Forget the current job and remember how it ended.

    Returns
    -------
    Outcome
        How it ended; "stopped" when it was abandoned.
    """
    global current, last
    outcome = current.outcome if current is not None else None
    last = outcome or Outcome("stopped", "Bake cancelled; finished cells are kept")
    current = None
    return last


@persistent
def forget(*_: object) -> None:
    """Forget how the last job ended: another file is open.

    Parameters
    ----------
    *_
        What Blender tells its handlers.
    """
    global last
    last = None
