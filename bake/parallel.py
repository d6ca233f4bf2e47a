"""Threads: tiles of one stage, and whole jobs at once; embreex and numpy release Python's lock while they compute.

Jobs that run at once share the threads, so that there are about as many as processors: more of them, and smaller
tiles, spend their time on handing Python's lock around. When work fails or the user stops it, all threads get a
`CancelledError` at their next instruction.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait

import numpy as np

LANES = 1 << 18
"""Rays or paths of a tile: below, the cost of a call shows (2^16 takes 1.4 times as long on two busy processors);
above, tiles are too few to share out."""

VALUES = 1 << 21
"""Lanes times functions of light of a tile, at most: 24 MB, and a few times that in flight."""

PATIENCE = 0.2
"""How often the main thread looks for Ctrl-C [s]; on Windows nothing wakes it sooner."""

_jobs: set[int] = set()
"""Threads that run jobs."""


class CancelledError(Exception):
    """The caller asked to stop; nothing of the unfinished work is kept."""


class Room:
    """Lets jobs in as long as what they hold together is small enough; a single one may be as large as it likes.

    Parameters
    ----------
    limit : int
        Most that jobs hold together.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._held, self._changed = limit, 0, threading.Condition()

    @contextlib.contextmanager
    def hold(self, amount: int) -> Iterator[None]:
        """Wait until there is room; a job that waits has no share of the threads.

        Parameters
        ----------
        amount : int
            What the job holds.
        """
        me = {threading.get_ident()} & _jobs
        _jobs.difference_update(me)
        with self._changed:
            self._changed.wait_for(lambda: not self._held or self._held + amount <= self._limit)
            self._held += amount
        _jobs.update(me)
        try:
            yield
        finally:
            with self._changed:
                self._held -= amount
                self._changed.notify_all()


def number_of(threads: int) -> int:
    """Say how many threads a stage gets.

    Parameters
    ----------
    threads : int
        Threads of the process; 0 for one per processor.

    Returns
    -------
    int
        Its share where several jobs run, at least 1.
    """
    return max(1, (threads or os.cpu_count() or 1) // max(len(_jobs), 1))


def tile_size(functions: int = 1) -> int:
    """Say how many rays or paths a tile is to have.

    Parameters
    ----------
    functions : int
        Functions of light that each carries.

    Returns
    -------
    int
        As many as suit the processor and its memory.
    """
    return max(1, min(LANES, VALUES // functions))


def tiles(count: int, size: int) -> list[np.ndarray]:
    """Split rows for `run_tiles`.

    Parameters
    ----------
    count, size : int
        Rows, and most of them in a tile.

    Returns
    -------
    list of (m,) int64 ndarray
        In their order.
    """
    return [np.arange(first, min(first + size, count)) for first in range(0, count, size)]


def run_tiles(
    work: Callable[[np.ndarray], int],
    tiles: list[np.ndarray],
    threads: int,
    progress: Callable[[int], bool] | None = None,
) -> None:
    """Run independent tiles.

    Parameters
    ----------
    work : callable
        Does one tile and returns how many points it held.
    tiles : list of ndarray
        The tiles, first come first served.
    threads : int
        As for `number_of`.
    progress : callable, optional
        Called with the points done so far, from the calling thread; returns False to stop.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    done = 0
    with _pool(number_of(threads)) as submit:
        pending = {submit(work, tile) for tile in tiles}
        while pending:
            finished, pending = wait(pending, PATIENCE, FIRST_COMPLETED)
            done += sum(future.result() for future in finished)
            if finished and progress is not None and not progress(done):
                raise CancelledError


def run_jobs(work: Callable[[int], object], count: int, threads: int) -> list:
    """Run jobs, some at once.

    Parameters
    ----------
    work : callable
        Does the job of a number; called from several threads, or from this one if only one runs at a time.
    count : int
        Jobs 0 to count - 1, begun in this order.
    threads : int
        As for `number_of`.

    Returns
    -------
    list
        What each returned.

    Raises
    ------
    BaseException
        The first that a job raised, or that arrived here (Ctrl-C); the other jobs have ended by then.
    """
    at_once = min(count, number_of(threads))
    if at_once <= 1:
        return [work(number) for number in range(count)]

    def job(number: int) -> object:
        _jobs.add(threading.get_ident())
        try:
            return work(number)
        finally:
            _jobs.discard(threading.get_ident())

    with _pool(at_once) as submit:
        pending = futures = [submit(job, number) for number in range(count)]
        while pending:
            finished, pending = wait(pending, PATIENCE, FIRST_EXCEPTION)
            for future in finished:
                future.result()
        return [future.result() for future in futures]


@contextlib.contextmanager
def _pool(threads: int) -> Iterator[Callable[..., Future]]:
    """A function that runs calls on threads; whatever raises here, or in one of them, stops the others."""
    running: set[int] = set()

    def call(work: Callable, item: object) -> object:
        running.add(threading.get_ident())
        try:
            return work(item)
        finally:
            running.discard(threading.get_ident())

    with ThreadPoolExecutor(threads) as pool:
        try:
            yield lambda work, item: pool.submit(call, work, item)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for thread in list(running):
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(CancelledError))
            raise
