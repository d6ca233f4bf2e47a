"""Materials, painted textures and the sky of the demo.

Comes in: colours (linear Rec.709), seeds. Goes out: Blender materials, packed images, a world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

Colour = tuple[float, float, float]

TILE_TEXELS = 512
LEAF_TEXELS = 128
GROUT = (0.30, 0.27, 0.23)
SKY_STOPS = ((0.0, (0.12, 0.10, 0.08)), (0.49, (0.2, 0.18, 0.16)), (0.51, (0.85, 0.68, 0.5)), (0.62, (0.36, 0.5, 0.74)))
"""Radiance over height, 0 nadir to 1 zenith [W/(m2 sr)]; above the last stop it fades to `ZENITH`."""
ZENITH = (0.13, 0.27, 0.62)


@dataclass(frozen=True)
class Palette:
    """The materials of the demo, named for what they are."""

    plaster: bpy.types.Material
    stone: bpy.types.Material
    red: bpy.types.Material
    blue: bpy.types.Material
    ochre: bpy.types.Material
    white: bpy.types.Material
    wood: bpy.types.Material
    clay: bpy.types.Material
    bronze: bpy.types.Material
    bark: bpy.types.Material
    tiles: bpy.types.Material
    leaves: bpy.types.Material
    panel: bpy.types.Material


def mix_palette() -> Palette:
    """Make every material.

    Returns
    -------
    Palette
    """
    return Palette(
        plaster=plain("plaster", (0.80, 0.74, 0.64)),
        stone=plain("stone", (0.58, 0.52, 0.44), roughness=0.6),
        red=plain("red plaster", (0.78, 0.10, 0.05)),
        blue=plain("blue plaster", (0.05, 0.22, 0.72)),
        ochre=plain("ochre plaster", (0.78, 0.46, 0.10)),
        white=plain("whitewash", (0.85, 0.85, 0.82)),
        wood=plain("wood", (0.26, 0.13, 0.06), roughness=0.5),
        clay=plain("clay", (0.55, 0.22, 0.11)),
        bronze=plain("bronze", (0.62, 0.42, 0.18), roughness=0.35, metallic=1.0),
        bark=plain("bark", (0.22, 0.15, 0.10)),
        tiles=pictured("tiles", tile_image()),
        leaves=pictured("leaves", leaf_image(), masked=True),
        panel=glowing("light panel", (0.42, 1.0, 0.58), 3.0),
    )


def plain(name: str, colour: Colour, roughness: float = 0.8, metallic: float = 0.0) -> bpy.types.Material:
    """Make a material of one colour.

    Parameters
    ----------
    name : str
        Its name.
    colour : Colour
        Base colour.
    roughness, metallic : float
        As Principled has them.

    Returns
    -------
    bpy.types.Material
    """
    material, shader = _principled(name)
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    return material


def glowing(name: str, colour: Colour, radiance: float) -> bpy.types.Material:
    """Make an emissive material.

    Parameters
    ----------
    name : str
        Its name.
    colour : Colour
        Of its light.
    radiance : float [W/(m2 sr)]
        Times the colour.

    Returns
    -------
    bpy.types.Material
    """
    material, shader = _principled(name)
    shader.inputs["Emission Color"].default_value = (*colour, 1.0)
    shader.inputs["Emission Strength"].default_value = radiance
    return material


def pictured(name: str, image: bpy.types.Image, masked: bool = False) -> bpy.types.Material:
    """Make a material that shows an image.

    Parameters
    ----------
    name : str
        Its name.
    image : bpy.types.Image
        Base colour and, where `masked`, alpha.
    masked : bool
        Cut the surface away where alpha is below one half.

    Returns
    -------
    bpy.types.Material
    """
    material, shader = _principled(name)
    shader.inputs["Roughness"].default_value = 0.7
    nodes, links = material.node_tree.nodes, material.node_tree.links
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    if masked:
        cut = nodes.new("ShaderNodeMath")
        cut.operation = "GREATER_THAN"
        cut.inputs[1].default_value = 0.5
        links.new(texture.outputs["Alpha"], cut.inputs[0])
        links.new(cut.outputs[0], shader.inputs["Alpha"])
    return material


def tile_image() -> bpy.types.Image:
    """Paint four by four glazed tiles, each a star in a square.

    Returns
    -------
    bpy.types.Image
        Packed, sRGB, without seam.
    """
    row, column = np.mgrid[:TILE_TEXELS, :TILE_TEXELS] + 0.5
    u, v = 4 * column / TILE_TEXELS, 4 * row / TILE_TEXELS
    x, y = np.abs(u % 1 - 0.5), np.abs(v % 1 - 0.5)
    star = (np.maximum(x, y) < 0.27) | (x + y < 0.38)
    ring = (np.maximum(x, y) < 0.33) | (x + y < 0.46)
    tints = np.array([(0.62, 0.30, 0.16), (0.72, 0.52, 0.30), (0.66, 0.36, 0.20), (0.76, 0.60, 0.40)])
    clay = tints[(u.astype(int) + 3 * v.astype(int)) % 4]
    shade = 1 + 0.08 * np.random.default_rng(11).standard_normal((4, 4))[v.astype(int), u.astype(int), None]
    colour = np.where(ring[..., None], (0.66, 0.40, 0.24), clay * shade)
    colour = np.where(star[..., None], (0.46, 0.42, 0.34), colour)
    colour = np.where((np.maximum(x, y) > 0.48)[..., None], GROUT, colour)
    return _image("tiles", np.concatenate([colour, np.ones((TILE_TEXELS, TILE_TEXELS, 1))], axis=2))


def leaf_image() -> bpy.types.Image:
    """Paint a sprig of nine leaves; alpha is 1 on them and 0 around them.

    Returns
    -------
    bpy.types.Image
        Packed, sRGB.
    """
    row, column = (np.mgrid[:LEAF_TEXELS, :LEAF_TEXELS] + 0.5) / LEAF_TEXELS
    generator = np.random.default_rng(5)
    pixels = np.zeros((LEAF_TEXELS, LEAF_TEXELS, 4))
    pixels[..., :3] = (0.10, 0.22, 0.05)
    for leaf in range(9):
        angle = 2 * np.pi * leaf / 9 + generator.uniform(-0.2, 0.2)
        along = (column - 0.5) * np.cos(angle) + (row - 0.5) * np.sin(angle)
        across = (row - 0.5) * np.cos(angle) - (column - 0.5) * np.sin(angle)
        inside = np.abs(across) < 0.085 * np.sin(np.pi * np.clip((along - 0.04) / 0.43, 0, 1))
        vein = np.abs(across) < 0.008
        green = np.array((0.16, 0.34, 0.07)) * generator.uniform(0.75, 1.25)
        pixels[inside] = (*green, 1.0)
        pixels[inside & vein] = (0.36, 0.50, 0.20, 1.0)
    return _image("sprig", pixels)


def sky() -> bpy.types.World:
    """Make a clear afternoon sky: a gradient over height.

    Returns
    -------
    bpy.types.World
        Nodes: texture coordinate, height, colour ramp, background.
    """
    world = bpy.data.worlds.new("sky")
    ensure_nodes(world)
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    direction, axes, height, ramp, background, output = (
        nodes.new(f"ShaderNode{kind}")
        for kind in ("TexCoord", "SeparateXYZ", "MapRange", "ValToRGB", "Background", "OutputWorld")
    )
    height.inputs["From Min"].default_value = -1.0
    _set_stops(ramp.color_ramp, [*SKY_STOPS, (1.0, ZENITH)])
    links.new(direction.outputs["Generated"], axes.inputs[0])
    links.new(axes.outputs["Z"], height.inputs["Value"])
    links.new(height.outputs["Result"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs[0], output.inputs["Surface"])
    return world


def ensure_nodes(record: bpy.types.Material | bpy.types.World) -> None:
    """Give a material or a world its node tree; Blender 5 always has one.

    Parameters
    ----------
    record : bpy.types.Material or bpy.types.World
        Changed in place.
    """
    if record.node_tree is None:
        record.use_nodes = True


def _principled(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """A new material and its Principled shader."""
    material = bpy.data.materials.new(name)
    ensure_nodes(material)
    return material, next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def _image(name: str, linear: np.ndarray) -> bpy.types.Image:
    """Pack linear (h, w, 4) colours as an 8-bit sRGB image."""
    colour = np.clip(linear[..., :3], 0, 1)
    encoded = np.where(colour < 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    image = bpy.data.images.new(name, linear.shape[1], linear.shape[0], alpha=True)
    image.pixels.foreach_set(np.concatenate([encoded, linear[..., 3:]], axis=2).astype(np.float32).ravel())
    image.update()
    image.pack()
    return image


def _set_stops(ramp: bpy.types.ColorRamp, stops: Sequence[tuple[float, Colour]]) -> None:
    """Give a ramp exactly these stops; it has two to begin with, and cannot do with none."""
    while len(ramp.elements) < len(stops):
        ramp.elements.new(0.5)
    for element, (position, colour) in zip(ramp.elements, stops, strict=True):
        element.position, element.color = position, (*colour, 1.0)
