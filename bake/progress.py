"""Progress of a long command, for people on standard error or for programs as JSON lines on standard output.

Comes in: stages and how much of them is done. Goes out: a line now and then, with the time left.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time

INTERVAL = 0.2
"""Least time between two lines that a program or a terminal gets [s]."""

LOG_INTERVAL = 10.0
"""Least time between two lines of a log that nobody rewrites [s]."""


class Progress:
    """Says how far a command is.

    Parameters
    ----------
    as_json : bool
        Write one JSON object per line to standard output instead of text to standard error.
    """

    def __init__(self, as_json: bool = False) -> None:
        self._as_json = as_json
        self._stage = ""
        self._stage_start = 0.0
        self._total = 1
        self._first = 0
        self._said = -1
        self._last = 0.0
        self._seconds: dict[str, float] = {}
        self._open_line = False

    @property
    def seconds(self) -> dict[str, float]:
        """Time spent in each stage so far [s]."""
        self._close_stage()
        return {name: round(value, 3) for name, value in self._seconds.items()}

    def stage(self, name: str, total: int = 1, done: int = 0) -> None:
        """Begin a stage, ending the one before.

        Parameters
        ----------
        name : str
            A word or two for people.
        total : int
            Units of work in it.
        done : int
            Units that were done before; they say nothing about the time left.
        """
        self._close_stage()
        self._end_line()
        self._stage, self._total, self._first, self._said = name, max(total, 1), done, -1
        self._last = time.monotonic() if self._is_log and total > 1 else -LOG_INTERVAL
        self.show(done)

    def show(self, done: int) -> bool:
        """Say how much of the stage is done, unless that was said a moment ago.

        Parameters
        ----------
        done : int
            Units of work.

        Returns
        -------
        bool
            True: a callback that returns it lets the work go on.
        """
        now = time.monotonic()
        interval = LOG_INTERVAL if self._is_log else INTERVAL
        named = self._is_log and self._total == 1 and self._said >= 0
        if done != self._said and not named and (now - self._last >= interval or done == self._total):
            self._last, self._said = now, done
            spent, fresh = now - self._stage_start, done - self._first
            left = spent / fresh * (self._total - done) if fresh > 0 else None
            self._write(done, 0.0 if done >= self._total else left)
        return True

    def finish(self, result: dict) -> None:
        """End the last stage, and the line for people; programs get the result.

        Parameters
        ----------
        result : dict
            What the command found, ready for JSON.
        """
        self._close_stage()
        self._end_line()
        if self._as_json:
            print(json.dumps({"result": result}), flush=True)

    def fail(self, message: str) -> None:
        """Say in one line why the command failed.

        Parameters
        ----------
        message : str
            What, where, and the remedy.
        """
        self._end_line()
        if self._as_json:
            with contextlib.suppress(OSError):
                print(json.dumps({"error": message}), flush=True)
        print(f"error: {message}", file=sys.stderr, flush=True)

    def interrupt(self) -> None:
        """End the line for people; programs get an error as their last line."""
        self._end_line()
        if self._as_json:
            print(json.dumps({"error": "interrupted"}), flush=True)

    @property
    def _is_log(self) -> bool:
        """Whether lines pile up where they are written."""
        return not self._as_json and not sys.stderr.isatty()

    def _close_stage(self) -> None:
        """Add the running stage to the totals and go on counting."""
        now = time.monotonic()
        if self._stage:
            self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._stage_start
        self._stage_start = now

    def _write(self, done: int, left: float | None) -> None:
        """One line; on a terminal it replaces the one before."""
        if self._as_json:
            seconds_left = None if left is None else round(left, 1)
            line = {"stage": self._stage, "done": done, "total": self._total, "seconds_left": seconds_left}
            print(json.dumps(line), flush=True)
            return
        share = f": {100 * done / self._total:3.0f} %" if self._total > 1 else ""
        text = f"{self._stage}{share}" + (f", {left:.0f} s left" if left else "")
        if self._is_log:
            print(text, file=sys.stderr, flush=True)
        else:
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
            self._open_line = True

    def _end_line(self) -> None:
        """Leave the line that is being rewritten."""
        if self._open_line:
            print(file=sys.stderr, flush=True)
            self._open_line = False
