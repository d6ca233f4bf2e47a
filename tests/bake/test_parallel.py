"""Threads: results in order, errors and Ctrl-C that stop all others, room, and shares of the processors."""

from __future__ import annotations

import _thread
import threading
import time

import numpy as np
import pytest
from gi_volumes.bake import parallel
from gi_volumes.bake.parallel import CancelledError, Room, number_of, run_jobs, run_tiles, tiles

PATIENCE_S = 20.0
"""More than anything here takes; a test that waits as long has failed."""


def until(event: threading.Event, ended: list) -> None:
    """Work that looks whether it is to stop, and says how it ended."""
    start = time.monotonic()
    try:
        event.set()
        while time.monotonic() < start + PATIENCE_S:
            parallel.check()
    except BaseException as error:
        ended.append(type(error))
        raise


def test_tiles_hold_every_row_once_in_order():
    parts = tiles(10, 4)
    assert [len(part) for part in parts] == [4, 4, 2]
    assert np.concatenate(parts).tolist() == list(range(10))
    assert tiles(0, 4) == []


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_jobs_return_their_results_in_order(threads):
    assert run_jobs(lambda number: number * number, 7, threads) == [n * n for n in range(7)]


def test_an_error_in_one_tile_stops_the_others():
    running, ended = threading.Event(), []

    def work(rows: np.ndarray) -> int:
        if rows[0] == 0:
            assert running.wait(PATIENCE_S)
            raise OSError("no space")
        until(running, ended)
        return 1

    with pytest.raises(OSError, match="no space"):
        run_tiles(work, tiles(2, 1), 2)
    assert ended == [CancelledError]


def test_an_error_in_one_job_stops_the_others_and_their_tiles():
    running, ended = threading.Event(), []

    def work(number: int) -> None:
        if number == 0:
            assert running.wait(PATIENCE_S)
            raise OSError("no space")
        run_tiles(lambda rows: until(running, ended), tiles(1, 1), 1)

    with pytest.raises(OSError, match="no space"):
        run_jobs(work, 2, 2)
    assert ended == [CancelledError]
    assert not parallel._jobs


def test_ctrl_c_stops_all_jobs():
    running, ended = threading.Event(), []

    def interrupt() -> None:
        assert running.wait(PATIENCE_S)
        time.sleep(0.2)  # until the pool has started all its threads
        _thread.interrupt_main()

    threading.Thread(target=interrupt).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_jobs(lambda _: until(running, ended), 2, 2)
    assert time.monotonic() - start < PATIENCE_S / 2
    assert set(ended) == {CancelledError}


def test_ctrl_c_does_not_wait_for_a_job_in_the_middle_of_a_long_step():
    running, over = threading.Event(), threading.Event()

    def interrupt() -> None:
        assert running.wait(PATIENCE_S)
        time.sleep(0.2)  # until the pool has started all its threads
        _thread.interrupt_main()

    def work(_: int) -> None:
        running.set()
        assert over.wait(PATIENCE_S)

    threading.Thread(target=interrupt).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_jobs(work, 2, 2)
    assert time.monotonic() - start < PATIENCE_S / 2
    over.set()
    while parallel._jobs:  # they would take a share of the next test's threads
        assert time.monotonic() < start + PATIENCE_S
        time.sleep(0.01)


def test_hundreds_of_failures_in_the_middle_of_stages_leave_no_thread_behind():
    before = threading.active_count()
    for _ in range(300):
        begun = threading.Event()

        def work(number: int, begun=begun) -> None:
            if number == 0:
                assert begun.wait(PATIENCE_S)
                raise OSError("no space")
            while True:
                begun.set()
                run_tiles(len, tiles(4, 1), 2)

        with pytest.raises(OSError, match="no space"):
            run_jobs(work, 3, 3)
    assert threading.active_count() == before
    assert not parallel._jobs


def test_jobs_that_run_at_once_share_the_threads():
    both = threading.Barrier(2, timeout=PATIENCE_S)

    def work(_: int) -> int:
        both.wait()
        share = number_of(8)
        both.wait()
        return share

    assert run_jobs(work, 2, 2) == [4, 4]
    assert number_of(8) == 8
    assert run_jobs(lambda _: number_of(8), 1, 8) == [8]


def test_a_job_that_waits_for_room_leaves_its_share_to_the_others():
    room, waiting, shares = Room(10), threading.Event(), []

    def work(number: int) -> None:
        if number:
            assert waiting.wait(PATIENCE_S)
        with room.hold(10):
            waiting.set()
            time.sleep(0.2)
            shares.append(number_of(8))

    run_jobs(work, 2, 2)
    assert shares == [8, 8]


def test_jobs_never_hold_more_than_there_is_room_for_but_one_may_be_larger():
    room, lock, held, most = Room(10), threading.Lock(), [0], []

    def work(number: int) -> None:
        amount = (4, 5, 6, 25, 3, 7)[number]
        with room.hold(amount):
            with lock:
                held[0] += amount
                most.append((held[0], amount))
            time.sleep(0.01)
            with lock:
                held[0] -= amount

    run_jobs(work, 6, 4)
    assert len(most) == 6
    assert all(total <= 10 or total == amount for total, amount in most)
