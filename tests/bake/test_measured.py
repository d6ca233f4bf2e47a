"""Data points: how noisy they say they are, and how many paths they get for it."""

from __future__ import annotations

import numpy as np
import pytest
from command_line import yard
from gi_volumes.bake import measured
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.bake.measured import Measured, Sampling
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, choose_grid, model
from gi_volumes.tree import build
from gi_volumes.tree.outline import outline

SEEDS = 24


@pytest.fixture(scope="module")
def cell():
    """(scene, grid, tree) of the yard's only cell, three levels deep."""
    snapshot, settings = yard(), Settings(finest=0.5)
    snapshot, light = model(snapshot, settings)
    scene = prepare(snapshot, light)
    grid = choose_grid(scene.soup.corners, snapshot.origin, settings.finest)
    found = outline(scene.soup.corners, grid, (0, 0), by_light=False)
    return scene, grid, build.fit(found, [np.ones(len(mask)) for mask in found.wanted], "partial", 4096)


def sampling(scene, samples: int, seed: int = 0, aim: float = 0.0) -> Sampling:
    """All light counts alike."""
    return Sampling(Effort(samples, 4, seed, 1), np.ones((1, measured.functions(scene), 3)) * LUMINANCE, aim)


def known(noise: float, valid: bool = True) -> Measured:
    """Two voxels of the first level, the second one without noise."""
    coords = np.array([[0, 0, 0], [1, 0, 0]])
    light = np.ones((2, 1, 9, 3), np.float32)
    values = np.full(2, valid), light, np.array([[noise], [0]], np.float32), np.full(2, 256, np.int32)
    return Measured(np.zeros(2, np.uint8), coords, np.zeros((2, 3), np.int8), *values)


def counts(parent: Measured | None, samples: int = 256, aim: float = 0.1) -> list[int]:
    """Paths of a child of each parent, and of a voxel that has none."""
    coords = np.array([[1, 2, 3], [5, 2, 3], [9, 2, 3]])
    wanted = Sampling(Effort(samples), np.array([[[1.0, 0.0, 0.0]]]), aim)
    return measured._counts(parent, np.ones(3, np.uint8), coords, wanted).tolist()


@pytest.mark.parametrize("samples", [64, 100, 256, 300])
def test_noise_is_never_far_above_and_hardly_below_what_seeds_scatter_by(cell, samples):
    scene, grid, tree = cell
    runs = [measured.measure(scene, grid, tree, sampling(scene, samples, seed)) for seed in range(SEEDS)]
    valid = runs[0].valid
    light = np.stack([np.einsum("nfc,c->n", run.light[:, :, 0], LUMINANCE) for run in runs])[:, valid]
    said = np.sqrt(((np.stack([run.noise[:, 0] for run in runs])[:, valid] * light) ** 2).mean())
    scatter = np.sqrt(light.var(axis=0, ddof=1).mean())
    assert 0.4 * said < scatter < 1.1 * said


def test_the_noise_of_more_paths_is_given_as_that_of_the_usual_number(cell):
    scene, grid, tree = cell
    level, coords = tree.voxels()
    usual = sampling(scene, 64)
    found = [
        measured._trace(scene, grid, (level, coords, np.full(len(level), count)), usual, None)[3] for count in (64, 256)
    ]
    few, many = (np.sqrt((noise**2).mean()) for noise in found)
    assert 0.6 < many / few < 1.1


@pytest.mark.parametrize("samples", [1, 2, 1025])
def test_a_lonely_sample_makes_no_data_point_black(cell, samples):
    scene, grid, tree = cell
    wanted = sampling(scene, samples, aim=0.01)
    first = measured.measure(scene, grid, tree, wanted)
    found = measured.measure(scene, grid, tree, wanted, measured.take(first, first.level == 0))
    assert np.isfinite(found.noise).all()
    assert (found.paths > 0).all()
    assert (found.light[found.valid] != 0).any(axis=(1, 2, 3)).all()


def test_children_of_noisy_parents_get_twice_the_paths_and_those_of_others_a_quarter():
    assert counts(known(0.5)) == [512, 64, 256]
    assert counts(known(0.1)) == [256, 64, 256]
    assert counts(known(0.0701)) == [128, 64, 256]


def test_nobody_who_has_few_paths_gets_fewer_than_can_be_judged():
    assert counts(known(0.5), 64) == [128, 32, 64]
    assert counts(known(0.5), 16) == [32, 16, 16]


def test_without_an_aim_or_a_parent_in_free_space_all_get_the_same():
    assert counts(known(0.5), aim=0) == counts(known(0.5, valid=False)) == counts(None) == [256, 256, 256]


def test_means_do_not_depend_on_how_the_paths_are_shared_out(cell):
    scene, grid, tree = cell
    means, spread = [], []
    for aim in (0.0, 0.05):
        runs = []
        for seed in range(SEEDS):
            first = measured.measure(scene, grid, tree, sampling(scene, 64, seed))
            coarse = measured.take(first, first.level == 0)
            other = sampling(scene, 64, seed + 100, aim)
            run = measured.measure(scene, grid, tree, other, coarse)
            runs.append(np.einsum("nfc,c->", run.light[:, :, 0], LUMINANCE))
        means.append(np.mean(runs))
        spread.append(np.var(runs, ddof=1) / SEEDS)
    assert abs(means[0] - means[1]) < 4 * np.sqrt(sum(spread))
    assert np.sqrt(sum(spread)) < 0.01 * means[0]
