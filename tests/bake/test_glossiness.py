"""How much of a scene shows reflections: metal and smooth layers, by area, textures included."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.glossiness import glossy_share
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.snapshot import Channel, Image, Material, Texture


def share(*parts, **other) -> float:
    return glossy_share(prepare(build_scenes.snapshot(list(parts), **other), Model(local=False)))


def surface(roughness: float, metallic: float = 0.0, **other) -> Material:
    return Material("surface", roughness=Channel((roughness,)), metallic=Channel((metallic,)), **other)


@pytest.mark.parametrize(
    ("material", "is_glossy"),
    [
        (surface(0.39), True),
        (surface(0.41), False),
        (surface(0.1, metallic=1.0), True),
        (surface(0.6, metallic=1.0), False),
        (surface(0.1, specular_level=0.0), False),
        (surface(0.1, metallic=0.5, specular_level=0.0), True),
        (surface(0.0, transmission=Channel((1.0,))), True),
        (Material("as it comes"), False),
    ],
)
def test_a_surface_is_glossy_if_it_is_smooth_and_reflects(material, is_glossy):
    assert share((build_scenes.plane(1), material)) == is_glossy


def test_surfaces_count_by_their_area():
    floor, mirror = (build_scenes.plane(3), surface(0.8)), (build_scenes.plane(1, 1.0), surface(0.0, 1.0))
    assert share(floor, mirror) == pytest.approx(0.1, rel=1e-5)


def test_textures_of_roughness_are_read_where_surfaces_are():
    pixels = np.full((1, 2, 4), 255, np.uint8)
    pixels[0, 0, 1] = 25
    texture = Channel((1.0,), Texture(0, "g", interpolation="closest"))
    uvs = np.repeat([[[0.25, 0.5]], [[0.75, 0.5]]], 3, axis=1)
    material = Material("half", roughness=texture)
    images = (Image("roughness", pixels, "linear"),)
    assert share((build_scenes.plane(1), material), uvs=uvs, images=images) == pytest.approx(0.5)
