"""Interpolation between sun keys: exact at keys, continuous, defined for every direction."""

import numpy as np
import pytest
from gi_volumes.tree.suns import SunKeys


def random_directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def spiral(count):
    """Directions spread over the upper hemisphere."""
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def rings():
    """The worst case for a triangulation: many keys on common circles, the lowest on the horizon."""
    angle = np.arange(8) * np.pi / 4
    circles = [
        np.stack([np.cos(angle) * np.cos(e), np.sin(angle) * np.cos(e), np.full(8, np.sin(e))], axis=1)
        for e in (0, 0.5, 1)
    ]
    return np.concatenate([*circles, [[0, 0, 1]]])


def arc(count=7, latitude=0.7):
    """The sun's way over one day, on a small circle."""
    hour = np.linspace(-1.4, 1.4, count)
    east, south, up = np.sin(hour), np.cos(hour) * np.sin(latitude), np.cos(hour) * np.cos(latitude)
    return np.stack([east, -south, up], axis=1)


LAYOUTS = {
    "one": np.array([[0.0, 0.6, 0.8]]),
    "two": np.array([[0.0, 0.6, 0.8], [0.8, 0.0, 0.6]]),
    "twice the same": np.array([[0.0, 0.6, 0.8], [0.0, 0.6, 0.8]]),
    "arc": arc(),
    "equinox": arc(latitude=0.0),
    "spiral of 16": spiral(16),
    "spiral of 64": spiral(64),
    "rings": rings(),
    "sphere": random_directions(30, 5),
    "three": np.eye(3),
}


def dense(keys, directions):
    """(m, K) weights."""
    index, weight = keys.interpolate(directions)
    result = np.zeros((len(index), len(keys.directions)))
    for corner in range(3):
        result[np.arange(len(index)), index[:, corner]] += weight[:, corner]
    return result


@pytest.mark.parametrize("layout", LAYOUTS)
def test_weights_are_a_partition_of_one_for_every_direction(layout):
    keys = SunKeys(LAYOUTS[layout])
    index, weight = keys.interpolate(np.concatenate([random_directions(3000), np.eye(3), -np.eye(3)]))
    assert index.shape == weight.shape == (3006, 3)
    assert (weight >= 0).all()
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_key_is_reproduced_exactly(layout):
    keys = SunKeys(LAYOUTS[layout])
    weights = dense(keys, keys.directions)
    same = keys.directions @ keys.directions.T > 1 - 1e-12
    np.testing.assert_allclose((weights * same).sum(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("layout", ["spiral of 16", "spiral of 64", "rings", "sphere", "three"])
def test_weights_are_continuous_over_the_upper_hemisphere(layout):
    """Steps of 1e-6 rad move no weight by more than a small multiple of the keys' spacing explains."""
    keys = SunKeys(LAYOUTS[layout])
    start = random_directions(20_000)
    start[:, 2] = np.abs(start[:, 2])
    end = start + 1e-6 * random_directions(20_000, 1)
    step = np.abs(dense(keys, start) - dense(keys, end)).max()
    assert step < 1e-4


@pytest.mark.parametrize("layout", ["two", "arc", "equinox"])
def test_weights_are_continuous_near_an_arc(layout):
    """Within 0.2 rad of the arc; at its pole all of it is equally near."""
    keys = SunKeys(LAYOUTS[layout])
    share = np.random.default_rng(0).dirichlet([1, 1], 20_000)
    edge = np.random.default_rng(1).integers(0, len(keys.edges), 20_000)
    start = np.einsum("mc,mci->mi", share, keys.directions[keys.edges[edge]]) + 0.2 * random_directions(20_000)
    end = start + 1e-6 * random_directions(20_000, 1)
    assert np.abs(dense(keys, start) - dense(keys, end)).max() < 1e-4


@pytest.mark.parametrize("layout", ["spiral of 64", "rings", "sphere"])
def test_no_hole_opens_inside_the_hull(layout):
    """Blends of nearby keys are inside: what is interpolated there points to the query."""
    keys = SunKeys(LAYOUTS[layout])
    rng = np.random.default_rng(0)
    corners = keys.directions[keys.triangles[rng.integers(0, len(keys.triangles), 5000)]]
    query = np.einsum("mc,mci->mi", rng.dirichlet([1, 1, 1], 5000), corners)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    met = dense(keys, query) @ keys.directions
    cosine = (met * query).sum(axis=1) / np.linalg.norm(met, axis=1)
    assert cosine.min() > 1 - 1e-6


def test_between_two_neighbours_of_an_arc_only_these_two_count():
    keys = SunKeys(arc())
    middle = keys.directions[2] + keys.directions[3]
    weights = dense(keys, middle[None])[0]
    np.testing.assert_allclose(weights[[2, 3]], 0.5, atol=0.02)


def test_the_ends_of_an_arc_are_clamped_to():
    keys = SunKeys(arc(latitude=0.0))
    below = keys.directions[0] * [1, 1, -1]
    assert dense(keys, below[None])[0, 0] == pytest.approx(1)


def test_faces_are_those_of_the_convex_hull():
    """Euler: a triangulated sphere of 30 keys has 2 * 30 - 4 faces, and no key lies beyond any of them."""
    keys = SunKeys(random_directions(30, 5))
    assert len(keys.triangles) == 56
    assert len(keys.edges) == 84


@pytest.mark.parametrize(
    "bad", [np.zeros((0, 3)), np.zeros((65, 3)), np.zeros((2, 2)), np.zeros((1, 3)), [[0, np.nan, 1]]]
)
def test_what_are_no_keys_is_refused(bad):
    with pytest.raises(ValueError, match="sun key"):
        SunKeys(bad)


@pytest.mark.parametrize("bad", [[[0, 0, 0]], [[np.inf, 0, 0]]])
def test_what_is_no_direction_is_refused(bad):
    with pytest.raises(ValueError, match="sun direction"):
        SunKeys(np.eye(3)).interpolate(bad)
