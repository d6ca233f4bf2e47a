"""Lamps: the numbers of a snapshot give the irradiance that Cycles renders."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake.snapshot import LightKind, SnapshotError

UP = np.array([0.0, 0.0, 1.0])


def cone(lights, cosine):
    """Blender's spot profile: a smooth step from the rim inwards over the blend."""
    rim, blend = lights.spot[0]
    if rim <= -1:
        return 1.0
    t = np.clip((cosine - rim) / max((1 - rim) * blend, 1e-6), 0, 1)
    return t * t * (3 - 2 * t)


def irradiance(lights, point):
    """(3,) on a plane that faces up, from one lamp, by the definitions of `Lights` [W/m2]."""
    kind, frame, size = LightKind(lights.kind[0]), lights.frame[0].astype(float), lights.size[0].astype(float)
    strength = lights.strength[0].astype(float)
    if kind == LightKind.SUN:
        return strength * max(frame[:, 2] @ UP, 0)
    toward = lights.position[0] - point
    if kind in (LightKind.POINT, LightKind.SPOT):
        distance = np.linalg.norm(toward)
        axis = toward / distance
        return strength * cone(lights, axis @ frame[:, 2]) * axis[2] / (distance**2 + size[0] ** 2)
    steps = (np.arange(200) + 0.5) / 200 - 0.5
    x, y = np.meshgrid(steps, steps)
    weight = (x**2 + y**2 <= 0.25) if kind == LightKind.ELLIPSE else np.ones_like(x)
    there = toward + x[..., None] * size[0] * frame[:, 0] + y[..., None] * size[1] * frame[:, 1]
    squared = (there**2).sum(-1)
    facing = np.maximum(there[..., 2], 0) * np.maximum(there @ frame[:, 2], 0) / squared**2
    return strength * (facing * weight).mean() * size[0] * size[1]


LAMPS = {
    "a point": ("POINT", {"energy": 100, "shadow_soft_size": 0.1}, {}),
    "a point without radius": ("POINT", {"energy": 100, "shadow_soft_size": 0.0}, {}),
    "a point that is not normalised": ("POINT", {"energy": 100, "shadow_soft_size": 0.2, "normalize": False}, {}),
    "a scaled point": ("POINT", {"energy": 100, "shadow_soft_size": 0.1, "normalize": False}, {"scale": (3, 3, 3)}),
    "a point without radius or normalisation": (
        "POINT",
        {"energy": 100, "shadow_soft_size": 0.0, "normalize": False},
        {},
    ),
    "a spot on its axis": ("SPOT", {"energy": 100, "shadow_soft_size": 0.05, "spot_size": 1.0, "spot_blend": 0.2}, {}),
    "a spot inside its blend": (
        "SPOT",
        {"energy": 100, "shadow_soft_size": 0.0, "spot_size": 1.0, "spot_blend": 0.6},
        {"location": (0.7, 0, 2)},
    ),
    "a spot that is not normalised": ("SPOT", {"energy": 100, "shadow_soft_size": 0.1, "normalize": False}, {}),
    "a spot scaled along its axis": (
        "SPOT",
        {"energy": 100, "shadow_soft_size": 0.0, "spot_size": 1.0, "spot_blend": 0.0},
        {"location": (0.5, 0, 2), "scale": (1, 1, 1.5)},
    ),
    "a scaled and turned spot": (
        "SPOT",
        {"energy": 100, "shadow_soft_size": 0.0, "spot_size": 1.2, "spot_blend": 0.0},
        {"location": (0.5, 0, 2), "scale": (2, 2, 2), "rotation": (0.1, 0.2, 0.3)},
    ),
    "a square": ("AREA", {"energy": 100, "size": 0.5}, {}),
    "a rectangle": (
        "AREA",
        {"energy": 100, "shape": "RECTANGLE", "size": 2.0, "size_y": 0.3},
        {"rotation": (0.4, 0.2, 0.7)},
    ),
    "a disk": ("AREA", {"energy": 100, "shape": "DISK", "size": 1.5}, {}),
    "an ellipse": (
        "AREA",
        {"energy": 100, "shape": "ELLIPSE", "size": 2.0, "size_y": 0.7},
        {"rotation": (0.4, 0.2, 0.7)},
    ),
    "a scaled square": ("AREA", {"energy": 100, "size": 0.5}, {"scale": (2, 0.5, 3)}),
    "a mirrored rectangle": (
        "AREA",
        {"energy": 100, "shape": "RECTANGLE", "size": 2.0, "size_y": 0.3},
        {"scale": (-1, 1, 1), "rotation": (0.4, 0.2, 0.7)},
    ),
    "a square that is not normalised": ("AREA", {"energy": 100, "size": 0.5, "normalize": False}, {"scale": (2, 3, 1)}),
    "a disk that is not normalised": ("AREA", {"energy": 100, "shape": "DISK", "size": 0.5, "normalize": False}, {}),
    "a sun": ("SUN", {"energy": 3, "angle": 0.01}, {"rotation": (0.5, 0.3, 0)}),
    "a wide sun": ("SUN", {"energy": 3, "angle": 0.3}, {}),
    "a sun that is not normalised": ("SUN", {"energy": 3, "angle": 0.3, "normalize": False}, {}),
    "a scaled sun": ("SUN", {"energy": 3, "angle": 0.1}, {"scale": (3, 3, 3)}),
    "a bright coloured sun": ("SUN", {"energy": 3, "angle": 0.0, "exposure": 1.5, "color": (0.2, 0.5, 1.0)}, {}),
    "a warm point": ("POINT", {"energy": 100, "use_temperature": True, "temperature": 3000, "color": (0.5, 1, 1)}, {}),
}


@pytest.mark.parametrize("name", LAMPS)
def test_lamp_gives_the_irradiance_that_cycles_renders(studio, extract, name):
    kind, settings, place = LAMPS[name]
    studio.lamp(kind, **{"location": (0.1, -0.2, 2.0), **place}, **settings)
    studio.wear()
    expected = irradiance(extract().lights, np.zeros(3))
    studio.bpy.data.objects.remove(studio.bpy.data.objects["worn"])
    rendered = studio.irradiance()
    assert rendered.max() > 0
    np.testing.assert_allclose(expected, rendered, rtol=0.01)


def test_nodes_of_a_lamp_multiply_its_strength(studio, extract):
    lamp = studio.lamp("POINT", energy=50.0, shadow_soft_size=0.1, location=(0, 0, 1)).data
    lamp.use_nodes = True
    emission = next(node for node in lamp.node_tree.nodes if node.type == "EMISSION")
    emission.inputs["Color"].default_value = (0.5, 0.25, 1.0, 1.0)
    emission.inputs["Strength"].default_value = 2.0
    studio.wear()
    expected = irradiance(extract().lights, np.zeros(3))
    studio.bpy.data.objects.remove(studio.bpy.data.objects["worn"])
    np.testing.assert_allclose(expected, studio.irradiance(), rtol=0.01)


def test_what_a_lamp_cannot_say_is_noted(studio, extract):
    studio.lamp("AREA", "narrow", spread=1.0)
    studio.lamp("SPOT", "oval", scale=(2, 1, 1))
    studio.wear()
    notes = " ".join(note.what for note in extract().notes)
    assert "'narrow'" in notes
    assert "'oval'" in notes


def test_hidden_dark_and_portal_lamps_are_no_lamps(studio, extract):
    studio.lamp("POINT", "hidden").hide_render = True
    studio.lamp("POINT", "dark", energy=0.0)
    studio.lamp("AREA", "portal").data.cycles.is_portal = True
    studio.lamp("POINT", "unseen in the viewport").hide_viewport = True
    studio.wear()
    assert extract().lights.names == ("unseen in the viewport",)


def test_negative_light_becomes_none_and_is_noted(studio, extract):
    studio.lamp("POINT", "negative", energy=-5.0)
    mixed = studio.lamp("SUN", "mixed", energy=2.0).data
    mixed.use_nodes = True
    emission = next(node for node in mixed.node_tree.nodes if node.type == "EMISSION")
    below = studio.node(mixed, "ShaderNodeCombineXYZ", X=-0.5, Y=0.25, Z=1.0)
    mixed.node_tree.links.new(below.outputs[0], emission.inputs["Color"])
    studio.lamp("POINT", "positive")
    studio.wear()
    found = extract()
    assert set(found.lights.names) == {"mixed", "positive"}
    strength = found.lights.strength[found.lights.names.index("mixed")]
    np.testing.assert_allclose(strength, (0, 0.5, 2), rtol=1e-6)
    (note,) = [note for note in found.notes if "negative" in note.what]
    assert {"'negative'", "'mixed'"} == set(note.what.partition("(")[2].rstrip(")").split(", "))
    assert note.why == "no light"


def test_instanced_lamps_shine_at_each_instance(studio, extract):
    collection = studio.bpy.data.collections.new("lamps")
    lamp = studio.bpy.data.objects.new("lamp", studio.bpy.data.lights.new("lamp", "POINT"))
    lamp.location = (0, 0, 1)
    collection.objects.link(lamp)
    for x in (1, 5):
        placed = studio.place(None, f"group {x}", (x, 0, 0))
        placed.instance_type, placed.instance_collection = "COLLECTION", collection
    studio.wear()
    assert sorted(extract().lights.position[:, 0].tolist()) == [1, 5]
    np.testing.assert_allclose(extract().lights.position[:, 2], 1)


def test_lamp_without_a_finite_strength_is_refused_by_name(studio, extract):
    studio.lamp("POINT", "broken", energy=float("inf"))
    studio.wear()
    with pytest.raises(SnapshotError, match="'broken'"):
        extract()


def test_reflector_and_shadow_settings_reach_the_snapshot(studio, extract):
    bpy = studio.bpy
    annotations = {"reflector": bpy.props.BoolProperty()}
    Settings = type("Settings", (bpy.types.PropertyGroup,), {"__annotations__": annotations})  # noqa: N806
    bpy.utils.register_class(Settings)
    bpy.types.Light.gi_volumes = bpy.props.PointerProperty(type=Settings)
    try:
        studio.lamp("POINT", "a").data.gi_volumes.reflector = True
        studio.lamp("POINT", "b", use_shadow=False)
        studio.wear()
        lights = extract().lights
    finally:
        del bpy.types.Light.gi_volumes
        bpy.utils.unregister_class(Settings)
    found = {name: (bool(r), bool(s)) for name, r, s in zip(lights.names, lights.reflector, lights.shadow, strict=True)}
    assert found == {"a": (True, True), "b": (False, False)}
