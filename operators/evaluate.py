"""Evaluation of colour and value sockets into fields.

Comes in: a socket of a node graph. Goes out: a `Field`, a constant, one picture times vertex colour where the
graph says no more than that, or a picture painted texel by texel. What cannot be evaluated is replaced by a
plain value and noted with the material and the node.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy
import numpy as np

from .fields import Field, component, constant, multiply, paint
from .images import MISSING_GREY, Images
from .nodes import Graph, Place
from .notes import Notes
from .texture_mapping import Mapper

MID = 0.5
WHITE = constant(1.0, 1.0, 1.0)
# Depth of a graph beyond which something is wrong with it.
MAX_DEPTH = 400
# Outputs whose value light paths decide: what diffuse light sees.
LIGHT_PATH = {"Is Diffuse Ray": 1.0, "Is Reflection Ray": 1.0, "Ray Depth": 1.0, "Diffuse Depth": 1.0}


class Evaluator:
    """Evaluates sockets; results are kept, since graphs share branches.

    Parameters
    ----------
    images : Images
        Images and painted pictures.
    notes : Notes
        Gathers what cannot be represented.
    values : dict
        Functions by node type, `node_values.VALUES`.

    Attributes
    ----------
    place : str
        What is being read, for notes, such as "material 'Brick'".
    graph : Graph
        Finds what feeds a socket.
    """

    def __init__(self, images: Images, notes: Notes, values: dict[str, Callable[..., Field | None]]) -> None:
        self.place = ""
        self._values = values
        self.graph = Graph()
        self.images, self.notes = images, notes
        self.mapper = Mapper(self)
        self._done: dict[tuple, Field] = {}
        self._depth = 0

    def evaluate(self, place: Place, width: int) -> Field:
        """Return the value of an input.

        Parameters
        ----------
        place : Place
            An input socket.
        width : int
            3 for a colour, 1 for a scalar; values convert as they do in Blender.

        Returns
        -------
        Field
            Its value over the surface.
        """
        return self.converted(self._source(place), width)

    def mean(self, place: Place, width: int) -> np.ndarray:
        """Return the average of an input, noting when it is not constant.

        Parameters
        ----------
        place : Place
            An input socket.
        width : int
            3 for a colour, 1 for a scalar.

        Returns
        -------
        (width,) float64
            The average.
        """
        field = self.evaluate(place, width)
        if not field.is_constant:
            self.note(f"'{place.socket.name}' that varies over the surface", "its average")
        return field.mean()

    def note(self, what: str, instead: str) -> None:
        """Note a replacement in what is being read.

        Parameters
        ----------
        what, instead : str
            What the scene has, and what the snapshot holds.
        """
        self.notes.add(what, instead, self.place)

    def converted(self, field: Field, width: int) -> Field:
        """Return a field with another number of components: colours become luminance.

        Parameters
        ----------
        field : Field
            Any.
        width : int
            1 or 3.

        Returns
        -------
        Field
            With that many components.
        """
        if field.width == width:
            return field
        if width == 3:
            if field.vertex_color is not None:
                field = self._plain(field)
            if field.picture is not None and field.channel != "rgb":
                return self.combine(lambda a: np.broadcast_to(a, (*a.shape[:2], 3)), [field], 3)
            return replace(field, factor=field.factor * 3)
        return self.combine(lambda a: a @ np.array([[0.2126], [0.7152], [0.0722]]), [field], 1)

    def combine(self, function: Callable[..., np.ndarray], inputs: list[Field], width: int) -> Field:
        """Return a function of fields, painted when they are not constant.

        Parameters
        ----------
        function : callable
            Of one (h, w, c) array for each input.
        inputs : list of Field
            Any fields; what cannot be painted together is replaced and noted.
        width : int
            Components of the result.

        Returns
        -------
        Field
            The result.
        """
        inputs = [self._plain(field) for field in inputs]
        first = next((field.picture.placement for field in inputs if field.picture is not None), None)
        for index, field in enumerate(inputs):
            if field.picture is not None and field.picture.placement != first:
                self.note("textures combined that lie differently", "the average of all but the first")
                inputs[index] = Field(tuple(field.mean().tolist()))
        return paint(function, inputs, width, f"painted for {self.place}")

    def product(self, first: Field, second: Field) -> Field:
        """Return a product, exactly where a channel can hold it.

        Parameters
        ----------
        first, second : Field
            Factors.

        Returns
        -------
        Field
            Their product, with the larger number of components.
        """
        width = max(first.width, second.width)
        first, second = (field if field.is_constant else self.converted(field, width) for field in (first, second))
        exact = multiply(first, second)
        return exact if exact is not None else self.combine(lambda a, b: a * b, [first, second], width)

    def lerp(self, first: Field, second: Field, t: Field) -> Field:
        """Return first * (1 - t) + second * t.

        Parameters
        ----------
        first, second : Field
            Ends, of equal width.
        t : Field
            A scalar.

        Returns
        -------
        Field
            Between them.
        """
        if t.is_value(0.0) or first == second:
            return first
        if t.is_value(1.0):
            return second
        if t.is_constant and second.is_value(0.0):
            return self.product(first, constant(1 - t.factor[0]))
        if first.is_value(0.0):
            return self.product(second, t)
        return self.combine(lambda a, b, f: a + (b - a) * f, [first, second, t], first.width)

    def _source(self, place: Place) -> Field:
        """The value that reaches an input, as its source has it."""
        source = self.graph.resolve(place)
        key = (source.socket.as_pointer(), tuple(node.as_pointer() for node in source.groups))
        if key not in self._done:
            self._depth += 1
            self._done[key] = self._node(source) if self._depth < MAX_DEPTH else constant(MID)
            self._depth -= 1
        return self._done[key]

    def _node(self, place: Place) -> Field:
        """The value of an output, or of an unlinked input."""
        socket = place.socket
        if not socket.is_output:
            return socket_value(socket)
        node = socket.node
        if node.mute:
            return constant(*([0.0] * (3 if socket.type in ("RGBA", "VECTOR") else 1)))
        function = self._values.get(node.bl_idname)
        field = function(self, node, socket, place.groups) if function else None
        return field if field is not None else self.unknown(node, socket)

    def unknown(self, node: bpy.types.Node, socket: bpy.types.NodeSocket) -> Field:
        """Return a stand-in for a node that cannot be evaluated, and note it.

        Parameters
        ----------
        node : bpy.types.Node
            The node.
        socket : bpy.types.NodeSocket
            Which output.

        Returns
        -------
        Field
            Mid-grey or 0.5.
        """
        self.note(f"'{node.bl_label}' node", f"the constant {MID}")
        return constant(MID, MID, MID) if socket.type in ("RGBA", "VECTOR") else constant(MID)

    def missing(self, width: int) -> Field:
        """Return the stand-in for an image that cannot be loaded.

        Parameters
        ----------
        width : int
            3 for its colour, 1 for its alpha.

        Returns
        -------
        Field
            Grey, opaque.
        """
        return constant(*[MISSING_GREY] * 3) if width == 3 else constant(1.0)

    def channel(self, field: Field, index: int) -> Field:
        """Return one component of a colour.

        Parameters
        ----------
        field : Field
            A colour.
        index : int
            0, 1 or 2.

        Returns
        -------
        Field
            A scalar.
        """
        exact = component(field, index)
        return exact if exact is not None else self.combine(lambda a: a[..., index : index + 1], [field], 1)

    def _plain(self, field: Field) -> Field:
        """A field without vertex colour, which only mixes by multiplying."""
        if field.vertex_color is None:
            return field
        self.note("vertex colour used other than as a factor", "white in its place")
        return replace(field, vertex_color=None)


def socket_value(socket: bpy.types.NodeSocket) -> Field:
    """Return the constant of an unlinked input.

    Parameters
    ----------
    socket : bpy.types.NodeSocket
        Of a value, a vector or a colour.

    Returns
    -------
    Field
        Three components for colours and vectors, one otherwise.
    """
    value = getattr(socket, "default_value", 0.0)
    if isinstance(value, int | float):
        return constant(value)
    try:
        components = [float(part) for part in value][:3]
    except (TypeError, ValueError):
        return constant(0.0)
    return constant(*components) if len(components) == 3 else constant(0.0)
