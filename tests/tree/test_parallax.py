"""Rays through what probes see: exact in rooms, nothing behind what hides, and continuous."""

from __future__ import annotations

import functools

import build_scenes
import numpy as np
import probe_worlds
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.snapshot import Channel, Material
from gi_volumes.tree import octahedral
from gi_volumes.tree.parallax import Nearness, march
from gi_volumes.tree.probe_maps import ProbeMaps

GRAY = Material("gray", Channel((0.5,) * 3))
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([4.0, 5.0, 3.0])
PROBE = np.array([[0.3, 1.1, 1.4]])


def black(place: np.ndarray) -> np.ndarray:
    return np.zeros_like(place)


def seen(*parts: np.ndarray, pitch: int = 64) -> tuple[object, ProbeMaps]:
    """A scene, and the maps of the probe in it."""
    scene = prepare(build_scenes.snapshot([(np.concatenate(parts), GRAY)]), Model())
    return scene, probe_worlds.traced(scene, PROBE, black, 0.0, pitch)


@functools.cache
def room() -> tuple[object, ProbeMaps]:
    return seen(build_scenes.box(LOW, HIGH, inward=True))


@functools.cache
def room_with_pillar() -> tuple[object, ProbeMaps]:
    pillar = build_scenes.box((2.0, 0.8, 0.0), (2.5, 1.4, 3.0))
    return seen(build_scenes.box(LOW, HIGH, inward=True), pillar)


def rays(count: int, seed: int = 0, margin: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Starts in the room and directions."""
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(count, 3))
    start = LOW + (HIGH - LOW) * (margin + (1 - 2 * margin) * generator.random((count, 3)))
    return start, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def followed(maps: ProbeMaps, start: np.ndarray, direction: np.ndarray, level=0.0) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) unit vectors to what is met, the heaviest of each ray, and (n,) sums of weights."""
    near = Nearness.of(maps.layout, maps.distance)
    toward, best, total = np.zeros_like(start), np.zeros(len(start)), np.zeros(len(start))
    offset = (start - PROBE).astype(np.float32)
    for found in march(
        near, np.zeros(len(start), np.int64), offset, direction.astype(np.float32), np.full(len(start), level)
    ):
        total[found.row] += found.weight
        more = found.weight > best[found.row]
        rows = found.row[more]
        best[rows], toward[rows] = found.weight[more], found.toward[more]
    return toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30), total


def exact(start: np.ndarray, direction: np.ndarray, scene) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) unit vectors from the probe to what rays meet, and (n,) their lengths."""
    distance, _ = probe_worlds.meet(scene, start, direction, black, 0.0)
    way = start + direction * distance[:, None] - PROBE
    return way / np.linalg.norm(way, axis=1, keepdims=True), distance


def edge_of(place: np.ndarray) -> np.ndarray:
    """(n,) angles about, from the probe, between places on walls and the room's edges."""
    distance = np.sort(np.minimum(place - LOW, HIGH - place), axis=1)
    return distance[:, 1] / np.linalg.norm(place - PROBE, axis=1)


def test_rays_in_a_room_meet_its_walls_to_two_hundredths_of_a_texel():
    """Away from its edges, which texels round, and from the planes that part the map's eight faces. Distances in half
    precision, steps of 2**-11, alone make one hundredth."""
    scene, maps = room()
    start, direction = rays(20_000)
    want, length = exact(start, direction, scene)
    toward, weight = followed(maps, start, direction)
    texel = np.sqrt(4 * np.pi) / maps.layout.sizes[0]
    clear = (edge_of(start + direction * length[:, None]) > 4 * texel) & (np.abs(want) > 2 * texel).all(axis=1)
    clear &= (edge_of(start) > 4 * texel) & (length > 0.5)
    off = np.linalg.norm(toward - want, axis=1) / texel
    assert clear.sum() > 3000
    assert np.quantile(off[clear], 0.98) < 0.02
    assert off[clear].max() < 2
    assert np.quantile(off[length > 0.5], 0.98) < 1
    assert np.quantile(weight[clear], 0.01) > 0.9


def test_blurred_distances_keep_walls_where_they_are():
    """To a tenth of a texel of the level, away from edges and from the planes that part the map's eight faces."""
    scene, maps = room()
    start, direction = rays(5000)
    want, length = exact(start, direction, scene)
    away = (edge_of(start + direction * length[:, None]) > 0.3) & (edge_of(start) > 0.3) & (length > 0.5)
    for level in (0.5, 1.0):
        texel = np.sqrt(4 * np.pi) / maps.layout.sizes[0] * 2**level
        clear = away & (np.abs(want) > texel).all(axis=1)
        toward, weight = followed(maps, start, direction, level)
        off = np.linalg.norm(toward - want, axis=1) / texel
        assert clear.sum() > 100
        assert np.quantile(off[clear], 0.9) < 0.1
        assert weight[clear].mean() > 0.95


def test_distances_that_were_mixed_themselves_would_miss_walls():
    """The reciprocal by components is what makes planes exact; a mean of distances is off by texels' width squared."""
    _, maps = room()
    size = maps.layout.sizes[0]
    direction = octahedral.decode(np.random.default_rng(2).uniform(0.55, 0.95, (1000, 2)) * [0.5, 0.5] + 0.25)
    near = Nearness.of(maps.layout, maps.distance)
    value = near.at(np.zeros(1000, np.int64), direction.astype(np.float32), np.zeros(1000))
    ceiling = direction[:, 2] * 3 / (HIGH[2] - PROBE[0, 2])
    meets_ceiling = (np.abs(PROBE + direction * (HIGH[2] - PROBE[0, 2]) / direction[:, 2:]) < 1.5)[:, :2].all(axis=1)
    clear = meets_ceiling & (np.abs(direction[:, :2]) > 4 / size).all(axis=1)
    assert clear.sum() > 50
    np.testing.assert_allclose(value[clear], ceiling[clear] / 3, rtol=2e-3)


def test_what_a_pillar_hides_from_the_probe_is_not_found():
    """Rays along the wall behind the pillar: the part that the probe sees is found, the part in its shadow is not."""
    scene, maps = room_with_pillar()
    generator = np.random.default_rng(4)
    target = np.column_stack(
        [np.full(4000, HIGH[0]), generator.uniform(-1, 3.5, 4000), generator.uniform(0.3, 2.7, 4000)]
    )
    start = np.column_stack([np.full(4000, 3.2), target[:, 1] + generator.uniform(-0.5, 0.5, 4000), target[:, 2]])
    direction = (target - start) / np.linalg.norm(target - start, axis=1, keepdims=True)
    want, _ = exact(start, direction, scene)
    reach, _ = probe_worlds.meet(scene, np.broadcast_to(PROBE, want.shape), want, black, 0.0)
    shown = np.abs(reach - np.linalg.norm(target - PROBE, axis=1)) < 0.01
    deep = ~shown & (np.abs(target[:, 1] - 1.08) < 0.35)
    toward, weight = followed(maps, start, direction)
    wrong = np.linalg.norm(toward - want, axis=1) > 0.1
    assert min(shown.sum(), deep.sum()) > 300
    assert weight[shown].mean() > 0.9
    assert (weight * wrong)[shown].mean() < 0.05
    assert weight[deep].mean() < 0.1


def test_a_thin_wall_does_not_seem_to_end_rays_at_its_other_side():
    """Behind the probe's own wall nothing is known: the wall's inner side is met at once, and so counts for nothing."""
    _, maps = room()
    start, direction = rays(2000, 6, margin=0.1)
    start[:, 0], direction[:, 0] = HIGH[0] + 1e-4, np.abs(direction[:, 0]) + 0.2
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    _, weight = followed(maps, start, direction)
    assert weight.mean() < 0.02
    assert np.quantile(weight, 0.95) < 0.1


def test_no_ray_counts_for_more_than_itself_and_none_is_nan():
    _, maps = room_with_pillar()
    start, direction = rays(20_000, 8, margin=-0.3)
    start[:50] = PROBE
    direction[25:75] = np.eye(3)[np.arange(50) % 3]
    toward, weight = followed(maps, start, direction)
    assert np.isfinite(toward).all()
    assert weight.max() <= 1 + 1e-6
    assert weight.min() >= 0
    np.testing.assert_allclose(weight[:50], 1, atol=1e-5)


def test_the_sky_is_met_at_infinity_in_the_ray_s_own_direction():
    _, maps = seen(build_scenes.plane(50))
    start, direction = rays(3000, 9)
    direction[:, 2] = np.abs(direction[:, 2]) + 0.05
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    toward, weight = followed(maps, start, direction)
    np.testing.assert_allclose(weight, 1, atol=1e-5)
    np.testing.assert_allclose(toward, direction, atol=1e-5)


def along(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A path through the room, past the pillar, on which a ray turns."""
    t = t[:, None]
    direction = np.column_stack([np.cos(5 * t), np.sin(5 * t), 0.3 * np.sin(11 * t)])
    start = (1 - t) * [-2.5, -1.5, 0.4] + t * [3.5, 4.5, 2.6]
    return start, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_what_looks_like_a_jump_along_a_path_is_none_when_looked_at_closely():
    """The largest differences between steps of 0.1 mm, each cut into 128: single precision resolves few more."""
    _, maps = room_with_pillar()
    t = np.linspace(0, 1, 1 << 16)
    _, weight = followed(maps, *along(t))
    steepest = np.argsort(-np.abs(np.diff(weight)))[:8]
    assert np.abs(np.diff(weight))[steepest].min() > 0.1
    for row in steepest:
        toward, weight = followed(maps, *along(np.linspace(t[row], t[row + 1], 1 << 7)))
        assert np.abs(np.diff(weight)).max() < 0.1
        assert np.linalg.norm(np.diff(toward, axis=0), axis=1).max() < 0.1
