"""The world as a panorama of radiance.

Comes in: a scene. Goes out: one colour for a world of one colour; for any other, Cycles renders the world alone
into an equirectangular picture, in a temporary scene. Bright small spots (a sun) get many more samples, so that
the panorama keeps their energy.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from . import node_values, render_depsgraph
from .evaluate import LIGHT_PATH, Evaluator
from .images import Images
from .materials import uses_nodes
from .nodes import Place
from .notes import Notes

WIDTH, HEIGHT = 512, 256
SAMPLES = 16
TILE = 32
# Tiles with spots are rendered with this many texels for each of the panorama's, along both sides.
FINER, FINER_SAMPLES = 8, 16
# A tile has a bright spot when its brightest texel exceeds its mean by this factor, and holds this share of all light.
SPOT_CONTRAST = 8.0
SPOT_SHARE = 1e-3
# A sun at the zenith touches all 16 tiles of the last row.
MAX_SPOTS = 20
# With this rotation Cycles' panorama has +x at its centre and z up: the map of `Snapshot.sky`.
CAMERA_ROTATION = (math.pi / 2, 0.0, -math.pi / 2)


def read(scene: bpy.types.Scene, notes: Notes) -> np.ndarray:
    """Return the radiance of a scene's world.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene, not evaluated.
    notes : Notes
        Gathers what cannot be represented.

    Returns
    -------
    (h, w, 3) float32 [W/(m2 sr)]
        As `Snapshot.sky`; (1, 1, 3) when it is the same everywhere.
    """
    world = scene.world
    if world is None:
        return np.zeros((1, 1, 3), np.float32)
    if not world.cycles_visibility.diffuse:
        notes.add("world hidden from diffuse rays", "a black sky", f"world '{world.name}'")
        return np.zeros((1, 1, 3), np.float32)
    color = _uniform(world, notes)
    if color is not None:
        return color.astype(np.float32).reshape(1, 1, 3)
    panorama = _panorama(scene, world)
    if (np.ptp(panorama, axis=(0, 1)) == 0).all():
        return np.ascontiguousarray(panorama[:1, :1])
    return panorama


def _uniform(world: bpy.types.World, notes: Notes) -> np.ndarray | None:
    """(3,) the radiance of a world of one colour; None for others."""
    if not uses_nodes(world):
        return np.array(world.color, np.float64)
    output = world.node_tree.get_output_node("CYCLES")
    if output is None:
        return np.zeros(3)
    evaluator = Evaluator(Images(notes), Notes(), node_values.VALUES)
    if evaluator.graph.resolve(Place(output.inputs["Volume"])).socket.is_output:
        notes.add("volume of the world", "clear air", f"world '{world.name}'")
    source = evaluator.graph.resolve(Place(output.inputs["Surface"]))
    if not source.socket.is_output:
        return np.zeros(3)
    node = source.socket.node
    if node.bl_idname not in ("ShaderNodeBackground", "ShaderNodeEmission") or node.mute:
        return None
    color = evaluator.evaluate(Place(node.inputs["Color"], source.groups), 3)
    strength = evaluator.evaluate(Place(node.inputs["Strength"], source.groups), 1)
    exact = color.is_constant and strength.is_constant and not evaluator.notes.where
    return np.maximum(np.array(color.factor) * strength.factor[0], 0) if exact else None


def _panorama(scene: bpy.types.Scene, world: bpy.types.World) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) float32: the world as diffuse rays see it."""
    with _as_diffuse_rays_see(world) as seen, _temporary_scene(scene, seen) as temporary:
        panorama = _render(temporary, SAMPLES)
        for row, column in _spots(panorama):
            tile = (slice(row, row + TILE), slice(column, column + TILE))
            panorama[tile] = _averaged(_render(temporary, FINER_SAMPLES, (row, column)), row)
    return np.maximum(np.nan_to_num(panorama, posinf=0.0, neginf=0.0), 0)


def _spots(panorama: np.ndarray) -> list[tuple[int, int]]:
    """First row and column of the tiles whose light comes from a few texels and matters, brightest first."""
    elevation = ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5) * math.pi
    light = np.maximum(panorama.max(2), 0, dtype=np.float64) * np.cos(elevation)[:, None]
    tiles = light.reshape(HEIGHT // TILE, TILE, WIDTH // TILE, TILE).swapaxes(1, 2).reshape(-1, TILE * TILE)
    total = tiles.sum(1)
    matters = (tiles.max(1) > SPOT_CONTRAST * tiles.mean(1)) & (total > SPOT_SHARE * total.sum())
    order = np.argsort(-total * matters, kind="stable")[: min(MAX_SPOTS, int(matters.sum()))]
    rows, columns = np.divmod(order, WIDTH // TILE)
    return [(row * TILE, column * TILE) for row, column in zip(rows.tolist(), columns.tolist(), strict=True)]


@contextmanager
def _temporary_scene(scene: bpy.types.Scene, world: bpy.types.World) -> Iterator[bpy.types.Scene]:
    """A scene with nothing but the world and a panoramic camera."""
    temporary = bpy.data.scenes.new("GI Volumes")
    camera = bpy.data.cameras.new("GI Volumes")
    try:
        placed = bpy.data.objects.new("GI Volumes", camera)
        placed.rotation_euler = CAMERA_ROTATION
        camera.type = "PANO"
        # Cycles' own settings until Blender 4.5, the camera's from 5.0 on.
        owner = camera if hasattr(camera, "panorama_type") else camera.cycles
        owner.panorama_type = "EQUIRECTANGULAR"
        temporary.collection.objects.link(placed)
        temporary.camera, temporary.world = placed, world
        temporary.frame_current = scene.frame_current
        _set_up(temporary)
        yield temporary
    finally:
        bpy.data.scenes.remove(temporary)
        bpy.data.cameras.remove(camera)


def _set_up(scene: bpy.types.Scene) -> None:
    """Plain, unfiltered, linear pixels."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_denoising = cycles.use_adaptive_sampling = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.max_bounces = 0
    cycles.pixel_filter_type = "BOX"
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = False
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"


def _averaged(fine: np.ndarray, row: int) -> np.ndarray:
    """(TILE, TILE, 3) means by solid angle, which near the poles differs within a texel."""
    edges = np.sin(np.linspace(row, row + TILE, TILE * FINER + 1) / HEIGHT * math.pi - math.pi / 2)
    weights = np.diff(edges).reshape(TILE, FINER)
    weights /= weights.sum(1, keepdims=True)
    blocks = fine.reshape(TILE, FINER, TILE, FINER, 3).mean(3, dtype=np.float64)
    return np.einsum("rf,rfck->rck", weights, blocks).astype(np.float32)


def _render(scene: bpy.types.Scene, samples: int, tile: tuple[int, int] | None = None) -> np.ndarray:
    """(h, w, 3) float32 linear pixels of the panorama or, finer, of one tile of it, from the bottom up."""
    render = scene.render
    scene.cycles.samples = samples
    finer = 1 if tile is None else FINER
    width, height = (WIDTH, HEIGHT) if tile is None else (TILE * FINER, TILE * FINER)
    render.resolution_x, render.resolution_y = WIDTH * finer, HEIGHT * finer
    render.use_border = render.use_crop_to_border = tile is not None
    if tile is not None:
        render.border_min_x, render.border_max_x = tile[1] / WIDTH, (tile[1] + TILE) / WIDTH
        render.border_min_y, render.border_max_y = tile[0] / HEIGHT, (tile[0] + TILE) / HEIGHT
    with tempfile.TemporaryDirectory(prefix="gi_volumes_") as folder:
        render.filepath = str(Path(folder) / "sky.exr")
        render_depsgraph.render(scene, write=True)
        return _pixels(render.filepath, width, height)


def _pixels(path: str, width: int, height: int) -> np.ndarray:
    """(height, width, 3) float32 of an EXR file."""
    image = bpy.data.images.load(path, check_existing=False)
    try:
        values = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(values)
        return values.reshape(height, width, image.channels)[..., :3].copy()
    finally:
        bpy.data.images.remove(image)


@contextmanager
def _as_diffuse_rays_see(world: bpy.types.World) -> Iterator[bpy.types.World]:
    """A copy of a world that shows camera rays what it lights surfaces with."""
    copies: list[bpy.types.NodeTree] = []
    copy = world.copy()
    try:
        copy.cycles_visibility.camera = True
        # No light is sampled here, so its importance map would be made in vain, at each render.
        copy.cycles.sampling_method = "NONE"
        if uses_nodes(copy):
            _fix_light_paths(copy.node_tree, copies)
        yield copy
    finally:
        bpy.data.worlds.remove(copy)
        for tree in copies:
            bpy.data.node_groups.remove(tree)


def _fix_light_paths(tree: bpy.types.NodeTree, copies: list[bpy.types.NodeTree]) -> None:
    """Put a diffuse ray's constants in place of light paths, in groups too, which are copied first."""
    for node in list(tree.nodes):
        if node.type == "GROUP" and node.node_tree is not None:
            node.node_tree = node.node_tree.copy()
            copies.append(node.node_tree)
            _fix_light_paths(node.node_tree, copies)
        elif node.bl_idname == "ShaderNodeLightPath":
            for output in node.outputs:
                _replace_output(tree, output, LIGHT_PATH.get(output.name, 0.0))


def _replace_output(tree: bpy.types.NodeTree, output: bpy.types.NodeSocket, value: float) -> None:
    """Feed what an output feeds from a constant."""
    targets = [link.to_socket for link in output.links]
    if not targets:
        return
    constant = tree.nodes.new("ShaderNodeValue")
    constant.outputs[0].default_value = value
    for target in targets:
        tree.links.new(constant.outputs[0], target)
