"""OpenEXR files as probes need them: several images of half precision in one file, written and read.

Comes in: named images and a note. Goes out: a multi-part file of scan lines under ZIP compression, and back.

    magic 76 2F 31 01, version 2 with the flag of multi-part files
    a header for each part: attributes (name 0, type 0, length, value), then 0; after the last one another 0
    for each part the offsets of its chunks, u64
    chunks of 16 lines: part i32, first line i32, stored bytes i32, the bytes; nothing between or after

A reader's memory follows from what it has decompressed, never from what a header says. Files that use more of OpenEXR
than this are refused. Source: "OpenEXR File Layout", openexr.com; `tests/tree/test_exr.py` compares with its library.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from .container import FileError

__all__ = ["decode", "encode", "note_of"]

MAGIC = b"\x76\x2f\x31\x01\x02\x10\x00\x00"
LINES = 16
"""Lines of a chunk under ZIP compression."""

ZIP, HALF = 3, 1
"""Codes of the compression and of the pixels' type."""

LEVEL = 6
"""Of zlib: files are 1 % longer than those of level 9, in a quarter of its time."""

NOTE = "gi_volumes"
"""Name of the attribute of the first part that holds the note."""

CHANNELS = {1: ("Y",), 3: ("B", "G", "R")}
"""By how many numbers a pixel has; files hold them in the order of the alphabet."""

LONGEST_NAME = 31
"""Bytes of a name in a file without the flag of long names."""

CHUNK = struct.Struct("<iii")
OFFSET = struct.Struct("<Q")
REMEDY = "it is damaged, or another program has written it: bake again"


@dataclass(frozen=True)
class _Part:
    """What a part's header says: its name, pixels as an array, chunks."""

    name: str
    shape: tuple[int, ...]
    chunks: int


def encode(images: dict[str, np.ndarray], note: str) -> bytes:
    """Return the bytes of a file.

    Parameters
    ----------
    images : dict of str to (h, w) or (h, w, 3) float16 ndarray
        By name, at least one; the first one is the largest. Row 0 is shown at the top.
    note : str
        Stored as an attribute of the first part.

    Returns
    -------
    bytes
        The same for the same images and the same version of zlib.

    Raises
    ------
    ValueError
        An image has another type or shape, or a name that is too long.
    """
    for name, pixels in images.items():
        is_image = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
        if pixels.dtype != np.float16 or not is_image or not pixels.size:
            raise ValueError(f"{name}: {pixels.dtype} {pixels.shape}; want float16 of shape (h, w) or (h, w, 3)")
        if not 0 < len(name.encode()) <= LONGEST_NAME:
            raise ValueError(f"{name}: a name has 1 to {LONGEST_NAME} bytes")
    shapes = {name: pixels.shape for name, pixels in images.items()}
    window = next(iter(shapes.values()))[1::-1]
    head = MAGIC + b"".join(_header(*item, window, "" if n else note) for n, item in enumerate(shapes.items())) + b"\0"
    chunks = [_chunk(n, y, rows) for n, pixels in enumerate(images.values()) for y, rows in _blocks(pixels)]
    ends = len(head) + OFFSET.size * len(chunks) + np.cumsum([0, *map(len, chunks)])
    return b"".join([head, ends[:-1].astype("<i8").tobytes(), *chunks])


def decode(data: bytes, path: str | os.PathLike) -> tuple[dict[str, np.ndarray], str]:
    """Read a file's bytes.

    Parameters
    ----------
    data : bytes
        The file.
    path : str or Path
        Its name, for messages.

    Returns
    -------
    images : dict of str to float16 ndarray
        As `encode` takes them.
    note : str
        As well.

    Raises
    ------
    FileError
        The bytes are not such a file, whole; the message names the byte, what is wrong, and the remedy.
    """
    reader = _Reader(data, path)
    parts, note = reader.headers()
    return reader.images(parts), note


def note_of(data: bytes, path: str | os.PathLike) -> str:
    """Read a file's note, and nothing behind its headers.

    Parameters
    ----------
    data : bytes
        The file.
    path : str or Path
        Its name, for messages.

    Returns
    -------
    str
        As `encode` takes it.

    Raises
    ------
    FileError
        As `decode` raises it.
    """
    return _Reader(data, path).headers()[1]


def _header(name: str, shape: tuple[int, ...], display: tuple[int, int], note: str) -> bytes:
    """Attributes of a part, and their end."""
    height, width, count = (*shape, 1)[:3]
    attributes = [
        ("channels", "chlist", _channels(count)),
        ("chunkCount", "int", struct.pack("<i", -(-height // LINES))),
        ("compression", "compression", bytes([ZIP])),
        ("dataWindow", "box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)),
        ("displayWindow", "box2i", struct.pack("<4i", 0, 0, display[0] - 1, display[1] - 1)),
        ("lineOrder", "lineOrder", b"\0"),
        ("name", "string", name.encode()),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
        ("type", "string", b"scanlineimage"),
    ]
    attributes += [(NOTE, "string", note.encode())] if note else []
    packed = (f"{key}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value for key, kind, value in attributes)
    return b"".join(packed) + b"\0"


def _channels(count: int) -> bytes:
    """The list of a part's channels."""
    channel = struct.pack("<iB3xii", HALF, 0, 1, 1)
    return b"".join(letter.encode() + b"\0" + channel for letter in CHANNELS[count]) + b"\0"


def _blocks(pixels: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """First lines and lines of chunks."""
    return [(y, pixels[y : y + LINES]) for y in range(0, len(pixels), LINES)]


def _chunk(part: int, y: int, rows: np.ndarray) -> bytes:
    """A block of lines: channel by channel within each; all lower bytes, then all upper ones; differences; zlib."""
    planes = rows[:, :, None] if rows.ndim == 2 else rows[:, :, ::-1]
    raw = np.frombuffer(planes.transpose(0, 2, 1).astype("<f2").tobytes(), np.uint8)
    sorted_bytes = np.concatenate([raw[0::2], raw[1::2]])
    steps = sorted_bytes.copy()
    steps[1:] -= sorted_bytes[:-1]
    steps[1:] += np.uint8(128)
    packed = zlib.compress(steps.tobytes(), LEVEL)
    stored = packed if len(packed) < len(raw) else raw.tobytes()
    return CHUNK.pack(part, y, len(stored)) + stored


def _text(value: bytes) -> str:
    """A name or a note; bytes that are none become marks that no name has."""
    return value.decode(errors="replace")


class _Reader:
    """Walks through a file's bytes once, from the first to the last."""

    def __init__(self, data: bytes, path: str | os.PathLike) -> None:
        self._data, self._path, self._at = data, path, 0

    def headers(self) -> tuple[list[_Part], str]:
        """Headers of all parts, which have different names, and the note."""
        if self._take(min(len(MAGIC), len(self._data))) != MAGIC:
            self._at = 0
            raise self._error("this is no OpenEXR file of several parts")
        parts, note = [], ""
        while self._data[self._at : self._at + 1] != b"\0":
            attributes = self.attributes()
            note = note or _text(attributes.get(NOTE, b""))
            parts.append(self._part(attributes))
        self._at += 1
        if not parts or len({part.name for part in parts}) < len(parts):
            raise self._error("there is no part, or two have the same name")
        return parts, note

    def images(self, parts: list[_Part]) -> dict[str, np.ndarray]:
        """All images, once the headers are read."""
        table = np.frombuffer(self._take(OFFSET.size * sum(part.chunks for part in parts)), "<i8")
        chunks = iter(table.tolist())
        images = {part.name: self._pixels(number, part, chunks) for number, part in enumerate(parts)}
        if self._at != len(self._data):
            raise self._error("bytes follow after the last chunk")
        return images

    def attributes(self) -> dict[str, bytes]:
        """Values of one part's attributes by name."""
        found = {}
        while name := self._word():
            self._word()
            found[name] = self._take(*struct.unpack("<i", self._take(4)))
        return found

    def _error(self, reason: str) -> FileError:
        return FileError(self._path, self._at, f"{reason}; {REMEDY}")

    def _take(self, count: int) -> bytes:
        """The next bytes."""
        if count < 0 or count > len(self._data) - self._at:
            raise self._error(f"{count} bytes are missing")
        self._at += count
        return self._data[self._at - count : self._at]

    def _word(self) -> str:
        """The next zero-terminated name."""
        end = self._data.find(b"\0", self._at, self._at + LONGEST_NAME + 1)
        if end < 0:
            raise self._error("a name does not end")
        word = self._take(end - self._at)
        self._at += 1
        return _text(word)

    def _part(self, attributes: dict[str, bytes]) -> _Part:
        """What a header says, if it is one of those that `_header` writes."""
        try:
            name = _text(attributes["name"])
            low_x, low_y, width, height = np.frombuffer(attributes["dataWindow"], "<i4", 4).tolist()
            count = {_channels(n): n for n in CHANNELS}[attributes["channels"]]
        except (KeyError, ValueError):
            raise self._error(
                "a header lacks an attribute, is cut off, or has other channels than Y, or R, G and B"
            ) from None
        shape = (height + 1, width + 1) + (3,) * (count == 3)
        if (low_x, low_y) != (0, 0) or width < 0 or height < 0:
            raise self._error(f"part {name}: an image from {low_x}, {low_y} to {width}, {height}")
        wanted = _header(name, shape, (1, 1), "")
        for key, value in _Reader(wanted, self._path).attributes().items():
            if key != "displayWindow" and attributes.get(key) != value:
                raise self._error(f"part {name}: its attribute {key} is not what probes have")
        return _Part(name, shape, -(-shape[0] // LINES))

    def _pixels(self, number: int, part: _Part, offsets) -> np.ndarray:
        """One part's image; nothing is taken for it before all of its chunks are there."""
        blocks = []
        for y in range(0, part.shape[0], LINES):
            if next(offsets) != self._at:
                raise self._error(f"part {part.name}: a chunk is not where the table says")
            its_part, its_line, stored = CHUNK.unpack(self._take(CHUNK.size))
            if (its_part, its_line) != (number, y):
                raise self._error(f"line {its_line} of part {its_part} instead of line {y} of part {number}")
            lines = (min(LINES, part.shape[0] - y), *part.shape[2:], part.shape[1])
            blocks.append(self._block(stored, lines))
        pixels = np.concatenate(blocks)
        return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels.transpose(0, 2, 1)[:, :, ::-1])

    def _block(self, stored: int, shape: tuple[int, ...]) -> np.ndarray:
        """A chunk's numbers: lines, channels, columns."""
        length = 2 * int(np.prod(shape, dtype=object))
        data = self._take(stored)
        if stored != length:
            data = self._inflated(data, length)
        return np.frombuffer(data, "<f2").reshape(shape).astype(np.float16)

    def _inflated(self, data: bytes, length: int) -> bytes:
        """What `_chunk` has compressed."""
        try:
            inflate = zlib.decompressobj()
            steps = np.frombuffer(inflate.decompress(data, length + 1), np.uint8).copy()
        except (zlib.error, OverflowError):
            steps = np.zeros(0, np.uint8)
        if len(steps) != length or not inflate.eof or inflate.unused_data:
            raise self._error("a chunk cannot be decompressed")
        steps[1:] -= np.uint8(128)
        return np.cumsum(steps, dtype=np.uint8).reshape(2, -1).T.tobytes()
