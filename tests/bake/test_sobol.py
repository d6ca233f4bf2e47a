"""Random numbers: Sobol points, their scrambling, and that nothing but key, sample and dimension matters."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import sobol
from gi_volumes.bake.gather import seeded
from gi_volumes.bake.sobol import DIMENSIONS, Sampler, points, scramble
from scipy.stats import qmc
from statistics_checks import SIGNIFICANCE, chi_square, grid_counts

HASHED = (DIMENSIONS, DIMENSIONS + 1, 1000, (1 << 16) - 64, 1 << 16, (1 << 16) + 67)
"""Dimensions past the table: the first, the paths' later vertices, direct light, roulette, transparency."""

SOBOL = (0, 1, 2, 17, 40, DIMENSIONS - 1)


def every_number(keys: np.ndarray, samples: int, dimension: int) -> np.ndarray:
    """(keys, samples) numbers of one dimension."""
    point, sample = np.divmod(np.arange(len(keys) * samples), samples)
    return Sampler(keys, 0, samples).uniform(point, sample, dimension).reshape(len(keys), samples)


def some_keys(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1 << 32, count, dtype=np.uint32)


def test_unscrambled_points_are_scipy_s_sobol_points_in_every_dimension():
    exponent = 12
    theirs = qmc.Sobol(DIMENSIONS, scramble=False, bits=sobol.BITS).random_base2(exponent)
    rank = np.arange(1 << exponent)
    ours = points(0, 1 << exponent)[:, rank ^ (rank >> 1)] / 2.0**sobol.BITS
    assert np.array_equal(ours.T, theirs)


def test_a_block_of_points_is_the_same_part_of_the_whole_sequence():
    whole = points(0, 3000)
    assert np.array_equal(points(1234, 500), whole[:, 1234:1734])


@pytest.mark.parametrize("dimension", SOBOL)
def test_every_key_s_samples_fall_once_into_each_equal_part_of_a_sobol_dimension(dimension):
    samples = 512
    numbers = every_number(some_keys(50), samples, dimension)
    parts = np.sort((numbers * samples).astype(int), axis=1)
    assert np.array_equal(parts, np.broadcast_to(np.arange(samples), parts.shape))


@pytest.mark.parametrize("dimension", SOBOL + HASHED)
def test_every_dimension_is_uniform_over_keys_and_over_samples_and_a_slight_slope_is_caught(dimension):
    bins = 50
    numbers = every_number(np.arange(4000, dtype=np.uint32), 16, dimension)
    for values in (numbers[:, 5], numbers.ravel()):
        counts = np.bincount((values * bins).astype(int), minlength=bins)
        assert chi_square(counts, np.full(bins, values.size / bins)) > SIGNIFICANCE
    sloped = np.bincount((numbers.ravel() ** 1.05 * bins).astype(int), minlength=bins)
    assert chi_square(sloped, np.full(bins, numbers.size / bins)) < SIGNIFICANCE


@pytest.mark.parametrize("dimension", HASHED)
def test_hashed_numbers_of_one_key_are_uniform_too(dimension):
    bins, samples = 50, 20000
    values = every_number(some_keys(1, dimension), samples, dimension)[0]
    assert chi_square(np.bincount((values * bins).astype(int), minlength=bins), np.full(bins, samples / bins)) > (
        SIGNIFICANCE
    )


def test_numbers_are_multiples_of_two_to_the_minus_24_below_one():
    numbers = np.concatenate([every_number(some_keys(200), 1024, d).ravel() for d in (0, 3, 70)])
    assert numbers.dtype == np.float32
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert np.array_equal(numbers * 2.0**24, np.round(numbers * 2.0**24))
    largest = np.float32(np.uint32(0xFFFFFFFF) >> np.uint32(8)) * sobol.UNIT
    assert largest < 1


def test_the_first_two_dimensions_fill_every_elementary_interval():
    samples = 1024
    for key in some_keys(5):
        x, y = (every_number(np.array([key]), samples, d)[0] for d in (0, 1))
        for columns in (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024):
            assert (grid_counts(x, y, (columns, samples // columns)) == 1).all()


@pytest.mark.parametrize("samples", [64, 256, 1024])
def test_pairs_that_choose_the_first_directions_and_lamp_points_are_stratified_and_hashed_pairs_are_not(samples):
    cells = (int(np.sqrt(samples)) // 2,) * 2
    expected = samples / np.prod(cells)

    def spread(first: int) -> float:
        x, y = (every_number(some_keys(8), samples, d) for d in (first, first + 1))
        return np.var([grid_counts(a, b, cells) for a, b in zip(x, y, strict=True)]) / expected

    first_direction, first_scatter, first_lamp_point = 0, 2, 6
    assert max(spread(first_direction), spread(first_scatter), spread(first_lamp_point)) < 0.1
    assert spread(HASHED[0]) > 0.5


@pytest.mark.parametrize("dimension", [0, 5, DIMENSIONS - 1, DIMENSIONS, 1 << 16])
def test_a_number_depends_on_key_sample_and_dimension_not_on_chunks_or_order(dimension):
    keys, samples = some_keys(30), 700
    whole = every_number(keys, samples, dimension)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(keys))[:11]
    for first, count in ((0, 700), (0, 1), (699, 1), (123, 321)):
        point = rng.integers(0, len(order), 500)
        sample = rng.integers(0, count, 500)
        found = Sampler(keys[order], first, count).uniform(point, sample, dimension)
        assert np.array_equal(found, whole[order[point], first + sample])


def test_numbers_of_different_dimensions_keys_and_seeds_are_uncorrelated_and_a_shared_part_is_caught():
    count = 4096
    bound = 5 / np.sqrt(count)  # five standard errors of a correlation: 2e-4 over 400 pairs
    keys = np.arange(count, dtype=np.uint32)
    dimensions = (0, 1, 2, 3, 4, 5, 30, 63, 64, 65, 66, 1000, 65472, 65536, 65537, 65600)
    rows = [every_number(keys, 4, d)[:, 3] for d in dimensions]
    rows += [every_number(seeded(keys, seed), 4, d)[:, 3] for seed in (0, 1, -1, 2**31 - 1) for d in (0, 64)]
    rows += [np.roll(rows[d], 1) for d in (0, 8)]
    correlation = np.corrcoef(rows) - np.eye(len(rows))
    assert np.abs(correlation).max() < bound
    mixed = np.corrcoef(rows[0], (rows[0] + 9 * rows[1]) % 1.0 * 0.9 + 0.1 * rows[0])[0, 1]
    assert abs(mixed) > bound


def test_equal_keys_share_their_numbers_and_equal_seeds_their_keys():
    keys = np.array([7, 9, 7], np.uint32)
    numbers = every_number(keys, 64, 2)
    assert np.array_equal(numbers[0], numbers[2])
    assert not np.array_equal(numbers[0], numbers[1])
    assert np.array_equal(seeded(keys, 3), seeded(keys, 3))
    assert not (seeded(keys, 3) == seeded(keys, 4)).any()


def test_scrambling_is_a_bijection_in_which_every_input_bit_moves_every_output_bit():
    keys = np.arange(1 << 20, dtype=np.uint32)
    assert len(np.unique(scramble(keys, 5))) == len(keys)
    base = some_keys(4000)
    for salt in (0, 1, 77):
        for bit in range(32):
            flipped = scramble(base, salt) ^ scramble(base ^ np.uint32(1 << bit), salt)
            share = [(flipped >> np.uint32(k) & np.uint32(1)).mean() for k in range(32)]
            assert min(share) > 0.45
            assert max(share) < 0.55
