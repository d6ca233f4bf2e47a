"""What stands in the demo's court and rooms: fountain, benches, trees, pots, lamps' fittings.

Comes in: the palette. Goes out: objects in the open scene.
"""

from __future__ import annotations

import math

import bpy
import numpy as np

from . import shapes
from .building import CEILING, FLOOR, NORTH, WALL
from .matter import Palette
from .stage import bevel, kit, place, put, smooth

LEAF_CARDS = 320
LAMP = (-4.0, 8.4, 2.75)
"""The blue room's lamp hangs here [m]."""


def furnish(palette: Palette) -> None:
    """Add all furniture.

    Parameters
    ----------
    palette : Palette
        Its materials.
    """
    _build_fountain(palette)
    _plant_trees(palette)
    _set_benches(palette)
    _set_pots(palette)
    _hang_fittings(palette)
    _set_plinth(palette)


def _build_fountain(palette: Palette) -> None:
    """An octagonal basin with a bowl and a ball in the middle of the court."""
    basin = [(1.25, 0.0), (1.30, 0.06), (1.15, 0.12), (1.15, 0.40), (1.25, 0.48), (1.0, 0.48), (0.95, 0.2), (0.2, 0.2)]
    stem = [(0.2, 0.2), (0.12, 0.35), (0.11, 0.8), (0.16, 0.9), (0.48, 1.04), (0.52, 1.12), (0.46, 1.12), (0.1, 1.0)]
    put("basin", shapes.turned([*basin[:-1], (0.05, 0.2)], 8), [palette.stone], (0, 0, 0), math.pi / 8)
    smooth(put("bowl", shapes.turned(stem, 32), [palette.stone]))
    smooth(put("ball", _ball(0.17), [palette.bronze], (0, 0, 1.14)))


def _ball(radius: float) -> shapes.Solid:
    """A sphere, cut flat where its poles would be."""
    angle = np.linspace(-np.pi / 2 + 0.1, np.pi / 2 - 0.1, 14)
    return shapes.turned(list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)), 28)


def _plant_trees(palette: Palette) -> None:
    """Two instances of one tree in planters; its leaves are masked cards."""
    trunk = shapes.turned([(0.10, 0.3), (0.075, 0.8), (0.06, 1.5), (0.05, 2.1), (0.02, 2.7)], 12)
    generator = np.random.default_rng(7)
    direction = generator.normal(size=(LEAF_CARDS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = generator.uniform(0.25, 1.0, (LEAF_CARDS, 1)) ** (1 / 3)
    crown = shapes.cards(direction * radius * (0.95, 0.95, 0.8) + (0, 0, 2.6), 0.42, seed=8)
    planter = shapes.box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5))
    soil = shapes.box((-0.42, -0.42, 0.48), (0.42, 0.42, 0.52))
    tree = kit(
        "tree",
        [
            smooth(put("trunk", trunk, [palette.bark])),
            put("crown", crown, [palette.leaves]),
            bevel(put("planter", planter, [palette.clay]), 0.03),
            put("soil", soil, [palette.bark]),
        ],
    )
    place(tree, (-3.6, 2.6, 0.0))
    place(tree, (3.7, -2.7, 0.0), math.radians(130), (0.92, 0.92, 0.92))


def _set_benches(palette: Palette) -> None:
    """Benches with one arm; the one across the court is a mirror image."""
    parts = {
        "seat": ((-0.9, -0.22, 0.38), (0.9, 0.22, 0.45)),
        "left leg": ((-0.8, -0.2, 0.0), (-0.68, 0.2, 0.38)),
        "right leg": ((0.68, -0.2, 0.0), (0.8, 0.2, 0.38)),
        "arm": ((0.8, -0.22, 0.45), (0.9, 0.22, 0.75)),
    }
    bench = kit("bench", [bevel(put(name, shapes.box(*box), [palette.wood]), 0.012) for name, box in parts.items()])
    place(bench, (7.45, -0.9, FLOOR), math.pi / 2)
    place(bench, (7.45, -3.5, FLOOR), math.pi / 2, (-1, 1, 1))
    place(bench, (-1.6, 6.45, FLOOR))
    place(bench, (-6.5, 9.1, FLOOR))


def _set_pots(palette: Palette) -> None:
    """Clay pots of three sizes in the corners of the galleries and the court."""
    profile = [
        (0.16, 0.0),
        (0.20, 0.05),
        (0.30, 0.30),
        (0.32, 0.45),
        (0.24, 0.58),
        (0.27, 0.64),
        (0.22, 0.64),
        (0.20, 0.5),
    ]
    pot = kit("pot", [smooth(put("pot", shapes.turned(profile), [palette.clay]))])
    for x, y, z, scale in (
        (4.7, 3.7, 0, 1.2),
        (3.9, 3.75, 0, 0.8),
        (-4.6, -3.6, 0, 1.0),
        (7.4, 6.4, FLOOR, 1.4),
        (2.2, 6.4, FLOOR, 1),
    ):
        place(pot, (x, y, z), x, (scale, scale, scale))


def _hang_fittings(palette: Palette) -> None:
    """The shade over the blue room's lamp, and the light panel of the room east of it."""
    x, y, z = LAMP
    shade = shapes.turned([(0.30, 0.0), (0.31, 0.02), (0.10, 0.22), (0.02, 0.26), (0.01, CEILING - z - 0.15)])
    smooth(put("shade", shade, [palette.bronze], (x, y, z + 0.15)))
    front = NORTH - WALL - 0.06
    panel = shapes.slab((3.2, front, 1.3), (5.0, NORTH - WALL, 2.9))
    put("light panel", shapes.Solid(panel.vertices, panel.faces, np.zeros_like(panel.slots)), [palette.panel])


def _set_plinth(palette: Palette) -> None:
    """A white ball on a plinth in the red room, to see its light by."""
    bevel(put("plinth", shapes.box((-0.25, -0.25, 0), (0.25, 0.25, 0.9)), [palette.white], (10.0, 3.0, FLOOR)), 0.02)
    smooth(put("globe", _ball(0.3), [palette.white], (10.0, 3.0, FLOOR + 1.198)))


def point_lamp() -> bpy.types.Light:
    """Make the blue room's lamp.

    Returns
    -------
    bpy.types.Light
    """
    lamp = bpy.data.lights.new("lamp", "POINT")
    lamp.energy, lamp.color, lamp.shadow_soft_size, lamp.use_soft_falloff = 90.0, (1.0, 0.72, 0.42), 0.08, False
    return lamp
