"""Octahedral maps: round trips, solid angles, borders; atlas levels that neither leak nor have seams."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.tree import octahedral
from gi_volumes.tree.probe_atlas import Layout, fetch, put

ROUND_TRIP = 12 * 2.0**-24
"""Of float32, as a chord: u and v are off by 5 half units in the last place of 1 after a sum, a quotient, a fold, and
being stored in [0, 1]; both together, times the sqrt(3) by which the octahedron's faces are magnified at most."""

AXES = np.array(
    [(x, y, z) for x in (-1, -0.0, 0.0, 1) for y in (-1, -0.0, 0.0, 1) for z in (-1, 0.0, 1) if x or y or z]
)
LAYOUT = Layout(64, 3, 2)


def directions(seed: int, count: int = 100_000, kind=np.float64) -> np.ndarray:
    """(n, 3) uniform unit vectors."""
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(kind)


def on_fold(seed: int, count: int = 2000) -> np.ndarray:
    """(n, 3) unit vectors on the equator, where the lower half is folded out, and the map's axes."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.concatenate([flat, np.roll(flat, 1, axis=1), np.roll(flat, 2, axis=1), unit(AXES)])


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def chord(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a.astype(np.float64) - b, axis=-1)


def atlas_of(layout: Layout, level: int, image: np.ndarray, probe: int = 4, elsewhere: float = 1e6) -> np.ndarray:
    """One probe's map among tiles, their borders included, that hold something else."""
    atlas = np.full((*layout.shape(level), image.shape[2]), elsewhere, np.float32)
    put(atlas, layout, level, probe, image)
    return atlas


def look(layout: Layout, level: int, image: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return fetch(atlas_of(layout, level, image), layout, level, np.full(len(direction), 4), direction)


def noise(size: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((size, size, 3)).astype(np.float32)


@pytest.mark.parametrize(("kind", "limit"), [(np.float32, ROUND_TRIP), (np.float64, ROUND_TRIP * 2.0**-29)])
def test_directions_survive_the_round_trip(kind, limit):
    direction = np.concatenate([directions(1), on_fold(2)]).astype(kind)
    uv = octahedral.encode(direction)
    back = octahedral.decode(uv)
    assert uv.dtype == back.dtype == kind
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert chord(back, direction).max() <= limit
    swapped = octahedral.decode(uv[:, ::-1])
    assert chord(swapped, direction).max() > 1


def test_points_of_the_square_survive_the_round_trip():
    uv = np.random.default_rng(3).random((100_000, 2))
    assert np.abs(octahedral.encode(octahedral.decode(uv)) - uv).max() < 1e-15


def test_lengths_do_not_count_and_the_zero_vector_is_up():
    direction = directions(4, 1000)
    assert octahedral.encode(direction * 1e-20) == pytest.approx(octahedral.encode(direction * 1e20), abs=1e-15)
    assert octahedral.encode(np.zeros((1, 3))) == pytest.approx(np.array([[0.5, 0.5]]))
    assert octahedral.encode(np.zeros((1, 3), np.float32)) == pytest.approx(np.array([[0.5, 0.5]]))


@pytest.mark.parametrize("size", [2, 6, 14, 62, 126])
def test_solid_angles_are_those_of_the_texels_and_sum_to_the_sphere(size):
    area = octahedral.solid_angles(size)
    assert area.sum() == pytest.approx(4 * np.pi, rel=1e-13)
    fine = octahedral.solid_angles(4 * size).reshape(size, 4, size, 4).sum(axis=(1, 3))
    assert area == pytest.approx(fine, rel=1e-11)
    assert area == pytest.approx(area.T, rel=1e-11)
    assert np.array_equal(area, area[::-1])


def test_solid_angles_agree_with_counts_of_directions_and_equal_ones_do_not():
    size, count = 14, 400_000
    texel = np.minimum((octahedral.encode(directions(5, count)) * size).astype(int), size - 1)
    found = np.bincount(texel[:, 1] * size + texel[:, 0], minlength=size * size)
    for area, fits in ((octahedral.solid_angles(size), True), (np.full((size, size), 4 * np.pi / size**2), False)):
        expected = area.reshape(-1) / (4 * np.pi) * count
        statistic = ((found - expected) ** 2 / expected).sum()
        freedom = size * size - 1
        assert (abs(statistic - freedom) < 4 * np.sqrt(2 * freedom)) == fits


def test_an_even_function_has_its_integral():
    size = 62
    z = octahedral.centers(size)[:, :, 2]
    area = octahedral.solid_angles(size)
    assert (z * area).sum() == pytest.approx(0, abs=1e-12)
    assert (z * z * area).sum() == pytest.approx(4 * np.pi / 3, rel=1e-3)


@pytest.mark.parametrize("size", [0, 1, 3])
def test_maps_of_odd_sizes_are_refused(size):
    for call in (octahedral.centers, octahedral.solid_angles):
        with pytest.raises(ValueError, match="even"):
            call(size)


def test_a_border_holds_the_texels_whose_directions_lie_beyond_the_edge():
    size = 6
    bordered = octahedral.add_border(octahedral.centers(size))
    inner = octahedral.centers(size)
    for row, column in [(-1, 2), (size, 4), (3, -1), (0, size), (-1, -1), (size, size), (-1, size), (size, -1)]:
        u, v = (column + 0.5) / size, (row + 0.5) / size
        # Beyond an edge the square goes on mirrored: about the edge, and about the other axis.
        if not 0 <= u <= 1:
            u, v = (-u if u < 0 else 2 - u), 1 - v
        if not 0 <= v <= 1:
            u, v = 1 - u, (-v if v < 0 else 2 - v)
        nearest = inner[int(v * size), int(u * size)]
        assert bordered[row + 1, column + 1] == pytest.approx(nearest)
    with pytest.raises(ValueError, match="square"):
        octahedral.add_border(np.zeros((4, 6, 3)))


@pytest.mark.parametrize("level", range(LAYOUT.levels))
def test_look_ups_are_continuous_over_the_fold_the_edges_and_at_the_poles(level):
    image = noise(LAYOUT.sizes[level])
    direction = np.concatenate([on_fold(6), directions(7, 2000)])
    side = np.cross(direction, directions(8, len(direction)))
    step = 1e-5
    near = look(LAYOUT, level, image, direction + step * side), look(LAYOUT, level, image, direction - step * side)
    # A step of 2e-5 moves by at most sqrt(3) * size / 2 texels a radian along either axis, each worth at most 1.
    assert np.abs(near[0] - near[1]).max() <= 2 * step * np.sqrt(3) * LAYOUT.sizes[level] + 1e-6


def test_a_wrong_border_is_found():
    image = noise(LAYOUT.sizes[0])
    atlas = atlas_of(LAYOUT, 0, image)
    (row,), (column,) = LAYOUT.corner(np.array([4]), 0)
    tile = atlas[row : row + 64, column : column + 64]
    tile[1:-1, 0], tile[1:-1, -1] = image[:, 0], image[:, -1]  # clamped instead of mirrored
    edge = octahedral.decode(np.array([[0.0, 0.3], [1.0, 0.1], [0.0, 0.8]]))
    other = octahedral.decode(np.array([[0.0, 0.7], [1.0, 0.9], [0.0, 0.2]]))
    assert edge == pytest.approx(other)
    near = [
        fetch(atlas, LAYOUT, 0, np.full(3, 4), octahedral.decode(np.array(uv)))
        for uv in ([[1e-9, 0.3], [1 - 1e-9, 0.1], [1e-9, 0.8]], [[1e-9, 0.7], [1 - 1e-9, 0.9], [1e-9, 0.2]])
    ]
    assert np.abs(near[0] - near[1]).max() > 0.05


@pytest.mark.parametrize("level", range(LAYOUT.levels))
def test_constant_maps_are_constant_in_every_direction_and_neighbours_never_bleed(level):
    value = np.float32([0.1, 1 / 3, 7e4])
    image = np.broadcast_to(value, (LAYOUT.sizes[level],) * 2 + (3,))
    direction = np.concatenate([directions(9, 20_000, np.float32), on_fold(10).astype(np.float32)])
    found = look(LAYOUT, level, image, direction)
    assert (found == value).all()


def test_a_missing_border_bleeds():
    value = np.ones((LAYOUT.sizes[0], LAYOUT.sizes[0], 1), np.float32)
    atlas = np.full((*LAYOUT.shape(0), 1), 1e6, np.float32)
    (row,), (column,) = LAYOUT.corner(np.array([4]), 0)
    atlas[row + 1 : row + 63, column + 1 : column + 63] = value
    assert fetch(atlas, LAYOUT, 0, np.full(1, 4), np.array([[0.0, 0.0, -1.0]]))[0, 0] > 2


@pytest.mark.parametrize("level", range(LAYOUT.levels))
def test_look_ups_at_texel_centres_give_the_texels_of_every_tile(level):
    size = LAYOUT.sizes[level]
    atlas = np.full((*LAYOUT.shape(level), 3), np.nan, np.float32)
    images = [noise(size, seed) for seed in range(6)]
    for probe, image in enumerate(images):
        put(atlas, LAYOUT, level, probe, image)
    assert np.isfinite(atlas).all()
    direction = octahedral.centers(size).reshape(-1, 3)
    for probe, image in enumerate(images):
        found = fetch(atlas, LAYOUT, level, np.full(size * size, probe), direction)
        assert found == pytest.approx(image.reshape(-1, 3), abs=1e-6)


@pytest.mark.parametrize("level", range(LAYOUT.levels))
def test_a_linear_function_of_u_and_v_is_found_exactly_within_a_face(level):
    size = LAYOUT.sizes[level]
    step = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(step, step, indexing="xy")
    image = np.stack([u, v, u + 2 * v], axis=-1).astype(np.float32)
    direction = directions(11, 5000)
    uv = octahedral.encode(direction)
    inside = ((uv > 0.5 / size) & (uv < 1 - 0.5 / size)).all(axis=1)
    found = look(LAYOUT, level, image, direction[inside])
    expected = np.stack([uv[inside, 0], uv[inside, 1], uv[inside] @ [1, 2]], axis=1)
    assert found == pytest.approx(expected, abs=2e-6)


def test_half_precision_texels_are_mixed_in_single_precision():
    image, direction = noise(LAYOUT.sizes[0]).astype(np.float16), directions(12, 1000)
    atlas = atlas_of(LAYOUT, 0, image, elsewhere=9)
    found = fetch(atlas.astype(np.float16), LAYOUT, 0, np.full(1000, 4), direction)
    assert found.dtype == np.float32
    assert np.array_equal(found, fetch(atlas, LAYOUT, 0, np.full(1000, 4), direction))


def test_levels_of_an_atlas_are_mip_levels_and_of_all_probes_have_room():
    layout = Layout.of(1000, 128)
    assert layout.sizes == (126, 62, 30, 14, 6)
    assert layout.levels == 5
    assert layout.texels == 128**2 + 64**2 + 32**2 + 16**2 + 8**2
    assert [layout.shape(level) for level in range(3)] == [(4096 >> level, 4096 >> level) for level in range(3)]
    for count in (0, 1, 2, 3, 5, 99, 100, 101):
        found = Layout.of(count, 8)
        assert found.columns * found.rows >= max(count, 1)
        assert found.columns * (found.rows - 1) < max(count, 1)
        row, column = found.corner(np.arange(count), 0)
        assert len(set(zip(row, column, strict=True))) == count


def test_what_does_not_fit_an_atlas_is_refused():
    for sizes in ((100, 1, 1), (4, 1, 1), (64, 0, 1), (64, 1, 0)):
        with pytest.raises(ValueError, match=r"pitch|tiles"):
            Layout(*sizes)
    atlas = np.zeros((*LAYOUT.shape(0), 3), np.float32)
    with pytest.raises(ValueError, match="62"):
        put(atlas, LAYOUT, 0, 0, np.zeros((64, 64, 3)))
    for probe in (-1, 6):
        with pytest.raises(IndexError, match="6 tiles"):
            put(atlas, LAYOUT, 0, probe, np.zeros((62, 62, 3)))
