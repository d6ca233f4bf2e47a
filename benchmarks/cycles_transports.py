"""Cycles' bakes of the transports that a changing sun and sky need: one sun, or one function of the sky, each.

Comes in: the open scene, points, normals. Goes out: irradiance there, and the time it took. What is cheapest:
a function of the sky is a world of that signed radiance, so that one bake is enough, found by paths that leave the
scene (no shadow rays to it); paths end by Russian roulette as early as Blender's default has it; parts of local light
that the scene has none of are not baked.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import bpy
import mathutils
import numpy as np
from gi_volumes.benchmarks import cycles_judge, scene_edits
from gi_volumes.benchmarks.cost import Clock, Cost
from gi_volumes.tree import harmonics

SUN = "benchmark: sun"
WORLD = "benchmark: sky"
POWERS = ((), (1,), (2,), (0,), (0, 1), (1, 2), (2, 2), (0, 2), (0, 0))
"""Axes whose coordinates are multiplied in each harmonic, as `tree/harmonics.py` lists them; see `_terms`."""


@dataclass(frozen=True)
class Transport:
    """One thing to bake: `group` "local", "sun" or "sky"; `toward` the sun; `function` of the sky."""

    group: str
    toward: tuple[float, ...] = ()
    function: int = 0


class Bakes:
    """Bakes of the open scene, whose materials are as Cycles is to see them.

    Parameters
    ----------
    points : (n, 3) float64 ndarray [m]
        In world space.
    axes : (k, 3) float64 ndarray
        Normals of the quads at each point.
    bounces, threads : int
        As in `cycles_judge.Settings`.
    diameter : float [rad]
        Of the sun.
    """

    def __init__(self, points: np.ndarray, axes: np.ndarray, bounces: int, threads: int, diameter: float) -> None:
        self._points, self._normals = np.repeat(points, len(axes), axis=0), np.tile(axes, (len(points), 1))
        self._axes = len(axes)
        self._settings = cycles_judge.Settings(bounces=bounces, threads=threads, sure_bounces=0)
        light = bpy.data.lights.new(SUN, "SUN")
        light.energy, light.angle = 0.0, diameter
        self._sun = bpy.data.objects.new(SUN, light)
        self._sun.rotation_mode = "QUATERNION"
        bpy.context.scene.collection.objects.link(self._sun)

    def run(self, transport: Transport, samples: int, seed: int) -> tuple[Cost, np.ndarray]:
        """Bake once.

        Parameters
        ----------
        transport : Transport
            What.
        samples, seed : int
            As in `cycles_judge.Settings`.

        Returns
        -------
        cost : Cost
            Of all that is needed: quads, synchronisation, rays.
        values : (n, k, 3) float64 ndarray
            Irradiance, per unit irradiance of the sun or radiance of the function.
        """
        settings = replace(self._settings, samples=samples, seeds=(seed,))
        with scene_edits.Changes() as changes:
            self._light(changes, transport)
            passes = _passes(transport.group)
            with Clock() as clock:
                found = cycles_judge.irradiance(self._points, self._normals, passes, settings)
        return clock.cost, found.mean.reshape(-1, self._axes, 3)

    def _light(self, changes: scene_edits.Changes, transport: Transport) -> None:
        """Let nothing else shine than the transport's sun, or sky."""
        if transport.group == "sun":
            scene_edits.sources_off(changes, frozenset({"sun"}))
            changes.set(self._sun.data, energy=1.0)
            self._sun.rotation_quaternion = mathutils.Vector(transport.toward).to_track_quat("Z", "Y")
        elif transport.group == "sky":
            changes.set(bpy.context.scene, world=_world(transport.function))


def _passes(group: str) -> tuple[cycles_judge.Pass, ...]:
    """Bakes that add up to a transport, without those of light that the scene does not have."""
    passes = cycles_judge.TRANSPORTS[group]
    if group != "local":
        return passes
    lamps = {scene_edits.light_source(item.data) for item in bpy.context.scene.objects if item.type == "LIGHT"}
    there = lamps | ({"emission"} if any(map(_shines, scene_edits.material_trees())) else set())
    return tuple(part for part in passes if part.sources & there)


def _shines(tree: bpy.types.NodeTree) -> bool:
    """Whether a material may emit light."""
    strengths = [n.inputs[name] for n in tree.nodes if (name := scene_edits.EMISSION_INPUTS.get(n.bl_idname))]
    return any(socket.is_linked or socket.default_value > 0 for socket in strengths)


def _world(function: int) -> bpy.types.World:
    """A sky whose radiance is one of the nine harmonics, of either sign, that no shadow rays look for."""
    name = f"{WORLD} {function}"
    if name in bpy.data.worlds:
        return bpy.data.worlds[name]
    world = scene_edits.uniform_world(name, 1.0)
    world.cycles.sampling_method = "NONE"
    tree = world.node_tree
    background = next(node for node in tree.nodes if node.type == "BACKGROUND")
    background.inputs["Strength"].default_value = 1.0
    direction = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(direction, split.inputs[0])
    total = None
    for weight, axes in _terms(function):
        value = weight
        for axis in axes:
            value = _math(tree, "MULTIPLY", value, split.outputs[axis])
        total = value if total is None else _math(tree, "ADD", total, value)
    if isinstance(total, float):
        background.inputs["Strength"].default_value = total
    else:
        tree.links.new(total, background.inputs["Strength"])
    return world


def _terms(function: int) -> Iterator[tuple[float, tuple[int, ...]]]:
    """A harmonic as a sum of products of coordinates: (weight, axes)."""
    corner, axis = np.full(3, 3**-0.5), np.eye(3)
    axes = POWERS[function]
    if function < 4:
        yield float(harmonics.basis(axis[axes[0]] if axes else corner)[function]), axes
    elif function in (4, 5, 7):
        yield 3 * float(harmonics.basis(corner)[function]), axes
    else:
        pole = float(harmonics.basis(axis[axes[0]])[function])
        yield from ((1.5 * pole, axes), (-0.5 * pole, ())) if function == 6 else ((pole, (0, 0)), (-pole, (1, 1)))


def _math(tree: bpy.types.NodeTree, operation: str, *values) -> bpy.types.NodeSocket:
    """Output of a new node that computes with numbers or outputs."""
    node = tree.nodes.new("ShaderNodeMath")
    node.operation = operation
    for socket, value in zip(node.inputs, values, strict=False):
        if isinstance(value, float):
            socket.default_value = value
        else:
            tree.links.new(value, socket)
    return node.outputs[0]
