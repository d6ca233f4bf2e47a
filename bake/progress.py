"""Progress of a long command, for people on standard error or for programs as JSON lines on standard output.

Comes in: stages and how much of them is done. Goes out: a line now and then, with the time left.
"""

from __future__ import annotations

import json
import sys
import time

INTERVAL = 0.2
"""Least time between two lines [s]."""


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
        self._last = 0.0
        self._seconds: dict[str, float] = {}
        self._open_line = False

    @property
    def seconds(self) -> dict[str, float]:
        """Time spent in each stage so far [s]."""
        self._close_stage()
        return {name: round(value, 3) for name, value in self._seconds.items()}

    def stage(self, name: str, total: int = 1) -> None:
        """Begin a stage, ending the one before.

        Parameters
        ----------
        name : str
            A word or two for people.
        total : int
            Units of work in it.
        """
        self._close_stage()
        self._end_line()
        self._stage, self._total, self._last = name, max(total, 1), 0.0
        self.show(0)

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
        if now - self._last >= INTERVAL or done == self._total:
            self._last = now
            spent = now - self._stage_start
            left = spent / done * (self._total - done) if done else None
            self._write(done, left)
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
            print(json.dumps({"error": message}), flush=True)
        print(f"error: {message}", file=sys.stderr, flush=True)

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
        share = f"{100 * done / self._total:3.0f} %"
        text = f"{self._stage}: {share}" + (f", {left:.0f} s left" if left is not None and done < self._total else "")
        if sys.stderr.isatty():
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
            self._open_line = True
        elif done == self._total:
            print(text, file=sys.stderr, flush=True)

    def _end_line(self) -> None:
        """Leave the line that is being rewritten."""
        if self._open_line:
            print(file=sys.stderr, flush=True)
            self._open_line = False
