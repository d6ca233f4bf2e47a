"""The building of the demo: ground, arcades, walls, roofs.

Comes in: the palette. Goes out: objects in the open scene. The court lies in the middle, galleries around it,
rooms around the galleries; x points east, y north, z = 0 is the floor of the court.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import bpy
import numpy as np

from . import shapes
from .matter import Palette
from .shapes import Solid
from .stage import bevel, kit, place, put, repeat, show, smooth

EAST, NORTH = 12.0, 10.0
"""Half the building [m]."""
WING_EAST, WING_NORTH = 8.0, 7.0
"""Half the distance between the walls at the back of the galleries [m]."""
COURT_EAST, COURT_NORTH = 5.5, 4.5
"""Half the distance between the lines of columns [m]."""

FLOOR = 0.3
"""Height of galleries and rooms over the court: two steps [m]."""
SPRINGING = 2.5
"""Height at which arches begin [m]."""
CEILING, ROOF = 4.0, 4.25
"""Underside and top of the roof slab [m]."""
UPPER_CEILING, UPPER_ROOF, TOP = 7.3, 7.55, 8.0
"""The same of the northern wing's upper storey, and the top of its parapet [m]."""

WALL, ARCADE, PARTITION, PIER = 0.35, 0.4, 0.25, 0.5
"""Thicknesses [m]."""
ARCH = 0.41
"""Radius of an arch over the width of its bay: leaves room for a capital."""
DOOR = 2.3
"""Height of a door [m]."""
WINDOW_WIDTH, WINDOW_HEIGHT, SILL = 1.3, 1.6, 0.9
"""Size of every window, and its height over the floor [m]."""


def build(palette: Palette) -> None:
    """Add the whole building.

    Parameters
    ----------
    palette : Palette
        Its materials.
    """
    _lay_ground(palette)
    _raise_arcades(palette)
    _raise_walls(palette)
    _cover(palette)
    _raise_upper_storey(palette)


def _lay_ground(palette: Palette) -> None:
    """Land, the tiled court, the raised floor around it and the steps between them."""
    x, y = COURT_EAST - 0.3, COURT_NORTH - 0.3
    put("land", shapes.box((-17, -15, -0.5), (17, 15, -0.02)), [palette.stone])
    put("floor", shapes.slab((-EAST, -NORTH, -0.02), (EAST, NORTH, FLOOR), [(-x, x, -y, y)]), [palette.stone])
    tiles = shapes.slab((-x, -y, -0.02), (x, y, 0.0))
    uvs = np.concatenate([tiles.vertices[face][:, :2] for face in tiles.faces]) / 2.0
    put("court", Solid(tiles.vertices, tiles.faces, tiles.slots, uvs), [palette.tiles, palette.stone])
    for side in (-1, 1):
        step = shapes.box((-1.0, -0.4, 0.0), (1.0, 0.0, FLOOR / 2))
        bevel(put("step", step, [palette.stone], (0, side * y, 0), math.pi * (side < 0)), 0.02)


def _raise_arcades(palette: Palette) -> None:
    """Four arcades, their corner piers and the instanced columns."""
    column = kit("column", _column(palette))
    sides = ((COURT_EAST, COURT_NORTH, 0.0, 5), (COURT_NORTH, COURT_EAST, math.pi / 2, 4))
    for (half, away, turn, bays), flip in itertools.product(sides, (0.0, math.pi)):
        length, angle = 2 * half - PIER, turn + flip
        solid = shapes.arcade(length, bays, ARCH * length / bays, CEILING - SPRINGING, ARCADE)
        put("arcade", solid, [palette.plaster], _turned((-length / 2, -away, SPRINGING), angle), angle)
        for bay in range(1, bays):
            place(column, _turned((bay * length / bays - length / 2, -away, FLOOR), angle), angle)
    for x, y in itertools.product((-COURT_EAST, COURT_EAST), (-COURT_NORTH, COURT_NORTH)):
        pier = shapes.box((-PIER / 2, -PIER / 2, FLOOR), (PIER / 2, PIER / 2, CEILING))
        bevel(put("pier", pier, [palette.plaster], (x, y, 0)), 0.02)


def _column(palette: Palette) -> list[bpy.types.Object]:
    """A column from the floor to the springing: base, shaft and capital."""
    top = SPRINGING - FLOOR
    foot = [(0.20, 0.10), (0.21, 0.13), (0.20, 0.17), (0.165, 0.20), (0.16, 0.6), (0.15, 1.2)]
    head = [(0.13, -0.30), (0.155, -0.28), (0.135, -0.25), (0.15, -0.19), (0.19, -0.13), (0.195, -0.10)]
    shaft = shapes.turned([*foot, *((radius, top + below) for radius, below in head)])
    base = shapes.box((-0.22, -0.22, 0.0), (0.22, 0.22, 0.10))
    abacus = shapes.box((-0.23, -0.23, top - 0.10), (0.23, 0.23, top))
    return [
        smooth(put("shaft", shaft, [palette.stone])),
        bevel(put("base", base, [palette.stone]), 0.015),
        bevel(put("abacus", abacus, [palette.stone]), 0.015),
    ]


def _turned(at: Sequence[float], angle: float) -> tuple[float, float, float]:
    """A point turned about the z axis."""
    c, s = math.cos(angle), math.sin(angle)
    return c * at[0] - s * at[1], s * at[0] + c * at[1], at[2]


def _raise_walls(palette: Palette) -> None:
    """Walls of the ground floor: start, end, colour on the right and left of the way, windows, doors."""
    p = palette
    x, y = EAST - WALL / 2, NORTH - WALL / 2
    inner_x, inner_y = EAST - WALL, NORTH - WALL
    ends = WING_NORTH - WALL / 2
    entrance = (-1.2, 1.2, 2.9)
    rows = (
        ((-EAST, -y), (EAST, -y), p.plaster, p.white, (2.0, 5.4, 17.3, 20.7), ((10.8, 13.2, 2.9),)),
        ((EAST, y), (0, y), p.plaster, p.white, (2.0, 8.9), ()),
        ((0, y), (-EAST, y), p.plaster, p.blue, (2.0, 8.5), ()),
        ((x, -inner_y), (x, -WING_NORTH), p.plaster, p.white, (), ()),
        ((x, -WING_NORTH), (x, WING_NORTH), p.plaster, p.red, (3.5,), ()),
        ((x, WING_NORTH), (x, inner_y), p.plaster, p.white, (), ()),
        ((-x, inner_y), (-x, WING_NORTH), p.plaster, p.blue, (), ()),
        ((-x, WING_NORTH), (-x, -WING_NORTH), p.plaster, p.ochre, (2.6, 6.4, 10.2), ()),
        ((-x, -WING_NORTH), (-x, -inner_y), p.plaster, p.white, (), ()),
        ((-inner_x, -WING_NORTH), (-WING_EAST, -WING_NORTH), p.white, p.ochre, (), ()),
        (
            (-WING_EAST, -WING_NORTH),
            (WING_EAST, -WING_NORTH),
            p.white,
            p.plaster,
            (),
            (_gap(entrance, 8), (2.6, 4.0, DOOR), (12, 13.4, DOOR)),
        ),
        ((WING_EAST, -WING_NORTH), (inner_x, -WING_NORTH), p.white, p.red, (), ()),
        ((-inner_x, WING_NORTH), (-WING_EAST, WING_NORTH), p.ochre, p.blue, (), ()),
        ((-WING_EAST, WING_NORTH), (0, WING_NORTH), p.blue, p.blue, (), ((3.0, 4.8, DOOR),)),
        ((0, WING_NORTH), (WING_EAST, WING_NORTH), p.blue, p.white, (), ((3.2, 5.0, DOOR),)),
        ((WING_EAST, WING_NORTH), (inner_x, WING_NORTH), p.red, p.white, (), ()),
        ((WING_EAST, -ends), (WING_EAST, ends), p.red, p.red, (), ((7.4, 9.6, DOOR), (11.0, 12.8, DOOR))),
        ((-WING_EAST, -ends), (-WING_EAST, ends), p.plaster, p.ochre, (), ((5.8, 7.7, DOOR),)),
    )
    for start, end, right, left, windows, doors in rows:
        _wall(p, (start, end), FLOOR, CEILING, (right, left), windows, doors)
    partitions = (
        (0.0, WING_NORTH + WALL / 2, p.white, p.blue),
        (-3.0, -inner_y, p.white, p.white),
        (3.0, -inner_y, p.white, p.white),
    )
    for east, south, right, left in partitions:
        solid = shapes.wall(inner_y - WING_NORTH - WALL / 2, CEILING - FLOOR, PARTITION)
        put("partition", solid, [right, left, p.white], (east, south, FLOOR), math.pi / 2)


def _gap(door: tuple[float, float, float], shift: float) -> tuple[float, float, float]:
    """A door, given from the middle of a wall, from its start."""
    return door[0] + shift, door[1] + shift, door[2]


def _wall(palette, way, low, high, colours, windows=(), doors=(), thickness=WALL) -> None:
    """One wall along `way`, with bars in its windows; openings are measured along the way."""
    start, end = np.array(way)
    length, turn = math.dist(start, end), math.atan2(*(end - start)[::-1])
    openings = [(at, at + WINDOW_WIDTH, SILL, SILL + WINDOW_HEIGHT) for at in windows]
    openings += [(left, right, 0.0, top) for left, right, top in doors]
    solid = shapes.wall(length, high - low, thickness, openings)
    put("wall", solid, [*colours, palette.white], (*start, low), turn)
    for at in windows:
        show("window", _bars(palette), (*(start + at * (end - start) / length), low + SILL), turn)


def _bars(palette: Palette) -> bpy.types.Mesh:
    """The wooden bars that all windows share."""
    if (mesh := bpy.data.meshes.get("bars")) is None:
        width, height, bar = WINDOW_WIDTH, WINDOW_HEIGHT, 0.06
        columns = [(bar, width / 2 - bar / 2), (width / 2 + bar / 2, width - bar)]
        rows = [(bar, 0.9), (0.9 + bar, height - bar)]
        panes = [(*column, *row) for column in columns for row in rows]
        thing = put("bars", shapes.wall(width, height, bar, panes), [palette.wood])
        mesh = thing.data
        bpy.data.objects.remove(thing)
    return mesh


def _cover(palette: Palette) -> None:
    """The roof of the ground floor, its coping around the court, and the beams under it."""
    x, y = COURT_EAST - 0.35, COURT_NORTH - 0.35
    out = 0.12
    roof = shapes.slab((-EAST - out, -NORTH - out, CEILING), (EAST + out, NORTH + out, ROOF), [(-x, x, -y, y)])
    put("roof", roof, [palette.clay, palette.plaster])
    coping = shapes.slab((-x - 0.4, -y - 0.4, ROOF), (x + 0.4, y + 0.4, ROOF + 0.2), [(-x, x, -y, y)])
    put("coping", coping, [palette.plaster])
    for side in (-1, 1):
        south = side * (COURT_NORTH + WING_NORTH) / 2
        span = (WING_NORTH - COURT_NORTH - ARCADE / 2 - WALL / 2) / 2
        beam = shapes.box((-0.07, -span, CEILING - 0.2), (0.07, span, CEILING))
        bevel(repeat(put("beams", beam, [palette.wood], (-7.2, south - side * 0.01, 0)), 21, (0.72, 0, 0)), 0.012)


def _raise_upper_storey(palette: Palette) -> None:
    """The northern wing's second floor, with its own roof and parapet."""
    x, y, south = EAST - WALL / 2, NORTH - WALL / 2, WING_NORTH
    inside = (south + WALL / 2, NORTH - WALL)
    colours = (palette.plaster, palette.white)
    _wall(palette, ((-EAST, south), (EAST, south)), ROOF, UPPER_CEILING, colours, (1.6, 5.35, 9.1, 13.6, 17.35, 21.1))
    _wall(palette, ((EAST, y), (-EAST, y)), ROOF, UPPER_CEILING, colours, (3.0, 11.35, 19.7))
    _wall(palette, ((x, inside[0]), (x, inside[1])), ROOF, UPPER_CEILING, colours)
    _wall(palette, ((-x, inside[1]), (-x, inside[0])), ROOF, UPPER_CEILING, colours)
    low, high = south - WALL / 2, NORTH
    put(
        "upper roof",
        shapes.slab((-EAST - 0.15, low - 0.15, UPPER_CEILING), (EAST + 0.15, high + 0.15, UPPER_ROOF)),
        [palette.plaster],
    )
    hole = (-EAST + 0.3, EAST - 0.3, low + 0.3, high - 0.3)
    put("parapet", shapes.slab((-EAST, low, UPPER_ROOF), (EAST, high, TOP), [hole]), [palette.plaster])
