"""The demo scene: a courtyard with arcades, coloured rooms around it, low afternoon sun.

    python demo/courtyard.py OUT.blend

Comes in: nothing; the scene is the same every time. Goes out: a .blend file with its images packed. It holds one
of everything that a bake has to get right, and is laid out so that most of what one sees is indirect light.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import bpy
from gi_volumes.demo import building, furniture, matter
from gi_volumes.demo.stage import show
from mathutils import Vector

SUN_IRRADIANCE = 5.0
"""On a surface that faces the sun [W/m2]."""
SUN_ANGLE = math.radians(0.53)
SUN_ELEVATION, SUN_AZIMUTH = math.radians(34), math.radians(224)
"""Azimuth from north towards east: from the south-west, low enough to reach the walls of two galleries."""

CAMERAS = {
    # name: (eye [m], target [m], focal length over a 36 mm wide film [mm])
    "courtyard": ((-6.5, -3.35, 1.7), (2.6, 1.5, 1.8), 19.0),
    "gallery": ((6.35, -3.2, 1.8), (7.0, 6.5, 1.75), 21.0),
    "red room": ((11.0, -2.6, 1.7), (9.5, 5.0, 1.45), 20.0),
    "panel room": ((10.6, 7.7, 1.8), (2.6, 8.8, 1.5), 20.0),
    "blue room": ((-9.9, 8.0, 1.9), (0.0, 8.2, 1.7), 20.0),
}
EXPOSURE = 0.9
"""Stops: the shade is what is looked at, the sun may glare."""


def main() -> None:
    """Write the scene to the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path, help=".blend file to create")
    output = parser.parse_args().output.resolve()
    build()
    bpy.ops.wm.save_as_mainfile(filepath=str(output), compress=True)


def build() -> None:
    """Replace the open file by the courtyard."""
    bpy.ops.wm.read_homefile(use_empty=True)
    palette = matter.mix_palette()
    building.build(palette)
    furniture.furnish(palette)
    _light()
    _place_cameras()
    _set_render()


def _light() -> None:
    """Sun, sky, the blue room's lamp and the ochre room's spot."""
    scene = bpy.context.scene
    scene.world = matter.sky()
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle, sun.color = SUN_IRRADIANCE, SUN_ANGLE, (1.0, 0.86, 0.68)
    show("sun", sun, (0, 0, 20)).rotation_euler = (math.pi / 2 - SUN_ELEVATION, 0, math.pi - SUN_AZIMUTH)
    show("lamp", furniture.point_lamp(), furniture.LAMP)
    spot = bpy.data.lights.new("spot", "SPOT")
    spot.energy, spot.spot_size, spot.spot_blend, spot.shadow_soft_size = 300.0, math.radians(55), 0.4, 0.05
    _aim(show("spot", spot, (-10.0, -4.6, 3.8)), (-10.8, -1.0, 0.3))


def _place_cameras() -> None:
    """The cameras; the first is active."""
    for name, (eye, target, focal_length) in CAMERAS.items():
        camera = bpy.data.cameras.new(name)
        camera.lens = focal_length
        _aim(show(name, camera, eye), target)
    bpy.context.scene.camera = bpy.data.objects[next(iter(CAMERAS))]


def _aim(thing: bpy.types.Object, target: tuple[float, float, float]) -> None:
    """Turn a camera or lamp, which look along -z, towards a point."""
    direction = Vector(target) - thing.location
    thing.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()


def _set_render() -> None:
    """Cycles, so that the file renders as intended when it is opened."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = 1280, 720
    scene.cycles.samples = 128
    scene.view_settings.view_transform, scene.view_settings.exposure = "AgX", EXPOSURE


if __name__ == "__main__":
    main()
