"""The folder of a bake: cells are complete or absent, and every damage is named."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import atomic, build, cells, container, folder, verify, world
from gi_volumes.tree.grid import Grid

sys.path.insert(0, str(Path(__file__).parent))
import meshes

TRIANGLES = meshes.soup(24, 7, spread=8.0, size=1.0)
GRID = Grid(origin=(1024.0, -2048.0, 0.0))
CELLS = [(-1, -1), (-1, 0), (0, -1), (0, 0)]


def write_cell(place, cell, bake="b", seed=0):
    topology, rng = build.build(TRIANGLES, GRID, cell), np.random.default_rng(seed)
    values = {"local": rng.random((topology.size, 1, 9, 3)).astype(np.float32)}
    offset = rng.integers(-127, 128, (topology.size, 3)).astype(np.int8)
    folder.write_cell(place, topology, values, rng.random(topology.size) > 0.1, offset, {"bake": bake})
    return topology


def assemble(place, bake="b"):
    header = {"bake": bake, "grid": GRID, "transports": {"local": {}}, "expected_cells": [list(c) for c in CELLS]}
    return folder.assemble(place, header)


@pytest.fixture
def bake(tmp_path):
    for cell in CELLS:
        write_cell(tmp_path, cell)
    assemble(tmp_path)
    return tmp_path


def test_a_complete_bake_has_no_defects_and_loads(bake):
    assert verify.verify(bake) == []
    assert world.load(bake).cells.tolist() == [list(cell) for cell in CELLS]
    header = folder.load_header(bake)
    assert header["grid"]["first_size"] == 8.0
    assert header["bounds"][0][0] < 1024 < header["bounds"][1][0]
    for entry in header["cells"]:
        for file in entry["files"].values():
            assert (bake / file["name"]).stat().st_size == file["bytes"]


def test_the_same_cells_give_the_same_bytes_in_any_order(bake, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    for cell in reversed(CELLS):
        write_cell(other, cell)
    assemble(other)
    for file in folder.files(bake):
        assert (other / file.name).read_bytes() == file.read_bytes()


def test_every_flipped_byte_of_every_file_is_a_defect_and_is_refused(bake):
    """A sample of bytes of each file; the container's own test flips all of them."""
    rng = np.random.default_rng(0)
    for file in folder.files(bake):
        whole = bytearray(file.read_bytes())
        for position in rng.choice(len(whole), 6):
            damaged = whole.copy()
            damaged[position] ^= 1 << rng.integers(8)
            file.write_bytes(damaged)
            names = [defect.file for defect in verify.verify(bake)]
            assert file.name in names, (file.name, position)
            with pytest.raises(container.FileError):
                world.load(bake)
        file.write_bytes(whole)
    assert verify.verify(bake) == []


def test_truncations_and_missing_files_are_named(bake):
    for file in folder.files(bake):
        whole = file.read_bytes()
        for length in (0, 1, 27, len(whole) // 2, len(whole) - 1):
            file.write_bytes(whole[:length])
            defects = verify.verify(bake)
            assert file.name in [defect.file for defect in defects]
            assert all("\n" not in defect.what for defect in defects)
        file.unlink()
        assert verify.Defect(file.name, "the file is missing") in verify.verify(bake)
        with pytest.raises(OSError, match="No such file"):
            world.load(bake)
        file.write_bytes(whole)


def test_an_edited_world_json_is_refused(bake):
    path = bake / "world.json"
    path.write_text(path.read_text().replace('"levels": 3', '"levels": 2'))
    with pytest.raises(container.FileError, match="changed by hand"):
        folder.load_header(bake)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "{}", "[" * 100_000, '{"format": "gi_volumes world", "version": 9}', "\x00"]
)
def test_what_is_no_world_json_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "world.json").write_text(text)
    with pytest.raises(container.FileError) as caught:
        folder.load_header(tmp_path)
    assert "\n" not in str(caught.value)
    assert [defect.file for defect in verify.verify(tmp_path)] == ["world.json"]


def test_missing_cells_are_named(tmp_path):
    write_cell(tmp_path, (0, 0))
    assemble(tmp_path)
    missing = [defect.file for defect in verify.verify(tmp_path)]
    assert missing == ["cell_-1_-1.tree", "cell_-1_0.tree", "cell_0_-1.tree"]


def test_cells_of_another_bake_are_left_out(bake):
    write_cell(bake, (0, 0), bake="other")
    assert len(assemble(bake)["cells"]) == 3
    assert not folder.has_cell(bake, (0, 0), "b")
    assert folder.has_cell(bake, (0, 0), "other")


def test_a_cell_counts_as_baked_only_when_all_its_files_fit(bake):
    assert folder.has_cell(bake, (0, 0), "b")
    path = cells.cell_path(bake, (0, 0), "local")
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    assert not folder.has_cell(bake, (0, 0), "b")
    path.write_bytes(cells.cell_path(bake, (0, -1), "local").read_bytes())
    assert not folder.has_cell(bake, (0, 0), "b")
    path.unlink()
    assert not folder.has_cell(bake, (0, 0), "b")
    assert not folder.has_cell(bake, (9, 9), "b")


def test_a_bake_that_stops_between_files_leaves_the_cell_unbaked(bake, monkeypatch):
    real, calls = atomic.os.replace, []

    def stop(source, target):
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        write_cell(bake, (0, 0), seed=1)
    monkeypatch.undo()
    assert not folder.has_cell(bake, (0, 0), "b")
    assert not [file for file in bake.iterdir() if file.name.endswith(".tmp")]
    write_cell(bake, (0, 0), seed=1)
    assert folder.has_cell(bake, (0, 0), "b")


def test_a_payload_that_is_no_longer_needed_is_removed(bake):
    topology = build.build(TRIANGLES, GRID, (0, 0))
    size = topology.size
    folder.write_cell(bake, topology, {}, np.ones(size, bool), np.zeros((size, 3), np.int8), {"bake": "b"})
    assert not cells.cell_path(bake, (0, 0), "local").exists()


@pytest.mark.parametrize("what", ["valid", "offset", "rows", "name", "nan", "tree"])
def test_what_a_reader_would_refuse_is_not_written(what, tmp_path):
    topology = build.build(TRIANGLES, GRID, (0, 0))
    size = topology.size
    values, valid, offset = (
        {"local": np.zeros((size, 1, 9, 3), np.float32)},
        np.ones(size, bool),
        np.zeros((size, 3), np.int8),
    )
    if what == "valid":
        valid = valid.astype(np.uint8)
    elif what == "offset":
        offset = offset[:-1]
    elif what == "rows":
        values["local"] = values["local"][:-1]
    elif what == "name":
        values = {"moon": values["local"]}
    elif what == "nan":
        values["local"][0, 0, 0, 0] = np.nan
    else:
        topology = replace(topology, cell=(5, 5))
    with pytest.raises(ValueError, match=r"valid|offset|rows|unknown|finite|leaves its world cell"):
        folder.write_cell(tmp_path, topology, values, valid, offset, {"bake": "b"})
    assert not cells.cell_path(tmp_path, topology.cell, "tree").exists()


def test_a_broken_invariant_behind_right_checksums_is_named_in_words(bake):
    path = cells.cell_path(bake, (0, 0), "tree")
    file = container.read(path)
    mask, terminal = file.arrays["mask"], file.arrays["terminal"].copy()
    terminal[np.flatnonzero(mask)[0]] ^= True
    container.write(path, "tree", {"mask": mask, "terminal": terminal}, file.meta)
    with pytest.raises(container.FileError, match=r"node array has \d+ nodes, .* need|node \d+ .*(terminal|block)"):
        cells.read_tree(path)


def test_a_terminal_bit_without_children_is_refused(bake):
    path = cells.cell_path(bake, (0, 0), "tree")
    file = container.read(path)
    mask, terminal = file.arrays["mask"], file.arrays["terminal"].copy()
    terminal[np.flatnonzero(mask == 0)[0]] = True
    container.write(path, "tree", {"mask": mask, "terminal": terminal}, file.meta)
    with pytest.raises(container.FileError, match="one without children is terminal"):
        cells.read_tree(path)


@pytest.mark.parametrize("shape", [[1 << 70, 1, 1], [-(1 << 70), 1, 1], [0, 1, 1], [-1, -1, 1], [40, 40, 40]])
def test_a_grid_that_the_nodes_do_not_fill_is_refused(bake, shape):
    path = cells.cell_path(bake, (0, 0), "tree")
    file = container.read(path)
    container.write(path, "tree", file.arrays, file.meta | {"grid_shape": shape})
    with pytest.raises(container.FileError, match=r"dense grid"):
        cells.read_tree(path)


@pytest.mark.parametrize(
    "change", [{"cell": None}, {"levels": 3.0}, {"grid_min": [0, 0]}, {"grid_shape": "abc"}, {"left_out": True}]
)
def test_a_tree_with_a_strange_header_is_refused(bake, change):
    path = cells.cell_path(bake, (0, 0), "tree")
    file = container.read(path)
    container.write(path, "tree", file.arrays, file.meta | change)
    with pytest.raises(container.FileError):
        cells.read_tree(path)


def test_only_files_of_a_bake_are_listed(bake):
    (bake / "notes.txt").write_text("mine")
    (bake / "cell_1_1.blend").write_text("mine")
    (bake / f".cell_0_0.tree.{'0' * 32}.tmp").write_text("left over")
    names = [file.name for file in folder.files(bake)]
    assert "notes.txt" not in names
    assert "cell_1_1.blend" not in names
    assert f".cell_0_0.tree.{'0' * 32}.tmp" in names
    assert len(names) == 4 * 3 + 2
    assert folder.files(bake / "nowhere") == []


def test_verify_of_no_folder_is_one_clear_line(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        verify.verify(tmp_path / "nowhere")


def test_world_json_is_plain_json_with_units(bake):
    content = json.loads((bake / "world.json").read_text())
    assert content["grid"]["unit"] == "m"
    assert content["format"] == "gi_volumes world"


@pytest.mark.parametrize("change", [(b" ", b"\t"), (b"\n", b"\r\n"), (b": ", b":"), (b"\n}\n", b"\n}")])
def test_white_space_of_world_json_is_covered_too(bake, change):
    path = bake / "world.json"
    path.write_bytes(path.read_bytes().replace(*change))
    with pytest.raises(container.FileError, match=r"checksum|not JSON"):
        folder.load_header(bake)
