"""How a texture lies on a mesh: texture coordinates through Mapping nodes, as an affine map of a UV map.

Comes in: the vector input of an image texture. Goes out: a `Placement`. A source starting with "@" is not a UV
map: "@generated" spans the mesh's bounding box with 0..1, "@object" is the position in mesh space.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np

from .fields import Placement
from .nodes import Place, named

if TYPE_CHECKING:
    from .evaluate import Evaluator

EXTENSIONS = {"REPEAT": "repeat", "EXTEND": "extend", "CLIP": "clip", "MIRROR": "mirror"}
GENERATED, OBJECT = "@generated", "@object"
Affine = tuple[str, np.ndarray]


class Mapper:
    """Finds placements.

    Parameters
    ----------
    evaluator : Evaluator
        Evaluates the constants of Mapping nodes.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator

    def placement(self, node: bpy.types.Node, groups: tuple) -> Placement:
        """Return how an image texture node's image lies on the mesh.

        Parameters
        ----------
        node : bpy.types.Node
            The image texture.
        groups : tuple
            The group nodes around it.

        Returns
        -------
        Placement
            What cannot be represented is replaced by the rendered UV map and noted.
        """
        if node.projection != "FLAT":
            self._evaluator.note(f"{node.projection.lower()} projection of a texture", "a flat projection")
        found = self._affine(Place(node.inputs["Vector"], groups))
        if found is None:
            self._evaluator.note(f"texture coordinates of '{node.name}'", "the UV map")
            found = ("", np.eye(3, 4))
        source, matrix = found
        if source.startswith("@") and np.abs(matrix[:2, 2]).max() > 1e-6:
            self._evaluator.note(f"turned texture coordinates of '{node.name}'", "their x and y alone")
        return Placement(
            source,
            tuple(matrix[:2][:, [0, 1, 3]].ravel().tolist()),
            EXTENSIONS.get(node.extension, "repeat"),
            "closest" if node.interpolation == "Closest" else "linear",
        )

    def _affine(self, place: Place) -> Affine | None:
        """Source and (3, 4) coordinates_from_source; None where it is not affine."""
        source = self._evaluator.graph.resolve(place)
        if not source.socket.is_output:
            return ("", np.eye(3, 4))
        node, output = source.socket.node, source.socket.name
        if node.bl_idname == "ShaderNodeUVMap":
            return (node.uv_map, np.eye(3, 4)) if not node.from_instancer else None
        if node.bl_idname == "ShaderNodeAttribute" and node.attribute_type == "GEOMETRY" and output == "Vector":
            return (node.attribute_name, np.eye(3, 4))
        if node.bl_idname == "ShaderNodeTexCoord":
            return self._coordinates(node, output)
        if node.bl_idname == "ShaderNodeMapping":
            return self._mapping(node, source.groups)
        if node.bl_idname == "ShaderNodeVectorMath":
            return self._vector_math(node, source.groups)
        return None

    def _coordinates(self, node: bpy.types.Node, output: str) -> Affine | None:
        """The outputs of Texture Coordinate that belong to the mesh."""
        if output == "UV" and not node.from_instancer:
            return ("", np.eye(3, 4))
        if output == "Generated" and not node.from_instancer:
            return (GENERATED, np.eye(3, 4))
        if output == "Object" and node.object is None:
            return (OBJECT, np.eye(3, 4))
        return None

    def _constant(self, socket: bpy.types.NodeSocket | None, groups: tuple, width: int = 3) -> np.ndarray | None:
        """The constant of an input; None when it varies."""
        if socket is None:
            return None
        field = self._evaluator.evaluate(Place(socket, groups), width)
        return np.array(field.factor) if field.is_constant else None

    def _mapping(self, node: bpy.types.Node, groups: tuple) -> Affine | None:
        """A Mapping node: scale, then rotation about x, y, z, then location; TEXTURE is its inverse."""
        inner = self._affine(Place(node.inputs["Vector"], groups))
        location = self._constant(named(node, "Location"), groups)
        rotation = self._constant(named(node, "Rotation"), groups)
        scale = self._constant(named(node, "Scale"), groups)
        if inner is None or rotation is None or scale is None:
            return None
        turn = _euler(rotation)
        if node.vector_type == "TEXTURE":
            if location is None:
                return None
            linear = np.diag(np.divide(1, scale, out=np.zeros(3), where=scale != 0)) @ turn.T
            offset = -linear @ location
        elif node.vector_type in ("POINT", "VECTOR"):
            linear = turn @ np.diag(scale)
            offset = location if location is not None else np.zeros(3)
        else:
            return None
        return (inner[0], _apply(linear, offset, inner[1]))

    def _vector_math(self, node: bpy.types.Node, groups: tuple) -> Affine | None:
        """Constant offsets and factors of the coordinates."""
        first, second = (Place(socket, groups) for socket in node.inputs[:2])
        if node.operation == "SCALE":
            inner, factor = self._affine(first), self._constant(named(node, "Scale"), groups, 1)
            return None if inner is None or factor is None else (inner[0], inner[1] * factor)
        varying = first if self._evaluator.graph.resolve(first).socket.is_output else second
        other = self._constant((second if varying is first else first).socket, groups)
        inner = self._affine(varying)
        if inner is None or other is None:
            return None
        if node.operation == "MULTIPLY":
            return (inner[0], inner[1] * other[:, None])
        if node.operation == "ADD" or (node.operation == "SUBTRACT" and varying is first):
            return (inner[0], _apply(np.eye(3), other if node.operation == "ADD" else -other, inner[1]))
        return None


def _apply(linear: np.ndarray, offset: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """(3, 4) of an affine map after another."""
    matrix = linear @ inner
    matrix[:, 3] += offset
    return matrix


def _euler(angles: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about x, then y, then z."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(angles), np.cos(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
