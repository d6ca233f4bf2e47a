"""docs/format.md is enough: a reader written from its text alone reads a real bake."""

import json
import math
import re
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from gi_volumes.tree import build, folder, harmonics, payload
from gi_volumes.tree.grid import Grid

sys.path.insert(0, str(Path(__file__).parent))
import meshes

DOCUMENT = (Path(__file__).parents[2] / "docs" / "format.md").read_text()

# --- from here to the next line, only struct, json, math, zlib and zstandard ---
ITEMS = dict(
    zip(
        ["|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8"],
        "?bBhHiIqQefd",
        strict=True,
    )
)


def read_container(path):
    data = path.read_bytes()
    assert data[:8] == bytes.fromhex("894749560D0A1A0A")
    version, header_bytes, length, checksum = struct.unpack("<IIQI", data[8:28])
    assert (version, length) == (1, len(data))
    text = data[28 : 28 + header_bytes]
    assert checksum == zlib.crc32(data[:24] + text)
    if text[:4] == bytes.fromhex("28B52FFD"):
        text = zstandard.ZstdDecompressor().decompress(text)
    header, position, arrays = json.loads(text), 28 + header_bytes, {}
    for entry in header["arrays"]:
        raw = b""
        width = struct.calcsize("<" + ITEMS[entry["dtype"]])
        for stored, size, crc in entry["blocks"]:
            block = data[position : position + stored]
            position += stored
            assert zlib.crc32(block) == crc
            if entry["codec"] != "raw":
                block = zstandard.ZstdDecompressor().decompress(block)
            if entry["codec"] == "shuffle+zstd":
                count = len(block) // width
                block = bytes(block[k * count + i] for i in range(count) for k in range(width))
            assert len(block) == size
            raw += block
        arrays[entry["name"]] = struct.unpack(f"<{len(raw) // width}{ITEMS[entry['dtype']]}", raw)
    assert position == len(data)
    return header["kind"], header["meta"], arrays


def first_children(meta, arrays):
    """Index of each node's first child: blocks lie in the order of their parents."""
    inner, leaf, first = math.prod(meta["grid_shape"]), len(arrays["mask"]), []
    for mask, terminal in zip(arrays["mask"], arrays["terminal"], strict=True):
        first.append(leaf if terminal else inner)
        leaf, inner = (leaf + mask.bit_count(), inner) if terminal else (leaf, inner + mask.bit_count())
    assert inner == len(arrays["mask"])
    return first


def walk(meta, arrays):
    """Yield (index, level, coordinates) of every voxel."""
    nx, ny, nz = meta["grid_shape"]
    first = first_children(meta, arrays)
    x0, y0, z0 = meta["grid_min"]
    todo = [
        (x + nx * (y + ny * z), 0, (x0 + x, y0 + y, z0 + z)) for z in range(nz) for y in range(ny) for x in range(nx)
    ]
    while todo:
        index, level, place = todo.pop()
        yield index, level, place
        if index >= len(arrays["mask"]):
            continue
        mask = arrays["mask"][index]
        for bit in range(64):
            if mask >> bit & 1:
                child = first[index] + (mask & ((1 << bit) - 1)).bit_count()
                step = (bit & 3, bit >> 2 & 3, bit >> 4)
                assert (child >= len(arrays["mask"])) == arrays["terminal"][index]
                todo.append((child, level + 1, tuple(4 * c + s for c, s in zip(place, step, strict=True))))


def decode(arrays, functions):
    """Every entry by the formula, number by number."""
    exponent, step, gain = arrays["exponent"], arrays["step"], arrays["gain"]
    width, rank = functions * 27, len(arrays["step"])
    coefficient = np.array(arrays["coefficient"]).reshape(rank, len(exponent))
    basis = np.array(arrays["basis"], float).reshape(rank, functions, 27)
    entries = np.zeros((len(exponent), functions, 27))
    for i in range(len(exponent)):
        for k in range(functions):
            for j in range(rank):
                entries[i, k] += coefficient[j, i] * step[j] * basis[j, k]
            entries[i, k] *= 2.0 ** (exponent[i] + gain[k])
    assert width == entries[:1].size
    return entries.reshape(-1, functions, 9, 3)


# ---


@pytest.fixture(scope="module")
def bake(tmp_path_factory):
    place, rng = tmp_path_factory.mktemp("bake"), np.random.default_rng(0)
    topology = build.build(meshes.soup(40, 4), Grid(), (-1, 0))
    values = {"local": rng.normal(size=(topology.size, 1, 9, 3)).astype(np.float32)}
    values["sun"] = rng.normal(size=(topology.size, 2, 9, 3)).astype(np.float32)
    valid, offset = rng.random(topology.size) > 0.2, rng.integers(-127, 128, (topology.size, 3)).astype(np.int8)
    folder.write_cell(place, topology, values, valid, offset, {"bake": "b"})
    return place, topology, values, valid, offset


def test_a_reader_from_the_text_finds_every_voxel(bake):
    place, topology, *_ = bake
    kind, meta, arrays = read_container(place / "cell_-1_0.tree")
    assert kind == "tree"
    voxels = sorted(walk(meta, arrays))
    assert [index for index, _, _ in voxels] == list(range(meta["data_points"]))
    level, coords = topology.voxels()
    expected = np.concatenate([level[:, None], coords], axis=1).tolist()
    assert [[depth, *place] for _, depth, place in voxels] == expected


def test_a_reader_from_the_text_finds_data_points_and_values(bake):
    place, _, values, valid, offset = bake
    _, _, points = read_container(place / "cell_-1_0.points")
    assert list(points["valid"]) == valid.tolist()
    assert np.array_equal(np.array(points["offset"]).reshape(-1, 3)[valid], offset[valid])
    for name, expected in values.items():
        kind, meta, arrays = read_container(place / f"cell_-1_0.{name}")
        assert (kind, meta["name"], meta["bake"]) == ("payload", name, "b")
        index = np.array(arrays["index"])
        assert np.array_equal(index == 65535, ~valid)
        table = decode(arrays, expected.shape[1])
        weight = 1 / np.exp2(np.array(arrays["gain"]))[:, None, None]
        error, length = (
            np.linalg.norm((rows * weight).reshape(len(rows), -1), axis=1)
            for rows in (table[index[valid]] - expected[valid], expected[valid])
        )
        assert (error <= meta["relative_error"] * length + meta["absolute_error"]).all()


def test_the_document_states_the_harmonics_that_are_used():
    x, y, z = normal = np.array([0.48, 0.6, 0.64])
    squares = ["(3 z^2 - 1)", "(x^2 - y^2)"]
    terms = {"": 1, "y": y, "z": z, "x": x, "x y": x * y, "y z": y * z, squares[0]: 3 * z * z - 1, "x z": x * z}
    terms |= {squares[1]: x * x - y * y}
    for k, (term, value) in enumerate(zip(terms, harmonics.basis(normal), strict=True)):
        number, _, rest = re.search(rf" {k}: (\d\.\d+)( ?)(.*)", DOCUMENT).groups()
        assert rest.startswith(term)
        assert float(number) * terms[term] == pytest.approx(value, rel=1e-6)


def test_the_document_names_the_numbers_that_the_code_uses():
    assert f"index {payload.NO_DATA} means no" in DOCUMENT.replace("\n", " ")
    assert "65,535 voxels" in DOCUMENT
