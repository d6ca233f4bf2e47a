"""Bounced light that texels share: across edges of the map, along planes, and only there; and only where it helps."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import capture, smoothing
from gi_volumes.bake.panorama import Light, Seen
from gi_volumes.bake.smoothing import alike, around, smoothed
from gi_volumes.tree import octahedral

SIZE = 30
COUNT = SIZE * SIZE
ROUNDING = 1e-5
HORIZON = 0.02
"""Sines below this are no elevation."""


def floor_and_ceiling(low: float = 1.0, high: float = 2.0) -> Seen:
    """Two planes, seen from between; at the horizon is the sky."""
    direction = octahedral.centers(SIZE).reshape(-1, 3).T.astype(np.float32)
    up, met = direction[2] > 0, np.abs(direction[2]) > HORIZON
    distance = np.where(met, np.where(up, high, low) / np.maximum(np.abs(direction[2]), HORIZON), np.inf)
    normal = np.zeros_like(direction)
    normal[2] = np.where(up, -1, 1) * met
    return Seen(direction, distance.astype(np.float32), normal, np.full_like(direction, 0.5))


def light(bounced: np.ndarray, reflectance: np.ndarray | float = 0.5, straight: float = 0.0) -> Light:
    """One function of the same in all colours."""
    parts = (straight, bounced, reflectance)
    straight, bounced, reflectance = (np.float32(np.broadcast_to(part, COUNT)) for part in parts)
    straight, bounced = (np.repeat(part[:, None, None], 3, axis=2) for part in (straight, bounced))
    return Light(straight, bounced, np.repeat(reflectance[:, None], 3, axis=1))


def test_texels_around_are_those_that_borders_show():
    index = np.arange(COUNT).reshape(SIZE, SIZE)
    bordered = octahedral.add_border(index)
    found = around(SIZE).reshape(5, 5, SIZE, SIZE)
    for down in range(3):
        for right in range(3):
            assert np.array_equal(found[down + 1, right + 1], bordered[down : down + SIZE, right : right + SIZE])


def test_texels_around_are_near_everywhere():
    direction = octahedral.centers(SIZE).reshape(-1, 3)
    cosine = (direction[around(SIZE)] * direction).sum(axis=2)
    assert np.arccos(np.clip(cosine, -1, 1)).max() < 8 * np.sqrt(4 * np.pi) / SIZE
    assert len({tuple(sorted(column)) for column in around(SIZE).T}) == COUNT


def test_planes_are_kept_apart_and_each_is_one():
    seen = floor_and_ceiling()
    weights, side = alike(seen), seen.normal[2]
    same = (side[around(SIZE)] == side) & (side != 0)
    same[12] = True
    assert np.array_equal(weights > 0, same)
    assert (weights[12] == 36).all()
    assert weights.sum(axis=0).max() == 256


def test_what_lies_behind_another_thing_is_another_plane():
    seen = floor_and_ceiling()
    table = seen.direction[0] > 0.5
    distance = np.where(table & (seen.direction[2] < 0), seen.distance * 0.9, seen.distance)
    weights = alike(Seen(seen.direction, distance, seen.normal, seen.albedo))
    below = np.flatnonzero((seen.direction[2] < 0) & (distance < 4))
    mixed = (table[around(SIZE)] != table)[:, below]
    assert mixed.any()
    assert not weights[:, below][mixed].any()


def test_the_sky_and_other_normals_share_nothing():
    seen = floor_and_ceiling()
    nothing = Seen(seen.direction, np.full(COUNT, np.inf, np.float32), seen.normal * 0, seen.albedo * 0)
    turned = seen.normal.copy()
    turned[:, ::2] = [[1], [0], [0]]
    for one in (nothing, Seen(seen.direction, seen.distance, turned, seen.albedo)):
        weights = alike(one)
        assert (weights[12] == 36).all()
    assert not np.delete(alike(nothing), 12, axis=0).any()


def test_even_light_on_textures_stays_what_it_is():
    reflectance = np.random.default_rng(0).random(COUNT)
    found = smoothed(light(3 * reflectance, reflectance, straight=2.0), alike(floor_and_ceiling()))
    assert found[:, 0, 0] == pytest.approx(2 + 3 * reflectance, rel=ROUNDING)


def test_noise_is_a_quarter_on_a_plane_and_its_mean_stays():
    noise = 1 + np.random.default_rng(1).normal(0, 0.2, COUNT)
    weights = alike(floor_and_ceiling())
    found = smoothed(light(noise), weights)[:, 0, 0]
    whole = weights.sum(axis=0) == 256
    assert found[whole].std() < 0.3 * noise.std()
    assert found.mean() == pytest.approx(1, abs=4 * 0.2 / np.sqrt(COUNT))


def test_black_and_empty_texels_are_no_trouble():
    assert not smoothed(light(0.0, 0.0), alike(floor_and_ceiling())).any()


def halves(truth: np.ndarray, noise: float, seed: int) -> list[Light]:
    rng = np.random.default_rng(seed)
    return [light(truth + rng.normal(0, noise, COUNT)) for _ in range(2)]


@pytest.mark.parametrize(("noise", "does_harm"), [(0.3, False), (0.001, True)])
def test_errors_with_and_without_smoothing_are_known(noise, does_harm):
    seen = floor_and_ceiling()
    truth, weights = 1 + 0.5 * np.sin(9 * seen.direction[0]), alike(seen)
    area = octahedral.solid_angles(SIZE).reshape(-1) / (4 * np.pi)
    said, true = [], []
    for seed in range(30):
        pair = halves(truth, noise, seed)
        plain, smooth = (
            np.stack([way(half)[:, 0, 0] for half in pair]) for way in (raw, lambda h: smoothed(h, weights))
        )
        said.append(np.square(capture._errors(plain, smooth)))
        off = [(found.mean(axis=0) - truth) / (truth + (area * truth).sum()) for found in (plain, smooth)]
        true.append([(area * one**2).sum() for one in off])
    said, true = np.sqrt(np.mean(said, axis=0)), np.sqrt(np.mean(true, axis=0))
    assert said == pytest.approx(true, rel=0.1)
    assert (true[0] < true[1]) == does_harm


def raw(half: Light) -> np.ndarray:
    return half.straight + half.bounced


def test_the_reach_is_that_of_the_weights():
    assert len(smoothing.WEIGHTS) == 2 * smoothing.REACH + 1
    assert smoothing.WEIGHTS.sum() ** 4 / (smoothing.WEIGHTS**2).sum() ** 2 == pytest.approx(13, abs=0.5)
