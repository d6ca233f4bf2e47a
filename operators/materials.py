"""Materials of a scene: node trees to `Material` records, and which mesh data they read.

Comes in: evaluated materials, one at a time. Goes out: the list that triangles index. Each record comes with
the UV map and the colour attribute to store on the triangles that wear it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..bake.snapshot import Channel, Material, Texture
from .evaluate import Evaluator
from .fields import Field, Placement, constant
from .nodes import Place
from .surfaces import ONE, Surface, read

DEFAULT_NAME = "(default)"
DEFAULT_CUTOFF = 0.5
COLOR_MAX = 1.0


@dataclass(frozen=True)
class Reads:
    """What a material reads from a mesh: names of a UV map and a colour attribute ("" the rendered one), or None.

    A UV source of "@generated" or "@object" is computed from positions.
    """

    uv: str | None = None
    color: str | None = None


class Materials:
    """Materials read so far.

    Parameters
    ----------
    evaluator : Evaluator
        Evaluates the inputs of shaders.

    Attributes
    ----------
    records : list of Material
        In the order of their indices.
    reads : list of Reads
        What each needs from meshes.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self.records: list[Material] = []
        self.reads: list[Reads] = []
        self._evaluator = evaluator
        self._indices: dict[int, int] = {}

    def index(self, material: bpy.types.Material | None) -> int:
        """Return the index of a material, reading it when it is new.

        Parameters
        ----------
        material : bpy.types.Material or None
            None for an empty slot, which gets Blender's default surface.

        Returns
        -------
        int
            Index into `records`.
        """
        key = material.as_pointer() if material is not None else 0
        if key not in self._indices:
            self._indices[key] = len(self.records)
            record, reads = self._read(material)
            self.records.append(record)
            self.reads.append(reads)
        return self._indices[key]

    def _read(self, material: bpy.types.Material | None) -> tuple[Material, Reads]:
        """The record of a material and what it reads."""
        if material is None:
            return Material(DEFAULT_NAME), Reads()
        self._evaluator.place = f"material '{material.name}'"
        surface, mask = self._surface(material)
        return self._record(material.name, surface, mask)

    def _surface(self, material: bpy.types.Material) -> tuple[Surface, tuple[Field, float] | None]:
        """The surface of the active output, and the field and threshold of a masked alpha."""
        if not uses_nodes(material):
            return Surface(color=constant(*material.diffuse_color[:3])), None
        output = material.node_tree.get_output_node("CYCLES")
        if output is None:
            return Surface(), None
        graph = self._evaluator.graph
        if graph.resolve(Place(output.inputs["Displacement"])).socket.is_output:
            self._evaluator.note("displacement by the material", "the mesh as it is")
        surface = read(self._evaluator, Place(output.inputs["Surface"]))
        if graph.resolve(Place(output.inputs["Volume"])).socket.is_output:
            self._evaluator.note("volume of a material", "no volume")
            surface = surface or Surface(alpha=constant(0.0))
        mask = self._mask(Place(output.inputs["Surface"])) if surface is not None else None
        return surface or Surface(), mask

    def _mask(self, place: Place) -> tuple[Field, float] | None:
        """The alpha before a threshold, and the threshold, where the alpha input of the shader is one.

        The patterns are those of the glTF importer: 1 - (alpha < cutoff), alpha > cutoff, round(alpha).
        """
        graph = self._evaluator.graph
        source = graph.resolve(place)
        if not source.socket.is_output:
            return None
        node = source.socket.node
        alpha = None
        if node.bl_idname == "ShaderNodeBsdfPrincipled":
            alpha = Place(node.inputs["Alpha"], source.groups)
        elif node.bl_idname == "ShaderNodeMixShader":
            first = graph.resolve(Place(node.inputs[1], source.groups)).socket
            if first.is_output and first.node.bl_idname == "ShaderNodeBsdfTransparent":
                alpha = Place(node.inputs[0], source.groups)
        return self._threshold(alpha) if alpha is not None else None

    def _threshold(self, place: Place) -> tuple[Field, float] | None:
        """The value that a Math node compares, and what with."""
        source = self._evaluator.graph.resolve(place)
        node = source.socket.node
        if not source.socket.is_output or node.bl_idname != "ShaderNodeMath" or node.mute:
            return None
        first, second = (Place(socket, source.groups) for socket in node.inputs[:2])
        if node.operation == "ROUND":
            return self._evaluator.evaluate(first, 1), DEFAULT_CUTOFF
        if node.operation == "GREATER_THAN":
            return self._compared(first, second)
        inner = self._evaluator.graph.resolve(second)
        if node.operation == "SUBTRACT" and inner.socket.is_output and self._evaluator.evaluate(first, 1).is_value(1.0):
            less = inner.socket.node
            if less.bl_idname == "ShaderNodeMath" and less.operation == "LESS_THAN":
                return self._compared(*(Place(socket, inner.groups) for socket in less.inputs[:2]))
        return None

    def _compared(self, value: Place, threshold: Place) -> tuple[Field, float] | None:
        """A field and a constant threshold."""
        cutoff = self._evaluator.evaluate(threshold, 1)
        return (self._evaluator.evaluate(value, 1), cutoff.factor[0]) if cutoff.is_constant else None

    def _record(self, name: str, surface: Surface, mask: tuple[Field, float] | None) -> tuple[Material, Reads]:
        """A surface as a record, with one UV map and one colour attribute."""
        alpha_mode, cutoff = "opaque" if surface.alpha == ONE else "blend", DEFAULT_CUTOFF
        alpha = surface.alpha
        if mask is not None and not mask[0].is_constant:
            alpha_mode, (alpha, cutoff) = "mask", mask
        fields = {
            "base_color": _limited(surface.color),
            "emission": surface.emission,
            "alpha": alpha,
            "metallic": surface.metallic,
            "roughness": surface.roughness,
            "transmission": surface.transmission,
        }
        reads = self._reads(fields)
        channels = {key: self._channel(field, reads) for key, field in fields.items()}
        record = Material(
            name=name,
            **channels,
            ior=float(np.clip(np.nan_to_num(surface.ior, nan=1.5), 1.0, 10.0)),
            specular_level=max(float(surface.specular_level), 0.0),
            alpha_mode=alpha_mode,
            alpha_cutoff=float(cutoff),
        )
        return record, reads

    def _reads(self, fields: dict[str, Field]) -> Reads:
        """The first UV map and the first colour attribute that the channels use."""
        uvs = [field.picture.placement.source for field in fields.values() if field.picture is not None]
        colors = [field.vertex_color for field in fields.values() if field.vertex_color is not None]
        if len(set(uvs)) > 1:
            self._evaluator.note("textures on several UV maps", f"the average of those not on '{uvs[0]}'")
        if len(set(colors)) > 1:
            self._evaluator.note("several colour attributes", f"white in place of those other than '{colors[0]}'")
        return Reads(uvs[0] if uvs else None, colors[0] if colors else None)

    def _channel(self, field: Field, reads: Reads) -> Channel:
        """A field as a channel; pictures on other UV maps become their average."""
        if field.vertex_color is not None and field.vertex_color != reads.color:
            field = replace(field, vertex_color=None)
        if field.picture is not None and field.picture.placement.source != reads.uv:
            field = replace(field, factor=tuple(field.mean().tolist()), picture=None)
        factor = tuple(np.nan_to_num(np.maximum(field.factor, 0.0)).tolist())
        return Channel(factor, self._texture(field), field.vertex_color is not None)

    def _texture(self, field: Field) -> Texture | None:
        """The texture of a field; colours without information become their factor alone."""
        if field.picture is None:
            return None
        placement: Placement = field.picture.placement
        return Texture(
            image=self._evaluator.images.index(field.picture),
            channel=field.channel,
            uv_from_mesh=placement.uv_from_mesh,
            extension=placement.extension,
            interpolation=placement.interpolation,
        )


def uses_nodes(owner: bpy.types.Material | bpy.types.World) -> bool:
    """Return whether nodes describe a material or a world.

    Parameters
    ----------
    owner : bpy.types.Material or bpy.types.World
        What may have nodes.

    Returns
    -------
    bool
        Always true from Blender 5.0 on, where asking warns.
    """
    if owner.node_tree is None:
        return False
    return bpy.app.version >= (5, 0, 0) or owner.use_nodes


def _limited(color: Field) -> Field:
    """A base colour that reflects no more than it receives, as far as its factor says."""
    if max(color.factor) <= COLOR_MAX:
        return color
    return replace(color, factor=tuple(min(part, COLOR_MAX) for part in color.factor))
