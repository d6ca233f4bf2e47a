"""A scene as plain arrays: the only thing that crosses from Blender to the bake.

Comes in: arrays read from a scene by `operators/`. Goes out: one immutable record (`snapshot_file` saves, loads,
checks and hashes it). Meshes are stored once and placed by instances, in double precision, so that a scene far
from the world origin keeps its detail. Units: metres, radiance W/(m2 sr), linear Rec.709, z up, right-handed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class SnapshotError(ValueError):
    """A scene that cannot be baked; the message says what is wrong, where, and the remedy."""


class LightKind(IntEnum):
    """Shapes of lamps."""

    POINT = 0
    SPOT = 1
    RECTANGLE = 2
    ELLIPSE = 3
    SUN = 4


@dataclass(frozen=True)
class Texture:
    """How an image is read: `image` indexes `Snapshot.images`; `channel` is "rgb", "r", "g", "b" or "a".

    `uv_from_mesh` is a 2x3 affine map of the mesh's UV (row-major tuple of 6), `extension` one of
    "repeat", "extend", "clip", "mirror", `interpolation` "linear" or "closest".
    """

    image: int
    channel: str = "rgb"
    uv_from_mesh: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    extension: str = "repeat"
    interpolation: str = "linear"


@dataclass(frozen=True)
class Channel:
    """A material input: `factor` times the texture, if any, times the mesh's vertex colour, if asked for.

    `factor` has three components for colours and one for scalars. A scalar reads the vertex colour's alpha.
    """

    factor: tuple[float, ...]
    texture: Texture | None = None
    vertex_color: bool = False


@dataclass(frozen=True)
class Material:
    """Surface parameters in the terms of the Principled shader; both sides reflect and emit.

    `emission` is radiance [W/(m2 sr)]. `alpha_mode` is "opaque", "mask" (pass through where alpha is below
    `alpha_cutoff`) or "blend" (pass through with probability 1 - alpha). `transmission` lets light pass
    straight through, tinted by the base colour.
    """

    name: str
    base_color: Channel = Channel((0.8, 0.8, 0.8))
    emission: Channel = Channel((0.0, 0.0, 0.0))
    alpha: Channel = Channel((1.0,))
    metallic: Channel = Channel((0.0,))
    roughness: Channel = Channel((0.5,))
    transmission: Channel = Channel((0.0,))
    ior: float = 1.5
    specular_level: float = 0.5
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5


@dataclass(frozen=True)
class Image:
    """Pixels of a texture, row 0 at v = 0.

    `pixels` is (h, w, 4) uint8 when `encoding` is "srgb" or "linear" (value / 255), and (h, w, 4) float16
    when it is "float". Alpha is never sRGB-encoded and the colour is not premultiplied.
    """

    name: str
    pixels: np.ndarray
    encoding: str = "srgb"


@dataclass(frozen=True)
class Geometry:
    """Meshes, stored once, and their instances.

    positions : (v, 3) float32 [m], in mesh space, all meshes one after the other
    triangles : (t, 3) int32, rows of `positions`
    corner_normals : (t, 3, 3) float32, unit length, in mesh space
    corner_uvs : (t, 3, 2) float32, or (0, 3, 2) when no material reads a texture
    corner_colors : (t, 3, 4) float32 linear, or (0, 3, 4) when no material reads vertex colours
    materials : (t,) int32, rows of `Snapshot.materials`
    mesh_first_triangle : (m + 1,) int64, mesh i owns the triangles [first[i], first[i + 1])
    instance_mesh : (k,) int32, the mesh that is placed
    instance_transform : (k, 3, 4) float64 [m], world_from_mesh; may mirror and scale unevenly
    instance_names : k names, for messages
    """

    positions: np.ndarray
    triangles: np.ndarray
    corner_normals: np.ndarray
    corner_uvs: np.ndarray
    corner_colors: np.ndarray
    materials: np.ndarray
    mesh_first_triangle: np.ndarray
    instance_mesh: np.ndarray
    instance_transform: np.ndarray
    instance_names: tuple[str, ...]


@dataclass(frozen=True)
class Lights:
    """Lamps; every array has one row for each.

    kind : (n,) uint8, `LightKind`
    position : (n, 3) float64 [m], world space (unused for a sun)
    frame : (n, 3, 3) float32, world_from_light rotation; the columns are its axes, it shines along -z
    strength : (n, 3) float32; point and spot: radiant intensity [W/sr] (on the axis of a spot); rectangle
        and ellipse: radiance [W/(m2 sr)] of the side it shines to; sun: irradiance on a surface that faces
        it [W/m2]
    size : (n, 2) float32; point and spot: (radius [m], 0 for soft falloff I / (d^2 + r^2), 1 for a sphere's I / d^2);
        rectangle and ellipse: full width along x and height along y [m]; sun: (angular diameter [rad], 0)
    spot : (n, 2) float32, (cosine of half the cone, blend 0..1); (-1, 0) for other lamps
    reflector : (n,) bool, baked only: its direct light is part of the local transport
    shadow : (n,) bool, whether it casts shadows
    names : n names, for messages
    """

    kind: np.ndarray
    position: np.ndarray
    frame: np.ndarray
    strength: np.ndarray
    size: np.ndarray
    spot: np.ndarray
    reflector: np.ndarray
    shadow: np.ndarray
    names: tuple[str, ...]


@dataclass(frozen=True)
class Camera:
    """A pinhole or orthographic camera that looks along -z, with y up.

    `world_from_camera` is a row-major 3x4 matrix. `half_width` is the tangent of half the horizontal field
    of view, or half the width [m] when `orthographic`; it and `shift` are for the full `resolution` (w, h).
    `shift` moves the frame, in units of its width.
    """

    name: str
    world_from_camera: tuple[float, ...]
    half_width: float
    shift: tuple[float, float] = (0.0, 0.0)
    orthographic: bool = False
    resolution: tuple[int, int] = (1920, 1080)


@dataclass(frozen=True)
class Note:
    """Something that the snapshot represents otherwise than the scene: what it is and what was used instead."""

    what: str
    why: str


@dataclass(frozen=True, eq=False)
class ProbeEdits:
    """What an artist says about reflection probes; nothing else of a bake depends on it.

    pinned : (m, 3) float64 [m], places in world space where probes are in any case
    deleted : (b, 2, 3) float64 [m], lowest and highest corners of boxes in world space that get no others
    """

    pinned: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    deleted: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))


@dataclass(frozen=True)
class Snapshot:
    """One scene.

    `origin` (3,) float64 [m] is a multiple of 1024 m near the scene's centre; the bake works relative to it.
    `sky` is (h, w, 3) float32 radiance [W/(m2 sr)] on Blender's equirectangular map, row 0 at the nadir
    (`u = 0.5 - atan2(y, x) / 2 pi`, `v = 0.5 + atan2(z, hypot(x, y)) / pi`); (1, 1, 3) when it is constant.
    """

    origin: np.ndarray
    geometry: Geometry
    materials: tuple[Material, ...]
    images: tuple[Image, ...]
    lights: Lights
    sky: np.ndarray
    cameras: tuple[Camera, ...] = ()
    notes: tuple[Note, ...] = ()
    probes: ProbeEdits = field(default_factory=ProbeEdits)
    source: str = field(default="", compare=False)
