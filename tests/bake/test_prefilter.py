"""Prefiltered maps: constants, energy, brute force, disks of light, symmetry, and the same bits always."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import prefilter as module
from gi_volumes.bake.prefilter import Prefilter, prefilter
from gi_volumes.tree import ggx, octahedral
from gi_volumes.tree.probe_atlas import Layout, fetch

LAYOUT = Layout(64, 1, 1)
SUMMED = 62 * 62
ROUNDING = 4 * 2.0**-24 * np.sqrt(SUMMED)
"""Of sums of so many float32 products, which round at random, and of a stored matrix."""

BALANCED = 0.016
"""Most that balancing changes a lobe, where 6 x 6 centres stand for a sphere; half of it on finer levels."""


@pytest.fixture(scope="module")
def blur() -> Prefilter:
    return prefilter(LAYOUT)


def noise(seed: int, channels: int = 3) -> np.ndarray:
    size = LAYOUT.sizes[0]
    return np.random.default_rng(seed).random((size, size, channels)).astype(np.float32)


def energy(image: np.ndarray) -> np.ndarray:
    """(channels,) integral over the sphere."""
    return np.einsum("yx,yxc->c", octahedral.solid_angles(len(image)), image.astype(np.float64))


def brute_force(image: np.ndarray, toward: np.ndarray, roughness: float, parts: int = 10) -> np.ndarray:
    """(n, channels) lobes over a map whose texels are even, each cut into many parts."""
    fine = octahedral.centers(parts * len(image)).reshape(-1, 3)
    area = octahedral.solid_angles(parts * len(image)).reshape(-1)
    light = np.repeat(np.repeat(image, parts, axis=0), parts, axis=1).reshape(len(fine), -1)
    return np.stack([(ggx.density(fine @ axis, roughness) * area) @ light for axis in toward])


def test_constant_maps_stay_constant_on_every_level(blur):
    value = np.float32([0.25, 1 / 3, 5e4])
    levels = blur(np.broadcast_to(value, (62, 62, 3)))
    assert [len(level) for level in levels] == list(LAYOUT.sizes)
    for level in levels:
        assert np.abs(level / value - 1).max() < ROUNDING


@pytest.mark.parametrize("texel", [(0, 0), (31, 31), (31, 0), (10, 51), (15, 46), (61, 30)])
def test_a_single_bright_texel_keeps_its_energy_on_every_level(blur, texel):
    image = np.zeros((62, 62, 2), np.float32)
    image[texel] = 1e5, 2
    for level in blur(image):
        assert energy(level) == pytest.approx(energy(image), rel=ROUNDING)


def test_matrices_that_are_not_balanced_are_found(monkeypatch):
    monkeypatch.setattr(module, "BALANCING", 0)
    image = np.zeros((62, 62, 1), np.float32)
    image[31, 31] = 1
    assert np.abs(energy(prefilter(LAYOUT)(image)[-1]) / energy(image) - 1) > 10 * ROUNDING


@pytest.mark.parametrize("number", range(1, LAYOUT.levels))
def test_levels_agree_with_brute_force_and_another_roughness_does_not(blur, number):
    image, size = noise(1), LAYOUT.sizes[number]
    image[20:24, 40:44] = 30  # a lamp
    rows = np.random.default_rng(2).permutation(size * size)[:24]
    toward = octahedral.centers(size).reshape(-1, 3)[rows]
    found = blur(image)[number].reshape(-1, 3)[rows]
    limit = BALANCED if number == LAYOUT.levels - 1 else BALANCED / 2
    roughness = blur.levels[number - 1].roughness
    assert found == pytest.approx(brute_force(image, toward, roughness), rel=limit)
    assert found != pytest.approx(brute_force(image, toward, 0.9 * roughness), rel=limit)


@pytest.mark.parametrize("number", range(1, LAYOUT.levels))
def test_a_disk_of_light_gives_the_share_of_its_cone(blur, number):
    size = LAYOUT.sizes[number]
    axis = octahedral.centers(size)[size // 2 + 1, size // 2]
    cosine = np.cos(0.6)
    part = octahedral.centers(16 * 62) @ axis >= cosine
    image = part.reshape(62, 16, 62, 16).mean(axis=(1, 3), dtype=np.float32)[:, :, None]
    found = blur(image)[number][size // 2 + 1, size // 2, 0]
    assert found == pytest.approx(float(ggx.share(cosine, blur.levels[number - 1].roughness)), rel=BALANCED)


def test_the_roughest_level_is_irradiance_over_pi(blur):
    z = octahedral.centers(62)[:, :, 2:].astype(np.float32)
    toward = octahedral.centers(LAYOUT.sizes[-1])[:, :, 2]
    # A radiance of 1 + z / 2 has the irradiance pi + pi / 3 z (Ramamoorthi and Hanrahan 2001).
    assert blur(1 + z / 2)[-1][:, :, 0] == pytest.approx(1 + toward / 3, rel=BALANCED)


def test_mirrored_maps_have_mirrored_levels(blur):
    image = noise(3)
    straight = blur(image)
    for turn in (lambda a: a[::-1], lambda a: a[:, ::-1], lambda a: a.transpose(1, 0, 2)):
        for one, other in zip(blur(turn(image)), straight, strict=True):
            assert one == pytest.approx(turn(other), rel=ROUNDING)


def test_a_map_has_the_same_levels_whatever_its_channels_stand_beside(blur):
    image = noise(4, 6)
    together = blur(image)
    apart = [blur(image[:, :, first : first + 3]) for first in (0, 3)]
    for number, level in enumerate(together):
        assert level == pytest.approx(np.concatenate([part[number] for part in apart], axis=2), rel=ROUNDING)


def test_any_number_of_threads_of_the_matrix_product_gives_the_same_bits(run_python):
    program = (
        "import os; os.environ['OPENBLAS_NUM_THREADS'] = '{}'\n"
        "import hashlib, numpy as np\n"
        "from gi_volumes.bake.prefilter import prefilter\n"
        "from gi_volumes.tree.probe_atlas import Layout\n"
        "image = np.random.default_rng(0).random((62, 62, 3)).astype(np.float32)\n"
        "levels = prefilter(Layout(64, 1, 1))(image)\n"
        "print(hashlib.sha256(b''.join(level.tobytes() for level in levels)).hexdigest())"
    )
    said = [run_python(program.format(threads)) for threads in (1, 2, 4)]
    assert said[0].returncode == 0, said[0].stderr
    assert len({done.stdout for done in said}) == 1


def test_between_levels_the_mixed_look_up_is_close_to_the_lobe_itself(blur):
    # Soft lamps on a gradient, as rooms have them; the bilinear look-up's own error is part of it.
    rng = np.random.default_rng(5)
    axis = rng.normal(size=(6, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    light = 1 + octahedral.centers(62)[:, :, 2] / 2
    light = light + 4 * np.exp(40 * (octahedral.centers(62) @ axis.T - 1)).sum(axis=2)
    image = light[:, :, None].astype(np.float32)
    toward = rng.normal(size=(300, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    levels, rungs = blur(image), ggx.ladder(LAYOUT.sizes)
    for roughness in (0.2, 0.35, 0.5, 0.7, 0.9, 1.0):
        found = _mixed(levels, float(ggx.level_of(roughness, rungs)), toward)
        truth = brute_force(image, toward, roughness, 4)[:, 0]
        assert np.sqrt(((found - truth) ** 2).mean()) < 0.04 * np.sqrt((truth**2).mean())
        assert found.mean() == pytest.approx(truth.mean(), rel=0.01)


def _mixed(levels: list[np.ndarray], level: float, toward: np.ndarray) -> np.ndarray:
    """(n,) look-ups between levels."""
    low = min(int(level), len(levels) - 2)
    one, other = (
        fetch(octahedral.add_border(levels[k]), LAYOUT, k, np.zeros(len(toward), np.int64), toward)[:, 0]
        for k in (low, low + 1)
    )
    return one + (level - low) * (other - one)


def test_maps_of_another_size_are_refused(blur):
    for shape in ((64, 64, 3), (62, 62), (62, 60, 3)):
        with pytest.raises(ValueError, match="62"):
            blur(np.zeros(shape, np.float32))
