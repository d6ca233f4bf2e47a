"""A limit on time, by a clock that is set by hand."""

from __future__ import annotations

import pytest
from gi_volumes.bake.deadline import FEWEST, FINISHING, USUAL, Deadline


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


def test_a_cell_without_data_points_may_grow(clock):
    assert Deadline(1.0, clock).pace().affordable() is None


def test_a_cell_grows_by_what_can_be_finished_in_time(clock):
    pace = Deadline(1000.0, clock).pace()
    clock.now += 100
    pace.grown(1000)  # 0.1 s each
    allowed = pace.affordable()
    growing, finishing = 0.1 * (allowed - 1000), FINISHING * 0.1 * allowed
    assert 900 - 0.2 < growing + finishing <= 900


def test_the_pace_is_that_of_the_last_large_step(clock):
    pace = Deadline(10000.0, clock).pace()
    clock.now += 100
    pace.grown(FEWEST)
    clock.now += 100
    pace.grown(FEWEST + 1000)  # 0.1 s each
    fast = pace.affordable()
    clock.now += 1
    pace.grown(2 * FEWEST + 999)  # too few to tell
    assert abs(pace.affordable() - fast) < FEWEST


def test_before_the_pace_is_known_a_usual_one_counts(clock):
    pace = Deadline(100.0, clock).pace()
    clock.now += 40
    pace.grown(18)
    assert pace.affordable() == pytest.approx(60 / (1 + FINISHING) / USUAL, abs=20)


def test_a_cell_that_is_late_keeps_its_size(clock):
    pace = Deadline(5.0, clock).pace()
    clock.now += 6
    pace.grown(64)
    assert pace.affordable() == 64
