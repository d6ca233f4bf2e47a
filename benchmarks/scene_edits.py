"""Edits of the open Blender scene that the judge needs: light sources off, materials made diffuse.

Comes in: the data of the open scene. Goes out: nothing; it is changed in place. Edits made through `Changes` are
taken back when its block ends, `make_diffuse` stays until the file is closed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self

import bpy
import numpy as np

from ..bake import gloss

TRANSPARENT_SHADERS = frozenset({"ShaderNodeBsdfGlass", "ShaderNodeBsdfRefraction"})
DIFFUSE_SHADERS = frozenset(
    {"ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfGlossy", "ShaderNodeBsdfMetallic", "ShaderNodeBsdfTranslucent"}
)
LAYER_POINTS = 33
EMISSION_INPUTS = {"ShaderNodeBsdfPrincipled": "Emission Strength", "ShaderNodeEmission": "Strength"}


class Changes:
    """Assignments and cut links that are taken back, last one first, when the `with` block ends."""

    def __init__(self) -> None:
        self._undo: list[tuple] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for function, *arguments in reversed(self._undo):
            function(*arguments)
        self._undo.clear()

    def set(self, owner: Any, **values: Any) -> None:
        """Assign attributes of a Blender record.

        Parameters
        ----------
        owner : bpy.types.bpy_struct
            The record.
        **values
            Its new attributes.
        """
        for name, value in values.items():
            self._undo.append((setattr, owner, name, getattr(owner, name)))
            setattr(owner, name, value)

    def cut(self, socket: bpy.types.NodeSocket) -> None:
        """Remove the link into an input, if there is one.

        Parameters
        ----------
        socket : bpy.types.NodeSocket
            The input.
        """
        tree = socket.id_data
        for link in list(socket.links):
            self._undo.append((tree.links.new, link.from_socket, socket))
            tree.links.remove(link)


def ensure_nodes(record: bpy.types.Material | bpy.types.World) -> None:
    """Give a material or a world its node tree; Blender 5 always has one.

    Parameters
    ----------
    record : bpy.types.Material or bpy.types.World
        Changed in place.
    """
    if record.node_tree is None:
        record.use_nodes = True


def light_source(light: bpy.types.Light) -> str:
    """Classify a lamp.

    Parameters
    ----------
    light : bpy.types.Light
        Its data.

    Returns
    -------
    str
        "sun", "reflector" (baked only, so that its direct light counts), or "lamp".
    """
    if light.type == "SUN":
        return "sun"
    return "reflector" if getattr(getattr(light, "gi_volumes", None), "reflector", False) else "lamp"


def sources_off(changes: Changes, sources: frozenset[str]) -> None:
    """Darken lamps.

    Parameters
    ----------
    changes : Changes
        Takes the edit back.
    sources : frozenset of str
        Those whose `light_source` is among these.
    """
    for light in bpy.data.lights:
        if light_source(light) in sources:
            changes.set(light, energy=0.0)


def emission_off(changes: Changes) -> None:
    """Make every emissive surface dark.

    Parameters
    ----------
    changes : Changes
        Takes the edit back.
    """
    for tree in material_trees():
        for node in tree.nodes:
            if node.bl_idname in EMISSION_INPUTS:
                strength = node.inputs[EMISSION_INPUTS[node.bl_idname]]
                changes.cut(strength)
                changes.set(strength, default_value=0.0)


def uniform_world(name: str, radiance: float) -> bpy.types.World:
    """Make a white sky, or find the one of that name.

    Parameters
    ----------
    name : str
        Of the world.
    radiance : float [W/(m2 sr)]
        In all directions.

    Returns
    -------
    bpy.types.World
    """
    world = bpy.data.worlds.get(name) or bpy.data.worlds.new(name)
    ensure_nodes(world)
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = radiance
    return world


def material_trees() -> Iterator[bpy.types.NodeTree]:
    """Node trees of all materials, and node groups."""
    yield from (material.node_tree for material in bpy.data.materials if material.node_tree)
    yield from (group for group in bpy.data.node_groups if group.bl_idname == "ShaderNodeTree")


def make_diffuse(smooth: bool = False, filtered: bool = False, only_glass: bool = False) -> None:
    """Replace the shaders of all materials by what the bake models.

    Reflection becomes diffuse: the base colour, under a dielectric's layer that reflects its average share in white,
    which depends on roughness; transmission goes straight through, tinted by the base colour; emission and alpha
    stay. Normal maps, coat, sheen and subsurface scattering are gone.

    Parameters
    ----------
    smooth : bool
        Keep smooth normals, which move light; the bake has those of triangles.
    filtered : bool
        Keep the filter of textures. Cycles filters sRGB bytes before it decodes them, which is darker than the mean
        of what it decodes; the bake reads the closest texel.
    only_glass : bool
        Leave materials without transmission as they are.
    """
    if not (smooth or only_glass):
        _flatten()
    for tree in material_trees():
        if only_glass and not _is_glass(tree):
            continue
        for node in list(tree.nodes):
            if node.bl_idname == "ShaderNodeTexImage" and not filtered:
                node.interpolation = "Closest"
            elif node.bl_idname == "ShaderNodeBsdfPrincipled":
                _replace(tree, node, _principled_as_diffuse(tree, node))
            elif node.bl_idname in DIFFUSE_SHADERS:
                colour = next(s for s in node.inputs if s.type == "RGBA")
                _replace(tree, node, _diffuse(tree, colour))
            elif node.bl_idname == "ShaderNodeBsdfDiffuse":
                _replace(tree, node, _diffuse(tree, node.inputs["Color"]))
            elif node.bl_idname in TRANSPARENT_SHADERS:
                _replace(tree, node, _shader(tree, "ShaderNodeBsdfTransparent", Color=node.inputs["Color"]))


def _is_glass(tree: bpy.types.NodeTree) -> bool:
    """Whether any shader of a material transmits."""
    principled = (node for node in tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
    return any(_varies(node.inputs["Transmission Weight"], 0.0) for node in principled) or any(
        node.bl_idname in TRANSPARENT_SHADERS for node in tree.nodes
    )


def _flatten() -> None:
    """Give all meshes the normals of their triangles. A shader's own normal is no way: Cycles darkens what has one."""
    for mesh in bpy.data.meshes:
        custom = mesh.attributes.get("custom_normal")
        if custom is not None:
            mesh.attributes.remove(custom)
        mesh.shade_flat()
    for item in bpy.data.objects:
        # Moves the shadow rays of smooth faces.
        item.shadow_terminator_geometry_offset = 0.0


def _principled_as_diffuse(tree: bpy.types.NodeTree, node: bpy.types.Node) -> bpy.types.NodeSocket:
    """Nodes of a diffuse surface with the emission, transmission and alpha of a Principled shader."""
    inputs = node.inputs
    colour = inputs["Base Color"]
    surface = base = _diffuse(tree, colour)
    if _varies(inputs["Transmission Weight"], 0.0):
        straight = _shader(tree, "ShaderNodeBsdfTransparent", Color=colour)
        surface = _mix(tree, inputs["Transmission Weight"], surface, straight)
    surface = _mix(tree, _layer(tree, inputs), surface, _diffuse(tree))
    if _varies(inputs["Metallic"], 0.0):
        surface = _mix(tree, inputs["Metallic"], surface, base)
    if _varies(inputs["Emission Strength"], 0.0):
        glow = _shader(
            tree,
            "ShaderNodeEmission",
            Color=inputs["Emission Color"],
            Strength=inputs["Emission Strength"],
        )
        add = tree.nodes.new("ShaderNodeAddShader")
        tree.links.new(surface, add.inputs[0])
        tree.links.new(glow, add.inputs[1])
        surface = add.outputs[0]
    if _varies(inputs["Alpha"], 1.0):
        surface = _mix(tree, inputs["Alpha"], _shader(tree, "ShaderNodeBsdfTransparent"), surface)
    return surface


def _layer(tree: bpy.types.NodeTree, inputs: bpy.types.bpy_prop_collection) -> bpy.types.NodeSocket:
    """Share of light that the specular layer reflects, as a curve over roughness."""
    node = tree.nodes.new("ShaderNodeFloatCurve")
    _feed(tree, inputs["Roughness"], node.inputs["Value"])
    node.mapping.use_clip = False
    curve = node.mapping.curves[0]
    ior, level = inputs["IOR"].default_value, inputs["Specular IOR Level"].default_value
    points = [(0.0, gloss.average_fresnel(ior, level))]
    points += [(x, gloss.rough_share(ior, level, x)) for x in np.linspace(0, 1, LAYER_POINTS)[1:]]
    for _ in range(len(points) - len(curve.points)):
        curve.points.new(0.5, 0.5)
    for point, location in zip(curve.points, points, strict=True):
        point.location, point.handle_type = location, "VECTOR"
    node.mapping.update()
    return node.outputs[0]


def _diffuse(tree: bpy.types.NodeTree, colour: bpy.types.NodeSocket | None = None) -> bpy.types.NodeSocket:
    """Output of a new diffuse surface, white unless a colour is given."""
    shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    if colour is not None:
        _feed(tree, colour, shader.inputs["Color"])
    return shader.outputs[0]


def _varies(socket: bpy.types.NodeSocket, default: float) -> bool:
    """Whether an input is linked or differs from its default."""
    return socket.is_linked or socket.default_value != default


def _shader(tree: bpy.types.NodeTree, kind: str, **inputs: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Output of a new node whose inputs get what the given inputs of another node get."""
    node = tree.nodes.new(kind)
    for name, source in inputs.items():
        _feed(tree, source, node.inputs[name])
    return node.outputs[0]


def _mix(
    tree: bpy.types.NodeTree, factor: bpy.types.NodeSocket, *shaders: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    """Output of a new mix: the first shader at factor 0, the second at factor 1."""
    node = tree.nodes.new("ShaderNodeMixShader")
    _feed(tree, factor, node.inputs[0])
    for index, shader in enumerate(shaders, start=1):
        tree.links.new(shader, node.inputs[index])
    return node.outputs[0]


def _feed(tree: bpy.types.NodeTree, source: bpy.types.NodeSocket, target: bpy.types.NodeSocket) -> None:
    """Give `target` the link or the value of an input, or a link from an output."""
    target.default_value = source.default_value
    if source.is_output:
        tree.links.new(source, target)
    elif source.is_linked:
        tree.links.new(source.links[0].from_socket, target)


def _replace(tree: bpy.types.NodeTree, node: bpy.types.Node, output: bpy.types.NodeSocket) -> None:
    """Put `output` wherever the node's shader went, and remove the node."""
    for link in list(node.outputs[0].links):
        tree.links.new(output, link.to_socket)
    tree.nodes.remove(node)
