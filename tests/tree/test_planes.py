"""Occluding planes in files: exact to a hundredth of a millimetre, refused when damaged, readable from the text."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import build, cells, container, folder, planes
from gi_volumes.tree.container import FileError
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.planes import NONE, CellPlanes, empty, join, of_cell, planes_defect

sys.path.insert(0, str(Path(__file__).parent))
import meshes
from test_format import read_container

CELL = (-1, 0)
CELL_SIZE = 128.0
CORNER = np.array([CELL[0] * CELL_SIZE, CELL[1] * CELL_SIZE, 0.0])
BOUND = 1e-5
"""What rounding may move a plane by, near the data points that use it [m]."""


def drawn(seed: int, size: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random planes within 4 m of the data points that use them: (planes, plane, position), relative to the origin."""
    rng = np.random.default_rng(seed)
    position = CORNER + rng.uniform((0, 0, -20), (128, 128, 120), (size, 3))
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    user = rng.integers(0, size, count)
    distance = (normal * position[user]).sum(axis=1) - rng.uniform(0, 4, count)
    width = 0.0625 * 4.0 ** -rng.integers(0, 5, count)
    used = np.full((size, 3), -1, np.int32)
    for row, point in enumerate(user):
        free = np.flatnonzero(used[point] < 0)
        if len(free):
            used[point, free[0]] = row
    return used, np.column_stack([normal, distance, width]), position


def heights(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (plane[..., :3] * points).sum(axis=-1) - plane[..., 3]


@pytest.mark.parametrize("seed", range(3))
def test_planes_return_to_where_they_were_within_a_hundredth_of_a_millimetre(seed):
    used, plane, position = drawn(seed, 4000, 3000)
    stored = of_cell(used, plane, position, CORNER)
    assert planes_defect(stored, len(used)) == ""
    rows, back = join([stored], CORNER[None])
    assert np.array_equal(rows >= 0, used >= 0)
    point, slot = np.nonzero(used >= 0)
    before, after = plane[used[point, slot]], back[rows[point, slot]]
    around = position[point] + np.random.default_rng(seed).uniform(-10, 10, (len(point), 3))
    assert np.abs(heights(after, around) - heights(before, around)).max() < BOUND
    assert np.array_equal(after[:, 4].astype(np.float32), before[:, 4].astype(np.float32))
    bare = plane[used[point, slot]].astype(np.float32).astype(float)  # rounding all five numbers, in world space
    assert np.abs(heights(bare, around) - heights(before, around)).max() > 0.9 * BOUND


def test_a_cell_takes_only_the_planes_that_it_uses():
    used, plane, position = drawn(1, 500, 400)
    part = slice(100, 200)
    stored = of_cell(used[part], plane, position[part], CORNER)
    assert len(stored.plane) == len(np.unique(used[part][used[part] >= 0]))
    rows, back = join([stored], CORNER[None])
    some = rows >= 0
    assert back[rows[some]] == pytest.approx(plane[used[part][some]], abs=1e-4)


def test_cells_are_joined_in_their_order():
    corners = np.array([[0.0, 0, 0], [128, 0, 0], [0, -128, 0]])
    parts = [drawn(seed, 50, 30) for seed in range(3)]
    parts = [
        (used, plane, position - CORNER + corner)
        for (used, plane, position), corner in zip(parts, corners, strict=True)
    ]
    for (_, plane, _), corner in zip(parts, corners, strict=True):
        plane[:, 3] += plane[:, :3] @ (corner - CORNER)
    stored = [of_cell(*part, corner) for part, corner in zip(parts, corners, strict=True)]
    rows, back = join(stored, corners)
    assert rows.dtype == np.int32
    first = 0
    for number, (used, plane, _) in enumerate(parts):
        own = rows[50 * number : 50 * number + 50]
        assert back[own[used >= 0]] == pytest.approx(plane[used[used >= 0]], abs=1e-4)
        assert ((own < 0) == (used < 0)).all()
        assert own[own >= 0].min() == first
        first += len(stored[number].plane)


def test_without_planes_nothing_is_stored():
    stored = empty(7)
    assert planes_defect(stored, 7) == ""
    rows, back = join([stored, empty(2)], np.zeros((2, 3)))
    assert rows.tolist() == [[-1, -1, -1]] * 9
    assert back.shape == (0, 5)
    assert join([], np.zeros((0, 3)))[0].shape == (0, 3)
    none = of_cell(np.full((7, 3), -1, np.int32), np.zeros((0, 5)), np.zeros((7, 3)), CORNER)
    assert np.array_equal(none.planes, stored.planes)
    assert none.plane.shape == (0, 5)


def test_a_table_that_16_bits_cannot_number_loses_the_planes_that_are_used_least(monkeypatch):
    monkeypatch.setattr(planes, "NONE", 50)
    used, plane, position = drawn(2, 200, 90)
    used[:40, 0] = used[used[:, 0] >= 0, 0][0]
    stored = of_cell(used, plane, position, CORNER)
    assert len(stored.plane) == 50
    assert planes_defect(stored, len(used)) == ""
    assert (stored.planes[:40, 0] < 50).all()


def whole() -> CellPlanes:
    used, plane, position = drawn(3, 60, 40)
    return of_cell(used, plane, position, CORNER)


def damaged(**changes) -> CellPlanes:
    """Planes with some numbers overwritten: name = (place, value)."""
    found = whole()
    arrays = {"planes": found.planes.copy(), "plane": found.plane.copy()}
    for name, (place, value) in changes.items():
        arrays[name][place] = value
    return CellPlanes(**arrays)


DEFECTS = {
    "beyond the": {"planes": ((0, 0), 40)},
    "after an empty slot": {"planes": ((1,), (NONE, 3, NONE))},
    "not finite": {"plane": ((5, 3), np.nan)},
    "infinite": {"plane": ((5, 4), np.inf)},
    "unit length": {"plane": ((7, slice(0, 3)), (1, 1e-2, 0))},
    "no normal": {"plane": ((7, slice(0, 3)), 0)},
    "width": {"plane": ((2, 4), 0)},
    "negative width": {"plane": ((2, 4), -0.1)},
}
WORDS = {"infinite": "not finite", "no normal": "unit length", "negative width": "width"}


@pytest.mark.parametrize("reason", DEFECTS)
def test_what_is_wrong_with_planes_is_said(reason):
    assert planes_defect(whole(), 60) == ""
    assert WORDS.get(reason, reason) in planes_defect(damaged(**DEFECTS[reason]), 60)


def test_planes_of_a_wrong_shape_or_type_are_refused():
    good = whole()
    for planes_, plane in [
        (good.planes[:-1], good.plane),
        (good.planes[:, :2], good.plane),
        (good.planes.astype(np.int32), good.plane),
        (good.planes, good.plane[:, :4]),
        (good.planes, good.plane.astype(np.float64)),
        (good.planes, good.plane[:, :, None]),
        (good.planes, np.zeros((NONE + 1, 5), np.float32)),
    ]:
        assert "is needed" in planes_defect(CellPlanes(planes_, plane), 60)


def test_what_fills_up_of_a_wrong_shape_or_type_is_refused():
    good = whole()
    for fill in (np.zeros(59, np.uint8), np.zeros(60, np.int8), np.zeros((60, 1), np.uint8), np.zeros(60, np.float32)):
        assert "fill is" in planes_defect(replace(good, fill=fill), 60)
    assert planes_defect(replace(good, fill=np.zeros(60, np.uint8)), 60) == ""


def test_a_cell_returns_what_its_voxels_leave_and_none_where_it_has_none(bake):
    place, topology, valid, stored = bake
    assert folder.read_cell(place, CELL).planes.fill is None
    fill = np.random.default_rng(1).integers(0, 256, topology.size).astype(np.uint8)
    offset = np.zeros((topology.size, 3), np.int8)
    folder.write_cell(place, topology, {}, valid, offset, {"bake": "b"}, replace(stored, fill=fill))
    assert np.array_equal(folder.read_cell(place, CELL).planes.fill, fill)


@pytest.fixture
def bake(tmp_path):
    topology = build.build(meshes.soup(40, 4), Grid(), CELL)
    used, plane, position = drawn(6, topology.size, topology.size // 2)
    valid = np.random.default_rng(0).random(topology.size) > 0.2
    stored = of_cell(used, plane, position, CORNER)
    offset = np.zeros((topology.size, 3), np.int8)
    folder.write_cell(tmp_path, topology, {}, valid, offset, {"bake": "b"}, stored)
    return tmp_path, topology, valid, stored


def test_a_cell_returns_its_planes_and_voxels_without_data_have_none(bake):
    place, _, valid, stored = bake
    found = folder.read_cell(place, CELL).planes
    assert np.array_equal(found.plane, stored.plane)
    assert np.array_equal(found.planes[valid], stored.planes[valid])
    assert (found.planes[~valid] == NONE).all()


def test_a_cell_that_is_written_without_planes_has_empty_ones(bake):
    place, topology, valid, _ = bake
    folder.write_cell(place, topology, {}, valid, np.zeros((topology.size, 3), np.int8), {"bake": "b"})
    found = folder.read_cell(place, CELL).planes
    assert found.plane.shape == (0, 5)
    assert (found.planes == NONE).all()


def test_a_cell_refuses_to_be_written_with_broken_planes(bake):
    place, topology, valid, stored = bake
    broken = CellPlanes(stored.planes, stored.plane * np.float32(1.1))
    with pytest.raises(ValueError, match="unit length"):
        folder.write_cell(place, topology, {}, valid, np.zeros((topology.size, 3), np.int8), {"bake": "b"}, broken)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda arrays, valid: arrays.pop("plane"), "no occluding planes"),
        (lambda arrays, valid: arrays.pop("planes"), "no occluding planes"),
        (lambda arrays, valid: arrays.update(plane=arrays["plane"][:3]), "beyond the 3"),
        (lambda arrays, valid: arrays.update(plane=arrays["plane"] * np.nan), "not finite"),
        (lambda arrays, valid: arrays.update(plane=arrays["plane"].astype(np.float64)), "is needed"),
        (lambda arrays, valid: arrays.update(planes=arrays["planes"][1:]), "is needed"),
        (
            lambda arrays, valid: arrays.update(
                planes=np.where(np.repeat(valid[:, None], 3, axis=1), NONE, 0).astype(np.uint16)
            ),
            "without a data",
        ),
    ],
)
def test_a_file_whose_planes_are_wrong_is_refused_by_name(bake, change, reason):
    place, _, valid, _ = bake
    path = cells.cell_path(place, CELL, cells.POINTS)
    file = container.read(path)
    arrays = dict(file.arrays)
    change(arrays, valid)
    container.write(path, file.kind, arrays, file.meta, file.units | {"plane": "1"})
    with pytest.raises(FileError, match=reason) as caught:
        folder.read_cell(place, CELL)
    assert str(path) in str(caught.value)
    assert not folder.has_cell(place, CELL, "b")


def test_a_reader_from_the_text_finds_the_planes_and_what_they_let_through(bake):
    place, _, valid, _ = bake
    _, _, arrays = read_container(place / "cell_-1_0.points")
    rows, table = np.array(arrays["planes"]).reshape(-1, 3), np.array(arrays["plane"]).reshape(-1, 5)
    some_rows, some = join([folder.read_cell(place, CELL).planes], CORNER[None])
    rng = np.random.default_rng(3)
    for voxel in rng.choice(np.flatnonzero(valid & (some_rows[:, 0] >= 0)), 50, replace=False):
        p = CORNER + rng.uniform(0, 128, 3)
        for row, joined in zip(rows[voxel], some_rows[voxel], strict=True):
            assert (row == 65535) == (joined < 0)
            if row == 65535:
                continue
            nx, ny, nz, d, w = table[row]
            for shift in (0, -0.3 * w, -0.7 * w, -2 * w):
                s = nx * (p[0] - CELL[0] * 128.0) + ny * (p[1] - CELL[1] * 128.0) + nz * p[2] - d
                q = p + (shift - s) * np.array([nx, ny, nz])
                s = nx * (q[0] - CELL[0] * 128.0) + ny * (q[1] - CELL[1] * 128.0) + nz * q[2] - d
                factor = min(max(1 + s / w, 0), 1)
                expected = np.clip(1 + heights(some[joined], q) / some[joined, 4], 0, 1)
                assert factor == pytest.approx(expected, abs=1e-6)
                assert factor == pytest.approx(min(max(1 + shift / w, 0), 1), abs=0.1)  # p is far away


def test_truncated_points_are_refused(bake):
    place, *_ = bake
    path = cells.cell_path(place, CELL, cells.POINTS)
    content = path.read_bytes()
    for length in (*range(0, len(content), 97), len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FileError):
            folder.read_cell(place, CELL)


def test_planes_are_equal_when_written_twice(bake, tmp_path_factory):
    place, topology, valid, stored = bake
    other = tmp_path_factory.mktemp("other")
    offset = np.zeros((topology.size, 3), np.int8)
    folder.write_cell(other, topology, {}, valid, offset, {"bake": "b"}, replace(stored))
    name = "cell_-1_0.points"
    assert (other / name).read_bytes() == (place / name).read_bytes()
