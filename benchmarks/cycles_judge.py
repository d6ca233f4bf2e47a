"""Irradiance by Cycles at chosen points of the open Blender scene: the independent judge of our own transport.

Comes in: the scene that is open in `bpy`, points and normals. Goes out: irradiance [W/m2] and its standard error.
The idea: one small quad for each point, in one mesh that no ray can see, with one texel for each quad; baking the
DIFFUSE pass without its colour makes Cycles estimate irradiance / pi there. Lamps, emission and world are switched
so that the passes add up to one transport; every switch is taken back, and the quads are removed, at the end.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from .scene_edits import Changes, emission_off, ensure_nodes, sources_off, uniform_world

HALF_SIZE = 2.5e-4
"""Half the edge of a quad [m], near the origin: four times that already averages over detail, by 0.5 % in sponza."""

HALF_SIZE_RELATIVE = 2.5e-5
"""Half the edge of a quad over its distance from the origin: float32 corners then tilt its normal by at most 3e-3."""

ATLAS_WIDTH = 256
"""Texels in a row of the image that is baked."""

RAY_KINDS = ("diffuse", "glossy", "transmission", "volume_scatter", "shadow")
"""Rays that do not see the quads. Cameras have to: Cycles bakes nothing else, and a bake has no camera rays."""

LAMP_SOURCES = frozenset({"lamp", "reflector", "sun"})


@dataclass(frozen=True)
class Settings:
    """How Cycles is run; the defaults leave out everything that is biased.

    `bounces` is Cycles' `max_bounces` for every kind of scattering: so many surfaces after the point scatter light
    of lamps, and emission and sky are seen one surface further. `seeds` are independent runs of `samples` each.
    Paths may end by chance after `sure_bounces`, with -1 never.
    """

    samples: int = 64
    bounces: int = 4
    seeds: tuple[int, ...] = (1, 2)
    threads: int = 2
    light_tree: bool = True
    caustics: bool = True
    sure_bounces: int = -1


@dataclass(frozen=True)
class Estimate:
    """Irradiance and how well it is known.

    Parameters
    ----------
    mean : (n, 3) float64 [W/m2]
        Linear Rec.709.
    error : (n, 3) float64 [W/m2]
        Standard error of `mean`, from the scatter of the seeds; NaN for one seed.
    runs : (k, n, 3) float64 [W/m2]
        One for each seed.
    """

    mean: np.ndarray
    error: np.ndarray
    runs: np.ndarray


@dataclass(frozen=True)
class Pass:
    """One bake: the light sources that are on, and the parts of their light that count."""

    sources: frozenset[str]
    parts: frozenset[str]


TRANSPORTS = {
    "sky": (Pass(frozenset({"world"}), frozenset({"DIRECT", "INDIRECT"})),),
    "sun": (Pass(frozenset({"sun"}), frozenset({"INDIRECT"})),),
    "local": (
        Pass(frozenset({"emission", "reflector"}), frozenset({"DIRECT", "INDIRECT"})),
        Pass(frozenset({"lamp"}), frozenset({"INDIRECT"})),
    ),
    "direct": (Pass(frozenset({"lamp", "reflector", "sun"}), frozenset({"DIRECT"})),),
    "emission_direct": (Pass(frozenset({"emission"}), frozenset({"DIRECT"})),),
    "emission_indirect": (Pass(frozenset({"emission"}), frozenset({"INDIRECT"})),),
}
"""Bakes that add up to a transport. Light that goes from an emissive surface or the sky straight to the point is
"DIRECT" for Cycles, however it was sampled, so that indirect passes of lamps never hold any of it."""


def irradiance(
    points: np.ndarray, normals: np.ndarray, transport: str | tuple[Pass, ...], settings: Settings | None = None
) -> Estimate:
    """Estimate one transport at points of the open scene.

    Parameters
    ----------
    points : (n, 3) float64 [m]
        In world space.
    normals : (n, 3) float64
        Unit length.
    transport : str or tuple of Pass
        A key of `TRANSPORTS`, or bakes to add up. "sun" is lit by the suns at their own strength.
    settings : Settings, optional
        How Cycles is run.

    Returns
    -------
    Estimate
        Of n points.

    Raises
    ------
    ValueError
        The arrays are not (n, 3) and finite, or the transport is unknown.

    Error
    -----
    Unbiased but for float32 texels; closed forms hold in tests/judge/test_cycles_judge.py.
    """
    settings = settings or Settings()
    points, normals = _checked(points, normals)
    if isinstance(transport, str) and transport not in TRANSPORTS:
        raise ValueError(f"transport is {transport!r}; it must be one of {', '.join(TRANSPORTS)}")
    runs = np.zeros((len(settings.seeds), len(points), 3))
    with Changes() as changes, _quads(points, normals) as atlas:
        _configure(changes, settings)
        for part in TRANSPORTS[transport] if isinstance(transport, str) else transport:
            runs += _bake_pass(part, settings.seeds, atlas)[:, : len(points)]
    spread = runs.std(axis=0, ddof=1) if len(runs) > 1 else np.full(runs.shape[1:], np.nan)
    return Estimate(runs.mean(axis=0), spread / np.sqrt(len(runs)), runs)


def _checked(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals as float64, refused where Cycles would fail silently."""
    points, normals = (np.asarray(array, np.float64) for array in (points, normals))
    if points.ndim != 2 or points.shape[1:] != (3,) or points.shape != normals.shape or not len(points):
        raise ValueError(f"points {points.shape} and normals {normals.shape} must both be (n, 3) with n > 0")
    if not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise ValueError("points and normals must be finite")
    return points, normals


def _configure(changes: Changes, settings: Settings) -> None:
    """Set Cycles up for an unbiased estimate, as asked."""
    scene = bpy.context.scene
    bounces = ("max", "diffuse", "glossy", "transmission")
    wanted = {f"{kind}_bounces": settings.bounces for kind in bounces} | {
        "device": "CPU",
        "samples": settings.samples,
        "use_adaptive_sampling": False,
        "use_denoising": False,
        "use_light_tree": settings.light_tree,
        "light_sampling_threshold": 0.0,
        "sample_clamp_direct": 0.0,
        "sample_clamp_indirect": 0.0,
        "blur_glossy": 0.0,
        "caustics_reflective": settings.caustics,
        "caustics_refractive": settings.caustics,
        "min_light_bounces": settings.bounces if settings.sure_bounces < 0 else settings.sure_bounces,
        "transparent_max_bounces": 64,
        "use_fast_gi": False,
        "film_exposure": 1.0,
        "use_animated_seed": False,
    }
    changes.set(scene.render, engine="CYCLES", use_simplify=False, threads_mode="FIXED", threads=settings.threads)
    changes.set(scene.cycles, **wanted)
    changes.set(bpy.context.view_layer, material_override=None)


def _bake_pass(part: Pass, seeds: tuple[int, ...], atlas: bpy.types.Image) -> np.ndarray:
    """Irradiance (k, texels, 3) of one pass, for each seed."""
    scene = bpy.context.scene
    with Changes() as changes:
        sources_off(changes, LAMP_SOURCES - part.sources)
        if "emission" not in part.sources:
            emission_off(changes)
        if "world" not in part.sources:
            changes.set(scene, world=uniform_world("judge: black", 0.0))
        runs = []
        for seed in seeds:
            changes.set(scene.cycles, seed=seed)
            bpy.ops.object.bake(
                type="DIFFUSE", pass_filter=set(part.parts), target="IMAGE_TEXTURES", margin=0, use_clear=True
            )
            texels = np.empty(len(atlas.pixels), np.float32)
            atlas.pixels.foreach_get(texels)
            runs.append(texels.reshape(-1, 4)[:, :3].astype(np.float64) * np.pi)
    return np.stack(runs)


@contextlib.contextmanager
def _quads(points: np.ndarray, normals: np.ndarray) -> Iterator[bpy.types.Image]:
    """Put the quads into the scene, alone selected; yields the image that their texels are baked into."""
    scene, view_layer = bpy.context.scene, bpy.context.view_layer
    rows = -(-len(points) // ATLAS_WIDTH)
    image = bpy.data.images.new("judge", ATLAS_WIDTH, rows, float_buffer=True, is_data=True)
    mesh = _mesh(points, normals, rows)
    mesh.materials.append(_material(image))
    quads = bpy.data.objects.new("judge", mesh)
    for kind in RAY_KINDS:
        setattr(quads, f"visible_{kind}", False)
    view_layer.update()
    selected = [item for item in view_layer.objects if item.select_get()]
    active = view_layer.objects.active
    scene.collection.objects.link(quads)
    try:
        for item in selected:
            item.select_set(False)
        quads.select_set(True)
        view_layer.objects.active = quads
        yield image
    finally:
        material = mesh.materials[0]
        bpy.data.objects.remove(quads)
        bpy.data.meshes.remove(mesh)
        bpy.data.materials.remove(material)
        bpy.data.images.remove(image)
        for item in selected:
            item.select_set(True)
        view_layer.objects.active = active


def _mesh(points: np.ndarray, normals: np.ndarray, rows: int) -> bpy.types.Mesh:
    """One quad for each point, and texel i of an image of `rows` rows as the UVs of quad i."""
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float64)
    tangent, bitangent = _tangents(normals)
    half = np.maximum(HALF_SIZE, HALF_SIZE_RELATIVE * np.linalg.norm(points, axis=1))[:, None, None]
    offset = corner[:, :1] * tangent[:, None] + corner[:, 1:] * bitangent[:, None]
    texel = np.arange(len(points))
    uv = np.stack([texel % ATLAS_WIDTH, texel // ATLAS_WIDTH], axis=1)[:, None] + (corner + 1) / 2
    count = len(points)
    mesh = bpy.data.meshes.new("judge")
    mesh.vertices.add(4 * count)
    mesh.loops.add(4 * count)
    mesh.polygons.add(count)
    mesh.vertices.foreach_set("co", (points[:, None] + half * offset).astype(np.float32).ravel())
    mesh.loops.foreach_set("vertex_index", np.arange(4 * count, dtype=np.int32))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 4 * count, 4, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.uv_layers.new(name="judge").uv.foreach_set("vector", (uv / (ATLAS_WIDTH, rows)).astype(np.float32).ravel())
    return mesh


def _tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) each, so that tangent x bitangent = normal."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.5, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normals, tangent)


def _material(image: bpy.types.Image) -> bpy.types.Material:
    """A white diffuse material with the image as the node that is baked into."""
    material = bpy.data.materials.new("judge")
    ensure_nodes(material)
    nodes = material.node_tree.nodes
    nodes.clear()
    diffuse = nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    output = nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(diffuse.outputs[0], output.inputs["Surface"])
    target = nodes.new("ShaderNodeTexImage")
    target.image = image
    nodes.active = target
    return material
