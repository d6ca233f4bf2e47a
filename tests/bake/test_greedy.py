"""The greedy choice: against brute force and its bound, against its own plain form, and what its order promises."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from gi_volumes.bake import greedy
from gi_volumes.bake.greedy import choose
from gi_volumes.bake.views import Views

BOUND = 1 - 1 / np.e


def sparse(worth: np.ndarray) -> Views:
    """Views of a dense (places, patches) matrix."""
    place, patch = np.nonzero(worth)
    first = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=len(worth)))])
    return Views(first, patch.astype(np.int32), worth[place, patch].astype(np.float32))


def random_case(seed: int, places: int = 12, patches: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """(places, patches) float32 worths, most of them 0, and (patches,) weights."""
    rng = np.random.default_rng(seed)
    worth = rng.random((places, patches)) * (rng.random((places, patches)) < 0.25)
    return worth.astype(np.float32), rng.exponential(1, patches).astype(np.float32)


def value(worth: np.ndarray, weight: np.ndarray, places) -> float:
    """F of some places."""
    return float(worth[list(places)].max(axis=0, initial=0).astype(np.float64) @ weight)


def best_of_all(worth: np.ndarray, weight: np.ndarray, count: int) -> float:
    return max(value(worth, weight, some) for some in itertools.combinations(range(len(worth)), count))


def plain_greedy(worth: np.ndarray, weight: np.ndarray, count: int) -> list[int]:
    """Every gain worked out every time."""
    chosen = []
    for _ in range(count):
        gains = [value(worth, weight, [*chosen, place]) - value(worth, weight, chosen) for place in range(len(worth))]
        chosen.append(int(np.argmax(gains)))
    return chosen


@pytest.mark.parametrize("seed", range(12))
def test_the_greedy_choice_is_within_the_bound(seed):
    worth, weight = random_case(seed)
    for count in (1, 2, 3, 5):
        found = choose(sparse(worth), weight, count)
        best = best_of_all(worth, weight, count)
        assert value(worth, weight, found.place) >= BOUND * best
        assert found.gain.sum() == pytest.approx(value(worth, weight, found.place))
        if count == 1:
            assert found.gain[0] == pytest.approx(best)


def crowded_case() -> tuple[np.ndarray, np.ndarray]:
    """Four places that see the same ten patches, and four that see two others each."""
    worth = np.zeros((8, 18), np.float32)
    worth[:4, :10] = np.linspace(0.9, 0.93, 4)[:, None]
    for place in range(4):
        worth[4 + place, 10 + 2 * place : 12 + 2 * place] = 0.9
    return worth, np.ones(18, np.float32)


def test_the_best_by_themselves_crowd_together_and_are_found_below_the_bound():
    worth, weight = crowded_case()
    found = choose(sparse(worth), weight, 4)
    alone = np.argsort(-(worth @ weight))[:4]
    best = best_of_all(worth, weight, 4)
    assert value(worth, weight, alone) < 0.67 * best
    assert value(worth, weight, found.place) == pytest.approx(best)
    assert found.place[0] == 3
    assert (np.sort(found.place[1:]) >= 4).all()


@pytest.mark.parametrize("seed", range(8))
def test_lazy_evaluation_chooses_what_the_plain_one_does_with_fewer_looks(seed):
    worth, weight = random_case(seed, places=80, patches=300)
    found = choose(sparse(worth), weight, 20)
    assert found.place.tolist() == plain_greedy(worth, weight, 20)
    assert found.looks < 20 * 80 / 2


def test_a_choice_by_old_gains_is_found(monkeypatch):
    worth, weight = random_case(3, places=80, patches=300)
    monkeypatch.setattr(greedy._State, "gain", lambda self, place: float(self.alone()[place]))
    assert choose(sparse(worth), weight, 20).place.tolist() != plain_greedy(worth, weight, 20)


@pytest.mark.parametrize("seed", range(6))
def test_the_first_of_many_are_the_list_of_few_and_gains_never_rise(seed):
    worth, weight = random_case(seed, places=60, patches=200)
    many = choose(sparse(worth), weight, 30)
    assert (np.diff(many.gain) <= 1e-12).all()
    for count in (0, 1, 7, 29):
        few = choose(sparse(worth), weight, count)
        assert few.place.tolist() == many.place[:count].tolist()
    assert len(set(many.place.tolist())) == len(many.place)


def test_given_places_come_first_whatever_they_see_and_the_others_know_of_them():
    worth, weight = crowded_case()
    worth = np.concatenate([np.zeros((1, 18), np.float32), worth[3:4], worth])
    found = choose(sparse(worth), weight, 6, given=2)
    assert found.place[:2].tolist() == [0, 1]
    assert found.gain[:2] == pytest.approx([0, 9.3])
    assert (found.place[2:] >= 6).all()
    assert choose(sparse(worth), weight, 0, given=2).place.tolist() == [0, 1]


def test_the_choice_stops_where_places_add_too_little():
    worth, weight = crowded_case()
    everything = choose(sparse(worth), weight, 8)
    assert len(everything.place) == 5  # the other three add nothing
    assert (everything.gain > 0).all()
    assert len(choose(sparse(worth), weight, 8, least=0.2).place) == 1
    assert len(choose(sparse(worth), weight, 8, least=1.8 / 9.3 * 0.999).place) == 5
    # With a given place the limit is still that of the best place alone.
    assert choose(sparse(worth), weight, 8, least=0.2, given=1).place.tolist() == [0]


def test_equal_places_are_taken_by_number():
    worth = np.zeros((4, 4), np.float32)
    worth[[3, 1, 2, 0], [0, 1, 2, 3]] = 0.5
    assert choose(sparse(worth), np.ones(4, np.float32), 4).place.tolist() == [0, 1, 2, 3]


def test_nothing_to_see_and_nowhere_to_stand_give_empty_lists():
    for shape in ((0, 5), (5, 0), (0, 0), (4, 3)):
        found = choose(sparse(np.zeros(shape, np.float32)), np.ones(shape[1], np.float32), 3)
        assert found.place.shape == found.gain.shape == (0,)
