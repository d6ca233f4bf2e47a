"""The blended value: linear and convex, without a step along any path, the same however points are grouped."""

import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import blend as module
from gi_volumes.tree import interpolate
from gi_volumes.tree.blend import blend, clamp
from gi_volumes.tree.interpolate import weigh

sys.path.insert(0, str(Path(__file__).parent))
import bakes
from definition import surrounded

STEP = 1e-4
"""Distance of neighbouring samples [m]."""
CLOSE = 1e-9
"""Distance that jumps are bisected down to [m]."""
SAMPLES = 33
"""Of a segment."""
SMOOTH = 2 * 2.0**-24 / interpolate.NEAR / module.ENOUGH
"""Largest jump over CLOSE that is no step, in units of the field's range.

Places are float32, so near a data point, within `NEAR`, the cosine has grains of 2^-24 / NEAR = 6e-5, which the ramp of
`ENOUGH` makes up to 1 / ENOUGH times coarser; half of SMOOTH is the largest that is seen. The value itself, however
steep it is, changes by less than that over a nanometre.
"""


def directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def noise(data, seed=0):
    """A value from 0 to 1 at every voxel, with no relation between neighbours."""
    return np.random.default_rng(seed).random((len(data.valid), 1), np.float32)


def features(data, count, seed=0):
    """Where the definition changes: faces of dual cells of all levels, cell borders, edges of planes, data points."""
    rng = np.random.default_rng(seed)
    found = bakes.points(data, count, seed)
    face, plane, close = np.array_split(rng.permutation(len(found)), 3)
    level = rng.integers(0, data.grid.levels, len(face))
    size, axis = np.asarray(data.grid.voxel_size(level)), rng.integers(0, 3, len(face))
    found[face, axis] = (np.round(found[face, axis] / size - 0.5) + 0.5) * size
    if len(data.plane):
        user = rng.choice(np.flatnonzero(data.has_planes), len(plane))
        found[plane] = data.position[user] + rng.uniform(-1, 1, (len(plane), 3)) * data.size[user, None]
        used = data.plane[data.planes[user, 0]]
        used = np.where(data.planes[user, :1] >= 0, used, [[0, 0, 1, 0, 1]])
        height = (found[plane] * used[:, :3]).sum(axis=1) - used[:, 3]
        edge = np.where(rng.random(len(plane)) < 0.5, 0, -used[:, 4])
        found[plane] += used[:, :3] * (edge - height)[:, None]
    row = rng.choice(np.flatnonzero(data.valid), len(close))
    found[close] = data.position[row] + rng.normal(size=(len(close), 3)) * data.size[row, None] * 1e-3
    return found


def jumps(value, start, way):
    """Largest changes between neighbouring samples of segments, and what is left of them within CLOSE.

    value : takes (n, 3) points and segments' numbers; start, way : (n, 3) segments [m], of any length
    """
    count = len(start)
    place = np.arange(SAMPLES) / (SAMPLES - 1)
    at = (start[:, None] + way[:, None] * place[:, None]).reshape(-1, 3)
    sampled = value(at, np.repeat(np.arange(count), SAMPLES)).reshape(count, SAMPLES)
    change = np.abs(np.diff(sampled, axis=1))
    worst = change.argmax(axis=1)
    lower, upper, numbers = place[worst], place[worst + 1], np.arange(count)
    low, high = sampled[numbers, worst], sampled[numbers, worst + 1]
    length = np.linalg.norm(way, axis=1)
    for _ in range(int(np.ceil(np.log2(length.max() / (SAMPLES - 1) / CLOSE)))):
        middle = (lower + upper) / 2
        between = value(start + way * middle[:, None], numbers)
        first = np.abs(between - low) >= np.abs(high - between)
        lower, low = np.where(first, lower, middle), np.where(first, low, between)
        upper, high = np.where(first, middle, upper), np.where(first, between, high)
    return change.max(axis=1), np.abs(high - low)


def along_segments(data, values, start, way, normals):
    """`jumps` of the blended value, each segment with its own normal."""
    return jumps(lambda at, which: blend(data, values, at, normals[which])[:, 0], start, way)


def inside(data, start, way):
    """Segments whose ends lie in dense grids."""
    voxels = np.floor(np.concatenate([start, start + way]) / data.grid.first_size).astype(np.int64)
    return (data.atlas.find(0, voxels) >= 0).reshape(2, -1).all(axis=0)


def short_segments(data, count, seed=0):
    """Segments through features with samples STEP apart, in the dense grids, with normals; some along an axis."""
    rng = np.random.default_rng(seed)
    middle, way = features(data, count, seed), directions(count, seed + 1)
    along = np.flatnonzero(rng.random(count) < 0.3)
    way[along] = np.eye(3)[rng.integers(0, 3, len(along))]
    middle, way = middle[:count], way[: len(middle)] * STEP * (SAMPLES - 1)
    start, normals = middle - way * rng.random((len(middle), 1)), directions(len(middle), seed + 2)
    normals[::10] = 0.0
    kept = inside(data, start, way)
    return start[kept], way[kept], normals[kept].astype(np.float32)


@pytest.mark.parametrize("name", bakes.SCENES)
@pytest.mark.parametrize("dilation", ["none", "partial", "full"])
def test_the_value_has_no_step_inside_the_dense_grids(name, dilation):
    """With normals, planes, moved and invalid data points, and every way to fill up: jumps shrink with the distance."""
    data = bakes.rough(name, dilation, dims=True)
    values = noise(data)
    start, way, normals = short_segments(data, 1500)
    assert len(start) > 500
    coarse, close = along_segments(data, values, start, way, normals)
    assert coarse.max() > SMOOTH or data.grid.levels == 1
    assert close.max() < SMOOTH


@pytest.mark.parametrize("name", ["soup", "five levels"])
def test_long_segments_have_no_step_either(name):
    """Across many neighbourhoods: the largest change of each is followed down."""
    data = bakes.rough(name, dims=True)
    start = bakes.points(data, 3000, seed=3)
    way = directions(len(start), 4) * np.random.default_rng(5).uniform(0.05, 2.0, (len(start), 1))
    kept = inside(data, start, way)
    normals = directions(len(start), 6).astype(np.float32)
    coarse, close = along_segments(data, noise(data), start[kept], way[kept], normals[kept])
    assert coarse.max() > 0.3
    assert close.max() < SMOOTH


def test_the_bisection_finds_a_planted_step(monkeypatch):
    """A cosine that starts at 0.05 instead of 0, a plane without a ramp, no filling up."""
    data = bakes.rough("soup")
    values, segments = noise(data), short_segments(data, 2500)
    trust = interpolate._trust

    def stepped(data, found, normals):
        trust(data, found, normals)
        found.weight[:] = np.where(found.weight > 0, found.weight + np.float32(0.05), 0)

    monkeypatch.setattr(interpolate, "_trust", stepped)
    assert along_segments(data, values, *segments)[1].max() > 4 * SMOOTH
    monkeypatch.undo()
    sharp = replace(data, plane=np.where(np.arange(5) == 4, 1e-12, data.plane))
    assert along_segments(sharp, values, *segments)[1].max() > 4 * SMOOTH
    monkeypatch.setattr(module, "ENOUGH", 1e-30)
    assert along_segments(data, values, *segments)[1].max() > 4 * SMOOTH


def test_the_last_resort_has_no_step_inside_the_dense_grids():
    """Most of the first level invalid, normals into nowhere: only stand-ins count."""
    data = bakes.rough("room")
    data = replace(
        data, valid=data.valid & (data.level == 0) & (np.random.default_rng(0).random(len(data.valid)) < 0.2)
    )
    start = bakes.points(data, 4000, seed=7)
    way = directions(len(start), 8) * STEP * (SAMPLES - 1)
    kept = inside(data, start, way)
    close = along_segments(data, noise(data), start[kept], way[kept], directions(int(kept.sum())).astype(np.float32))[1]
    assert close.max() < SMOOTH


def test_outside_of_the_dense_grids_the_value_is_that_of_the_nearest_point_in_one():
    """There it may step, between two grids that are equally near."""
    data = bakes.rough("soup")
    outside = np.random.default_rng(0).uniform(-150, 150, (2000, 3))
    moved = clamp(data, outside)
    nearest = np.clip(outside[:, None], data.boxes[:, 0], data.boxes[:, 1])
    distance = np.linalg.norm(nearest - outside[:, None], axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved - outside, axis=1), distance, atol=1e-9)
    normals = directions(2000).astype(np.float32)
    np.testing.assert_array_equal(clamp(data, moved), moved)
    assert np.isfinite(blend(data, noise(data), moved, normals)).all()


@pytest.mark.parametrize("name", bakes.SCENES)
def test_linear_fields_are_reproduced_without_normals(name):
    data = bakes.plain(name)
    points = bakes.points(data, 20_000)
    whole = surrounded(bakes.grown(name)[0], data.grid, points)
    origin = points.mean(axis=0)
    values = np.column_stack([data.position - origin, np.ones(len(data.valid))]).astype(np.float32)
    found = blend(data, values, points, np.zeros_like(points))
    np.testing.assert_allclose(found[whole, 3], 1, rtol=1e-6)
    scale = np.abs(values).max()
    np.testing.assert_allclose(found[whole, :3], (points - origin)[whole], atol=1e-6 * scale)


@pytest.mark.parametrize("name", ["soup", "five levels"])
def test_the_value_is_a_mean(name):
    """Between the least and the largest value; a constant stays what it is, also outside and far away."""
    data = bakes.rough(name)
    points = np.concatenate([bakes.points(data, 20_000), directions(500) * 1e3, directions(500) * 1e12])
    normals = directions(len(points)).astype(np.float32)
    points = clamp(data, points)
    found = blend(data, np.column_stack([noise(data), np.ones(len(data.valid), np.float32)]), points, normals)
    np.testing.assert_allclose(found[:, 1], 1, rtol=1e-5)
    assert found[:, 0].min() >= 0
    assert found[:, 0].max() <= 1 + 1e-5


def test_values_do_not_depend_on_the_order_or_number_of_points():
    data = bakes.rough("soup")
    values = np.random.default_rng(0).random((len(data.valid), 27), np.float32)
    points, normals = bakes.points(data, 3000), directions(3000).astype(np.float32)
    normals = normals[: len(points)]
    whole = blend(data, values, points, normals)
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_array_equal(blend(data, values, points[order], normals[order]), whole[order])
    for size in (1, 2, 7):
        part = slice(100, 100 + size)
        np.testing.assert_array_equal(blend(data, values, points[part], normals[part]), whole[part])


class Reader:
    """Section 5 of docs/format.md, one point at a time, in double precision."""

    def __init__(self, data, values):
        self.data, self.values = data, values.astype(np.float64)
        keys = np.column_stack([data.level, data.coords]).tolist()
        self.rows = {tuple(key): row for row, key in enumerate(keys)}

    def corners(self, q, level):
        size = self.data.grid.voxel_size(level)
        base = np.floor(q / size - 0.5)
        t = q / size - 0.5 - base
        for c in np.ndindex(2, 2, 2):
            voxel = base + c
            row = self.rows.get((level, *(int(number) for number in voxel)), -1)
            yield row, np.where(c, t, 1 - t).prod(), (voxel + 0.5) * size

    def stencil(self, p, level):
        found, q, share = [], p, 1.0
        for k in range(level, -1, -1):
            corners = list(self.corners(q, k))
            if all(row < 0 for row, _, _ in corners):
                continue
            found += [(row, share * w) for row, w, _ in corners if row >= 0]
            lost = sum(w for row, w, _ in corners if row < 0)
            if share * lost < 1e-9:
                break
            q = sum(w * center for row, w, center in corners if row < 0) / lost
            share *= lost
        return found

    def weight(self, row, a, p, n):
        if not self.data.valid[row]:
            return 0.0
        v = (self.data.position[row] - p) / self.data.size[row]
        facing = min(max((n @ v + 0.001) / np.sqrt(v @ v + 0.000001), 0), 1) if n.any() else 1
        for plane in self.data.plane[self.data.planes[row][self.data.planes[row] >= 0]]:
            facing *= min(max(1 + (plane[:3] @ p - plane[3]) / plane[4], 0), 1)
        return a * facing

    def last(self, p):
        data, total, weights = self.data, 0.0, 0.0
        first = np.flatnonzero((data.level == 0) & data.valid)
        for row, w, _ in self.corners(p, 0):
            if row >= 0:
                j = first[((data.coords[first] - data.coords[row]) ** 2).sum(axis=1).argmin()]
                total, weights = total + w * data.shade[j] * self.values[j], weights + w
        return total / weights

    def fill(self, p, level):
        return 1 - sum(w * (1 - self.data.fill[row]) for row, w, _ in self.corners(p, level) if row >= 0)

    def value(self, p, n, level):
        if level < 0:
            return self.last(p)
        found = [(row, self.weight(row, a, p, n)) for row, a in self.stencil(p, level)]
        s, mean = sum(b for _, b in found), sum(b * self.values[row] for row, b in found)
        rest = (module.ENOUGH - s) * self.fill(p, level) * self.value(p, n, level - 1) if s < module.ENOUGH else 0
        return (mean + rest) / max(s, module.ENOUGH)


@pytest.mark.parametrize(("name", "dilation"), [("room", "partial"), ("five levels", "partial"), ("soup", "none")])
def test_values_are_those_of_a_reader_written_from_the_format(name, dilation):
    data = bakes.rough(name, dilation, dims=True)
    data = replace(data, shade=np.linspace(0.2, 1, len(data.valid)).astype(np.float32))
    points, values = bakes.points(data, 400, seed=2), noise(data)
    points = points[inside(data, points, 0 * points)]
    normals = directions(len(points))
    normals[::10] = 0
    reader = Reader(data, values)
    expected = [reader.value(p, n, data.grid.levels - 1)[0] for p, n in zip(points, normals, strict=True)]
    found = blend(data, values, points, normals.astype(np.float32))[:, 0]
    assert len(points) > 100
    assert np.abs(found - expected).max() < SMOOTH
    assert np.median(np.abs(found - expected)) < 1e-6


def test_weights_say_how_far_the_finest_start_is_trusted():
    """Where they sum to ENOUGH or more, the value is their mean."""
    data = bakes.rough("soup")
    points, values = bakes.points(data, 5000), noise(data)
    normals = directions(len(points)).astype(np.float32)
    row, weight = weigh(data, points, normals)
    total = weight.sum(axis=1)
    assert row.shape == weight.shape == (len(points), 16)
    assert (data.valid[row] | (weight == 0)).all()
    trusted = total > module.ENOUGH
    expected = (values[row, 0] * weight).sum(axis=1)[trusted] / total[trusted]
    found = blend(data, values, points, normals)[trusted, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert 0.5 < trusted.mean() < 1


def test_a_data_point_behind_its_planes_does_not_count():
    """Brute force of the factors: cosine, planes, validity, of every tap."""
    data = bakes.rough("slab")
    points = bakes.points(data, 2000)
    normals = directions(len(points))
    row, weight = weigh(data, points, normals)
    linear = weigh(bakes.plain("slab"), points, np.zeros_like(normals))
    arm = (data.position[row] - points[:, None]) / data.size[row][..., None]
    near = interpolate.NEAR
    cosine = ((arm * normals[:, None]).sum(axis=2) + near) / np.sqrt((arm**2).sum(axis=2) + near**2)
    plane = data.plane[data.planes[row]]
    height = (plane[..., :3] * points[:, None, None]).sum(axis=3) - plane[..., 3]
    seen = np.where(data.planes[row] >= 0, np.clip(1 + height / plane[..., 4], 0, 1), 1).prod(axis=2)
    same = (row == linear[0]) | (weight == 0)
    assert same.all()
    expected = linear[1] * np.clip(cosine, 0, 1) * seen * data.valid[linear[0]]
    np.testing.assert_allclose(weight, np.where(linear[0] == row, expected, weight), atol=2e-4)
    assert (seen[weight > 0] < 1).any()


def test_memory_of_a_chunk_is_bounded():
    """`World.irradiance` hands over chunks; one chunk of one transport takes little."""
    data = bakes.rough("soup")
    values = np.zeros((len(data.valid), 27), np.float32)
    points, normals = bakes.points(data, 1 << 14), directions(1 << 14).astype(np.float32)
    blend(data, values, points[:10], normals[:10])
    tracemalloc.start()
    blend(data, values, points, normals[: len(points)])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2000 * len(points)
