"""A limit on time, by a clock that is set by hand."""

from __future__ import annotations

import pytest
from gi_volumes.bake.deadline import FINISHING, Deadline


class Clock:
    """Stands still until it is set."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


def test_without_a_limit_time_is_never_over_and_cells_may_grow(clock):
    deadline = Deadline(0.0, clock)
    pace = deadline.pace()
    clock.now += 1e9
    pace.grown(1000)
    assert deadline.left == float("inf")
    assert pace.affordable() is None


def test_time_that_is_left_falls_to_nothing(clock):
    deadline = Deadline(10.0, clock)
    clock.now += 4
    assert deadline.left == 6
    clock.now += 7
    assert deadline.left == 0


def test_a_cell_of_which_nothing_is_known_may_grow(clock):
    assert Deadline(1.0, clock).pace().affordable() is None


def test_a_cell_grows_by_what_can_be_finished_in_time(clock):
    deadline = Deadline(100.0, clock)
    pace = deadline.pace()
    clock.now += 10
    pace.grown(100)  # 0.1 s each
    allowed = pace.affordable()
    growing, finishing = 0.1 * (allowed - 100), FINISHING * 0.1 * allowed
    assert 90 - 0.2 < growing + finishing <= 90


def test_the_pace_is_that_of_the_last_step_and_steps_without_growth_do_not_count(clock):
    pace = Deadline(1000.0, clock).pace()
    clock.now += 100
    pace.grown(10)
    clock.now += 10
    pace.grown(110)  # 0.1 s each
    fast = pace.affordable()
    clock.now += 1
    pace.grown(110)
    assert fast - 20 < pace.affordable() < fast


def test_a_cell_that_is_late_keeps_its_size(clock):
    pace = Deadline(5.0, clock).pace()
    clock.now += 6
    pace.grown(64)
    assert pace.affordable() == 64
