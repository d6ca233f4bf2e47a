"""Time that work takes: what passes, and what processors spend, which other work on the machine disturbs less."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Cost:
    """Seconds: `wall`, that pass, and `cpu`, of all threads together."""

    wall: float
    cpu: float

    def __mul__(self, count: float) -> Cost:
        return Cost(self.wall * count, self.cpu * count)

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall + other.wall, self.cpu + other.cpu)

    def __sub__(self, other: Cost) -> Cost:
        return Cost(self.wall - other.wall, self.cpu - other.cpu)


class Clock:
    """Measures a block of work; `cost` holds it afterwards."""

    def __enter__(self) -> Clock:
        self._start = Cost(time.perf_counter(), time.process_time())
        return self

    def __exit__(self, *_: object) -> None:
        self.cost = Cost(time.perf_counter(), time.process_time()) - self._start


def median(costs: list[Cost]) -> Cost:
    """The median of either time.

    Parameters
    ----------
    costs : list of Cost
        Repeats.

    Returns
    -------
    Cost
    """
    return Cost(*(float(np.median([getattr(cost, name) for cost in costs])) for name in ("wall", "cpu")))
