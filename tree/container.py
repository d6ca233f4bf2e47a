"""The container of every file of a bake: named arrays and a JSON header, compressed, checked, deterministic.

Comes in: arrays and a dict. Goes out: one file, written atomically, whose every byte a checksum covers.

    0   8  magic 89 47 49 56 0D 0A 1A 0A      16  8  u64 file length
    8   4  u32 version                        24  4  u32 CRC-32 of the bytes [0, 24) and the JSON header
    12  4  u32 length of the JSON header      28  .  JSON header, then the blocks, nothing between or after

`docs/format.md` specifies it byte by byte.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import zstandard

from .atomic import write_bytes_atomically

__all__ = ["MAGIC", "VERSION", "Container", "FileError", "read", "write", "write_bytes_atomically"]

MAGIC = b"\x89GIV\r\n\x1a\n"
VERSION = 1
PREFIX = struct.Struct("<8sIIQ")
CHECKSUM = struct.Struct("<I")
PREFIX_BYTES = PREFIX.size + CHECKSUM.size
SHORT_HEADER = 512
"""Headers below this are stored as text, which people can read [bytes]."""
BLOCK_BYTES = 1 << 20
"""Raw bytes of every block but an array's last; a multiple of every item size."""
COMPRESSION_LEVEL = 6
"""Of zstd: the last level before time grows faster than size shrinks; fixed, so that bytes are deterministic."""
MAX_DIMENSIONS = 8
DTYPES = ("|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8")
CODECS = ("raw", "zstd", "shuffle+zstd")


class FileError(ValueError):
    """A file that cannot be trusted; the message names the file, the byte and the reason.

    Parameters
    ----------
    path : str or Path
        The file.
    offset : int
        Where in the file the reader found the reason [bytes].
    reason : str
        What is wrong there.
    """

    def __init__(self, path: str | os.PathLike, offset: int, reason: str):
        super().__init__(f"{os.fspath(path)}: byte {offset}: {reason}")
        self.path, self.offset, self.reason = os.fspath(path), offset, reason


@dataclass(frozen=True)
class Container:
    """What a file holds: its kind, its header dict, and read-only arrays with their units."""

    kind: str
    meta: dict
    arrays: dict[str, np.ndarray]
    units: dict[str, str]
    version: int = VERSION


@dataclass(frozen=True)
class _Block:
    """Where one block lies, so that all of them are checked before anything is allocated."""

    offset: int
    stored: int
    raw: int
    checksum: int


@dataclass(frozen=True)
class _Entry:
    """One array of the header, after its description was found to be consistent."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    unit: str
    codec: str
    blocks: tuple[_Block, ...]


def write(
    path: str | os.PathLike,
    kind: str,
    arrays: dict[str, np.ndarray],
    meta: dict,
    units: dict[str, str] | None = None,
) -> int:
    """Write arrays and a header as one file, atomically; the same input gives the same bytes.

    Parameters
    ----------
    path : str or Path
        The file to write; replaced only when the new one is complete.
    kind : str
        What the file is, checked by `read`.
    arrays : dict of str to ndarray
        Bool, integer and float arrays of at most 8 bytes an item, of any shape.
    meta : dict
        What JSON can hold; no NaN and no infinity.
    units : dict of str to str, optional
        Unit of each array, "1" where not given.

    Returns
    -------
    int
        The file's length [bytes].

    Raises
    ------
    TypeError
        For an array or a header that the format cannot hold.
    OSError
        When the file cannot be written; nothing is left behind.
    """
    content = encode(kind, arrays, meta, units)
    write_bytes_atomically(path, content)
    return len(content)


def encode(kind: str, arrays: dict[str, np.ndarray], meta: dict, units: dict[str, str] | None = None) -> bytes:
    """Return the bytes that `write` puts into a file.

    Parameters
    ----------
    kind : str
        What the file is.
    arrays : dict of str to ndarray
        As for `write`.
    meta : dict
        As for `write`.
    units : dict of str to str, optional
        As for `write`.

    Returns
    -------
    bytes
        The whole file.

    Raises
    ------
    TypeError
        For an array or a header that the format cannot hold.
    """
    entries, blocks = [], []
    for name, array in arrays.items():
        entry, array_blocks = _encode_array(name, np.asarray(array), (units or {}).get(name, "1"))
        entries.append(entry)
        blocks += array_blocks
    header = _packed(_to_json({"arrays": entries, "kind": kind, "meta": meta}))
    length = PREFIX_BYTES + len(header) + sum(map(len, blocks))
    prefix = PREFIX.pack(MAGIC, VERSION, len(header), length)
    checksum = CHECKSUM.pack(zlib.crc32(header, zlib.crc32(prefix)))
    return b"".join([prefix, checksum, header, *blocks])


def read(path: str | os.PathLike, kind: str | None = None) -> Container:
    """Read a file after checking every byte of it.

    Parameters
    ----------
    path : str or Path
        The file.
    kind : str, optional
        The kind that the file has to be.

    Returns
    -------
    Container
        Read-only arrays in native byte order, and the header.

    Raises
    ------
    FileError
        For anything but a complete, undamaged file of this kind; naming the byte and the reason.
    OSError
        When the file cannot be opened or read.
    """
    with open(path, "rb") as file:
        header, first_block = _read_header(path, file)
        if not isinstance(header, dict) or set(header) != {"arrays", "kind", "meta"}:
            raise FileError(path, PREFIX_BYTES, "the header is not an object of arrays, kind and meta")
        if kind is not None and header["kind"] != kind:
            raise FileError(path, PREFIX_BYTES, f"this is a {header['kind']!r} file, not a {kind!r} file")
        if not isinstance(header["kind"], str) or not isinstance(header["meta"], dict):
            raise FileError(path, PREFIX_BYTES, "the header's kind or meta has the wrong type")
        entries = _read_entries(path, header["arrays"], first_block, os.fstat(file.fileno()).st_size)
        for entry in entries:
            _check_blocks(path, file, entry)
        arrays = {entry.name: _read_array(path, file, entry) for entry in entries}
    return Container(header["kind"], header["meta"], arrays, {entry.name: entry.unit for entry in entries})


def _to_json(value: object) -> bytes:
    """Give one text for one value, whatever the order in which its keys were set."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")
    except ValueError as error:
        raise TypeError(f"the header cannot be stored as JSON: {error}") from None


def _encode_array(name: str, array: np.ndarray, unit: str) -> tuple[dict, list[bytes]]:
    """Compress one array; keep it raw where compression does not pay."""
    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in DTYPES:
        raise TypeError(f"array {name!r} has dtype {array.dtype}; a file holds {', '.join(DTYPES)}")
    if array.ndim > MAX_DIMENSIONS:
        raise TypeError(f"array {name!r} has {array.ndim} dimensions; a file holds at most {MAX_DIMENSIONS}")
    raw = np.ascontiguousarray(array, dtype=dtype).tobytes()
    pieces = [raw[start : start + BLOCK_BYTES] for start in range(0, len(raw), BLOCK_BYTES)]
    codec = "zstd" if dtype.itemsize == 1 else "shuffle+zstd"
    compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_checksum=False, write_content_size=True)
    blocks = [compressor.compress(_shuffle(piece, dtype.itemsize)) for piece in pieces]
    if sum(map(len, blocks)) >= len(raw):
        codec, blocks = "raw", pieces
    sizes = [[len(block), len(piece), zlib.crc32(block)] for block, piece in zip(blocks, pieces, strict=True)]
    entry = {"name": name, "dtype": dtype.str, "shape": list(array.shape), "unit": unit, "codec": codec}
    return entry | {"blocks": sizes}, blocks


def _shuffle(raw: bytes, itemsize: int) -> bytes:
    """Put the first bytes of all items first, then the second ones: neighbours then resemble each other."""
    if itemsize == 1:
        return raw
    return np.frombuffer(raw, np.uint8).reshape(-1, itemsize).T.tobytes()


def _unshuffle(raw: bytes, itemsize: int) -> bytes:
    """Undo `_shuffle`."""
    return np.frombuffer(raw, np.uint8).reshape(itemsize, -1).T.tobytes()


def _read_header(path: str | os.PathLike, file: BinaryIO) -> tuple[object, int]:
    """Return the header and the offset of the first block; each length is checked before it is used."""
    actual = os.fstat(file.fileno()).st_size
    prefix = file.read(PREFIX_BYTES)
    if not prefix.startswith(MAGIC[: len(prefix)]) or not prefix:
        raise FileError(path, 0, "this is not a GI Volumes file, or a text-mode transfer damaged it")
    if len(prefix) < PREFIX_BYTES:
        raise FileError(path, len(prefix), "the file ends within its first 28 bytes")
    _, version, json_bytes, length = PREFIX.unpack_from(prefix)
    if length != actual:
        raise FileError(path, 16, f"the file has {actual} bytes, its header says {length}: incomplete or damaged")
    if json_bytes > actual - PREFIX_BYTES:
        raise FileError(path, 12, f"the header is said to have {json_bytes} bytes, more than the file has left")
    text = file.read(json_bytes)
    checksum = zlib.crc32(text, zlib.crc32(prefix[: PREFIX.size]))
    if CHECKSUM.unpack_from(prefix, PREFIX.size)[0] != checksum:
        raise FileError(path, PREFIX.size, "the header's checksum is wrong: the file is damaged")
    if version != VERSION:
        raise FileError(path, 8, f"format version {version}; this program reads version {VERSION}")
    try:
        header = _unpacked(text).decode("ascii")
        return json.loads(header, parse_constant=_refuse_constant), PREFIX_BYTES + json_bytes
    except (ValueError, RecursionError, zstandard.ZstdError) as error:
        raise FileError(path, PREFIX_BYTES, f"the header is not the JSON of this format: {error}") from None


def _packed(text: bytes) -> bytes:
    """The header as it is stored: as one zstd frame where that is shorter; a world of many cells is mostly headers."""
    if not SHORT_HEADER <= len(text) <= BLOCK_BYTES:
        return text
    compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_checksum=False, write_content_size=True)
    return min(text, compressor.compress(text), key=len)


def _unpacked(stored: bytes) -> bytes:
    """The header's text; a frame that states no size, or a large one, is refused before it takes memory."""
    if not stored.startswith(zstandard.FRAME_HEADER):
        return stored
    size = zstandard.get_frame_parameters(stored).content_size
    if not 0 < size <= BLOCK_BYTES:
        raise ValueError(f"a packed header of {size} bytes; at most {BLOCK_BYTES} are allowed")
    decompressor = zstandard.ZstdDecompressor(max_window_size=BLOCK_BYTES)
    return decompressor.decompress(stored, max_output_size=size, allow_extra_data=False)


def _refuse_constant(name: str) -> float:
    """NaN and infinities are no JSON, though Python reads them."""
    raise ValueError(f"{name} is not a JSON number")


def _read_entries(path: str | os.PathLike, listed: object, offset: int, end: int) -> list[_Entry]:
    """Check that the arrays' descriptions are well formed and fill the file to its last byte."""
    if not isinstance(listed, list):
        raise FileError(path, PREFIX_BYTES, "the header's arrays are not a list")
    entries, names = [], set()
    for description in listed:
        try:
            entry = _read_entry(description, offset)
        except (KeyError, TypeError, ValueError) as error:
            raise FileError(path, PREFIX_BYTES, f"array {len(entries)} of the header: {error}") from None
        offset += sum(block.stored for block in entry.blocks)
        if entry.name in names:
            raise FileError(path, PREFIX_BYTES, f"two arrays are named {entry.name!r}")
        names.add(entry.name)
        entries.append(entry)
    if offset != end:
        raise FileError(path, min(offset, end), f"the arrays end at byte {offset}, the file at byte {end}")
    return entries


def _read_entry(description: dict, offset: int) -> _Entry:
    """Turn one description into a record; shape, blocks and sizes have to agree with each other."""
    if not isinstance(description, dict) or set(description) != {"name", "dtype", "shape", "unit", "codec", "blocks"}:
        raise ValueError("it is not an object of name, dtype, shape, unit, codec and blocks")
    name, code, codec, unit = (description[key] for key in ("name", "dtype", "codec", "unit"))
    if not all(isinstance(text, str) for text in (name, code, codec, unit)):
        raise ValueError("its name, dtype, codec or unit is not a string")
    if code not in DTYPES or codec not in CODECS:
        raise ValueError(f"dtype {code!r} or codec {codec!r} is unknown")
    dtype, shape = np.dtype(code), tuple(_natural(size) for size in description["shape"])
    if len(shape) > MAX_DIMENSIONS or math.prod(max(size, 1) for size in shape) >= 1 << 48:
        raise ValueError(f"its shape {shape} is too large")
    blocks = []
    for stored, raw, checksum in description["blocks"]:
        blocks.append(_Block(offset, _natural(stored), _natural(raw), _natural(checksum)))
        offset += stored
    total = math.prod(shape) * dtype.itemsize
    if len(blocks) != -(-total // BLOCK_BYTES) or sum(block.raw for block in blocks) != total:
        raise ValueError(f"its blocks do not hold the {total} bytes of shape {shape}")
    if any(block.raw != BLOCK_BYTES for block in blocks[:-1]) or any(block.raw > BLOCK_BYTES for block in blocks):
        raise ValueError(f"a block other than the last does not hold {BLOCK_BYTES} bytes")
    if any(block.stored != block.raw if codec == "raw" else block.stored >= 2 * BLOCK_BYTES for block in blocks):
        raise ValueError(f"a block's size does not fit its codec {codec!r}")
    return _Entry(name, dtype, shape, unit, codec, tuple(blocks))


def _natural(value: object) -> int:
    """Accept a whole number that is not negative, and nothing that merely behaves like one."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is not a natural number")
    return value


def _check_blocks(path: str | os.PathLike, file: BinaryIO, entry: _Entry) -> None:
    """Check each block's checksum and announced size, before any memory is taken for the array."""
    for block in entry.blocks:
        stored = _read_block(file, block)
        if zlib.crc32(stored) != block.checksum:
            raise FileError(path, block.offset, f"a block of array {entry.name!r} is damaged (checksum)")
        if entry.codec == "raw":
            continue
        try:
            frame = zstandard.get_frame_parameters(stored)
        except zstandard.ZstdError as error:
            raise FileError(path, block.offset, f"a block of array {entry.name!r} is no zstd frame: {error}") from None
        if frame.content_size != block.raw or frame.window_size > BLOCK_BYTES:
            raise FileError(path, block.offset, f"a block of array {entry.name!r} unpacks to another size than stated")


def _read_block(file: BinaryIO, block: _Block) -> bytes:
    """Return a block's stored bytes."""
    file.seek(block.offset)
    return file.read(block.stored)


def _read_array(path: str | os.PathLike, file: BinaryIO, entry: _Entry) -> np.ndarray:
    """Unpack the blocks of one array, one at a time."""
    try:
        content = np.empty(sum(block.raw for block in entry.blocks), np.uint8)
        position = 0
        for block in entry.blocks:
            content[position : position + block.raw] = np.frombuffer(_unpack(file, entry, block), np.uint8)
            position += block.raw
    except (zstandard.ZstdError, ValueError, MemoryError) as error:
        offset = entry.blocks[0].offset
        raise FileError(path, offset, f"array {entry.name!r} cannot be unpacked: {error}") from None
    if entry.dtype.kind == "b" and content.size and content.max() > 1:
        raise FileError(path, entry.blocks[0].offset, f"array {entry.name!r} holds bytes that are no booleans")
    array = content.view(entry.dtype).reshape(entry.shape).astype(entry.dtype.newbyteorder("="), copy=False)
    array.flags.writeable = False
    return array


def _unpack(file: BinaryIO, entry: _Entry, block: _Block) -> bytes:
    """Return a block's raw bytes; zstd stops at the size that the header states."""
    stored = _read_block(file, block)
    if entry.codec == "raw":
        return stored
    decompressor = zstandard.ZstdDecompressor(max_window_size=BLOCK_BYTES)
    raw = decompressor.decompress(stored, max_output_size=block.raw, allow_extra_data=False)
    return raw if entry.codec == "zstd" else _unshuffle(raw, entry.dtype.itemsize)
