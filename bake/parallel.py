"""Threads: tiles of one stage, and whole jobs at once; embreex and numpy release Python's lock while they compute.

Jobs that run at once share the threads, so that there are about as many as processors: more of them, and smaller
tiles, spend their time on handing Python's lock around. When work fails or the user stops it, all threads are told to
stop, and raise `CancelledError` at their next `check`.
"""

from __future__ import annotations

import contextlib
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
"""How often threads that wait look whether they are to stop [s]; on Windows nothing wakes the main thread sooner."""

GRACE = 0.5
"""How long Ctrl-C waits for jobs [s]; those in the middle of a long step end by themselves, and nobody takes their
results."""

_jobs: set[int] = set()
"""Threads that run jobs, and do not wait for others."""

_local = threading.local()
"""Of each thread of a pool the `stops`: events that tell it to stop."""


class CancelledError(Exception):
    """The caller asked to stop; nothing of the unfinished work is kept."""


def check() -> None:
    """Look whether this thread is to stop; long work calls it now and then.

    Raises
    ------
    CancelledError
        It is.
    """
    if any(stop.is_set() for stop in getattr(_local, "stops", ())):
        raise CancelledError


class Room:
    """Lets jobs in, first come first served, as long as what they hold together is small enough; a single one may be
    as large as it likes.

    Parameters
    ----------
    limit : int
        Most that jobs hold together.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._held, self._queue, self._changed = limit, 0, [], threading.Condition()

    @contextlib.contextmanager
    def hold(self, amount: int) -> Iterator[None]:
        """Wait until there is room.

        Parameters
        ----------
        amount : int
            What the job holds.

        Raises
        ------
        CancelledError
            The job is to stop.
        """
        ticket = object()
        with _aside(), self._changed:
            self._queue.append(ticket)
            try:
                while self._queue[0] is not ticket or (self._held and self._held + amount > self._limit):
                    check()
                    self._changed.wait(PATIENCE)
                self._held += amount
            finally:
                self._queue.remove(ticket)
                self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._held -= amount
                self._changed.notify_all()


@contextlib.contextmanager
def held(lock: threading.Lock) -> Iterator[None]:
    """Hold a lock; a job that waits for it has no share of the threads.

    Parameters
    ----------
    lock : Lock
        The lock.

    Raises
    ------
    CancelledError
        The job is to stop.
    """
    with _aside():
        while not lock.acquire(timeout=PATIENCE):
            check()
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def _aside() -> Iterator[None]:
    """Leave a job's share of the threads to the others."""
    me = {threading.get_ident()} & _jobs
    _jobs.difference_update(me)
    try:
        yield
    finally:
        _jobs.update(me)


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
            check()
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
        The first that a job raised; the others have ended by then. Or Ctrl-C, which waits `GRACE` for them.
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

    with _pool(at_once, GRACE) as submit:
        pending = futures = [submit(job, number) for number in range(count)]
        while pending:
            finished, pending = wait(pending, PATIENCE, FIRST_EXCEPTION)
            for future in finished:
                future.result()
        return [future.result() for future in futures]


@contextlib.contextmanager
def _pool(threads: int, grace: float | None = None) -> Iterator[Callable[..., Future]]:
    """A function that runs calls on threads; whatever raises here, or in one of them, stops the others. After Ctrl-C
    it waits for them no longer than that, if there is a grace."""
    stop, outer, futures = threading.Event(), getattr(_local, "stops", ()), []

    def call(work: Callable, item: object) -> object:
        _local.stops = (*outer, stop)
        check()
        return work(item)

    def submit(work: Callable, item: object) -> Future:
        futures.append(pool.submit(call, work, item))
        return futures[-1]

    pool = ThreadPoolExecutor(threads)
    try:
        yield submit
    except KeyboardInterrupt:
        stop.set()
        pool.shutdown(wait=grace is None, cancel_futures=True)
        wait([future for future in futures if not future.cancelled()], grace)
        raise
    except BaseException:
        stop.set()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()
