"""The judge against closed forms: who judges others has to be right itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Cycles comes with the bpy wheel")

from gi_volumes.bake import gloss  # noqa: E402
from gi_volumes.benchmarks import cycles_judge, scene_edits  # noqa: E402
from gi_volumes.benchmarks.cycles_judge import Settings, irradiance  # noqa: E402

UP = np.array((0.0, 0.0, 1.0))
FEW = Settings(samples=4)
SIGMAS = 4.0
"""Standard errors that a correct mean may be off: one correct test in 16,000 fails."""


@pytest.fixture(autouse=True)
def empty_scene():
    """An empty file for every test."""
    bpy.ops.wm.read_homefile(use_empty=True)


def scatter(count: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points in the cube from -1 to 1 with normals in all directions."""
    generator = np.random.default_rng(seed)
    normals = generator.normal(size=(count, 3))
    return generator.uniform(-1, 1, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def facing(normal, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Points in the cube from -1 to 1, all with one normal."""
    return scatter(count)[0], np.tile(np.asarray(normal, float), (count, 1))


def add_lamp(kind: str, energy: float, location=(0.0, 0.0, 0.0), tilt: float = 0.0, radius: float = 0.0):
    """Link a white lamp; a sun shines down, turned about x by `tilt` [rad]."""
    light = bpy.data.lights.new("lamp", kind)
    light.energy = energy
    if kind == "SUN":
        light.angle = 0.0
    else:
        light.shadow_soft_size = radius
    lamp = bpy.data.objects.new("lamp", light)
    lamp.location, lamp.rotation_euler = location, (tilt, 0.0, 0.0)
    bpy.context.scene.collection.objects.link(lamp)
    return light


def add_world(radiance: float) -> None:
    """A uniform sky."""
    world = bpy.data.worlds.new("sky")
    scene_edits.ensure_nodes(world)
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = radiance
    bpy.context.scene.world = world


def add_mesh(corners, faces, albedo: float, emission: float = 0.0):
    """Link a mesh of one Principled material without gloss."""
    material = bpy.data.materials.new("matter")
    scene_edits.ensure_nodes(material)
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (albedo, albedo, albedo, 1)
    shader.inputs["Specular IOR Level"].default_value = 0.0
    shader.inputs["Emission Color"].default_value = (1, 1, 1, 1)
    shader.inputs["Emission Strength"].default_value = emission
    mesh = bpy.data.meshes.new("matter")
    mesh.from_pydata(corners, [], faces)
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("matter", mesh))
    return material


def add_floor(half: float, z: float, albedo: float, emission: float = 0.0):
    """A square that faces up."""
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return add_mesh(corners, [(0, 1, 2, 3)], albedo, emission)


def add_box(half: float, albedo: float, emission: float):
    """A closed box around the origin."""
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return add_mesh(corners, faces, albedo, emission)


def off_by(estimate: cycles_judge.Estimate, truth: float) -> float:
    """How many standard errors the mean over all points is off, if all should have one value."""
    per_point = estimate.mean.mean(axis=1)
    return float((per_point.mean() - truth) / (per_point.std(ddof=1) / math.sqrt(len(per_point))))


def test_a_sun_of_one_watt_gives_one_watt_on_a_quad_that_faces_it():
    add_lamp("SUN", 1.0)
    np.testing.assert_allclose(irradiance(*facing(UP), "direct", FEW).mean, 1.0, rtol=1e-6)


@pytest.mark.parametrize("distance", [0.0, 20.0, 900.0])
def test_a_suns_irradiance_follows_the_cosine_of_each_points_own_normal(distance):
    add_lamp("SUN", 1.0)
    points, normals = scatter(300)
    measured = irradiance(points + distance, normals, "direct", FEW).mean[:, 0]
    np.testing.assert_allclose(measured, np.maximum(normals[:, 2], 0), atol=3e-3)


def test_an_open_uniform_sky_gives_pi_times_its_radiance():
    add_world(2.0)
    np.testing.assert_allclose(irradiance(*scatter(300), "sky", FEW).mean, 2 * math.pi, rtol=1e-6)


@pytest.mark.parametrize("bounces", [1, 4])
def test_the_sun_bounced_off_a_wide_floor_is_albedo_times_its_irradiance(bounces):
    add_lamp("SUN", 3.0, tilt=math.radians(60))
    add_floor(400.0, -2.0, albedo=0.5)
    measured = irradiance(*facing(-UP), "sun", Settings(samples=16, bounces=bounces)).mean
    np.testing.assert_allclose(measured.mean(), 0.5 * 3.0 * 0.5, rtol=2e-4)


def test_crowded_quads_neither_shade_nor_light_each_other():
    add_lamp("SUN", 1.0)
    add_floor(400.0, -2.0, albedo=0.5)
    points, normals = scatter(4000)
    measured = irradiance(0.02 * points, np.where(normals[:, 2:] > 0, UP, -UP), "sun", FEW).mean[:, 0]
    np.testing.assert_allclose(measured[normals[:, 2] < 0].mean(), 0.5, rtol=1e-3)
    assert not measured[normals[:, 2] > 0].any()


@pytest.mark.parametrize("bounces", [0, 1, 4])
@pytest.mark.parametrize("light_tree", [True, False])
def test_a_furnace_gives_its_truncated_series_and_a_planted_one_percent_is_noticed(bounces, light_tree):
    albedo, emission = 0.6, 2.0
    add_box(2.0, albedo, emission)
    settings = Settings(samples=64, bounces=bounces, light_tree=light_tree)
    measured = irradiance(*scatter(1000), "local", settings)
    truth = math.pi * emission * sum(albedo**k for k in range(bounces + 1))
    assert abs(off_by(measured, truth)) < SIGMAS
    assert abs(off_by(measured, 1.01 * truth)) > SIGMAS


def test_light_straight_from_an_emissive_surface_is_direct_and_the_rest_is_indirect():
    albedo, emission = 0.6, 1.0
    add_box(2.0, albedo, emission)
    settings = Settings(samples=64, bounces=2)
    assert abs(off_by(irradiance(*scatter(500), "emission_direct", settings), math.pi)) < SIGMAS
    indirect = irradiance(*scatter(500), "emission_indirect", settings)
    assert abs(off_by(indirect, math.pi * (albedo + albedo**2))) < SIGMAS


@pytest.mark.parametrize("distance", [0.3, 1.0, 3.0])
def test_a_point_lamp_of_p_watts_gives_p_over_four_pi_r_squared(distance):
    add_lamp("POINT", 100.0)
    measured = irradiance(np.array([(0, 0, -distance)]), UP[None], "direct", FEW).mean
    np.testing.assert_allclose(measured, 100.0 / (4 * math.pi * distance**2), rtol=2e-5)


def test_a_point_lamp_with_soft_falloff_counts_its_radius_into_the_distance():
    light = add_lamp("POINT", 100.0, radius=0.1)
    light.use_soft_falloff = True
    measured = irradiance(np.array([(0, 0, -0.3)]), UP[None], "direct", Settings(samples=256)).mean
    np.testing.assert_allclose(measured, 100.0 / (4 * math.pi * (0.3**2 + 0.1**2)), rtol=2e-3)


def test_each_transport_sees_its_own_sources_only():
    """Over a floor, at height h: the sun's bounce is a E, a lamp's at the point itself 2 a I / (5 h^2)."""
    albedo, height, half = 0.5, 2.0, 400.0
    add_world(1.0)
    add_lamp("SUN", 5.0)
    add_lamp("POINT", 500.0)
    add_floor(half, -height, albedo, emission=1.0)
    points, normals = np.zeros((64, 3)), np.tile(-UP, (64, 1))
    settings = Settings(samples=64, bounces=1)
    sky, sun, local = (irradiance(points, normals, name, settings).mean.mean() for name in ("sky", "sun", "local"))
    lamp = 2 * albedo * 500.0 / (4 * math.pi) / (5 * height**2)
    assert sun == pytest.approx(albedo * 5.0, rel=0.002)
    assert sky == pytest.approx(math.pi * albedo, rel=0.002)
    assert local == pytest.approx(math.pi + lamp, rel=0.005)


def test_seeds_differ_by_what_the_standard_error_says():
    add_box(2.0, 0.6, 1.0)
    measured = irradiance(*scatter(400), "local", Settings(samples=16, seeds=(1, 2, 3, 4)))
    truth = math.pi * sum(0.6**k for k in range(5))
    z_squared = ((measured.mean - truth) / measured.error) ** 2
    # Student's t with 3 degrees of freedom has median square 0.585.
    assert np.median(z_squared[:, 0]) == pytest.approx(0.585, rel=0.3)
    assert irradiance(*scatter(4), "local", FEW).runs.shape == (2, 4, 3)


def test_the_scene_is_left_as_it_was():
    add_world(1.0)
    light = add_lamp("SUN", 5.0)
    material = add_box(2.0, 0.6, 1.5)
    strength = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs["Emission Strength"]
    value = material.node_tree.nodes.new("ShaderNodeValue")
    material.node_tree.links.new(value.outputs[0], strength)
    before = (bpy.context.scene.world, bpy.context.scene.render.engine, bpy.context.scene.cycles.samples)
    objects = set(bpy.data.objects)
    irradiance(*scatter(4), "local", FEW)
    irradiance(*scatter(4), "sky", FEW)
    after = (bpy.context.scene.world, bpy.context.scene.render.engine, bpy.context.scene.cycles.samples)
    assert (before, objects, 5.0) == (after, set(bpy.data.objects), light.energy)
    assert strength.default_value == pytest.approx(1.5)
    assert strength.links[0].from_node == value


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
def test_materials_made_diffuse_reflect_base_colour_and_fresnel_and_keep_alpha(metallic):
    material = add_floor(400.0, -2.0, albedo=0.5)
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Metallic"].default_value = metallic
    shader.inputs["Roughness"].default_value = 0.8
    shader.inputs["Specular IOR Level"].default_value = 0.5
    shader.inputs["Alpha"].default_value = 0.75
    add_lamp("SUN", 1.0)
    scene_edits.make_diffuse()
    fresnel = (1 - metallic) * gloss.rough_share(1.5, 0.5, 0.8)
    measured = irradiance(*facing(-UP), "sun", Settings(samples=256)).mean.mean()
    assert measured == pytest.approx(0.75 * (0.5 + 0.5 * fresnel), rel=0.004)


def groove(is_smooth: bool, keeps_smooth: bool) -> float:
    """Light that two slopes which meet in a sharp edge reflect up, made diffuse."""
    corners = [(x, y, z) for x in (-300, 300) for y, z in ((-2, 0), (0, -2), (2, 0))]
    add_mesh(corners, [(0, 1, 4, 3), (1, 2, 5, 4)], 0.5)
    mesh = bpy.data.meshes[-1]
    mesh.polygons.foreach_set("use_smooth", [is_smooth] * 2)
    add_lamp("SUN", 1.0, tilt=math.radians(20))
    scene_edits.make_diffuse(smooth=keeps_smooth)
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 1), (400, 3))
    return float(irradiance(points, np.tile(-UP, (400, 1)), "sun", Settings(samples=256)).mean.mean())


def test_smooth_surfaces_made_diffuse_reflect_what_flat_ones_do():
    flat = groove(is_smooth=False, keeps_smooth=False)
    bpy.ops.wm.read_homefile(use_empty=True)
    assert groove(is_smooth=True, keeps_smooth=False) == pytest.approx(flat, rel=2e-3)
    bpy.ops.wm.read_homefile(use_empty=True)
    assert groove(is_smooth=True, keeps_smooth=True) != pytest.approx(flat, rel=2e-2)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.5, 0.8, 1.0])
def test_the_layer_of_a_black_dielectric_reflects_in_cycles_the_share_that_the_bake_gives_it(roughness):
    add_world(1.0)
    material = add_floor(400.0, -2.0, albedo=0.0)
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Specular IOR Level"].default_value = 0.5
    shader.inputs["Roughness"].default_value = roughness
    measured = irradiance(*facing(-UP), "sky", Settings(samples=128, bounces=1)).mean.mean() / math.pi
    assert measured == pytest.approx(gloss.rough_share(1.5, 0.5, roughness), abs=1e-3)


def test_the_share_of_a_smooth_layer_is_the_tabulated_one():
    # Internal reflection apart, a dielectric of index 1.5 reflects 9.18 % of diffuse light.
    assert gloss.average_fresnel(1.5, 0.5) == pytest.approx(0.0918, abs=1e-4)


@pytest.mark.parametrize(
    ("points", "normals", "transport"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), "sky"),
        (np.zeros((2, 3)), np.zeros((3, 3)), "sky"),
        (np.full((1, 3), np.nan), UP[None], "sky"),
        (np.zeros((1, 3)), UP[None], "moon"),
    ],
)
def test_bad_arguments_are_refused_in_words(points, normals, transport):
    with pytest.raises(ValueError, match=r"must (both )?be"):
        irradiance(points, normals, transport)
