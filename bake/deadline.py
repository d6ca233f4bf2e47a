"""A limit on time: how many data points a cell may have so that it is done when the time is over.

Comes in: when it is over, and how a cell has grown so far. Goes out: a cap on data points. Growing by voxels that are
needed most, as the cap on data points does it anyway, is what makes the most of the time.
"""

from __future__ import annotations

import time

FINISHING = 0.75
"""What planes, fits and files of the whole cell take per data point, of what growing took for each new one."""

USUAL = 4e-3
"""Time for each new data point before that is known [s]: what two processors take for two cells at once."""

FEWEST = 256
"""New data points that a step has to have to tell: what every step takes, however small, does not count then."""


class Deadline:
    """When a bake is to be done.

    Parameters
    ----------
    seconds : float
        From now on [s]; 0 for no limit.
    clock : callable, optional
        Says what time it is [s].
    """

    def __init__(self, seconds: float = 0.0, clock=time.monotonic) -> None:
        self._clock = clock
        self._end = clock() + seconds if seconds else float("inf")

    @property
    def left(self) -> float:
        """Time that is left [s], at least 0."""
        return max(self._end - self._clock(), 0.0)

    def pace(self) -> Pace:
        """Start to watch a cell.

        Returns
        -------
        Pace
            Of a cell without data points.
        """
        return Pace(self, self._clock)


class Pace:
    """How fast a cell grows.

    Parameters
    ----------
    deadline : Deadline
        When it is to be done.
    clock : callable
        Says what time it is [s].
    """

    def __init__(self, deadline: Deadline, clock) -> None:
        self._deadline, self._clock = deadline, clock
        self._began, self._size, self._cost = clock(), 0, USUAL

    def grown(self, size: int) -> None:
        """Take note of a step that is done.

        Parameters
        ----------
        size : int
            Data points that the cell has now.
        """
        now = self._clock()
        if size >= self._size + FEWEST:
            self._cost = (now - self._began) / (size - self._size)
        self._began, self._size = now, size

    def affordable(self) -> int | None:
        """Say how large the cell may grow.

        Returns
        -------
        int or None
            Data points, at least those that it has; None without a limit, and for a cell that has none yet.
        """
        left = self._deadline.left
        if left == float("inf") or not self._size:
            return None
        more = (left - FINISHING * self._cost * self._size) / ((1 + FINISHING) * self._cost)
        return self._size + max(int(more), 0)
