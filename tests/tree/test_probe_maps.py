"""The record of probes: what rounding does, names of parts, room for any number."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.tree.probe_maps import LARGEST, empty, part_names, rounded


def test_rounding_is_within_its_bound_everywhere_and_the_same_for_both_signs():
    values = np.exp(np.random.default_rng(0).uniform(np.log(6.2e-5), np.log(float(LARGEST)), 100_000)).astype(
        np.float32
    )
    found = rounded(values).astype(np.float64)
    assert np.abs(found / values - 1).max() <= 2.0**-9
    assert np.abs(found / values - 1).max() > 0.99 * 2.0**-9
    assert abs((found / values).mean() - 1) < 1e-5
    assert np.array_equal(rounded(-values).astype(np.float64), -found)


def test_rounding_twice_is_rounding_once():
    once = rounded(np.random.default_rng(1).normal(size=10_000).astype(np.float32))
    assert np.array_equal(rounded(once.astype(np.float32)), once)


def test_small_numbers_are_rounded_to_the_step_of_half_precision_and_large_ones_are_held():
    small = np.random.default_rng(2).uniform(0, 6e-5, 10_000).astype(np.float32)
    assert np.abs(rounded(small).astype(np.float64) - small).max() <= 2.0**-24
    assert rounded(np.float32([1e9, -1e9, LARGEST])).tolist() == [LARGEST, -LARGEST, LARGEST]


@pytest.mark.parametrize(
    ("light", "names"),
    [
        ((False, 0, 0), ()),
        ((True, 0, 0), ("local",)),
        ((False, 1, 1), ("sun.0", "sky")),
        ((True, 2, 3), ("local", "sun.0", "sun.1", "sky.0", "sky.1", "sky.2")),
    ],
)
def test_parts_have_names(light, names):
    assert part_names(*light) == names


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_there_is_room_for_any_number_of_probes(count):
    maps = empty(np.zeros((count, 3)), np.zeros(count, bool), 16, ("local",))
    assert maps.layout.rows * maps.layout.columns >= max(count, 1)
    assert [level.shape[:2] for level in maps.radiance["local"]] == [maps.layout.shape(level) for level in (0, 1)]
    assert np.isinf(maps.distance).all()
    assert maps.normal.shape == maps.albedo.shape == (*maps.layout.shape(0), 3)
    assert maps.normal.base is not maps.albedo
