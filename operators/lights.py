"""Lamps of a scene, in physical units.

Comes in: evaluated lamps and their placements. Goes out: `Lights`. Blender states a lamp's strength as its power
[W] (sun: irradiance [W/m2]); the conversions follow what Cycles renders and are measured against it in
`tests/operators/test_lights_extract.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import bpy
import numpy as np

from ..bake.snapshot import LightKind, Lights, SnapshotError
from .evaluate import Evaluator
from .nodes import Place
from .notes import Notes

KINDS = {"POINT": LightKind.POINT, "SPOT": LightKind.SPOT, "SUN": LightKind.SUN}
AREA_KINDS = {
    "SQUARE": LightKind.RECTANGLE,
    "RECTANGLE": LightKind.RECTANGLE,
    "DISK": LightKind.ELLIPSE,
    "ELLIPSE": LightKind.ELLIPSE,
}
# Axes of a cone that differ by less than this are taken as round [ratio].
ROUND = 0.01
# Cycles treats a lamp without normalisation and without radius as if it had this sphere's area over pi.
POINT_AREA = 4.0


@dataclass
class Lamps:
    """Lamps gathered so far; `add` one after the other, then `record`."""

    notes: Notes
    evaluator: Evaluator
    rows: list[tuple] = field(default_factory=list)

    def add(self, lamp: bpy.types.Object, matrix: np.ndarray, name: str) -> None:
        """Add a lamp.

        Parameters
        ----------
        lamp : bpy.types.Object
            The evaluated lamp.
        matrix : (4, 4) float64 [m]
            World from lamp.
        name : str
            Its name, for messages.

        Raises
        ------
        SnapshotError
            Its placement or its strength is not finite.
        """
        data = lamp.data
        if data.type == "AREA" and getattr(getattr(data, "cycles", None), "is_portal", False):
            return
        color = _color(data) * self._node_color(data, name)
        if not (np.isfinite(matrix).all() and np.isfinite(color).all()):
            raise SnapshotError(f"lamp '{name}' has an invalid position or strength: give it finite numbers")
        if (color < 0).any():
            self.notes.add("negative lamp", "no light", f"'{name}'")
            color = np.maximum(color, 0)
        if not color.any():
            return
        frame, scale = _frame(matrix)
        kind, strength, size, spot = self._shape(data, color, scale, name)
        self._note_links(lamp, name)
        reflector = bool(getattr(getattr(data.original, "gi_volumes", None), "reflector", False))
        self.rows.append((kind, matrix[:3, 3], frame, strength, size, spot, reflector, data.use_shadow, name))

    def record(self) -> Lights:
        """Return all lamps.

        Returns
        -------
        Lights
            One row for each.
        """
        kind, position, frame, strength, size, spot, reflector, shadow, names = (
            zip(*self.rows, strict=True) if self.rows else ((),) * 9
        )
        count = len(self.rows)
        return Lights(
            kind=np.array(kind, np.uint8).reshape(count),
            position=np.array(position, np.float64).reshape(count, 3),
            frame=np.array(frame, np.float32).reshape(count, 3, 3),
            strength=np.array(strength, np.float32).reshape(count, 3),
            size=np.array(size, np.float32).reshape(count, 2),
            spot=np.array(spot, np.float32).reshape(count, 2),
            reflector=np.array(reflector, bool).reshape(count),
            shadow=np.array(shadow, bool).reshape(count),
            names=tuple(names),
        )

    def _shape(self, data: bpy.types.Light, color: np.ndarray, scale: np.ndarray, name: str) -> tuple:
        """Kind, strength, size and cone in the units of `Lights`."""
        no_cone = (-1.0, 0.0)
        if data.type == "SUN":
            solid = 1.0 if data.normalize or data.angle == 0 else math.pi * math.sin(data.angle / 2) ** 2
            return LightKind.SUN, color * solid, (data.angle, 0.0), no_cone
        if data.type == "AREA":
            size = (
                np.array([data.size, data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else data.size]) * scale[:2]
            )
            size = np.maximum(size, 1e-4)
            kind = AREA_KINDS[data.shape]
            area = size[0] * size[1] * (math.pi / 4 if kind == LightKind.ELLIPSE else 1.0)
            if data.spread < math.pi * (1 - ROUND):
                self.notes.add("narrow spread of an area lamp", "a full spread of the same power", f"'{name}'")
            return kind, color / (math.pi * (area if data.normalize else 1.0)), tuple(size), no_cone
        radius = data.shadow_soft_size
        share = 1.0 if data.normalize else (4 * math.pi * radius**2 if radius > 0 else POINT_AREA)
        cone = self._cone(data, scale, name) if data.type == "SPOT" else no_cone
        is_sphere = 0.0 if data.use_soft_falloff else 1.0
        return KINDS[data.type], color * share / (4 * math.pi), (radius, is_sphere), cone

    def _cone(self, data: bpy.types.SpotLight, scale: np.ndarray, name: str) -> tuple[float, float]:
        """Cosine of half the cone and the blend; a lamp's scale widens or narrows its cone."""
        if data.use_square or abs(scale[0] - scale[1]) > ROUND * max(scale[0], scale[1]):
            self.notes.add("square or oval spot", "a round cone", f"'{name}'")
        half = data.spot_size / 2
        ratio = math.sqrt(scale[0] * scale[1]) / max(scale[2], 1e-9)
        if half < math.pi / 2 and abs(ratio - 1) > 1e-6:
            half = math.atan(math.tan(half) * ratio)
        return math.cos(half), data.spot_blend

    def _node_color(self, data: bpy.types.Light, name: str) -> np.ndarray:
        """What the lamp's nodes multiply its strength with, (3,) float64."""
        if data.node_tree is None or not _uses_nodes(data):
            return np.ones(3)
        output = data.node_tree.get_output_node("CYCLES")
        if output is None:
            return np.zeros(3)
        self.evaluator.place = f"lamp '{name}'"
        source = self.evaluator.graph.resolve(Place(output.inputs["Surface"]))
        if not source.socket.is_output:
            return np.zeros(3)
        if source.socket.node.type != "EMISSION":
            self.notes.add(f"'{source.socket.node.name}' node of a lamp", "a plain emission of strength 1", f"'{name}'")
            return np.ones(3)
        node = source.socket.node
        color = self.evaluator.mean(Place(node.inputs["Color"], source.groups), 3)
        return color * self.evaluator.mean(Place(node.inputs["Strength"], source.groups), 1)

    def _note_links(self, lamp: bpy.types.Object, name: str) -> None:
        """Lamps that light some objects only."""
        linking = lamp.light_linking
        if linking is not None and (linking.receiver_collection or linking.blocker_collection):
            self.notes.add("light linking", "a lamp that lights everything", f"'{name}'")
        if not lamp.visible_diffuse:
            self.notes.add("lamp hidden from diffuse surfaces", "a lamp that lights everything", f"'{name}'")


def _uses_nodes(data: bpy.types.Light) -> bool:
    """Lamps keep this switch in Blender 5 as well; where it goes, nodes count."""
    return bool(getattr(data, "use_nodes", True))


def _color(data: bpy.types.Light) -> np.ndarray:
    """Power (sun: irradiance) for each colour, (3,) float64 [W or W/m2]."""
    color = np.array(data.color, np.float64) * data.energy * 2.0**data.exposure
    return color * np.array(data.temperature_color, np.float64) if data.use_temperature else color


def _frame(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) whose -z is where the lamp shines, and the scale of its axes (3,)."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    z = matrix[:3, 2] / scale[2] if scale[2] > 0 else np.array([0.0, 0.0, 1.0])
    x = matrix[:3, 0] - z * (matrix[:3, 0] @ z)
    if np.linalg.norm(x) <= 1e-6 * scale[0] or scale[0] == 0:
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z]), scale
