"""The check of a surface cache: an error that is planted is found, an honest cache passes, noise is what it is."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from command_line import yard
from gi_volumes.bake import cell_job, job, radiosity
from gi_volumes.bake import check as checking
from gi_volumes.bake.check import Check
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, choose_grid, model
from gi_volumes.tree import world
from gi_volumes.tree.outline import outline

SETTINGS = Settings(samples=32, bounces=6, finest=0.5, error=0.1, method="cache")
STANDARD_ERRORS = 4.0


@pytest.fixture(scope="module")
def parts():
    """The yard with a cache, without, its cell and its judge."""
    snapshot, light = model(yard(), SETTINGS)
    scene = prepare(snapshot, light)
    grid = choose_grid(scene.soup.corners, snapshot.origin, SETTINGS.finest)
    cell = outline(scene.soup.corners, grid, (0, 0), by_light=True)
    low, high = scene.soup.bounds
    cached = radiosity.around(scene, grid, np.stack([low, high + 1e-3]), Effort(64, 6, 1))
    return cached, scene, grid, cell.coords, job._judge(snapshot, SETTINGS, scene)


def scaled(scene, factor: float):
    """A scene whose cache brings too much light."""
    cache = dataclasses.replace(scene.cache, light=scene.cache.light * np.float32(factor))
    return dataclasses.replace(scene, cache=cache)


def test_an_honest_cache_is_off_by_less_than_the_check_can_tell(parts):
    bias, error = checking.check(*parts, Effort(256, 6, 0)).bias()
    assert (np.abs(bias) < STANDARD_ERRORS * error).all()
    assert (error < 0.1).all()


def test_a_cache_that_brings_too_much_light_fails(parts):
    cached, *others = parts
    effort = Effort(256, 6, 0)
    assert not checking.check(*parts, effort).fails(0.1)
    assert checking.check(scaled(cached, 3.0), *others, effort).fails(0.1)


def test_the_noise_is_that_of_other_seeds(parts):
    made = [checking.check(*parts, Effort(64, 6, seed)) for seed in range(8)]
    light = np.stack([part.cached for part in made])
    truth = np.sqrt(light.var(axis=0, ddof=1).mean(axis=0)) / light.mean(axis=(0, 1))
    found = np.sqrt(np.mean([part.noise() ** 2 for part in made], axis=0))
    assert found == pytest.approx(truth, rel=0.2)


def test_the_number_of_threads_changes_nothing(parts):
    one, two = (checking.check(*parts, Effort(32, 6, 0, threads)) for threads in (1, 3))
    assert (one.cached == two.cached).all()
    assert (one.paths == two.paths).all()


def light(sigma: float, views: int = 1) -> np.ndarray:
    """Uneven light at 128 places."""
    return np.random.default_rng(3).lognormal(0, sigma, (128, views))


def test_the_standard_error_does_not_count_how_uneven_light_is():
    truth = light(2.0)
    bias, error = Check(1.5 * truth, truth, 1.5 * truth).bias()
    assert bias == pytest.approx([0.5])
    assert error == pytest.approx([0], abs=1e-12)
    noise = np.random.default_rng(4).normal(0, 0.1, (128, 1))
    bias, error = Check(truth + noise, truth, truth + noise).bias()
    assert error == pytest.approx([0.1 / np.sqrt(128) / truth.mean()], rel=0.2)


@pytest.mark.parametrize(
    ("cached", "paths"),
    [
        (1.5 * light(2.0), light(2.0)),
        (np.ones((128, 1)), np.zeros((128, 1))),
        (np.where(np.arange(128)[:, None] == 5, np.nan, 1.0), np.ones((128, 1))),
        (light(1.0, 2) * (2.0, 1 / 3), light(1.0, 2) * (1.0, 1.5)),
    ],
    ids=["a factor", "light where there is none", "not a number", "errors that cancel"],
)
def test_a_cache_that_is_wrong_fails(cached, paths):
    assert Check(cached, paths, cached).fails(0.1)
    assert not Check(paths, paths, paths).fails(0.1)


def test_checks_of_cells_are_joined():
    part = Check(*(np.full((3, 2), value) for value in (1.0, 2.0, 1.0)))
    bias, error = Check.join([part, part], 2).bias()
    assert bias.tolist() == [-0.5, -0.5]
    assert error.tolist() == [0, 0]
    assert len(Check.join([], 2).paths) == 0


def bake(target, settings=SETTINGS) -> job.Outcome:
    """Bake the yard by the cache, small as it is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_job, "WORTH", 0)
        return job.bake(yard(), target, settings)


def test_the_summary_says_what_the_check_found(tmp_path):
    outcome = bake(tmp_path)
    assert [item["what"] for item in outcome.checked] == [name for name in outcome.modelled if name != "probes"]
    assert all(item["places"] > 50 and 0 < item["noise"] < 1 for item in outcome.checked)
    assert json.loads(json.dumps(outcome.checked)) == outcome.checked
    assert not [text for text in outcome.warnings if "cache" in text]


def test_where_the_cache_is_too_far_off_the_bake_is_that_of_paths(tmp_path, monkeypatch):
    around = cell_job.radiosity.around
    bake(tmp_path / "paths", dataclasses.replace(SETTINGS, method="paths"))
    monkeypatch.setattr(cell_job.radiosity, "around", lambda *given: scaled(around(*given), 5.0))
    outcome = bake(tmp_path / "cache")
    assert ["surface cache is too far off" in text for text in outcome.warnings].count(True) == outcome.cells
    points = np.random.default_rng(1).uniform((0, 0, 0), (8, 8, 3), (500, 3))
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    one, two = (world.load(tmp_path / name).irradiance(points, normals) for name in ("paths", "cache"))
    assert one.max() > 0
    assert (one == two).all()
