"""OpenEXR files: its own library reads ours and we its; every damage is found, and no header makes anything large."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
import zlib

import numpy as np
import OpenEXR
import pytest
from gi_volumes.tree import exr
from gi_volumes.tree.container import FileError


def images(seed: int = 0) -> dict[str, np.ndarray]:
    """Noise, a ramp, black; heights that are no multiples of a chunk's, all kinds of numbers."""
    rng = np.random.default_rng(seed)
    odd = rng.normal(size=(21, 7, 3)).astype(np.float16)
    odd[0, 0] = np.inf, -0.0, 6e-8
    ramp = np.broadcast_to(np.arange(40, dtype=np.float16)[:, None], (40, 9))
    return {"noise": rng.random((48, 32, 3)).astype(np.float16), "odd": odd, "ramp": ramp, "one": np.float16([[3]])}


SMALL = exr.encode({"a": np.zeros((3, 2, 3), np.float16), "b": np.ones((17, 2), np.float16)}, "a note")


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return list(one) == list(other) and all(
        one[name].shape == other[name].shape and one[name].tobytes() == other[name].tobytes() for name in one
    )


def test_what_is_read_is_what_was_written():
    found, note = exr.decode(exr.encode(images(), "any note: \N{GREEK SMALL LETTER ALPHA}"), "x.exr")
    assert same(found, images())
    assert note == "any note: \N{GREEK SMALL LETTER ALPHA}"
    assert exr.note_of(SMALL, "x.exr") == "a note"


def test_the_format_s_own_library_reads_the_same_pixels(tmp_path):
    path = tmp_path / "ours.exr"
    path.write_bytes(exr.encode(images(), "a note"))
    file = OpenEXR.File(str(path))
    found = {part.name(): next(iter(part.channels.values())).pixels for part in file.parts}
    assert same({name: np.ascontiguousarray(pixels) for name, pixels in found.items()}, images())
    assert file.parts[0].header["gi_volumes"] == "a note"
    windows = {tuple(map(int, part.header["displayWindow"][1])) for part in file.parts}
    assert windows == {(31, 47)}


def test_files_of_the_format_s_own_library_are_read(tmp_path):
    path, window = tmp_path / "theirs.exr", (np.zeros(2, np.int32), np.int32([31, 47]))
    common = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "displayWindow": window}
    parts = [
        OpenEXR.Part(common | {"name": name}, {"RGB" if pixels.ndim == 3 else "Y": np.ascontiguousarray(pixels)})
        for name, pixels in images().items()
    ]
    OpenEXR.File(parts).write(str(path))
    assert same(exr.decode(path.read_bytes(), path)[0], images())


def test_every_truncation_is_refused():
    for length in range(len(SMALL)):
        with pytest.raises(FileError, match="bake again"):
            exr.decode(SMALL[:length], "x.exr")
    with pytest.raises(FileError, match="bytes follow"):
        exr.decode(SMALL + b"\0", "x.exr")


@pytest.mark.parametrize("flip", [0x01, 0x80, 0xFF])
def test_flipped_bytes_are_refused_or_change_a_value_but_nothing_else(flip):
    whole = bytearray(SMALL)
    for position in range(len(whole)):
        whole[position] ^= flip
        with contextlib.suppress(FileError):
            found, _ = exr.decode(bytes(whole), "x.exr")
            assert sorted(image.shape for image in found.values()) == [(3, 2, 3), (17, 2)]
        whole[position] ^= flip


def forged(width: int, height: int, chunk: bytes) -> bytes:
    """A file whose header names a size, with chunks that are all alike."""
    head = exr.MAGIC + exr._header("a", (height, width), (1, 1), "") + b"\0"
    count = -(-height // exr.LINES)
    step = exr.CHUNK.size + len(chunk)
    table = b"".join(exr.OFFSET.pack(len(head) + 8 * count + step * number) for number in range(count))
    return head + table + b"".join(exr.CHUNK.pack(0, number * exr.LINES, len(chunk)) + chunk for number in range(count))


@pytest.mark.parametrize("size", [(1 << 30, 16), (16, 1 << 30), (1 << 30, 1 << 30), (1 << 20, 1)])
def test_a_header_alone_makes_nothing_large(size):
    head = exr.MAGIC + exr._header("a", size[::-1], (1, 1), "") + b"\0"
    chunk = zlib.compress(bytes(1000))
    data = head + struct.pack("<Q", len(head) + 8) + exr.CHUNK.pack(0, 0, len(chunk)) + chunk
    tracemalloc.start()
    with pytest.raises(FileError):
        exr.decode(data, "x.exr")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_chunks_hold_as_much_as_they_should():
    for length in (0, 127, 129, 100_000):
        with pytest.raises(FileError, match="decompressed"):
            exr.decode(forged(4, 16, zlib.compress(bytes(length))), "x.exr")
    assert not exr.decode(forged(4, 32, zlib.compress(b"\0" + b"\x80" * 127)), "x.exr")[0]["a"].any()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (exr.MAGIC, b"\x89PNG\r\n\x1a\n", "no OpenEXR file"),
        (b"compression\0\x01\0\0\0\x03", b"compression\0\x01\0\0\0\x04", "compression"),
        (b"scanlineimage", b"deepscanline!", "type"),
        (b"name\0string\0\x01\0\0\0b", b"name\0string\0\x01\0\0\0a", "same name"),
        (b"lineOrder\0\x01\0\0\0\0", b"lineOrder\0\x01\0\0\0\x01", "lineOrder"),
        (b"Y\0\x01\0\0\0", b"Y\0\x02\0\0\0", "channels"),
        (b"chunkCount\0int\0\x04\0\0\0\x02", b"chunkCount\0int\0\x04\0\0\0\x03", "chunkCount"),
    ],
)
def test_what_probes_have_no_use_for_is_refused_by_name(old, new, reason):
    assert old in SMALL
    with pytest.raises(FileError, match=reason):
        exr.decode(SMALL.replace(old, new), "x.exr")


@pytest.mark.parametrize(
    "array", [np.zeros((2, 2), np.float32), np.zeros((2, 2, 2), np.float16), np.zeros((0, 2), "f2")]
)
def test_other_arrays_are_not_written(array):
    with pytest.raises(ValueError, match="want float16"):
        exr.encode({"a": array}, "")
    with pytest.raises(ValueError, match="1 to 31 bytes"):
        exr.encode({"a" * 32: np.zeros((2, 2), np.float16)}, "")
