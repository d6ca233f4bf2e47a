"""Snapshots on disk: what is written is what is read, digests, and every rule of the definition."""

from __future__ import annotations

import dataclasses
import re

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import snapshot_file
from gi_volumes.bake.snapshot import (
    Camera,
    Channel,
    Image,
    LightKind,
    Material,
    Note,
    ProbeEdits,
    Snapshot,
    SnapshotError,
    Texture,
)
from gi_volumes.tree import container
from gi_volumes.tree.container import FileError


def scene() -> Snapshot:
    """Something in every field."""
    rng = np.random.default_rng(1)
    texture = Texture(1, "a", (1.0, 0.25, 0.0, -0.5, 1.0, 1 / 3), "mirror", "closest")
    materials = (
        Material("plain"),
        Material(
            "ålles 'x'",
            base_color=Channel((0.1, 0.2, 1 / 3), Texture(0), True),
            emission=Channel((0.0, 1e6, 1e-6)),
            alpha=Channel((0.5,), texture),
            metallic=Channel((1.0,), Texture(2, "r")),
            alpha_mode="mask",
            alpha_cutoff=0.25,
            ior=1.33,
            specular_level=0.7,
        ),
    )
    parts = [(build_scenes.box((0, 0, 0), (1, 2, 3)), materials[0]), (build_scenes.plane(4.0), materials[1])]
    images = (
        Image("a", rng.integers(0, 256, (3, 5, 4), dtype=np.uint8)),
        Image("b", rng.integers(0, 256, (2, 2, 4), dtype=np.uint8), "linear"),
        Image("c", rng.random((4, 1, 4)).astype(np.float16), "float"),
    )
    lights = build_scenes.lamps(
        {"kind": LightKind.SUN, "frame": build_scenes.sun_frame((1, 2, 3)), "size": (0.01, 0), "name": "Sønne"},
        {"kind": LightKind.SPOT, "spot": (0.7, 0.3), "reflector": True, "shadow": False},
        {"kind": LightKind.ELLIPSE, "size": (1, 2), "position": (4e5, -1, 2)},
    )
    base = build_scenes.snapshot(
        parts, lights, rng.random((4, 8, 3)), (1024.0, -2048.0, 0.0), rng.random((14, 3, 2)), images
    )
    colors = rng.random((14, 3, 4)).astype(np.float32)
    matrix = (1.0, 0.0, 0.0, 3.0, 0.0, 1.0, 0.0, 4.0, 0.0, 0.0, 1.0, 5.0)
    return dataclasses.replace(
        base,
        geometry=dataclasses.replace(base.geometry, corner_colors=colors),
        cameras=(
            Camera("main", matrix, 0.7, (0.1, -0.2), False, (640, 360)),
            Camera("top", matrix, 4.0, orthographic=True),
        ),
        notes=(Note("hair", "not a mesh"),),
        probes=ProbeEdits(rng.normal(size=(2, 3)), np.sort(rng.normal(size=(3, 2, 3)), axis=1)),
        source="level.blend",
    )


def same(one, two) -> bool:
    """Equal in value, type, dtype and shape, all the way down."""
    if isinstance(one, np.ndarray):
        return one.dtype == two.dtype and one.shape == two.shape and np.array_equal(one, two)
    if dataclasses.is_dataclass(one):
        fields = dataclasses.fields(one)
        return type(one) is type(two) and all(same(getattr(one, f.name), getattr(two, f.name)) for f in fields)
    if isinstance(one, tuple):
        return isinstance(two, tuple) and len(one) == len(two) and all(map(same, one, two))
    return one == two


def test_what_is_saved_is_loaded_to_the_last_bit_and_read_only(tmp_path):
    snapshot = scene()
    size = snapshot_file.save(snapshot, tmp_path / "scene.giv")
    assert size == (tmp_path / "scene.giv").stat().st_size
    loaded = snapshot_file.load(tmp_path / "scene.giv")
    assert same(snapshot, loaded)
    assert not loaded.geometry.positions.flags.writeable
    assert not same(snapshot, dataclasses.replace(loaded, sky=loaded.sky + 1))


def test_a_scene_of_lamps_only_and_an_empty_one_are_saved_and_loaded(tmp_path):
    for snapshot in (build_scenes.snapshot([], build_scenes.lamps({})), build_scenes.snapshot([])):
        snapshot_file.save(snapshot, tmp_path / "scene.giv")
        assert same(snapshot, snapshot_file.load(tmp_path / "scene.giv"))
        assert len(snapshot_file.digest(snapshot)) == 32


def test_saving_twice_gives_the_same_bytes(tmp_path):
    snapshot_file.save(scene(), tmp_path / "a")
    snapshot_file.save(scene(), tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_digest_is_the_same_for_equal_scenes_before_and_after_a_file(tmp_path):
    snapshot_file.save(scene(), tmp_path / "scene.giv")
    digests = {snapshot_file.digest(s) for s in (scene(), scene(), snapshot_file.load(tmp_path / "scene.giv"))}
    assert len(digests) == 1
    assert re.fullmatch(r"[0-9a-f]{32}", digests.pop())


def test_whole_numbers_count_like_the_same_numbers_with_a_point(tmp_path):
    whole = dataclasses.replace(scene(), materials=(Material("m", Channel((1, 0, 0)), ior=1), Material("n")))
    point = dataclasses.replace(scene(), materials=(Material("m", Channel((1.0, 0.0, 0.0)), ior=1.0), Material("n")))
    snapshot_file.save(whole, tmp_path / "scene.giv")
    loaded = snapshot_file.load(tmp_path / "scene.giv")
    assert snapshot_file.digest(loaded) == snapshot_file.digest(whole) == snapshot_file.digest(point)


def with_field(snapshot: Snapshot, path: str, value) -> Snapshot:
    """A copy whose field at a dotted path is another; tuples are entered by number."""
    name, _, rest = path.partition(".")
    if isinstance(snapshot, tuple):
        items = list(snapshot)
        items[int(name)] = with_field(items[int(name)], rest, value) if rest else value
        return tuple(items)
    old = getattr(snapshot, name)
    return dataclasses.replace(snapshot, **{name: with_field(old, rest, value) if rest else value})


def at(snapshot: Snapshot, path: str):
    value = snapshot
    for name in path.split("."):
        value = value[int(name)] if isinstance(value, tuple) else getattr(value, name)
    return value


def nudged(array: np.ndarray) -> np.ndarray:
    """One element of an array changed by as little as its type allows."""
    copy = array.copy()
    flat = copy.reshape(-1)
    if array.dtype == bool or array.dtype.kind in "iu":
        flat[-1] = flat[-1] ^ 1
    else:
        flat[-1] = np.nextafter(flat[-1], np.asarray(9, array.dtype))
    return copy


ARRAYS = [f"geometry.{name}" for name in snapshot_file.GEOMETRY_LAYOUT]
ARRAYS += [f"lights.{name}" for name in snapshot_file.LIGHTS_LAYOUT]
ARRAYS += ["sky", "origin", "images.0.pixels", "images.2.pixels"]
VALUES = {
    "materials.1.base_color.factor": (0.1, 0.2, 0.3),
    "materials.1.base_color.vertex_color": False,
    "materials.1.base_color.texture": None,
    "materials.1.alpha.texture.channel": "r",
    "materials.1.alpha.texture.extension": "clip",
    "materials.1.alpha.texture.uv_from_mesh": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
    "materials.1.alpha_mode": "blend",
    "materials.1.alpha_cutoff": 0.26,
    "materials.1.ior": 1.34,
    "materials.0.specular_level": 0.0,
    "images.1.encoding": "srgb",
}


@pytest.mark.parametrize("path", ARRAYS)
def test_the_digest_changes_with_one_bit_of_any_array(path):
    snapshot = scene()
    changed = with_field(snapshot, path, nudged(at(snapshot, path)))
    assert snapshot_file.digest(changed) != snapshot_file.digest(snapshot)


@pytest.mark.parametrize("path", VALUES)
def test_the_digest_changes_with_any_setting_of_a_material_or_image(path):
    snapshot = scene()
    assert snapshot_file.digest(with_field(snapshot, path, VALUES[path])) != snapshot_file.digest(snapshot)


def test_the_digest_does_not_change_with_cameras_notes_probes_or_the_source():
    snapshot = scene()
    other = dataclasses.replace(snapshot, cameras=(), notes=(), probes=ProbeEdits(), source="elsewhere.blend")
    assert snapshot_file.digest(other) == snapshot_file.digest(snapshot)


def test_the_digest_tells_arrays_apart_that_hold_the_same_bytes():
    snapshot = scene()
    swapped = with_field(snapshot, "sky", np.ascontiguousarray(snapshot.sky.reshape(8, 4, 3)))
    assert snapshot_file.digest(swapped) != snapshot_file.digest(snapshot)


def holding(array: np.ndarray, value) -> np.ndarray:
    """A copy with one element replaced."""
    copy = array.copy()
    copy.reshape(-1)[0] = value
    return copy


BASE = scene()
TRIANGLES = len(BASE.geometry.triangles)
POSITIONS = len(BASE.geometry.positions)

VIOLATIONS = {
    "positions of double precision": ("geometry.positions", lambda a: a.astype(np.float64), "geometry.positions: want"),
    "triangles of four corners": (
        "geometry.triangles",
        lambda a: np.zeros((TRIANGLES, 4), np.int32),
        "geometry.triangles",
    ),
    "a NaN position": ("geometry.positions", lambda a: holding(a, np.nan), "positions: holds NaN"),
    "an infinite normal": ("geometry.corner_normals", lambda a: holding(a, np.inf), "corner_normals: holds NaN"),
    "a NaN uv": ("geometry.corner_uvs", lambda a: holding(a, np.nan), "corner_uvs: holds NaN"),
    "an infinite colour": ("geometry.corner_colors", lambda a: holding(a, np.inf), "corner_colors: holds NaN"),
    "a NaN transform": ("geometry.instance_transform", lambda a: holding(a, np.nan), "transform: holds NaN"),
    "a corner too many": ("geometry.triangles", lambda a: holding(a, POSITIONS), "geometry.triangles: an index"),
    "a negative corner": ("geometry.triangles", lambda a: holding(a, -1), "geometry.triangles: an index"),
    "a missing material": ("geometry.materials", lambda a: holding(a, 2), "geometry.materials: an index"),
    "a missing mesh": ("geometry.instance_mesh", lambda a: holding(a, 1), "geometry.instance_mesh: an index"),
    "too few normals": ("geometry.corner_normals", lambda a: a[1:], "geometry.corner_normals: 13 rows for 14"),
    "too few uvs": ("geometry.corner_uvs", lambda a: a[1:], "geometry.corner_uvs: 13 rows for 14"),
    "too many colours": ("geometry.corner_colors", lambda a: np.concatenate([a, a]), "geometry.corner_colors: 28 rows"),
    "too few materials": ("geometry.materials", lambda a: a[1:], "geometry.materials: 13 rows for 14"),
    "no meshes": ("geometry.mesh_first_triangle", lambda a: a[:0], "mesh_first_triangle: ends are off"),
    "meshes that start late": ("geometry.mesh_first_triangle", lambda a: holding(a, 1), "mesh_first_triangle: ends"),
    "meshes that end late": (
        "geometry.mesh_first_triangle",
        lambda a: np.array([0, TRIANGLES + 1], np.int64),
        "mesh_first_triangle: ends are off",
    ),
    "meshes out of order": (
        "geometry.mesh_first_triangle",
        lambda a: np.array([0, 9, 3, TRIANGLES], np.int64),
        "mesh_first_triangle: not ascending",
    ),
    "an instance without a transform": (
        "geometry.instance_transform",
        lambda a: a[:0],
        "geometry.instance_transform: one for each instance",
    ),
    "an instance without a name": ("geometry.instance_names", lambda a: (), "geometry.instance_names: one for each"),
    "lamps of unequal length": ("lights.position", lambda a: a[1:], "lights: arrays differ in length"),
    "a lamp without a name": ("lights.names", lambda a: a[1:], "lights: one name for each lamp"),
    "a NaN lamp": ("lights.position", lambda a: holding(a, np.nan), "lights.position: holds NaN"),
    "an infinite lamp": ("lights.strength", lambda a: holding(a, np.inf), "lights.strength: holds NaN"),
    "an unknown lamp": ("lights.kind", lambda a: holding(a, 5), "lights: kind is not a known shape"),
    "a negative lamp": ("lights.strength", lambda a: holding(a, -1), "lights: strength is negative; use"),
    "a lamp of negative size": ("lights.size", lambda a: holding(a, -1), "lights: size is negative"),
    "shadows that are numbers": ("lights.shadow", lambda a: a.astype(np.uint8), "lights.shadow: want bool"),
    "a flat sky": ("sky", lambda a: a[0], "sky: shape must be"),
    "a sky with alpha": ("sky", lambda a: np.zeros((2, 2, 4), np.float32), "sky: shape must be"),
    "a sky without texels": ("sky", lambda a: a[:0], "sky: shape must be"),
    "a sky of double precision": ("sky", lambda a: a.astype(np.float64), "sky: shape must be"),
    "a NaN sky": ("sky", lambda a: holding(a, np.nan), "sky: radiance must be finite"),
    "a negative sky": ("sky", lambda a: holding(a, -1e-6), "sky: radiance must be finite"),
    "a flat origin": ("origin", lambda a: a[:2], "origin: three"),
    "a NaN origin": ("origin", lambda a: holding(a, np.nan), "origin: three"),
    "an origin of single precision": ("origin", lambda a: a.astype(np.float32), "origin: three"),
    "an unknown encoding": ("images.0.encoding", lambda a: "jpeg", "image 'a': unknown encoding 'jpeg'"),
    "an image without alpha": ("images.0.pixels", lambda a: a[..., :3], "image 'a': want (h, w, 4) uint8"),
    "an image without texels": ("images.0.pixels", lambda a: a[:0], "image 'a': want (h, w, 4) uint8"),
    "floats called bytes": ("images.2.encoding", lambda a: "linear", "image 'c': want (h, w, 4) uint8"),
    "bytes called floats": ("images.0.encoding", lambda a: "float", "image 'a': want (h, w, 4) float16"),
    "an infinite texel": ("images.2.pixels", lambda a: holding(a, np.inf), "image 'c': NaN or infinity"),
    "an unknown alpha mode": ("materials.1.alpha_mode", lambda a: "cut", "unknown alpha mode"),
    "a gray base colour": ("materials.0.base_color.factor", lambda a: (0.5,), "'plain', base_color: 3 component"),
    "a coloured alpha": ("materials.0.alpha.factor", lambda a: (1.0,) * 3, "'plain', alpha: 1 component"),
    "a negative emission": ("materials.0.emission.factor", lambda a: (0.0, -1.0, 0.0), "emission: must be finite"),
    "a NaN roughness": ("materials.0.roughness.factor", lambda a: (np.nan,), "roughness: must be finite"),
    "an infinite emission": ("materials.0.emission.factor", lambda a: (np.inf,) * 3, "emission: must be finite"),
    "a missing image": ("materials.1.metallic.texture.image", lambda a: 3, "metallic: no such image"),
    "a negative image": ("materials.1.metallic.texture.image", lambda a: -1, "metallic: no such image"),
    "an unknown channel": ("materials.1.alpha.texture.channel", lambda a: "x", "alpha: texture"),
    "an unknown extension": ("materials.1.alpha.texture.extension", lambda a: "tile", "alpha: texture"),
    "an unknown interpolation": ("materials.1.alpha.texture.interpolation", lambda a: "cubic", "alpha: texture"),
    "a short uv map": ("materials.1.alpha.texture.uv_from_mesh", lambda a: (1.0, 0.0), "alpha: texture"),
    "a NaN uv map": ("materials.1.alpha.texture.uv_from_mesh", lambda a: (np.nan,) * 6, "alpha: texture"),
    "a NaN index of refraction": ("materials.0.ior", lambda a: np.nan, "'plain', ior: must be"),
    "no index of refraction": ("materials.0.ior", lambda a: -1.0, "'plain', ior: must be"),
    "an infinite specular level": ("materials.0.specular_level", lambda a: np.inf, "specular_level: must be"),
    "a negative specular level": ("materials.0.specular_level", lambda a: -0.5, "specular_level: must be"),
    "a NaN cutoff": ("materials.1.alpha_cutoff", lambda a: np.nan, "alpha_cutoff: must be"),
    "a NaN probe": ("probes.pinned", lambda a: holding(a, np.nan), "probes.pinned: holds NaN"),
    "a probe on a plane": ("probes.pinned", lambda a: a[:, :2], "probes.pinned: want float64"),
    "a deleted place": ("probes.deleted", lambda a: a[:, 0], "probes.deleted: want float64"),
    "an infinite deleted box": ("probes.deleted", lambda a: holding(a, -np.inf), "probes.deleted: holds NaN"),
    "a deleted box inside out": ("probes.deleted", lambda a: a[:, ::-1], "probes.deleted: a lowest corner"),
    "a camera of eleven numbers": ("cameras.0.world_from_camera", lambda a: a[:11], "camera 'main'"),
    "a NaN camera": ("cameras.0.half_width", lambda a: np.nan, "camera 'main'"),
    "a camera without pixels": ("cameras.1.resolution", lambda a: (0, 10), "camera 'top'"),
}


def test_the_scene_that_the_violations_are_planted_in_is_sound():
    snapshot_file.check(BASE)


@pytest.mark.parametrize("name", VIOLATIONS)
def test_every_broken_rule_is_refused_by_name_and_nothing_is_written(name, tmp_path):
    path, plant, message = VIOLATIONS[name]
    broken = with_field(BASE, path, plant(at(BASE, path)))
    with pytest.raises(SnapshotError, match=re.escape(message)):
        snapshot_file.check(broken)
    with pytest.raises(SnapshotError):
        snapshot_file.save(broken, tmp_path / "scene.giv")
    assert list(tmp_path.iterdir()) == []


def rewritten(tmp_path, change):
    """A file with sound checksums whose contents `change(arrays, meta)` spoiled."""
    snapshot_file.save(BASE, tmp_path / "good.giv")
    file = container.read(tmp_path / "good.giv", snapshot_file.KIND)
    arrays, meta = dict(file.arrays), file.meta
    change(arrays, meta)
    container.write(tmp_path / "bad.giv", snapshot_file.KIND, arrays, meta)
    return tmp_path / "bad.giv"


def test_a_file_that_says_nothing_of_probes_has_none_and_the_same_digest(tmp_path):
    path = rewritten(tmp_path, lambda arrays, meta: [arrays.pop(f"probes/{name}") for name in ("pinned", "deleted")])
    loaded = snapshot_file.load(path)
    assert same(loaded, dataclasses.replace(BASE, probes=ProbeEdits()))
    assert snapshot_file.digest(loaded) == snapshot_file.digest(BASE)


SPOILED = {
    "no positions": lambda arrays, meta: arrays.pop("geometry/positions"),
    "no sky": lambda arrays, meta: arrays.pop("sky"),
    "probes that are words": lambda arrays, meta: arrays.update({"probes/pinned": np.zeros((2, 3), np.int32)}),
    "no image": lambda arrays, meta: arrays.pop("image/1"),
    "no materials": lambda arrays, meta: meta.pop("materials"),
    "materials as a word": lambda arrays, meta: meta.update(materials="none"),
    "materials as numbers": lambda arrays, meta: meta.update(materials=[1, 2]),
    "a material of another version": lambda arrays, meta: meta["materials"][0].update(sheen=1.0),
    "a factor of words": lambda arrays, meta: meta["materials"][0]["alpha"].update(factor=["x"]),
    "a factor that is a number": lambda arrays, meta: meta["materials"][0]["alpha"].update(factor=1.0),
    "a channel that is missing": lambda arrays, meta: meta["materials"][0].update(alpha=None),
    "a channel that is a number": lambda arrays, meta: meta["materials"][0].update(alpha=0.5),
    "a refraction that is a word": lambda arrays, meta: meta["materials"][0].update(ior="glass"),
    "a cutoff that is missing": lambda arrays, meta: meta["materials"][0].update(alpha_cutoff=None),
    "an image number that is a word": lambda arrays, meta: meta["materials"][1]["alpha"]["texture"].update(image="b"),
    "an image number with a point": lambda arrays, meta: meta["materials"][1]["alpha"]["texture"].update(image=0.5),
    "a texture that is a number": lambda arrays, meta: meta["materials"][1]["alpha"].update(texture=3),
    "a camera of another version": lambda arrays, meta: meta["cameras"][0].update(lens=50.0),
    "a camera that is a word": lambda arrays, meta: meta.update(cameras=["main"]),
    "a width that is a word": lambda arrays, meta: meta["cameras"][0].update(half_width="wide"),
    "notes that are numbers": lambda arrays, meta: meta.update(notes=[3]),
    "names that are a number": lambda arrays, meta: meta.update(light_names=7),
    "an encoding that is missing": lambda arrays, meta: meta["images"][0].pop("encoding"),
    "an encoding that is a list": lambda arrays, meta: meta["images"][0].update(encoding=["srgb"]),
    "positions as bytes": lambda arrays, meta: arrays.update({"geometry/positions": np.zeros(3, np.uint8)}),
    "an index out of range": lambda arrays, meta: arrays.update(
        {"geometry/materials": arrays["geometry/materials"] + 9}
    ),
    "a number for a sky": lambda arrays, meta: arrays.update(sky=np.float32(1)),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_file_whose_contents_are_not_a_sound_snapshot_is_refused_in_one_line(name, tmp_path):
    path = rewritten(tmp_path, SPOILED[name])
    with pytest.raises((FileError, SnapshotError)) as caught:
        snapshot_file.load(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_was_not_spoiled_is_loaded(tmp_path):
    assert same(snapshot_file.load(rewritten(tmp_path, lambda arrays, meta: None)), BASE)


def test_a_damaged_truncated_or_foreign_file_is_refused_by_name(tmp_path):
    path = tmp_path / "scene.giv"
    snapshot_file.save(BASE, path)
    good = path.read_bytes()
    rng = np.random.default_rng(2)
    spots = np.concatenate([np.arange(64), rng.integers(64, len(good), 100)])
    for spot in spots:
        path.write_bytes(good[:spot] + bytes([good[spot] ^ 1 << int(spot) % 8]) + good[spot + 1 :])
        with pytest.raises(FileError, match=r"scene\.giv"):
            snapshot_file.load(path)
    for length in [*range(0, 64, 7), *rng.integers(64, len(good), 20)]:
        path.write_bytes(good[:length])
        with pytest.raises(FileError, match=r"scene\.giv"):
            snapshot_file.load(path)
    container.write(path, "payload", {}, {})
    with pytest.raises(FileError, match="not a 'snapshot' file"):
        snapshot_file.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises((FileError, OSError), match=r"nowhere\.giv"):
        snapshot_file.load(tmp_path / "nowhere.giv")


def test_saving_into_a_missing_folder_fails_and_leaves_nothing(tmp_path):
    with pytest.raises(OSError, match="missing"):
        snapshot_file.save(BASE, tmp_path / "missing" / "scene.giv")
    assert list(tmp_path.iterdir()) == []
