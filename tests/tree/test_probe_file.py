"""Probes on disk: as they were, be there none; damaged, forged and missing files say what is wrong and what to do."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import OpenEXR
import pytest
from gi_volumes.tree import exr, folder, octahedral, probe_file
from gi_volumes.tree.container import FileError
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.probe_atlas import fetch
from gi_volumes.tree.probe_maps import ProbeMaps, empty, part_names
from gi_volumes.tree.verify import verify

BAKE = "0123456789abcdef"


def maps_of(count: int, pitch: int = 16, parts: tuple[str, ...] = part_names(True, 2, 9), seed: int = 0) -> ProbeMaps:
    """Probes that see noise."""
    rng = np.random.default_rng(seed)
    maps = empty(rng.uniform(-1e4, 1e4, (count, 3)), rng.random(count) < 0.5, pitch, parts)
    for array in (*(level for levels in maps.radiance.values() for level in levels), maps.normal, maps.albedo):
        array[...] = rng.normal(size=array.shape)
    maps.distance[:, ::2] = rng.random(maps.distance[:, ::2].shape)
    return maps


def arrays_of(maps: ProbeMaps) -> list[np.ndarray]:
    levels = [level for part in maps.radiance.values() for level in part]
    return [maps.position, maps.pinned, *levels, maps.distance, maps.normal, maps.albedo]


def written(place, maps: ProbeMaps) -> dict:
    """Put probes into a bake of no cells; its header."""
    probe_file.write(place, maps, BAKE, "made")
    return folder.assemble(place, {"bake": BAKE, "grid": Grid(), "transports": {}})


@pytest.fixture
def bake(tmp_path):
    return tmp_path, written(tmp_path, maps_of(3))


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("parts", [(), ("sky",), part_names(True, 2, 9)])
def test_what_is_read_is_what_was_written(tmp_path, count, parts):
    maps = maps_of(count, parts=parts)
    header = written(tmp_path, maps)
    found = probe_file.load(tmp_path, folder.load_header(tmp_path))
    assert (found.layout, list(found.radiance)) == (maps.layout, list(parts))
    for one, other in zip(arrays_of(found), arrays_of(maps), strict=True):
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    assert header["probes"]["roughness"][-1] == 1
    assert verify(tmp_path) == []


def test_the_entry_names_the_file_and_its_hash(bake):
    place, header = bake
    entry = header["probes"]
    assert entry["file"]["name"] == "probes.exr"
    assert entry["file"]["bytes"] == (place / "probes.exr").stat().st_size
    assert (entry["bake"], entry["made"], entry["pitch"], entry["columns"], entry["rows"]) == (BAKE, "made", 16, 2, 2)
    assert probe_file.made_of(place, BAKE) == "made"
    assert probe_file.made_of(place, "another") is None
    assert place / "probes.exr" in folder.files(place)


def test_a_bake_without_probes_has_none(tmp_path):
    header = folder.assemble(tmp_path, {"bake": BAKE, "grid": Grid(), "transports": {}})
    assert "probes" not in header
    found = probe_file.load(tmp_path, header)
    assert (len(found.position), found.radiance) == (0, {})


def test_probes_of_another_bake_are_not_listed(tmp_path):
    probe_file.write(tmp_path, maps_of(1), "another", "made")
    assert "probes" not in folder.assemble(tmp_path, {"bake": BAKE, "grid": Grid(), "transports": {}})


def test_a_missing_file_is_said(bake):
    place, header = bake
    (place / "probes.exr").unlink()
    with pytest.raises(FileNotFoundError, match="bake again"):
        probe_file.load(place, header)
    assert [defect.file for defect in verify(place)] == ["probes.exr"]


def test_truncated_files_are_refused_at_any_length(bake):
    place, header = bake
    path = place / "probes.exr"
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 200).astype(int):
        path.write_bytes(whole[:length])
        with pytest.raises(FileError, match=r"probes\.exr: byte \d+: .*bake again"):
            probe_file.load(place, header)
        assert probe_file.made_of(place, BAKE) is None


def test_a_flipped_byte_is_always_found(bake):
    place, header = bake
    path = place / "probes.exr"
    whole = bytearray(path.read_bytes())
    for position in np.random.default_rng(0).permutation(len(whole))[:300]:
        whole[position] ^= 0x10
        path.write_bytes(whole)
        with pytest.raises(FileError, match="bake again"):
            probe_file.load(place, header)
        whole[position] ^= 0x10


def test_a_whole_file_that_is_another_one_is_refused(bake):
    place, header = bake
    probe_file.write(place, maps_of(3, seed=1), BAKE, "made")
    with pytest.raises(FileError, match="not the file that"):
        probe_file.load(place, header)


def forged(place, note: dict | None = None, **changes) -> None:
    """A file whose note or images are whatever a forger wants; images that are None are left out."""
    images, text = exr.decode((place / "probes.exr").read_bytes(), "")
    images = {name: image for name, image in (images | changes).items() if image is not None}
    (place / "probes.exr").write_bytes(exr.encode(images, json.dumps(json.loads(text) | (note or {}))))


@pytest.mark.parametrize(
    ("note", "reason"),
    [
        ({"positions": [[0, 0, 0]]}, "other tiles"),
        ({"positions": [[0, 0, 0]] * 2 + [[0, 0, float("nan")]]}, "no numbers"),
        ({"positions": [[0, 0]] * 3}, "three numbers"),
        ({"positions": [0] * 9}, "three numbers"),
        ({"said": None}, "which bake"),
        ({"positions": "everywhere"}, "could not convert|its note"),
        ({"positions": {}}, "its note"),
        ({"pitch": 17}, "power of two"),
        ({"pitch": 1 << 60}, "is missing|has the shape"),
        ({"pitch": 32}, "is missing|has the shape"),
        ({"pitch": None}, "its note"),
        ({"columns": 1 << 40}, "other tiles"),
        ({"pinned": [1, 0, 1]}, "pinned"),
        ({"pinned": [True]}, "pinned"),
        ({"parts": ["local", "local"]}, "unknown parts"),
        ({"parts": ["../../etc/passwd"]}, "unknown parts"),
        ({"parts": 7}, "unknown parts"),
        ({"parts": ["local"]}, "parts that probes do not have"),
        ({"parts": ["local", "sun.9"]}, "sun.9.level_0 is missing"),
        ({"bake": 1}, "which bake"),
    ],
)
def test_a_forged_note_is_refused(bake, note, reason):
    place, _ = bake
    forged(place, note)
    with pytest.raises(FileError, match=reason):
        probe_file.read(place / "probes.exr")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"distance": None}, "distance is missing"),
        ({"sun.1.level_1": None}, "sun.1.level_1 is missing"),
        ({"more": np.zeros((2, 2), np.float16)}, "do not have"),
        ({"normal": np.zeros((32, 32), np.float16)}, "normal has the shape"),
        ({"albedo": np.zeros((32, 31, 3), np.float16)}, "albedo has the shape"),
        ({"local.level_1": np.zeros((32, 32, 3), np.float16)}, "local.level_1 has the shape"),
        ({"local.level_0": np.full((32, 32, 3), np.nan, np.float16)}, "not finite"),
        ({"albedo": np.full((32, 32, 3), np.inf, np.float16)}, "not finite"),
        ({"distance": np.full((32, 32), -1, np.float16)}, "no distances"),
        ({"distance": np.full((32, 32), np.nan, np.float16)}, "no distances"),
    ],
)
def test_forged_images_are_refused(bake, changes, reason):
    place, _ = bake
    forged(place, **changes)
    with pytest.raises(FileError, match=reason):
        probe_file.read(place / "probes.exr")


@pytest.mark.parametrize(
    "note", ['{"bake": "0123456789abcdef"}', '{"bake": "0123456789abcdef", "made": "", "x": NaN}', "[]"]
)
def test_a_file_of_no_bake_is_not_listed(bake, note):
    place, _ = bake
    images, _ = exr.decode((place / "probes.exr").read_bytes(), "")
    (place / "probes.exr").write_bytes(exr.encode(images, note))
    assert probe_file.describe(place) is None
    assert "probes" not in folder.list_again(place)


def test_a_note_that_is_no_object_is_refused(bake):
    place, _ = bake
    images, _ = exr.decode((place / "probes.exr").read_bytes(), "")
    for text in ("", "[]", "7", "[" * 100_000, '"a"', "{}"):
        (place / "probes.exr").write_bytes(exr.encode(images, text))
        with pytest.raises(FileError, match="bake again"):
            probe_file.read(place / "probes.exr")
        assert "probes" not in folder.assemble(place, {"bake": BAKE, "grid": Grid(), "transports": {}})


def test_the_same_probes_have_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        probe_file.write(tmp_path / name, maps_of(2), BAKE, "made")
    assert (tmp_path / "a/probes.exr").read_bytes() == (tmp_path / "b/probes.exr").read_bytes()


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(OSError, match="cannot write"):
        probe_file.write(tmp_path / "nowhere", maps_of(1), BAKE, "made")


def test_a_part_that_was_changed_shows(bake):
    place, header = bake
    maps = probe_file.load(place, header)
    changed = dataclasses.replace(maps, position=maps.position + 1)
    probe_file.write(place, changed, BAKE, "made")
    assert [defect.file for defect in verify(place)] == ["probes.exr"]


def described_texel(direction, pitch: int, columns: int, probe: int) -> tuple[int, int]:
    """Line and column of the texel that shows a direction, as section 7 of docs/format.md has it."""
    x, y, z = direction
    s = abs(x) + abs(y) + abs(z)
    a, b = x / s, y / s
    if z < 0:
        a, b = (1 - abs(y / s)) * (1 if x >= 0 else -1), (1 - abs(x / s)) * (1 if y >= 0 else -1)
    n = pitch - 2
    line, column = (min(int((part + 1) / 2 * n), n - 1) for part in (b, a))
    return probe // columns * pitch + 1 + line, probe % columns * pitch + 1 + column


def test_the_format_s_library_and_the_description_find_what_look_ups_find(bake):
    place, header = bake
    entry, file = header["probes"], OpenEXR.File(str(place / "probes.exr"))
    assert json.loads(file.parts[0].header["gi_volumes"]) == {k: v for k, v in entry.items() if k != "file"}
    pixels = {part.name(): next(iter(part.channels.values())).pixels for part in file.parts}
    maps, level = probe_file.load(place, header), 1
    for probe in range(3):
        directions = octahedral.centers(maps.layout.sizes[level]).reshape(-1, 3)
        found = fetch(maps.radiance["sun.1"][level], maps.layout, level, np.full(len(directions), probe), directions)
        texels = [described_texel(d, entry["pitch"] >> level, entry["columns"], probe) for d in directions]
        assert found == pytest.approx(
            np.array([pixels["sun.1.level_1"][texel] for texel in texels]), rel=1e-3, abs=1e-3
        )
