"""Snapshots on disk: saved, loaded, checked and hashed.

Comes in: a `Snapshot`. Goes out: one container file, and a digest of everything that light depends on. A
loaded file is checked like any other untrusted input: every index and every number, before anything uses it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from pathlib import Path

import numpy as np

from ..tree import container
from .snapshot import (
    Camera,
    Channel,
    Geometry,
    Image,
    LightKind,
    Lights,
    Material,
    Note,
    ProbeEdits,
    Snapshot,
    SnapshotError,
    Texture,
)
from .textures import EXTENSIONS

KIND = "snapshot"
VERSION = 1
"""Of the definition. Fields added later have defaults and keep it; a change of meaning raises it."""

GEOMETRY_LAYOUT = {
    "positions": (np.float32, (None, 3)),
    "triangles": (np.int32, (None, 3)),
    "corner_normals": (np.float32, (None, 3, 3)),
    "corner_uvs": (np.float32, (None, 3, 2)),
    "corner_colors": (np.float32, (None, 3, 4)),
    "materials": (np.int32, (None,)),
    "mesh_first_triangle": (np.int64, (None,)),
    "instance_mesh": (np.int32, (None,)),
    "instance_transform": (np.float64, (None, 3, 4)),
}
LIGHTS_LAYOUT = {
    "kind": (np.uint8, (None,)),
    "position": (np.float64, (None, 3)),
    "frame": (np.float32, (None, 3, 3)),
    "strength": (np.float32, (None, 3)),
    "size": (np.float32, (None, 2)),
    "spot": (np.float32, (None, 2)),
    "reflector": (np.bool_, (None,)),
    "shadow": (np.bool_, (None,)),
}
PROBES_LAYOUT = {"pinned": (np.float64, (None, 3)), "deleted": (np.float64, (None, 2, 3))}
CHANNELS = ("rgb", "r", "g", "b", "a")
PIXEL_DTYPES = {"srgb": np.uint8, "linear": np.uint8, "float": np.float16}


def save(snapshot: Snapshot, path: Path | str) -> int:
    """Write a snapshot atomically.

    Parameters
    ----------
    snapshot : Snapshot
        What to write.
    path : Path or str
        File to create or replace.

    Returns
    -------
    int
        Size of the file [bytes].

    Raises
    ------
    SnapshotError
        The snapshot breaks a rule of its own definition.
    OSError
        The file cannot be written; nothing is left behind.
    """
    check(snapshot)
    arrays, meta = _to_container(snapshot)
    return container.write(Path(path), KIND, arrays, meta)


def load(path: Path | str) -> Snapshot:
    """Read a snapshot and check it.

    Parameters
    ----------
    path : Path or str
        A file made by `save`.

    Returns
    -------
    Snapshot
        The scene; its arrays are read-only.

    Raises
    ------
    FileError
        The file is missing, damaged, or not a snapshot.
    SnapshotError
        The file is whole, but what it says breaks a rule of the definition.
    """
    file = container.read(Path(path), KIND)
    try:
        snapshot = _from_container(file.arrays, file.meta)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise container.FileError(path, 0, f"not a snapshot that this version can read ({error!r})") from error
    check(snapshot)
    return snapshot


def digest(snapshot: Snapshot) -> str:
    """Hash everything that a bake's cells depend on: no names, cameras, notes or probes, nor where the scene came from.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.

    Returns
    -------
    str
        32 hexadecimal digits; equal for equal scenes on every machine.
    """
    arrays, meta = _to_container(_nameless(snapshot))
    state = hashlib.blake2b(json.dumps(meta, sort_keys=True).encode(), digest_size=16)
    for name in sorted(name for name in arrays if not name.startswith("probes/")):
        array = np.ascontiguousarray(arrays[name])
        state.update(f"{name}{array.dtype.str}{array.shape}".encode())
        state.update(array.data)
    return state.hexdigest()


def _nameless(snapshot: Snapshot) -> Snapshot:
    """What light depends on: renaming things must not ask for a new bake."""
    geometry = dataclasses.replace(snapshot.geometry, instance_names=("",) * len(snapshot.geometry.instance_names))
    return dataclasses.replace(
        snapshot,
        geometry=geometry,
        materials=tuple(dataclasses.replace(material, name="") for material in snapshot.materials),
        images=tuple(dataclasses.replace(image, name="") for image in snapshot.images),
        lights=dataclasses.replace(snapshot.lights, names=("",) * len(snapshot.lights.names)),
        cameras=(),
        notes=(),
        source="",
    )


def check(snapshot: Snapshot) -> None:
    """Verify every rule of the data definition.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.

    Raises
    ------
    SnapshotError
        Names the first rule that is broken, and where.
    """
    geometry, lights = snapshot.geometry, snapshot.lights
    _check_layout("geometry", geometry, GEOMETRY_LAYOUT)
    _check_layout("lights", lights, LIGHTS_LAYOUT)
    _check_layout("probes", snapshot.probes, PROBES_LAYOUT)
    low, high = snapshot.probes.deleted[:, 0], snapshot.probes.deleted[:, 1]
    _require(bool((low <= high).all()), "probes.deleted: a lowest corner is above the highest one")
    _check_geometry(geometry, len(snapshot.materials))
    _require(len(lights.names) == len(lights.kind), "lights: one name for each lamp")
    _require(bool((lights.kind <= max(LightKind)).all()), "lights: kind is not a known shape")
    _require(bool((lights.strength >= 0).all()), "lights: strength is negative; use a positive power")
    _require(bool((lights.size >= 0).all()), "lights: size is negative")
    _check_sky(snapshot.sky)
    origin = snapshot.origin
    _require(origin.shape == (3,) and origin.dtype == np.float64, "origin: three float64 numbers expected")
    _require(bool(np.isfinite(origin).all()), "origin: three finite numbers expected")
    for image in snapshot.images:
        _check_image(image)
    for material in snapshot.materials:
        _check_material(material, len(snapshot.images))
    for camera in snapshot.cameras:
        _check_camera(camera)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise SnapshotError(f"snapshot, {message}")


def _check_layout(name: str, record, layout: dict) -> None:
    """Dtype, shape, equal first dimensions of parallel arrays, and finiteness."""
    for field, (dtype, shape) in layout.items():
        array = getattr(record, field)
        fits = array.dtype == dtype and array.ndim == len(shape)
        fits = fits and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
        _require(fits, f"{name}.{field}: want {np.dtype(dtype).name} {shape}, got {array.dtype} {array.shape}")
        if array.dtype.kind == "f":
            _require(bool(np.isfinite(array).all()), f"{name}.{field}: holds NaN or infinity")
    if name == "lights":
        rows = {len(getattr(record, field)) for field in layout}
        _require(len(rows) == 1, "lights: arrays differ in length")


def _check_geometry(geometry: Geometry, material_count: int) -> None:
    rows = len(geometry.triangles)
    for field in ("corner_normals", "corner_uvs", "corner_colors", "materials"):
        length = len(getattr(geometry, field))
        optional = field in ("corner_uvs", "corner_colors") and length == 0
        _require(optional or length == rows, f"geometry.{field}: {length} rows for {rows} triangles")
    first = geometry.mesh_first_triangle
    _require(len(first) > 0 and first[0] == 0 and first[-1] == rows, "geometry.mesh_first_triangle: ends are off")
    _require(bool((np.diff(first) >= 0).all()), "geometry.mesh_first_triangle: not ascending")
    instances = len(geometry.instance_mesh)
    _require(len(geometry.instance_transform) == instances, "geometry.instance_transform: one for each instance")
    _require(len(geometry.instance_names) == instances, "geometry.instance_names: one for each instance")
    _check_range("geometry.triangles", geometry.triangles, len(geometry.positions))
    _check_range("geometry.materials", geometry.materials, material_count)
    _check_range("geometry.instance_mesh", geometry.instance_mesh, len(first) - 1)


def _check_range(name: str, index: np.ndarray, end: int) -> None:
    inside = index.size == 0 or (index.min() >= 0 and index.max() < end)
    _require(bool(inside), f"{name}: an index is outside 0..{end - 1}")


def _check_image(image: Image) -> None:
    _require(image.encoding in PIXEL_DTYPES, f"image {image.name!r}: unknown encoding {image.encoding!r}")
    pixels = image.pixels
    fits = (
        pixels.ndim == 3 and pixels.shape[2] == 4 and pixels.size > 0 and pixels.dtype == PIXEL_DTYPES[image.encoding]
    )
    _require(fits, f"image {image.name!r}: want (h, w, 4) {np.dtype(PIXEL_DTYPES[image.encoding]).name}")
    _require(pixels.dtype == np.uint8 or bool(np.isfinite(pixels).all()), f"image {image.name!r}: NaN or infinity")


def _check_sky(sky: np.ndarray) -> None:
    fits = sky.ndim == 3 and sky.shape[2] == 3 and sky.size > 0 and sky.dtype == np.float32
    _require(fits, "sky: shape must be (h, w, 3), float32")
    _require(bool(np.isfinite(sky).all() and (sky >= 0).all()), "sky: radiance must be finite and not negative")


def _check_material(material: Material, image_count: int) -> None:
    where = f"material {material.name!r}"
    _check_types(where, material)
    _require(material.alpha_mode in ("opaque", "mask", "blend"), f"{where}: unknown alpha mode")
    _require(np.isfinite(material.ior) and material.ior > 0, f"{where}, ior: must be finite and positive")
    _require(_is_amount(material.specular_level), f"{where}, specular_level: must be finite and not negative")
    _require(_is_amount(material.alpha_cutoff), f"{where}, alpha_cutoff: must be finite and not negative")
    for field in dataclasses.fields(Material):
        channel = getattr(material, field.name)
        if not isinstance(channel, Channel):
            continue
        want = 3 if field.name in ("base_color", "emission") else 1
        _require(len(channel.factor) == want, f"{where}, {field.name}: {want} component(s) expected")
        _require(all(map(_is_amount, channel.factor)), f"{where}, {field.name}: must be finite and not negative")
        if channel.texture is not None:
            _check_texture(f"{where}, {field.name}", channel.texture, image_count)


def _check_texture(where: str, texture: Texture, image_count: int) -> None:
    _require(0 <= texture.image < image_count, f"{where}: no such image")
    _require(texture.channel in CHANNELS, f"{where}: texture reads an unknown channel {texture.channel!r}")
    _require(texture.extension in EXTENSIONS, f"{where}: texture has an unknown extension {texture.extension!r}")
    known = texture.interpolation in ("linear", "closest")
    _require(known, f"{where}: texture has an unknown interpolation {texture.interpolation!r}")
    affine = len(texture.uv_from_mesh) == 6 and bool(np.isfinite(texture.uv_from_mesh).all())
    _require(affine, f"{where}: texture is placed by other than six finite numbers")


def _check_camera(camera: Camera) -> None:
    where = f"camera {camera.name!r}"
    _check_types(where, camera)
    numbers = (*camera.world_from_camera, camera.half_width, *camera.shift)
    _require(len(camera.world_from_camera) == 12, f"{where}: its matrix needs 12 numbers")
    _require(bool(np.isfinite(numbers).all()) and camera.half_width > 0, f"{where}: must be finite, with some width")
    _require(min(camera.resolution) > 0, f"{where}: its resolution has no pixels")


def _check_types(where: str, record) -> None:
    try:
        _plain(record)
    except ValueError as error:
        raise SnapshotError(f"snapshot, {where}: {error}") from error


def _is_amount(value: float) -> bool:
    """Whether a number is finite and not negative."""
    return bool(np.isfinite(value)) and value >= 0


def _to_container(snapshot: Snapshot) -> tuple[dict[str, np.ndarray], dict]:
    arrays = {f"geometry/{name}": getattr(snapshot.geometry, name) for name in GEOMETRY_LAYOUT}
    arrays |= {f"lights/{name}": getattr(snapshot.lights, name) for name in LIGHTS_LAYOUT}
    arrays |= {f"probes/{name}": getattr(snapshot.probes, name) for name in PROBES_LAYOUT}
    arrays |= {f"image/{i}": image.pixels for i, image in enumerate(snapshot.images)}
    arrays |= {"sky": snapshot.sky, "origin": snapshot.origin}
    meta = {
        "version": VERSION,
        "instance_names": list(snapshot.geometry.instance_names),
        "light_names": list(snapshot.lights.names),
        "images": [{"name": image.name, "encoding": image.encoding} for image in snapshot.images],
        "materials": [_plain(material) for material in snapshot.materials],
        "cameras": [_plain(camera) for camera in snapshot.cameras],
        "notes": [_plain(note) for note in snapshot.notes],
        "source": snapshot.source,
    }
    return arrays, meta


def _from_container(arrays: dict[str, np.ndarray], meta: dict) -> Snapshot:
    if _build(int, meta["version"]) > VERSION:
        raise ValueError(f"version {meta['version']}; this program reads up to {VERSION}")
    geometry = {name: arrays[f"geometry/{name}"] for name in GEOMETRY_LAYOUT}
    lights = {name: arrays[f"lights/{name}"] for name in LIGHTS_LAYOUT}
    probes = {name: arrays[f"probes/{name}"] for name in PROBES_LAYOUT if f"probes/{name}" in arrays}
    labels = [(_build(str, entry["name"]), _build(str, entry["encoding"])) for entry in meta["images"]]
    return Snapshot(
        origin=arrays["origin"],
        geometry=Geometry(**geometry, instance_names=_build(tuple[str, ...], meta["instance_names"])),
        materials=_build(tuple[Material, ...], meta["materials"]),
        images=tuple(Image(name, arrays[f"image/{i}"], encoding) for i, (name, encoding) in enumerate(labels)),
        lights=Lights(**lights, names=_build(tuple[str, ...], meta["light_names"])),
        sky=arrays["sky"],
        cameras=_build(tuple[Camera, ...], meta["cameras"]),
        notes=_build(tuple[Note, ...], meta["notes"]),
        probes=ProbeEdits(**probes),
        source=_build(str, meta["source"]),
    )


def _build(kind, value):
    """A value from outside as what a record's field is declared to be; anything else is a ValueError."""
    if dataclasses.is_dataclass(kind):
        kinds = typing.get_type_hints(kind)
        if not isinstance(value, dict) or not set(value) <= set(kinds):
            raise ValueError(f"{kind.__name__} has the fields {', '.join(kinds)}")
        missing = {f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING} - set(value)
        if missing:
            raise ValueError(f"{kind.__name__} lacks {', '.join(sorted(missing))}")
        return kind(**{name: _build(kinds[name], value[name]) for name in value})
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"{value!r} is not a list")
        items = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return tuple(_build(item, part) for item, part in zip(items, value, strict=True))
    if type(None) in parts:
        return None if value is None else _build(parts[0], value)
    fits = isinstance(value, (int, float) if kind is float else kind)
    if not fits or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{value!r} is not {kind.__name__}")
    return kind(value)


def _plain(record) -> dict:
    """A record as JSON; whole numbers become floats where those are declared, so that equal scenes stay equal."""
    return dataclasses.asdict(_build(type(record), dataclasses.asdict(record)))
