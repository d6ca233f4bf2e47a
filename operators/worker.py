"""One bake in a process of its own: start, poll, stop.

Comes in: the arguments of a command. Goes out: progress, then a result or a one-line error. The worker writes
JSON lines to a file, which is read from where the last poll ended: nothing blocks the parent, and no full pipe
can stall the worker. The worker's standard input is a pipe that the parent holds and never writes to: when it
breaks, the parent is gone, and the worker stops. Neither side needs `bpy` here.
"""

from __future__ import annotations

import _thread
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from . import dependencies

ROOT = Path(__file__).resolve().parent.parent
INTERRUPTED = 130
# Time for the cells in flight to be put away before the process is killed; files are replaced atomically.
PATIENCE_S = 15.0
# Tells a command that it is a worker and that its standard input is its parent's pipe.
ORPHAN_VARIABLE = "GI_VOLUMES_STOP_WITH_PARENT"


@dataclass(frozen=True)
class Progress:
    """How far a job is.

    `stage` is a word or two for people, `fraction` of that stage in 0..1, `seconds_left` [s] until the end of
    the job or -1 when unknown.
    """

    stage: str
    fraction: float = 0.0
    seconds_left: float = -1.0

    @property
    def text(self) -> str:
        """The stage, how much of it is done and the time left, for a status bar."""
        left = f", {duration(self.seconds_left)} left" if self.seconds_left >= 0 else ""
        return f"{self.stage} {self.fraction:.0%}{left}"


def duration(seconds: float) -> str:
    """Return a time span as people say it.

    Parameters
    ----------
    seconds : float
        Time span [s].

    Returns
    -------
    str
        For example "0.4 s", "45 s", "3 min 5 s" or "2 h 10 min".

    Examples
    --------
    >>> duration(0.43), duration(45.4), duration(185), duration(7800)
    ('0.4 s', '45 s', '3 min 5 s', '2 h 10 min')
    """
    if seconds < 1:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def start(arguments: list[str], **streams) -> subprocess.Popen:
    """Start a command of `gi_volumes` with this Python, in a process group of its own; it ends when we are gone.

    Parameters
    ----------
    arguments : list of str
        A command and its arguments.
    **streams
        `stdout` and `stderr`, as for `subprocess.Popen`.

    Returns
    -------
    subprocess.Popen
        The process; closing its standard input stops it.
    """
    # In a group of its own, so that Ctrl-C in a terminal reaches Blender, and through it the worker, once.
    group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {"process_group": 0}
    variables = {**os.environ, "PYTHONPATH": dependencies.search_path(), "PYTHONUNBUFFERED": "1", ORPHAN_VARIABLE: "1"}
    command = [sys.executable, "-P", "-s", str(ROOT / "__main__.py"), *arguments]
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=variables, **group, **streams)


def stop_with_parent() -> None:
    """In a worker: interrupt this process once its parent is gone, and end it if it does not heed that.

    Nothing happens in a process that `start` did not start. What this process starts in turn is no worker.
    """
    if os.environ.pop(ORPHAN_VARIABLE, None) is None:
        return
    # Away from standard input, which on Windows others cannot even ask about while a thread reads from it.
    pipe = os.dup(0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    threading.Thread(target=_outlive, args=(pipe,), daemon=True).start()


def _outlive(pipe: int) -> None:
    """Wait for the pipe to break: the system closes the other end, however the parent ended."""
    try:
        while os.read(pipe, 1):
            pass
    except OSError:  # another way for a pipe to break
        pass
    if hasattr(signal, "pthread_kill"):  # wakes a thread that waits for a lock, too
        signal.pthread_kill(threading.main_thread().ident, signal.SIGTERM)
    else:
        _thread.interrupt_main(signal.SIGTERM)
    time.sleep(PATIENCE_S)
    os._exit(INTERRUPTED)


def interrupt(process: subprocess.Popen) -> None:
    """Ask a worker to put away what it has finished and to end.

    Parameters
    ----------
    process : subprocess.Popen
        The worker; nothing happens when it has ended.
    """
    if process.poll() is None:
        process.send_signal(signal.CTRL_BREAK_EVENT if os.name == "nt" else signal.SIGTERM)


class Worker:
    """A running command.

    Parameters
    ----------
    arguments : list of str
        A command of `gi_volumes` that understands `--progress json`, and its arguments.
    folder : Path
        An existing folder for the worker's output.
    """

    def __init__(self, arguments: list[str], folder: Path) -> None:
        self.progress = Progress("Starting")
        self.result: dict | None = None
        self.error = ""
        self._output = folder / "progress.jsonl"
        self._log = folder / "log.txt"
        self._offset = 0
        self._stopped_at: float | None = None
        with self._output.open("wb") as output, self._log.open("wb") as log:
            self._process = start([*arguments, "--progress", "json"], stdout=output, stderr=log)

    def poll(self) -> bool:
        """Read what the worker has said since the last call.

        Returns
        -------
        bool
            Whether it still runs. Once it does not, `result` or `error` is set.
        """
        code = self._process.poll()
        self._read()
        if code is None:
            if self._stopped_at is not None and time.monotonic() - self._stopped_at > PATIENCE_S:
                self._process.kill()
            return True
        self._hang_up()
        if self.result is None and not self.error:
            self.error = self._last_words(code)
        return False

    def stop(self) -> None:
        """Ask the worker to put away what it has finished and to end; ask once."""
        if self._stopped_at is None and self._process.poll() is None:
            self._stopped_at = time.monotonic()
            interrupt(self._process)

    def wait(self, seconds: float) -> None:
        """Stop the worker and wait for its end, by force when it takes too long.

        Parameters
        ----------
        seconds : float
            Patience [s].
        """
        self.stop()
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.poll()

    @property
    def stopped(self) -> bool:
        """Whether the worker was asked to stop, or was interrupted from outside."""
        return self._stopped_at is not None or self._process.poll() == INTERRUPTED

    def _hang_up(self) -> None:
        """The worker has ended: nobody listens to the pipe."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def _read(self) -> None:
        """Only whole lines: the last one may still be on its way."""
        with self._output.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.splitlines():
            self._understand(line)

    def _understand(self, line: bytes) -> None:
        """One line of the protocol; anything else on standard output is not for us."""
        try:
            message = json.loads(line)
        except ValueError:
            return
        if not isinstance(message, dict):
            return
        if "stage" in message:
            fraction = message.get("done", 0) / max(message.get("total", 0), 1)
            left = message.get("seconds_left")
            self.progress = Progress(str(message["stage"]), min(fraction, 1.0), -1.0 if left is None else float(left))
        self.result = message.get("result", self.result)
        self.error = message.get("error", self.error)

    def _last_words(self, code: int) -> str:
        """Why a worker ended without saying so on its standard output."""
        lines = [line.strip() for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        last = lines[-1] if lines else "it said nothing"
        return last.removeprefix("error: ") if code in (1, 2) else f"the worker stopped with code {code}: {last}"
