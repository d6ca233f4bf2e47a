"""The container: bytes are fixed, damage is always found, nothing is allocated on a file's word alone."""

import json
import os
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import zstandard
from gi_volumes.tree import container
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

ARRAYS = {
    "mask": np.array([1, 2**63 + 5, 7], np.uint64),
    "valid": np.array([[True, False], [True, True]]),
    "zeros": np.zeros((100, 3), np.float32),
    "empty": np.zeros((0, 9, 3), np.float16),
}
META = {"cell": [-1, 2], "name": "Mühle", "first_size": 8.0}


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.tree"
    container.write(path, "tree", ARRAYS, META, {"zeros": "m"})
    return path


def forge(path, header, blocks=b"", version=container.VERSION):
    """Write a file whose checksums are right and whose content is whatever a forger wants."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    prefix = struct.pack("<8sIIQ", container.MAGIC, version, len(text), 28 + len(text) + len(blocks))
    path.write_bytes(prefix + struct.pack("<I", zlib.crc32(text, zlib.crc32(prefix))) + text + blocks)
    return path


def forged_array(**changes):
    entry = {"name": "a", "dtype": "|u1", "shape": [4], "unit": "1", "codec": "raw", "blocks": []}
    return {"kind": "k", "meta": {}, "arrays": [entry | changes]}


def test_what_is_read_is_what_was_written(small):
    got = container.read(small, "tree")
    assert (got.kind, got.meta, got.version) == ("tree", META, 1)
    assert got.units["zeros"] == "m"
    assert got.units["mask"] == "1"
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(got.arrays[name], array)
        assert got.arrays[name].dtype == array.dtype
        assert not got.arrays[name].flags.writeable


@settings(max_examples=60, deadline=None)
@given(
    array=hnp.arrays(
        st.one_of(hnp.integer_dtypes(), hnp.unsigned_integer_dtypes(), hnp.floating_dtypes(), st.just(np.bool_)),
        hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=7),
    )
)
def test_any_array_comes_back_bit_for_bit(array, tmp_path_factory):
    path = tmp_path_factory.mktemp("any") / "a"
    container.write(path, "k", {"a": array}, {})
    got = container.read(path).arrays["a"]
    assert got.shape == array.shape
    assert got.astype(array.dtype.newbyteorder("<")).tobytes() == array.astype(array.dtype.newbyteorder("<")).tobytes()


def test_arrays_of_many_blocks_come_back(tmp_path):
    rng = np.random.default_rng(1)
    arrays = {"noise": rng.integers(0, 256, 2_500_000).astype(np.uint8), "ramp": np.arange(300_000, dtype=np.int64)}
    size = container.write(tmp_path / "a", "k", arrays, {})
    assert size == (tmp_path / "a").stat().st_size
    got = container.read(tmp_path / "a").arrays
    for name, array in arrays.items():
        np.testing.assert_array_equal(got[name], array)


def test_the_same_input_gives_the_same_bytes_whatever_the_order_of_keys(tmp_path):
    turned = dict(reversed(META.items()))
    assert container.encode("tree", ARRAYS, META) == container.encode("tree", ARRAYS, turned)


def test_every_truncation_is_refused(small):
    whole = small.read_bytes()
    for length in range(len(whole)):
        small.write_bytes(whole[:length])
        with pytest.raises(container.FileError, match="byte"):
            container.read(small)


@pytest.mark.parametrize("flip", [0x01, 0x80, 0xFF])
def test_every_flipped_byte_is_refused(small, flip):
    whole = bytearray(small.read_bytes())
    for position in range(len(whole)):
        whole[position] ^= flip
        small.write_bytes(whole)
        with pytest.raises(container.FileError):
            container.read(small)
        whole[position] ^= flip


@pytest.mark.parametrize("extra", [b"\0", b"\n", b"x" * 1000])
def test_trailing_bytes_are_refused(small, extra):
    small.write_bytes(small.read_bytes() + extra)
    with pytest.raises(container.FileError, match="its header says"):
        container.read(small)


@pytest.mark.parametrize("damage", [(b"\r\n", b"\n"), (b"\n", b"\r\n"), (b"\x89", b"\x09")])
def test_text_mode_damage_is_named(small, damage):
    small.write_bytes(small.read_bytes().replace(*damage))
    with pytest.raises(container.FileError, match="text-mode"):
        container.read(small)


def test_the_message_names_file_byte_and_reason(small):
    whole = bytearray(small.read_bytes())
    whole[-1] ^= 1
    small.write_bytes(whole)
    with pytest.raises(container.FileError) as caught:
        container.read(small)
    assert str(small) in str(caught.value)
    assert f"byte {caught.value.offset}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_kind_is_refused(small):
    with pytest.raises(container.FileError, match="'tree' file, not a 'payload' file"):
        container.read(small, "payload")


def test_another_version_is_named(tmp_path):
    with pytest.raises(container.FileError, match="version 2"):
        container.read(forge(tmp_path / "a", {"kind": "k", "meta": {}, "arrays": []}, version=2))


FORGERIES = {
    "shape of a terabyte": forged_array(shape=[1 << 40]),
    "shape beyond 64 bits": forged_array(shape=[1 << 40, 1 << 40]),
    "empty shape beyond 64 bits": forged_array(shape=[0, 1 << 62, 1 << 62]),
    "negative shape": forged_array(shape=[-4]),
    "float shape": forged_array(shape=[4.0]),
    "true shape": forged_array(shape=[True]),
    "nine dimensions": forged_array(shape=[1] * 9),
    "shape of strings": forged_array(shape="4"),
    "object dtype": forged_array(dtype="|O"),
    "big-endian dtype": forged_array(dtype=">f4"),
    "record dtype": forged_array(dtype=[["a", "<f4"]]),
    "unknown codec": forged_array(codec="pickle"),
    "missing blocks": forged_array(),
    "block of a terabyte": forged_array(blocks=[[1 << 40, 1 << 40, 0]], shape=[1 << 40]),
    "raw block of two sizes": forged_array(blocks=[[3, 4, 0]]),
    "blocks without checksum": forged_array(blocks=[[4, 4]]),
    "extra key": forged_array(more=1),
    "arrays as a dict": {"kind": "k", "meta": {}, "arrays": {}},
    "no kind": {"meta": {}, "arrays": []},
    "kind as a number": {"kind": 1, "meta": {}, "arrays": []},
    "meta as a list": {"kind": "k", "meta": [], "arrays": []},
    "list": [],
    "not JSON": b"{",
    "not ASCII": '{"kind":"ü","meta":{},"arrays":[]}'.encode(),
    "NaN": b'{"kind":"k","meta":{"a":NaN},"arrays":[]}',
    "deep nesting": b"[" * 200_000,
    "long integer": b'{"kind":"k","meta":{"a":' + b"9" * 10_000 + b'},"arrays":[]}',
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_header_with_a_right_checksum_is_refused_without_allocating(name, tmp_path):
    path = forge(tmp_path / "a", FORGERIES[name])
    tracemalloc.start()
    with pytest.raises(container.FileError):
        container.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 * path.stat().st_size + 500_000


def test_two_arrays_of_one_name_are_refused(tmp_path):
    header = forged_array(shape=[0])
    header["arrays"] *= 2
    with pytest.raises(container.FileError, match="two arrays"):
        container.read(forge(tmp_path / "a", header))


def test_a_block_that_unpacks_to_more_than_stated_is_refused_without_unpacking_it(tmp_path):
    bomb = zstandard.ZstdCompressor().compress(bytes(50_000_000))
    header = forged_array(codec="zstd", blocks=[[len(bomb), 4, zlib.crc32(bomb)]])
    tracemalloc.start()
    with pytest.raises(container.FileError, match="another size"):
        container.read(forge(tmp_path / "a", header, bomb))
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_a_block_without_a_content_size_is_refused(tmp_path):
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(b"abcd")
    header = forged_array(codec="zstd", blocks=[[len(frame), 4, zlib.crc32(frame)]])
    with pytest.raises(container.FileError):
        container.read(forge(tmp_path / "a", header, frame))


def test_two_frames_in_one_block_are_refused(tmp_path):
    frame = zstandard.ZstdCompressor().compress(b"abcd")
    header = forged_array(codec="zstd", blocks=[[2 * len(frame), 4, zlib.crc32(2 * frame)]])
    with pytest.raises(container.FileError, match="cannot be unpacked"):
        container.read(forge(tmp_path / "a", header, 2 * frame))


def test_bytes_that_are_no_booleans_are_refused(tmp_path):
    header = forged_array(dtype="|b1", blocks=[[4, 4, zlib.crc32(b"\0\1\2\0")]])
    with pytest.raises(container.FileError, match="no booleans"):
        container.read(forge(tmp_path / "a", header, b"\0\1\2\0"))


@pytest.mark.parametrize("array", [np.array(["a"]), np.array([None]), np.zeros(2, np.complex64), np.zeros((1,) * 9)])
def test_arrays_that_a_file_cannot_hold_are_refused(array, tmp_path):
    with pytest.raises(TypeError, match="array 'a'"):
        container.write(tmp_path / "a", "k", {"a": array}, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("meta", [{"a": float("nan")}, {"a": object()}])
def test_headers_that_are_no_json_are_refused(meta, tmp_path):
    with pytest.raises(TypeError):
        container.write(tmp_path / "a", "k", {}, meta)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_the_old_file_and_nothing_else(small, monkeypatch):
    def fail(descriptor):
        raise OSError(28, "No space left on device")

    before = small.read_bytes()
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left on device") as caught:
        container.write(small, "tree", {}, {})
    assert str(small) in str(caught.value)
    assert small.read_bytes() == before
    assert list(small.parent.iterdir()) == [small]


def test_an_interrupt_leaves_no_temporary_file(small, monkeypatch):
    def interrupt(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        container.write(small, "tree", {}, {})
    assert list(small.parent.iterdir()) == [small]


def test_a_missing_folder_is_one_clear_line(tmp_path):
    with pytest.raises(FileNotFoundError, match="cannot write") as caught:
        container.write(tmp_path / "nowhere" / "a", "k", {}, {})
    assert "nowhere" in str(caught.value)
    assert ".tmp" not in str(caught.value)


GOLDEN = (
    b"\x89GIV\r\n\x1a\n\x01\x00\x00\x00\x92\x00\x00\x00\xb4\x00\x00\x00\x00\x00\x00\x00Z\x18\xb4\xac"
    b'{"arrays":[{"blocks":[[6,6,448620040]],"codec":"raw","dtype":"<u2","name":"index","shape":[3],"unit":"1"}],'
    b'"kind":"golden","meta":{"cell":[-1,2]}}\x01\x00\xff\x00\xff\xff'
)


def test_golden_bytes_of_version_1_are_written_and_read(tmp_path):
    index, meta = np.array([1, 255, 65535], np.uint16), {"cell": [-1, 2]}
    assert container.encode("golden", {"index": index}, meta) == GOLDEN
    (tmp_path / "golden").write_bytes(GOLDEN)
    got = container.read(tmp_path / "golden", "golden")
    np.testing.assert_array_equal(got.arrays["index"], index)
    assert got.meta == meta


def test_long_headers_are_packed_and_read_back(tmp_path):
    meta = {"names": [f"thing {number}" for number in range(200)]}
    size = container.write(tmp_path / "long", "k", {}, meta)
    assert size < len(json.dumps(meta)) // 2
    assert container.read(tmp_path / "long").meta == meta


@pytest.mark.parametrize("size", [None, 1 << 21])
def test_packed_headers_of_unknown_or_great_size_are_refused(tmp_path, size):
    text = json.dumps({"arrays": [], "kind": "k", "meta": {"a": "a" * (size or 10)}}).encode()
    compressor = zstandard.ZstdCompressor(write_content_size=size is not None)
    path = forge(tmp_path / "forged", compressor.compress(text) if size else compressor.compressobj().compress(text))
    with pytest.raises(container.FileError, match="header"):
        container.read(path)
