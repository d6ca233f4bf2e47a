"""Refinement of a cell: how it is stopped, and what it says of its progress."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from command_line import yard
from gi_volumes.bake import job
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.refine import Refinement, Target, refine
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, choose_grid, model
from gi_volumes.tree.outline import outline


def parts(error: float = 0.05):
    """What refines the yard's only cell."""
    snapshot, settings = yard(), Settings(samples=8, bounces=1, finest=0.5, error=error)
    snapshot, light = model(snapshot, settings)
    scene = prepare(snapshot, light)
    grid = choose_grid(scene.soup.corners, snapshot.origin, settings.finest)
    target = Target(error, settings.max_points, "partial", Effort(8, 1, 0, 1), 8)
    return (
        scene,
        outline(scene.soup.corners, grid, (0, 0), by_light=error > 0),
        job._judge(snapshot, settings, scene),
        target,
    )


class Patience:
    """Has time for so many data points."""

    def __init__(self, points: int) -> None:
        self.points, self.sizes = points, []

    def grown(self, size: int) -> None:
        self.sizes.append(size)

    def affordable(self) -> int | None:
        return self.points if self.sizes else None


def limited(points: int) -> Refinement:
    """A cell refined with time for so many data points."""
    made = Refinement(*parts(), None)
    made.pace = Patience(points)
    made.run()
    return made


def test_a_cell_grows_to_what_there_is_time_for_and_says_that_it_was_cut_short():
    whole = refine(*parts()).tree.size
    first = limited(1 << 16).pace.sizes[0]
    middle = (first + whole) // 2
    for points, cut in ((middle, True), (whole, False)):
        made = limited(points)
        assert made.cut == cut
        assert first <= made.state.tree.size <= points
    assert made.state.tree.size == whole


def test_levels_without_voxels_are_no_trouble():
    scene, found, judge, target = parts()
    least = int(np.prod(found.dense.shape))
    made = Refinement(scene, found, judge, dataclasses.replace(target, max_points=least), None)
    assert made.run().tree.size == least
    assert limited(1).state.tree.size >= least


def test_progress_grows_from_0_to_at_most_1():
    shares = []
    refine(*parts(), lambda share: shares.append(share) or True)
    assert shares == sorted(shares)
    assert 0 <= shares[0] < shares[-1] <= 1


def test_saying_no_at_any_time_stops_the_work_at_once():
    shares = []
    refine(*parts(), lambda share: shares.append(share) or True)
    for calls in range(len(shares)):
        said = []
        with pytest.raises(CancelledError):
            refine(*parts(), lambda share, said=said, calls=calls: said.append(share) or len(said) <= calls)
        assert said == shares[: calls + 1]


def looked_at(made: Refinement) -> tuple[np.ndarray, np.ndarray]:
    """Levels and keys of all receivers, in one number, and their light."""
    seen = [look.seen for look in made.looks]
    keys = [part.at.key + (np.int64(level) << 32) for level, part in enumerate(seen)]
    return np.concatenate(keys), np.concatenate([part.light for part in seen], axis=1)


def test_receivers_in_doubt_get_more_paths_and_others_keep_theirs(monkeypatch):
    plain, made = Refinement(*parts(), None), Refinement(*parts(), None)
    made.run()
    monkeypatch.setattr(Refinement, "_look_closer", lambda self, level: None)
    plain.run()
    (key, light), (plain_key, plain_light) = looked_at(made), looked_at(plain)
    _, row, plain_row = np.intersect1d(key, plain_key, return_indices=True)
    light, plain_light = light[:, row], plain_light[:, plain_row]
    other = (np.abs(light - plain_light) > 1e-3 * plain_light.mean()).any(axis=(0, 2, 3))
    assert 10 < other.sum() < 0.9 * len(other)
    spread = [np.square(part[0] - part[1])[other].mean() for part in (plain_light, light)]
    assert spread[1] < spread[0] / 2
    assert np.array_equal(made.state.seen.light, looked_at(made)[1][:, made.current])


def test_coarse_voxels_that_have_become_poor_are_judged_once_more(monkeypatch):
    judged = []
    monkeypatch.setattr(
        Refinement, "_wanting", lambda self, level, own=Refinement._wanting: judged.append(level) or own(self, level)
    )
    made = Refinement(*parts(), None)
    made.run()
    levels = made.grid.levels
    assert judged == [*range(levels - 1), *range(levels - 1)]
    at, count = made.state.seen.at, len(made.state.seen.at.key)
    assert len(np.unique(made.current)) == count == len(made.current)
    keys = np.concatenate([look.seen.at.key for look in made.looks])
    assert np.array_equal(keys[made.current], at.key)
