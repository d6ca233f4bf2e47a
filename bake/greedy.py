"""The greedy choice of places that together see patches best: facility location, lazily evaluated.

Comes in: what places see and how well, weights of patches. Goes out: places in the order of their choice. The value

    F(chosen) = sum over patches of weight * (best worth of any chosen place)

is monotone and submodular: what a place adds only shrinks as others are chosen. So taking the one that adds most, again
and again, reaches at least 1 - 1/e of the best value of any as many, and what a place added earlier bounds what it adds
now: few places are looked at again for each choice. The first k of a longer list are the list of k.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from .parallel import check
from .views import Views

__all__ = ["Choice", "choose"]


@dataclass(frozen=True, eq=False)
class Choice:
    """Places in the order of their choice.

    place : (k,) int64
    gain : (k,) float64, what each added to the value when it was chosen, in units of the weights
    looks : how often the gain of a place was worked out, after the first time
    """

    place: np.ndarray
    gain: np.ndarray
    looks: int


def choose(views: Views, weight: np.ndarray, count: int, least: float = 0.0, given: int = 0) -> Choice:
    """Choose places.

    Parameters
    ----------
    views : Views
        What each place sees.
    weight : (patches,) float32 ndarray
        How much patches count, 0 or more.
    count : int
        Most places, given ones among them.
    least : float
        Stop when the next gain is below this part of what the best place alone would gain, or is 0.
    given : int
        The first so many places are taken first, in their order, whatever they add and however many are wanted.

    Returns
    -------
    Choice
        Of equal gains the place with the lower number.

    Notes
    -----
    Error: value at least 1 - 1/e of the best one of as many; `test_the_greedy_choice_is_within_the_bound`.
    Source: Nemhauser, Wolsey and Fisher 1978; Minoux 1978 for the lazy evaluation.
    """
    state = _State(views, weight)
    alone = state.alone()
    places = list(range(given))
    gains = [state.take(place) for place in places]
    heap = [(-gain, place) for place, gain in enumerate(alone[given:].tolist(), given)]
    heapq.heapify(heap)
    limit, looks = max(least * alone.max(initial=0), 0), 0
    while heap and len(places) < count and -heap[0][0] > limit:
        check()
        _, place = heapq.heappop(heap)
        fresh = (-state.gain(place), place)
        looks += 1
        if heap and fresh > heap[0]:
            heapq.heappush(heap, fresh)
        elif -fresh[0] >= limit and fresh[0] < 0:
            places.append(place)
            gains.append(state.take(place))
        else:
            break
    return Choice(np.array(places, np.int64), np.array(gains, np.float64), looks)


class _State:
    """The best worth so far of each patch."""

    def __init__(self, views: Views, weight: np.ndarray) -> None:
        self._views, self._weight = views, weight.astype(np.float64)
        self._best = np.zeros(len(weight))

    def alone(self) -> np.ndarray:
        """(n,) gains of all places, were nothing chosen."""
        place = np.repeat(np.arange(len(self._views.first) - 1), np.diff(self._views.first))
        value = self._weight[self._views.patch] * self._views.worth
        return np.bincount(place, value, len(self._views.first) - 1)

    def gain(self, place: int) -> float:
        """What a place would add."""
        row = self._views.row(place)
        patch = self._views.patch[row]
        return float((self._weight[patch] * np.maximum(self._views.worth[row] - self._best[patch], 0)).sum())

    def take(self, place: int) -> float:
        """Choose a place; returns what it adds."""
        gain, row = self.gain(place), self._views.row(place)
        patch = self._views.patch[row]
        self._best[patch] = np.maximum(self._best[patch], self._views.worth[row])
        return gain
