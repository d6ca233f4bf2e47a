"""The world as a panorama: directions, energy, and what the render leaves behind."""

from __future__ import annotations

import math

import numpy as np
import pytest


def directions(height, width):
    """(h, w, 3) the documented map: u = 0.5 - atan2(y, x) / 2 pi, v = 0.5 + elevation / pi."""
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * math.pi
    elevation = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * math.pi
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], -1
    )


def energy(sky):
    """(3,) integral of radiance over the sphere, by the exact solid angle of each row."""
    height, width = sky.shape[:2]
    edges = np.sin(np.linspace(-math.pi / 2, math.pi / 2, height + 1))
    return (sky.sum(1) * (np.diff(edges) * 2 * math.pi / width)[:, None]).sum(0, dtype=np.float64)


@pytest.fixture
def sky_of(studio, extract):
    """The panorama of the current world."""

    def read():
        studio.wear()
        return extract().sky

    return read


def background(studio, **inputs):
    world = studio.world()
    studio.surface(world, studio.node(world, "ShaderNodeBackground", **inputs))
    return world


def disk(studio, direction, half_angle, radiance):
    """A world that is black but for a disk."""
    world = studio.world()
    coordinates = studio.node(world, "ShaderNodeTexCoord")
    toward = studio.node(
        world, "ShaderNodeVectorMath", {"operation": "DOT_PRODUCT"}, _0=(coordinates, "Generated"), _1=direction
    )
    inside = studio.node(
        world, "ShaderNodeMath", {"operation": "GREATER_THAN"}, _0=(toward, "Value"), _1=math.cos(half_angle)
    )
    strength = studio.node(world, "ShaderNodeMath", {"operation": "MULTIPLY"}, _0=inside, _1=radiance)
    studio.surface(world, studio.node(world, "ShaderNodeBackground", Color=(1, 1, 1, 1), Strength=strength))


def test_no_world_is_a_black_texel(sky_of):
    np.testing.assert_array_equal(sky_of(), np.zeros((1, 1, 3)))


def test_a_plain_background_is_one_texel_of_color_times_strength(studio, sky_of):
    background(studio, Color=(0.2, 0.4, 0.6, 1), Strength=2.5)
    np.testing.assert_allclose(sky_of(), [[[0.5, 1.0, 1.5]]], rtol=1e-6)


def test_colored_axes_land_where_the_documented_map_says(studio, sky_of):
    world = studio.world()
    coordinates = studio.node(world, "ShaderNodeTexCoord")
    half = (0.5, 0.5, 0.5)
    color = studio.node(
        world, "ShaderNodeVectorMath", {"operation": "MULTIPLY_ADD"}, _0=(coordinates, "Generated"), _1=half, _2=half
    )
    studio.surface(world, studio.node(world, "ShaderNodeBackground", Color=(color, "Vector")))
    sky = sky_of()
    assert sky.shape == (256, 512, 3)
    # Half a texel spans 0.7 degrees: samples are spread over it.
    np.testing.assert_allclose(sky * 2 - 1, directions(256, 512), atol=0.02)


@pytest.mark.parametrize("degrees", [0.2666, 1.0])
@pytest.mark.parametrize("direction", [(0.6, 0.48, 0.64), (-1.0, 1e-3, 1e-2), (0.0, 0.0, 1.0)])
def test_a_small_sun_keeps_its_energy(studio, sky_of, direction, degrees):
    half_angle = math.radians(degrees)
    direction = tuple(np.array(direction) / np.linalg.norm(direction))
    disk(studio, direction, half_angle, 1000.0)
    expected = 1000 * 2 * math.pi * (1 - math.cos(half_angle))
    np.testing.assert_allclose(energy(sky_of()), expected, rtol=0.03)


def test_sky_texture_of_this_version_is_read_with_its_sun(studio, sky_of):
    world = studio.world()
    kind = "MULTIPLE_SCATTERING" if studio.bpy.app.version >= (5, 0, 0) else "NISHITA"
    settings = {"sky_type": kind, "sun_elevation": math.radians(40), "sun_rotation": 0.7}
    texture = studio.node(world, "ShaderNodeTexSky", settings)
    studio.surface(world, studio.node(world, "ShaderNodeBackground", Color=texture, Strength=0.1))
    with_sun = sky_of()
    texture.sun_disc = False
    without = sky_of()
    assert (without[200:] > 0).all()
    assert with_sun.max() > 100 * without.max()
    row, column = np.unravel_index(with_sun.sum(2).argmax(), with_sun.shape[:2])
    assert math.degrees(math.asin(directions(*with_sun.shape[:2])[row, column, 2])) == pytest.approx(40, abs=1)


def test_camera_rays_alone_do_not_make_a_sky(studio, sky_of):
    world = studio.world()
    path = studio.node(world, "ShaderNodeLightPath")
    lit = studio.node(world, "ShaderNodeBackground", Color=(1, 0, 0, 1))
    shown = studio.node(world, "ShaderNodeBackground", Color=(0, 0, 9, 1))
    studio.surface(world, studio.node(world, "ShaderNodeMixShader", _0=(path, "Is Camera Ray"), _1=lit, _2=shown))
    np.testing.assert_allclose(sky_of(), [[[1, 0, 0]]], atol=1e-5)


def test_image_sky_turned_by_a_mapping_node_moves_with_it(studio, sky_of):
    world = studio.world()
    pixels = np.zeros((8, 16, 4), np.float32)
    pixels[..., 3] = 1
    pixels[5, 3, :3] = 1
    environment = studio.node(world, "ShaderNodeTexEnvironment", {"image": studio.image(pixels, floats=True)})
    environment.interpolation = "Closest"
    studio.surface(world, studio.node(world, "ShaderNodeBackground", Color=environment))
    sky = sky_of()
    bright = np.argwhere(sky[..., 0] > 0.5)
    assert bright.min(0).tolist() == [5 * 32, 3 * 32]
    assert bright.max(0).tolist() == [6 * 32 - 1, 4 * 32 - 1]


def test_rendering_the_sky_leaves_nothing_behind(studio, extract):
    disk(studio, (0.0, 0.6, 0.8), 0.02, 5.0)
    studio.wear()
    calls = []
    studio.bpy.app.handlers.render_pre.append(calls.append)
    before = studio.counts()
    extract()
    assert studio.counts() == before
    assert not calls
    assert calls.append in studio.bpy.app.handlers.render_pre
    studio.bpy.app.handlers.render_pre.remove(calls.append)
