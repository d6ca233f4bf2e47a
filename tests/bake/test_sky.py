"""The sky: its orientation, its samples by chi-square, their density, its harmonics."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import warp
from gi_volumes.bake.sky import Sky
from gi_volumes.tree import harmonics
from statistics_checks import SIGNIFICANCE, chi_square, is_uniform

HEIGHT, WIDTH = 12, 20
SAMPLES = 200_000
EDGE = 1e-5
"""Distance from a texel's edge, in texels, within which float32 may decide either way."""


def directions(seed: int, count: int = SAMPLES) -> np.ndarray:
    return warp.sphere(*np.random.default_rng(seed).random((2, count), np.float32))


def place(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(row, column) in texels by the snapshot's formula, in double precision."""
    x, y, z = direction.astype(np.float64)
    u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
    v = 0.5 + np.arctan2(z, np.hypot(x, y)) / np.pi
    return v * HEIGHT, u * WIDTH


def inside_texels(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    return (np.abs(row - np.round(row)) > EDGE * HEIGHT) & (np.abs(column - np.round(column)) > EDGE * WIDTH)


def solid_angles() -> np.ndarray:
    """(HEIGHT, 1) of one texel in each row."""
    edges = np.sin(np.linspace(-np.pi / 2, np.pi / 2, HEIGHT + 1))
    return np.diff(edges)[:, None] * 2 * np.pi / WIDTH


def uneven_map() -> np.ndarray:
    rng = np.random.default_rng(1)
    radiance = rng.uniform(0.1, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    radiance[7, 3] = (80, 60, 20)
    radiance[0, 10] = 30
    radiance[4, 4:9] = 0
    return radiance


def luminance(radiance: np.ndarray) -> np.ndarray:
    return radiance.astype(float) @ [0.2126, 0.7152, 0.0722]


def test_every_direction_sees_the_texel_that_the_snapshot_s_formula_names():
    radiance = np.random.default_rng(2).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    direction = directions(3)
    row, column = place(direction)
    clear = inside_texels(row, column)
    found = Sky(radiance).radiance(direction).T
    assert np.array_equal(found[clear], radiance[row[clear].astype(int), column[clear].astype(int)])
    for flipped in (radiance[::-1], radiance[:, ::-1]):
        assert not np.array_equal(Sky(flipped).radiance(direction).T[clear], found[clear])


def test_the_nadir_is_the_first_row_and_plus_y_a_quarter_to_the_left_of_plus_x():
    radiance = np.zeros((4, 8, 3), np.float32)
    radiance[0] = 1
    radiance[2, :, 1] = np.arange(8)
    sky = Sky(radiance)
    x = np.array([[0, 0, 1, 0, -1, 0], [0, 0, -0.01, 1, 0.01, -1], [-1, 1, 0.3, 0.3, 0.3, 0.3]], np.float32)
    x[1, 3], x[0, 3], x[0, 5] = 1, 0.01, 0.01
    found = sky.radiance(x / np.sqrt(warp.dot(x, x)))
    assert found[:, 0].tolist() == [1, 1, 1]
    assert found[:, 1].tolist() == [0, 0, 0]
    assert found[1, 2:].tolist() == [4, 2, 0, 5]


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (5, 1), (2, 2)])
def test_the_poles_and_the_seam_are_inside_maps_of_any_size(shape):
    sky = Sky(np.ones((*shape, 3), np.float32))
    edge = np.array([(0, 0, 1), (0, 0, -1), (-1, 0.0, 0), (-1, -0.0, 0), (-1, 1e-30, 0), (-1, -1e-8, 0), (1, 0, 0)])
    assert np.all(sky.radiance(np.ascontiguousarray(edge.T.astype(np.float32))) == 1)


def test_samples_fall_into_texels_by_their_power_and_evenly_within_and_a_wrong_density_is_caught():
    radiance = uneven_map()
    sky = Sky(radiance)
    assert sky.uneven
    direction, found, pdf = sky.sample(tuple(np.random.default_rng(4).random((3, SAMPLES), np.float32)))
    row, column = place(direction)
    texel = np.clip(row.astype(int), 0, HEIGHT - 1) * WIDTH + np.clip(column.astype(int), 0, WIDTH - 1)
    counts = np.bincount(texel, minlength=HEIGHT * WIDTH)
    power = (luminance(radiance) * solid_angles()).ravel()
    assert chi_square(counts, SAMPLES * power / power.sum()) > SIGNIFICANCE
    without_cosine = luminance(radiance).ravel()
    assert chi_square(counts, SAMPLES * without_cosine / without_cosine.sum()) < SIGNIFICANCE
    assert np.abs(warp.dot(direction, direction) - 1).max() < 1e-6
    bright = texel == 7 * WIDTH + 3
    low, high = np.sin(np.pi * (np.array([7, 8]) / HEIGHT - 0.5))
    within = np.clip((direction[2][bright] - low) / (high - low), 0, 1 - 1e-9)
    assert is_uniform(within, column[bright] % 1.0)
    clear = inside_texels(row, column)
    assert np.array_equal(found[:, clear].T, radiance.reshape(-1, 3)[texel[clear]])
    assert np.array_equal(pdf[clear], sky.pdf_solid_angle(direction)[clear])
    assert pdf.min() > 0


def test_the_density_integrates_to_one_and_is_luminance_over_its_integral():
    radiance = uneven_map()
    sky = Sky(radiance)
    total = (luminance(radiance) * solid_angles()).sum()
    row, column = (a.ravel() for a in np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij"))
    elevation, angle = np.pi * (row / HEIGHT - 0.5), 2 * np.pi * (0.5 - column / WIDTH)
    centers = np.stack([np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)])
    pdf = sky.pdf_solid_angle(centers.astype(np.float32)).reshape(HEIGHT, WIDTH)
    assert (pdf * solid_angles()).sum() == pytest.approx(1, abs=1e-6)
    assert np.allclose(pdf, luminance(radiance) / total, rtol=1e-6)


def test_a_smooth_sky_needs_no_samples_and_a_black_one_is_dark():
    assert not Sky(np.ones((8, 16, 3), np.float32)).uneven
    black = Sky(np.zeros((8, 16, 3), np.float32))
    assert black.dark
    assert not black.uneven


def test_the_mean_is_the_integral_over_the_sphere():
    radiance = uneven_map()
    truth = (radiance * solid_angles()[:, :, None]).sum(axis=(0, 1)) / (4 * np.pi)
    assert np.allclose(Sky(radiance).mean, truth, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (3, 5), (16, 32)])
def test_a_constant_sky_has_one_harmonic_whatever_the_size_of_its_map(shape):
    found = Sky(np.full((*shape, 3), (1.0, 2.0, 0.5), np.float32)).harmonics()
    assert np.allclose(found[0], np.sqrt(4 * np.pi) * np.array([1.0, 2.0, 0.5]), rtol=1e-6)
    assert np.abs(found[1:]).max() < 2e-3


def test_a_linear_sky_has_the_harmonics_of_its_slope():
    height, width = 64, 128
    slope = np.array([0.3, -0.2, 0.5])
    elevation = np.pi * ((np.arange(height) + 0.5) / height - 0.5)[:, None]
    angle = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    parts = (np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation) + 0 * angle)
    values = 1 + np.einsum("khw,k->hw", np.stack(parts), slope)
    found = Sky(np.repeat(values[:, :, None], 3, axis=2).astype(np.float32)).harmonics()[:, 0]
    truth = np.zeros(9)
    truth[0], truth[1:4] = np.sqrt(4 * np.pi), np.sqrt(4 * np.pi / 3) * slope[[1, 2, 0]]
    assert np.allclose(found, truth, atol=2e-3)
    assert not np.allclose(found, truth * [1, -1, 1, 1, 1, 1, 1, 1, 1], atol=2e-3)


def test_harmonics_of_any_map_are_its_integral_against_the_basis():
    radiance = uneven_map()
    sky = Sky(radiance)
    direction = directions(5, 400_000)
    values = harmonics.basis(direction.T).astype(float)[:, :, None] * sky.radiance(direction).T[:, None].astype(float)
    error = 4 * np.pi * values.std(axis=0) / np.sqrt(len(values))
    assert (np.abs(4 * np.pi * values.mean(axis=0) - sky.harmonics()) < 4 * error + 2e-3).all()
