"""One function for each node type that has a value: it evaluates the node's inputs and combines them.

Comes in: an evaluator, a node, which of its outputs, and the groups around it. Goes out: a `Field`, or None where
the node's settings cannot be represented.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from . import blackbody, node_math
from .evaluate import LIGHT_PATH, MID, WHITE, Evaluator
from .fields import Field, constant
from .nodes import Place, named

Groups = tuple
# Points at which curves and ramps are tabulated; linear in between.
TABLE = 1025


def _input(evaluator: Evaluator, node: bpy.types.Node, groups: Groups, width: int, *names: str) -> Field:
    """The value of an input by name; 0 where the node has none."""
    socket = named(node, *names)
    return evaluator.evaluate(Place(socket, groups), width) if socket is not None else constant(*[0.0] * width)


def _image(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    alpha = socket.name == "Alpha"
    if node.image is None:
        evaluator.note(f"'{node.name}' node without an image", "plain grey")
        return evaluator.missing(1 if alpha else 3)
    alpha_used = node.outputs["Alpha"].is_linked
    picture = evaluator.images.picture(node.image, evaluator.mapper.placement(node, groups), alpha_used)
    if picture is None:
        return evaluator.missing(1 if alpha else 3)
    return Field((1.0,), picture, "a") if alpha else Field((1.0, 1.0, 1.0), picture)


def _vertex_color(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    return Field((1.0,) if socket.name == "Alpha" else (1.0, 1.0, 1.0), vertex_color=node.layer_name)


def _attribute(
    evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups
) -> Field | None:
    if node.attribute_type != "GEOMETRY" or socket.name not in ("Color", "Alpha"):
        return None
    return Field((1.0,) if socket.name == "Alpha" else (1.0, 1.0, 1.0), vertex_color=node.attribute_name)


def _constant(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    value = socket.default_value
    return constant(*value[:3]) if node.bl_idname == "ShaderNodeRGB" else constant(value)


def _math(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    a, b, c = (evaluator.evaluate(Place(input, groups), 1) for input in node.inputs[:3])
    if node.operation == "MULTIPLY" and not node.use_clamp:
        return evaluator.product(a, b)
    function = node_math.MATH.get(node.operation)
    if function is None:
        return None
    return evaluator.combine(_clamped(function, node.use_clamp), [a, b, c], 1)


def _vector_math(
    evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups
) -> Field | None:
    function = node_math.VECTOR.get(node.operation)
    if function is None:
        return None
    a, b, c = (evaluator.evaluate(Place(input, groups), 3) for input in node.inputs[:3])
    scale = _input(evaluator, node, groups, 1, "Scale")
    if node.operation in ("MULTIPLY", "SCALE"):
        return evaluator.product(a, b if node.operation == "MULTIPLY" else scale)
    return evaluator.combine(function, [a, b, c, scale], 1 if socket.type == "VALUE" else 3)


def _mix(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    if node.data_type not in ("RGBA", "FLOAT", "VECTOR"):
        return None
    width = 1 if node.data_type == "FLOAT" else 3
    per_component = node.data_type == "VECTOR" and node.factor_mode == "NON_UNIFORM"
    factor = _input(evaluator, node, groups, 3 if per_component else 1, "Factor")
    a, b = (_input(evaluator, node, groups, width, name) for name in ("A", "B"))
    if node.clamp_factor:
        factor = _clamp(evaluator, factor)
    mode = node.blend_type if node.data_type == "RGBA" else "MIX"
    field = _blend(evaluator, a, b, factor, mode)
    return _clamp(evaluator, field) if node.data_type == "RGBA" and node.clamp_result and field is not None else field


def _mix_rgb(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    factor = _clamp(evaluator, evaluator.evaluate(Place(node.inputs[0], groups), 1))
    a, b = (evaluator.evaluate(Place(input, groups), 3) for input in node.inputs[1:3])
    field = _blend(evaluator, a, b, factor, node.blend_type)
    return _clamp(evaluator, field) if node.use_clamp and field is not None else field


def _blend(evaluator: Evaluator, a: Field, b: Field, factor: Field, mode: str) -> Field | None:
    """a blended towards mode(a, b), exactly where a product says it."""
    if mode in node_math.FACTOR_BLEND:
        return evaluator.combine(node_math.FACTOR_BLEND[mode], [a, b, factor], a.width)
    if mode not in node_math.BLEND:
        return None
    if factor.is_value(0.0):
        return a
    if mode == "MIX" and factor.width == 1:
        return evaluator.lerp(a, b, factor)
    if mode == "MULTIPLY" and factor.is_constant and (b.is_constant or factor.is_value(1.0)):
        toward = evaluator.combine(lambda x, f: 1 - f + f * x, [b, factor], 3) if b.is_constant else b
        return evaluator.product(a, toward)
    blend = node_math.BLEND[mode]
    return evaluator.combine(lambda x, y, f: x + (blend(x, y) - x) * f, [a, b, factor], a.width)


def _clamp(evaluator: Evaluator, field: Field) -> Field:
    """A field within 0..1; products of 8-bit pictures and factors up to 1 are already."""
    within = all(0 <= part <= 1 for part in field.factor)
    if within and (
        field.picture is None or (field.picture.image is not None and field.picture.image.encoding != "float")
    ):
        return field
    return evaluator.combine(lambda a: np.clip(a, 0, 1), [field], field.width)


def _clamped(function: Callable[..., np.ndarray], clamp: bool) -> Callable[..., np.ndarray]:
    """A function, clamped to 0..1 where asked for."""
    return (lambda *values: np.clip(function(*values), 0, 1)) if clamp else function


def _hue_saturation(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    hue, saturation, value, factor = (
        _input(evaluator, node, groups, 1, *names)
        for names in (("Hue",), ("Saturation",), ("Value",), ("Fac", "Factor"))
    )

    def shift(color, hue, saturation, value, factor):
        hsv = node_math.hsv_from_rgb(color)
        turned = np.stack(
            [
                np.mod(hsv[..., 0] + hue[..., 0] + MID, 1),
                np.clip(hsv[..., 1] * saturation[..., 0], 0, 1),
                hsv[..., 2] * value[..., 0],
            ],
            -1,
        )
        return np.maximum(color + (node_math.rgb_from_hsv(turned) - color) * factor, 0)

    color = _input(evaluator, node, groups, 3, "Color")
    if hue.is_value(MID) and saturation.is_value(1.0) and value.is_constant and factor.is_value(1.0):
        return evaluator.product(color, value)
    return evaluator.combine(shift, [color, hue, saturation, value, factor], 3)


def _gamma(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    color, gamma = _input(evaluator, node, groups, 3, "Color"), _input(evaluator, node, groups, 1, "Gamma")
    if gamma.is_value(1.0):
        return color
    return evaluator.combine(lambda a, g: np.where(a > 0, np.power(np.maximum(a, 0), g), a), [color, gamma], 3)


def _invert(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    color, factor = _input(evaluator, node, groups, 3, "Color"), _input(evaluator, node, groups, 1, "Fac", "Factor")
    return evaluator.combine(lambda a, f: a + (1 - 2 * a) * f, [color, factor], 3)


def _bright_contrast(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    color = _input(evaluator, node, groups, 3, "Color")
    bright, contrast = (
        _input(evaluator, node, groups, 1, *names) for names in (("Bright", "Brightness"), ("Contrast",))
    )
    if bright.is_value(0.0) and contrast.is_value(0.0):
        return color
    return evaluator.combine(lambda a, b, c: np.maximum((1 + c) * a + b - c * 0.5, 0), [color, bright, contrast], 3)


def _ramp(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    points = np.linspace(0, 1, TABLE)
    table = np.array([node.color_ramp.evaluate(x) for x in points])
    columns = table[:, 3:] if socket.name == "Alpha" else table[:, :3]
    factor = _input(evaluator, node, groups, 1, "Fac", "Factor")
    return evaluator.combine(lambda a: _lookup(points, columns, a), [factor], columns.shape[1])


def _lookup(points: np.ndarray, table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Table columns at scalar values, (h, w, columns)."""
    return np.stack([np.interp(values[..., 0], points, column) for column in table.T], -1)


def _curves(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    mapping = node.mapping
    mapping.initialize()
    is_float = node.bl_idname == "ShaderNodeFloatCurve"
    low, high = (0.0, 1.0)
    points = np.linspace(low, high, TABLE)
    tables = [np.array([mapping.evaluate(curve, x) for x in points]) for curve in mapping.curves]
    factor = _input(evaluator, node, groups, 1, "Fac", "Factor")
    if is_float:
        value = _input(evaluator, node, groups, 1, "Value")
        return evaluator.combine(lambda a, f: a + (np.interp(a, points, tables[0]) - a) * f, [value, factor], 1)

    def apply(color, factor):
        curved = [np.interp(np.interp(color[..., i], points, tables[3]), points, tables[i]) for i in range(3)]
        return color + (np.stack(curved, -1) - color) * factor

    return evaluator.combine(apply, [_input(evaluator, node, groups, 3, "Color"), factor], 3)


def _to_grey(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    return evaluator.evaluate(Place(node.inputs[0], groups), 1)


def _separate(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    index = list(node.outputs).index(socket)
    color = evaluator.evaluate(Place(node.inputs[0], groups), 3)
    mode = getattr(node, "mode", "HSV" if "HSV" in node.bl_idname else "RGB")
    if mode == "RGB":
        return evaluator.channel(color, index)
    if mode != "HSV":
        return None
    return evaluator.combine(lambda a: node_math.hsv_from_rgb(a)[..., index : index + 1], [color], 1)


def _combine(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field | None:
    mode = getattr(node, "mode", "HSV" if "HSV" in node.bl_idname else "RGB")
    if mode not in ("RGB", "HSV"):
        return None
    parts = [evaluator.evaluate(Place(input, groups), 1) for input in node.inputs[:3]]

    def join(*planes):
        joined = np.concatenate(np.broadcast_arrays(*planes), -1)
        return node_math.rgb_from_hsv(joined) if mode == "HSV" else joined

    return evaluator.combine(join, parts, 3)


def _map_range(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field | None:
    if node.data_type != "FLOAT":
        return None
    names = ("Value", "From Min", "From Max", "To Min", "To Max", "Steps")
    inputs = [_input(evaluator, node, groups, 1, name) for name in names]
    mode = node.interpolation_type

    def remap(value, low, high, to_low, to_high, steps):
        result = node_math.map_range(value, low, high, to_low, to_high, mode, steps)
        return np.clip(result, np.minimum(to_low, to_high), np.maximum(to_low, to_high)) if node.clamp else result

    return evaluator.combine(remap, inputs, 1)


def _clamp_node(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    value, low, high = (_input(evaluator, node, groups, 1, name) for name in ("Value", "Min", "Max"))
    if node.clamp_type == "RANGE":
        return evaluator.combine(lambda a, x, y: np.clip(a, np.minimum(x, y), np.maximum(x, y)), [value, low, high], 1)
    return evaluator.combine(lambda a, x, y: np.minimum(np.maximum(a, x), y), [value, low, high], 1)


def _blackbody(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    temperature = evaluator.mean(Place(node.inputs[0], groups), 1)
    return constant(*blackbody.color(float(temperature[0])))


def _light_path(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    evaluator.note("'Light Path' node", "what a diffuse ray sees")
    return constant(LIGHT_PATH.get(socket.name, 0.0))


def _fresnel(evaluator: Evaluator, node: bpy.types.Node, socket, groups: Groups) -> Field:
    ior = max(float(_input(evaluator, node, groups, 1, "IOR").mean()[0]), 1e-3)
    evaluator.note("'Fresnel' node", "its value head-on")
    return constant(((ior - 1) / (ior + 1)) ** 2)


def _layer_weight(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    evaluator.note("'Layer Weight' node", "its value head-on")
    blend = min(max(float(_input(evaluator, node, groups, 1, "Blend").mean()[0]), 0.0), 1 - 1e-5)
    ior = 1 / max(1 - blend, 1e-5)
    return constant(((ior - 1) / (ior + 1)) ** 2 if socket.name == "Fresnel" else 0.0)


def _geometry(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field | None:
    if socket.name != "Backfacing":
        return None
    evaluator.note("material that differs by side", "its front on both sides")
    return constant(0.0)


def _object_info(
    evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups
) -> Field | None:
    if socket.name not in ("Color", "Alpha"):
        return None
    evaluator.note("object colour", "white")
    return WHITE if socket.name == "Color" else constant(1.0)


def _checker(evaluator: Evaluator, node: bpy.types.Node, socket: bpy.types.NodeSocket, groups: Groups) -> Field:
    evaluator.note(f"'{node.bl_label}' node", "the average of its two colours")
    if socket.type != "RGBA":
        return constant(MID)
    first, second = (_input(evaluator, node, groups, 3, name) for name in ("Color1", "Color2"))
    return evaluator.lerp(first, second, constant(MID))


VALUES: dict[str, Callable[..., Field | None]] = {
    "ShaderNodeTexImage": _image,
    "ShaderNodeVertexColor": _vertex_color,
    "ShaderNodeAttribute": _attribute,
    "ShaderNodeRGB": _constant,
    "ShaderNodeValue": _constant,
    "ShaderNodeMath": _math,
    "ShaderNodeVectorMath": _vector_math,
    "ShaderNodeMix": _mix,
    "ShaderNodeMixRGB": _mix_rgb,
    "ShaderNodeHueSaturation": _hue_saturation,
    "ShaderNodeGamma": _gamma,
    "ShaderNodeInvert": _invert,
    "ShaderNodeBrightContrast": _bright_contrast,
    "ShaderNodeValToRGB": _ramp,
    "ShaderNodeRGBCurve": _curves,
    "ShaderNodeFloatCurve": _curves,
    "ShaderNodeRGBToBW": _to_grey,
    "ShaderNodeSeparateColor": _separate,
    "ShaderNodeSeparateRGB": _separate,
    "ShaderNodeSeparateHSV": _separate,
    "ShaderNodeSeparateXYZ": _separate,
    "ShaderNodeCombineColor": _combine,
    "ShaderNodeCombineRGB": _combine,
    "ShaderNodeCombineHSV": _combine,
    "ShaderNodeCombineXYZ": _combine,
    "ShaderNodeMapRange": _map_range,
    "ShaderNodeClamp": _clamp_node,
    "ShaderNodeBlackbody": _blackbody,
    "ShaderNodeLightPath": _light_path,
    "ShaderNodeFresnel": _fresnel,
    "ShaderNodeLayerWeight": _layer_weight,
    "ShaderNodeNewGeometry": _geometry,
    "ShaderNodeObjectInfo": _object_info,
    "ShaderNodeTexChecker": _checker,
    "ShaderNodeTexBrick": _checker,
}
