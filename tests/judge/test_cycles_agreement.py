"""The comparison's statistics and its choice of points."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="scenes are opened in Blender")

from gi_volumes.benchmarks import surface_points
from gi_volumes.benchmarks.cycles_agreement import agreement

SIGMAS = 4.0


def box(low, high) -> np.ndarray:
    """(12, 3, 3) triangles of a box that faces outwards."""
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) * np.subtract(high, low) + low
    quads = corners[[[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]]
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


def noisy(truth: np.ndarray, seed: int, noise: float = 0.2, runs: int = 2) -> np.ndarray:
    """Runs of an unbiased estimate with independent noise at every point."""
    generator = np.random.default_rng(seed)
    grey = truth * (1 + noise * generator.standard_normal((runs, len(truth))))
    return np.repeat(grey[..., None], 3, axis=2)


def test_equal_truths_agree_and_a_planted_two_percent_does_not():
    truth = np.random.default_rng(0).uniform(0.1, 2.0, 2000)
    same, off = (agreement(noisy(factor * truth, 1), noisy(truth, 2)) for factor in (1.0, 1.02))
    assert abs(same.difference) < SIGMAS * same.error < 0.03
    assert off.difference == pytest.approx(0.02 + same.difference, rel=0.1)
    assert abs(off.difference) > 2 * off.error


def test_the_error_is_what_repetitions_scatter_by():
    truth = np.random.default_rng(0).uniform(0.1, 2.0, 300)
    found = [agreement(noisy(truth, 2 * k), noisy(truth, 2 * k + 1)) for k in range(400)]
    scatter = np.std([result.difference for result in found])
    assert np.mean([result.error for result in found]) == pytest.approx(scatter, rel=0.15)
    assert np.mean([result.rmse for result in found]) == pytest.approx(np.mean([r.noise for r in found]), rel=0.05)


def test_no_light_gives_no_verdict():
    dark = agreement(np.zeros((2, 5, 3)), np.zeros((2, 5, 3)))
    assert dark.mean == 0
    assert np.isnan(dark.difference)


def test_points_spread_by_area_and_are_the_same_for_the_same_seed():
    room = box((0, 0, 0), (4, 2, 1))[:, ::-1]
    points, normals = surface_points.pick(room, 4000, seed=1)
    again, _ = surface_points.pick(room, 4000, seed=1)
    np.testing.assert_array_equal(points, again)
    share = np.array([np.isclose(np.abs(normals[:, axis]), 1).mean() for axis in range(3)])
    np.testing.assert_allclose(share, np.array([2, 4, 8]) / 14, atol=0.04)
    assert ((points > 0) & (points < (4, 2, 1))).all()


def test_no_point_is_buried_in_a_solid_or_a_crack_or_sees_nothing():
    room = box((0, 0, 0), (4, 4, 3))[:, ::-1]
    buried, crack = box((1, 1, -0.5), (2, 2, 0.5)), box((2.5, 1, 0.01), (3.5, 2, 0.5))
    alone = box((50, 50, 50), (51, 51, 51))
    points, _ = surface_points.pick(np.concatenate([room, buried, crack, alone]), 3000, seed=2)
    assert (points[:, 2] > 0).all()
    assert (points < 4.01).all()
    under = (points[:, 2] < 0.01) & (np.abs(points[:, 0] - 3.0) < 0.4) & (np.abs(points[:, 1] - 1.5) < 0.4)
    inside = (np.abs(points[:, :2] - 1.5) < 0.49).all(axis=1) & (points[:, 2] < 0.49)
    assert not under.any()
    assert not inside.any()


def test_a_scene_without_room_is_refused_in_words():
    with pytest.raises(ValueError, match="no surface"):
        surface_points.pick(np.zeros((0, 3, 3)), 5, seed=0)
    with pytest.raises(ValueError, match="free space"):
        surface_points.pick(box((0, 0, 0), (1, 1, 1)), 50, seed=0)
