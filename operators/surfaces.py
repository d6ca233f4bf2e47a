"""Shader nodes to one surface: what reflects, emits, and lets light through.

Comes in: a shader socket. Goes out: a `Surface`, the parameters of one Principled-like layer as fields. Mix and
Add combine surfaces; the result is exact for mixtures of diffuse, emission and transparency, and averages the
parameters otherwise, which is noted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import bpy
import numpy as np

from .evaluate import Evaluator
from .fields import Field, constant
from .nodes import Place, named

BLACK, WHITE = constant(0.0, 0.0, 0.0), constant(1.0, 1.0, 1.0)
ZERO, ONE, MID = constant(0.0), constant(1.0), constant(0.5)
DEFAULT_IOR = 1.5


@dataclass(frozen=True)
class Surface:
    """One layer; `alpha` is its coverage, which scales all the rest, emission included.

    `emits_only` marks plain emission, which adds to another surface without covering it.
    """

    color: Field = BLACK
    emission: Field = BLACK
    alpha: Field = ONE
    metallic: Field = ZERO
    roughness: Field = ONE
    transmission: Field = ZERO
    ior: float = DEFAULT_IOR
    specular_level: float = 0.0
    emits_only: bool = False


def read(evaluator: Evaluator, place: Place) -> Surface | None:
    """Return the surface that a shader socket describes.

    Parameters
    ----------
    evaluator : Evaluator
        Evaluates the inputs of shaders.
    place : Place
        A shader input.

    Returns
    -------
    Surface or None
        None when nothing is connected.
    """
    source = evaluator.graph.resolve(place)
    if not source.socket.is_output:
        return None
    node = source.socket.node
    if node.mute:
        return None
    shader = SHADERS.get(node.bl_idname)
    if shader is None:
        evaluator.note(f"'{node.bl_label}' node", "a grey diffuse surface")
        return Surface(color=constant(0.8, 0.8, 0.8))
    return shader(_Inputs(evaluator, node, source.groups))


@dataclass(frozen=True)
class _Inputs:
    """A shader node and the groups around it."""

    evaluator: Evaluator
    node: bpy.types.Node
    groups: tuple

    def color(self, *names: str) -> Field:
        """A colour; black where the node has no such input."""
        socket = named(self.node, *names)
        return self.evaluator.evaluate(Place(socket, self.groups), 3) if socket else BLACK

    def value(self, default: float, *names: str) -> Field:
        """A scalar."""
        socket = named(self.node, *names)
        return self.evaluator.evaluate(Place(socket, self.groups), 1) if socket else constant(default)

    def number(self, default: float, *names: str) -> float:
        """A constant scalar."""
        socket = named(self.node, *names)
        return float(self.evaluator.mean(Place(socket, self.groups), 1)[0]) if socket else default

    def shader(self, index: int) -> Surface | None:
        """A shader input, counted among all."""
        return read(self.evaluator, Place(self.node.inputs[index], self.groups))

    def is_linked(self, name: str) -> bool:
        """Whether something feeds an input."""
        socket = named(self.node, name)
        return socket is not None and self.evaluator.graph.resolve(Place(socket, self.groups)).socket.is_output

    def note_normals(self) -> None:
        """Normal and bump maps are finer than the light that is stored."""
        if self.is_linked("Normal"):
            self.evaluator.note("normal or bump map", "the mesh's own normals")


def _principled(inputs: _Inputs) -> Surface:
    inputs.note_normals()
    _note_layers(inputs)
    emission = inputs.evaluator.product(
        inputs.color("Emission Color", "Emission"), inputs.value(0.0, "Emission Strength")
    )
    return Surface(
        color=inputs.color("Base Color"),
        emission=emission,
        alpha=inputs.value(1.0, "Alpha"),
        metallic=inputs.value(0.0, "Metallic"),
        roughness=inputs.value(0.5, "Roughness"),
        transmission=inputs.value(0.0, "Transmission Weight", "Transmission"),
        ior=inputs.number(DEFAULT_IOR, "IOR"),
        specular_level=inputs.number(0.5, "Specular IOR Level", "Specular"),
    )


def _note_layers(inputs: _Inputs) -> None:
    """Layers of Principled that a material record does not have."""
    for name, instead in (
        ("Subsurface Weight", "diffuse reflection"),
        ("Coat Weight", "no coat"),
        ("Sheen Weight", "no sheen"),
        ("Thin Film Thickness", "no thin film"),
    ):
        if not inputs.value(0.0, name).is_value(0.0):
            inputs.evaluator.note(name.removesuffix(" Weight").lower(), instead)
    if not inputs.color("Specular Tint").is_value(1.0) and named(inputs.node, "Specular Tint"):
        inputs.evaluator.note("specular tint", "white reflections")


def _diffuse(inputs: _Inputs) -> Surface:
    inputs.note_normals()
    return Surface(color=inputs.color("Color", "Base Color"))


def _diffuse_like(inputs: _Inputs) -> Surface:
    inputs.evaluator.note(f"'{inputs.node.bl_label}' node", "a diffuse surface of its colour")
    return _diffuse(inputs)


def _emission(inputs: _Inputs) -> Surface:
    emission = inputs.evaluator.product(inputs.color("Color"), inputs.value(1.0, "Strength"))
    return Surface(emission=emission, emits_only=True)


def _transparent(inputs: _Inputs) -> Surface:
    color = inputs.color("Color")
    if color.is_value(1.0):
        return Surface(alpha=ZERO)
    return Surface(color=color, transmission=ONE, roughness=ZERO, ior=1.0)


def _glass(inputs: _Inputs) -> Surface:
    inputs.note_normals()
    level = 0.5 if inputs.node.bl_idname == "ShaderNodeBsdfGlass" else 0.0
    return Surface(
        color=inputs.color("Color"),
        transmission=ONE,
        roughness=inputs.value(0.0, "Roughness"),
        ior=inputs.number(DEFAULT_IOR, "IOR"),
        specular_level=level,
    )


def _translucent(inputs: _Inputs) -> Surface:
    inputs.evaluator.note("'Translucent BSDF' node", "light that passes straight through, tinted")
    return Surface(color=inputs.color("Color"), transmission=ONE)


def _metal(inputs: _Inputs) -> Surface:
    inputs.note_normals()
    return Surface(
        color=inputs.color("Color", "Base Color"),
        metallic=ONE,
        roughness=inputs.value(0.5, "Roughness"),
        specular_level=0.5,
    )


def _specular(inputs: _Inputs) -> Surface:
    inputs.note_normals()
    inputs.evaluator.note("'Specular BSDF' node", "a surface of its base colour with plain reflections")
    transparency = inputs.value(0.0, "Transparency")
    return Surface(
        color=inputs.color("Base Color"),
        emission=inputs.color("Emissive Color"),
        alpha=inputs.evaluator.combine(lambda a: 1 - a, [transparency], 1),
        roughness=inputs.value(0.2, "Roughness"),
        specular_level=0.5,
    )


def _holdout(inputs: _Inputs) -> Surface:
    return Surface()


def _mix(inputs: _Inputs) -> Surface | None:
    factor = inputs.evaluator.evaluate(Place(inputs.node.inputs[0], inputs.groups), 1)
    first, second = inputs.shader(1), inputs.shader(2)
    if factor.is_value(0.0) or factor.is_value(1.0):
        return (second if factor.is_value(1.0) else first) or Surface()
    return mixed(inputs.evaluator, first or Surface(), second or Surface(), factor)


def mixed(evaluator: Evaluator, first: Surface, second: Surface, factor: Field) -> Surface:
    """Return a mixture of two surfaces.

    Parameters
    ----------
    evaluator : Evaluator
        Combines fields.
    first, second : Surface
        The surfaces.
    factor : Field
        Share of the second, 0..1.

    Returns
    -------
    Surface
        Exact when one of them is fully transparent, or both cover everything and differ in colour and
        emission only.
    """
    alpha = evaluator.lerp(first.alpha, second.alpha, factor)
    if first.alpha.is_value(0.0):
        return replace(second, alpha=evaluator.product(second.alpha, factor), emits_only=False)
    if second.alpha.is_value(0.0):
        rest = evaluator.combine(lambda a: 1 - a, [factor], 1)
        return replace(first, alpha=evaluator.product(first.alpha, rest), emits_only=False)
    if not (first.alpha.is_value(1.0) and second.alpha.is_value(1.0)) and first.alpha != second.alpha:
        evaluator.note("mix of surfaces of different transparency", "their averaged parameters")
    return _averaged(evaluator, first, second, factor, alpha)


def _averaged(evaluator: Evaluator, first: Surface, second: Surface, factor: Field, alpha: Field) -> Surface:
    """Parameters in between; black surfaces (emission alone) leave those of the other."""
    share = float(factor.mean()[0])
    if first.emits_only:
        first = replace(second, color=BLACK, emission=first.emission)
    elif second.emits_only:
        second = replace(first, color=BLACK, emission=second.emission)
    shapes = ("metallic", "roughness", "transmission")
    if any(getattr(first, name) != getattr(second, name) for name in shapes):
        evaluator.note("mix of different kinds of surface", "one surface of averaged parameters")
    return Surface(
        color=evaluator.lerp(first.color, second.color, factor),
        emission=evaluator.lerp(first.emission, second.emission, factor),
        alpha=alpha,
        **{name: evaluator.lerp(getattr(first, name), getattr(second, name), factor) for name in shapes},
        ior=first.ior + (second.ior - first.ior) * share,
        specular_level=first.specular_level + (second.specular_level - first.specular_level) * share,
    )


def _add(inputs: _Inputs) -> Surface | None:
    first, second = inputs.shader(0), inputs.shader(1)
    if first is None or second is None:
        return first or second
    return added(inputs.evaluator, first, second)


def added(evaluator: Evaluator, first: Surface, second: Surface) -> Surface:
    """Return the sum of two surfaces.

    Parameters
    ----------
    evaluator : Evaluator
        Combines fields.
    first, second : Surface
        The surfaces.

    Returns
    -------
    Surface
        Exact when one only emits and the other covers everything; the sum of two reflecting surfaces is noted.
    """
    emission = evaluator.combine(np.add, [first.emission, second.emission], 3)
    if second.emission.is_value(0.0):
        emission = first.emission
    elif first.emission.is_value(0.0):
        emission = second.emission
    if first.emits_only and second.emits_only:
        return replace(first, emission=emission)
    if first.emits_only or second.emits_only:
        base = second if first.emits_only else first
        return _glowing(evaluator, base, emission)
    if first.alpha.is_value(0.0) or second.alpha.is_value(0.0):
        evaluator.note("transparency added to a surface", "a half-transparent surface")
        base = second if first.alpha.is_value(0.0) else first
        return replace(base, emission=emission, alpha=evaluator.product(base.alpha, MID))
    evaluator.note("sum of reflecting surfaces", "one surface of their summed colours")
    total = evaluator.combine(lambda a, b: np.minimum(a + b, 1), [first.color, second.color], 3)
    return replace(_averaged(evaluator, first, second, MID, first.alpha), color=total, emission=emission)


def _glowing(evaluator: Evaluator, base: Surface, emission: Field) -> Surface:
    """A surface that also emits; where it covers nothing, its glow takes half of the coverage."""
    if base.alpha.is_value(1.0):
        return replace(base, emission=emission)
    evaluator.note("emission added to a transparent surface", "a surface of the same glow that covers half or more")
    alpha = evaluator.combine(lambda a: np.maximum(a, 0.5), [base.alpha], 1)
    glow = evaluator.combine(lambda e, a: e / a, [emission, alpha], 3)
    return replace(base, emission=glow, alpha=alpha)


SHADERS: dict[str, Callable[[_Inputs], Surface | None]] = {
    "ShaderNodeBsdfPrincipled": _principled,
    "ShaderNodeBsdfDiffuse": _diffuse,
    "ShaderNodeEmission": _emission,
    "ShaderNodeBackground": _emission,
    "ShaderNodeBsdfTransparent": _transparent,
    "ShaderNodeBsdfGlass": _glass,
    "ShaderNodeBsdfRefraction": _glass,
    "ShaderNodeBsdfTranslucent": _translucent,
    "ShaderNodeBsdfAnisotropic": _metal,
    "ShaderNodeBsdfGlossy": _metal,
    "ShaderNodeBsdfMetallic": _metal,
    "ShaderNodeEeveeSpecular": _specular,
    "ShaderNodeSubsurfaceScattering": _diffuse_like,
    "ShaderNodeBsdfSheen": _diffuse_like,
    "ShaderNodeBsdfVelvet": _diffuse_like,
    "ShaderNodeBsdfToon": _diffuse_like,
    "ShaderNodeBsdfHair": _diffuse_like,
    "ShaderNodeBsdfHairPrincipled": _diffuse_like,
    "ShaderNodeHoldout": _holdout,
    "ShaderNodeMixShader": _mix,
    "ShaderNodeAddShader": _add,
}
