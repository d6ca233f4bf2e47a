"""Materials: shader nodes to surface parameters, images to pixels, and notes about what differs."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake.snapshot import Material
from gi_volumes.operators.images import decode


def checkered(alpha=False):
    """(4, 4, 4) stored values."""
    pixels = np.random.default_rng(3).integers(20, 235, (4, 4, 4)).astype(np.float32) / 255
    if not alpha:
        pixels[..., 3] = 1
    return pixels


@pytest.fixture
def read(studio, extract):
    """The record of a shader, given a function that makes its node; and the snapshot."""

    def make(build, name="material"):
        material = studio.material(name)
        studio.surface(material, build(material))
        studio.wear(material)
        snapshot = extract()
        return snapshot.materials[0], snapshot

    return make


def notes(snapshot):
    return [f"{note.what}: {note.why}" for note in snapshot.notes]


def principled(studio, material, **inputs):
    return studio.node(material, "ShaderNodeBsdfPrincipled", **inputs)


def test_principled_constants_arrive(studio, read):
    inputs = {
        "Base_Color": (0.1, 0.2, 0.3, 1), "Metallic": 0.4, "Roughness": 0.6, "IOR": 1.4, "Alpha": 0.7,
        "Specular_IOR_Level": 0.3, "Transmission_Weight": 0.2, "Emission_Color": (1, 0.5, 0.25, 1),
        "Emission_Strength": 8.0,
    }  # fmt: skip
    record, snapshot = read(lambda m: principled(studio, m, **inputs))
    found = [record.base_color, record.metallic, record.roughness, record.alpha, record.transmission, record.emission]
    expected = [(0.1, 0.2, 0.3), (0.4,), (0.6,), (0.7,), (0.2,), (8, 4, 2)]
    for channel, factor in zip(found, expected, strict=True):
        np.testing.assert_allclose(channel.factor, factor, rtol=1e-6)
        assert channel.texture is None
    assert (record.ior, record.specular_level, record.alpha_mode) == (pytest.approx(1.4), pytest.approx(0.3), "blend")
    assert not snapshot.notes
    assert snapshot.geometry.corner_uvs.shape == (0, 3, 2), "no texture, no UVs"
    assert snapshot.geometry.corner_colors.shape == (0, 3, 4)


def test_byte_image_keeps_its_pixels_bottom_row_first(studio, read):
    pixels = checkered()
    image = studio.image(pixels)
    record, snapshot = read(
        lambda m: principled(studio, m, Base_Color=studio.node(m, "ShaderNodeTexImage", {"image": image}))
    )
    assert snapshot.images[0].encoding == "srgb"
    np.testing.assert_array_equal(snapshot.images[0].pixels, np.rint(pixels * 255))
    assert (record.base_color.texture.image, record.base_color.texture.channel) == (0, "rgb")
    np.testing.assert_array_equal(snapshot.geometry.corner_uvs[0], [(0, 0), (1, 0), (0, 1)])


def test_float_image_keeps_values_beyond_one(studio, read):
    pixels = checkered() * 40
    pixels[..., 3] = 1
    image = studio.image(pixels, space="Linear Rec.709", floats=True)
    _, snapshot = read(
        lambda m: studio.node(m, "ShaderNodeEmission", Color=studio.node(m, "ShaderNodeTexImage", {"image": image}))
    )
    assert snapshot.images[0].encoding == "float"
    np.testing.assert_allclose(snapshot.images[0].pixels, pixels, rtol=1e-3)


def test_orm_texture_of_gltf_is_one_image_read_by_channel(studio, read):
    image = studio.image(checkered(), space="Non-Color")

    def build(material):
        texture = studio.node(material, "ShaderNodeTexImage", {"image": image})
        parts = studio.node(material, "ShaderNodeSeparateColor", _0=texture)
        return principled(studio, material, Roughness=(parts, 1), Metallic=(parts, 2))

    record, snapshot = read(build)
    assert len(snapshot.images) == 1
    assert snapshot.images[0].encoding == "linear"
    assert (record.roughness.texture.channel, record.metallic.texture.channel) == ("g", "b")


@pytest.mark.parametrize("pattern", ["one minus less than", "greater than", "round", "mix with transparent"])
def test_thresholded_alpha_is_a_mask(studio, read, pattern):
    image = studio.image(checkered(alpha=True))

    def build(material):
        texture = studio.node(material, "ShaderNodeTexImage", {"image": image})
        alpha = (texture, "Alpha")
        if pattern == "one minus less than":
            less = studio.node(material, "ShaderNodeMath", {"operation": "LESS_THAN"}, _0=alpha, _1=0.3)
            mask = studio.node(material, "ShaderNodeMath", {"operation": "SUBTRACT"}, _0=1.0, _1=less)
        elif pattern == "round":
            mask = studio.node(material, "ShaderNodeMath", {"operation": "ROUND"}, _0=alpha)
        else:
            mask = studio.node(material, "ShaderNodeMath", {"operation": "GREATER_THAN"}, _0=alpha, _1=0.3)
        if pattern == "mix with transparent":
            clear = studio.node(material, "ShaderNodeBsdfTransparent")
            diffuse = studio.node(material, "ShaderNodeBsdfDiffuse", Color=texture)
            return studio.node(material, "ShaderNodeMixShader", _0=mask, _1=clear, _2=diffuse)
        return principled(studio, material, Base_Color=texture, Alpha=mask)

    record, snapshot = read(build)
    assert record.alpha_mode == "mask"
    assert record.alpha_cutoff == pytest.approx(0.5 if pattern == "round" else 0.3)
    assert record.alpha.texture.channel == "a"
    assert len(snapshot.images) == 1


def test_alpha_texture_is_blended(studio, read):
    image = studio.image(checkered(alpha=True))
    record, _ = read(
        lambda m: principled(studio, m, Alpha=(studio.node(m, "ShaderNodeTexImage", {"image": image}), "Alpha"))
    )
    assert (record.alpha_mode, record.alpha.texture.channel) == ("blend", "a")


@pytest.mark.parametrize("clear_first", [True, False])
def test_mix_with_transparent_is_coverage(studio, read, clear_first):
    def build(material):
        clear = studio.node(material, "ShaderNodeBsdfTransparent")
        diffuse = studio.node(material, "ShaderNodeBsdfDiffuse", Color=(0.5, 0.6, 0.7, 1))
        first, second = (clear, diffuse) if clear_first else (diffuse, clear)
        return studio.node(material, "ShaderNodeMixShader", _0=0.25, _1=first, _2=second)

    record, snapshot = read(build)
    np.testing.assert_allclose(record.alpha.factor, 0.25 if clear_first else 0.75)
    np.testing.assert_allclose(record.base_color.factor, (0.5, 0.6, 0.7), rtol=1e-6)
    assert not snapshot.notes


def test_emission_adds_to_diffuse(studio, read):
    def build(material):
        glow = studio.node(material, "ShaderNodeEmission", Color=(1, 0.5, 0, 1), Strength=3.0)
        return studio.node(material, "ShaderNodeAddShader", _0=studio.node(material, "ShaderNodeBsdfDiffuse"), _1=glow)

    record, snapshot = read(build)
    np.testing.assert_allclose(record.emission.factor, (3, 1.5, 0))
    np.testing.assert_allclose(record.base_color.factor, (0.8, 0.8, 0.8))
    assert not snapshot.notes


def test_emission_alone_is_black_and_opaque(studio, read):
    record, _ = read(lambda m: studio.node(m, "ShaderNodeEmission", Strength=2.0))
    np.testing.assert_allclose(record.emission.factor, (2, 2, 2))
    assert record.base_color.factor == (0, 0, 0)
    assert record.alpha_mode == "opaque"


def test_mix_of_diffuse_and_emission_by_constant_is_exact(studio, read):
    def build(material):
        glow = studio.node(material, "ShaderNodeEmission", Color=(1, 1, 1, 1), Strength=4.0)
        diffuse = studio.node(material, "ShaderNodeBsdfDiffuse", Color=(0.8, 0.4, 0.2, 1))
        return studio.node(material, "ShaderNodeMixShader", _0=0.25, _1=diffuse, _2=glow)

    record, snapshot = read(build)
    np.testing.assert_allclose(record.emission.factor, (1, 1, 1))
    np.testing.assert_allclose(record.base_color.factor, (0.6, 0.3, 0.15), rtol=1e-6)
    assert not snapshot.notes


def test_glass_transmits(studio, read):
    glass, _ = read(lambda m: studio.node(m, "ShaderNodeBsdfGlass", Color=(0.9, 1, 0.9, 1), IOR=1.3))
    assert (glass.transmission.factor, glass.ior) == ((1.0,), pytest.approx(1.3))


def test_glossy_is_a_metal(studio, read):
    record, _ = read(lambda m: studio.node(m, "ShaderNodeBsdfAnisotropic", Color=(0.9, 0.8, 0.7, 1), Roughness=0.3))
    assert record.metallic.factor == (1.0,)
    np.testing.assert_allclose(record.roughness.factor, 0.3)


def test_empty_slot_and_no_slot_wear_the_default(studio, extract):
    mesh = studio.mesh()
    mesh.materials.append(None)
    studio.wear(mesh=mesh)
    studio.wear()
    assert extract().materials == (Material("(default)"),)


def test_material_with_nothing_connected_is_black(studio, extract):
    studio.wear(studio.material())
    record = extract().materials[0]
    assert record.base_color.factor == record.emission.factor == (0, 0, 0)
    assert record.alpha_mode == "opaque"


def test_material_without_nodes_shows_its_viewport_color(studio, extract):
    if studio.bpy.app.version >= (5, 0, 0):
        pytest.skip("materials always have nodes from Blender 5.0 on")
    material = studio.bpy.data.materials.new("plain")
    material.diffuse_color = (0.3, 0.2, 0.1, 1)
    studio.wear(material)
    np.testing.assert_allclose(extract().materials[0].base_color.factor, (0.3, 0.2, 0.1), rtol=1e-6)


def test_output_for_cycles_wins_over_that_for_eevee(studio, extract):
    material = studio.material()
    outputs = [material.node_tree.nodes[0], studio.node(material, "ShaderNodeOutputMaterial")]
    for output, target, red in zip(outputs, ("EEVEE", "CYCLES"), (0.1, 0.9), strict=True):
        output.target = target
        diffuse = studio.node(material, "ShaderNodeBsdfDiffuse", Color=(red, 0, 0, 1))
        material.node_tree.links.new(diffuse.outputs[0], output.inputs[0])
    studio.wear(material)
    assert extract().materials[0].base_color.factor[0] == pytest.approx(0.9)


def test_triangles_know_their_material_and_their_own_uv_map(studio, extract):
    mesh = studio.mesh("m", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], [(0, 1, 2), (1, 3, 2)])
    second = mesh.uv_layers.new(name="second")
    for element in second.data:
        element.uv = (0.25, 0.75)
    image = studio.image(checkered())
    materials = []
    for name in ("UVMap", "second"):
        material = studio.material(name)
        uv = studio.node(material, "ShaderNodeUVMap", {"uv_map": name})
        texture = studio.node(material, "ShaderNodeTexImage", {"image": image}, Vector=uv)
        studio.surface(material, studio.node(material, "ShaderNodeBsdfDiffuse", Color=texture))
        materials.append(material)
    mesh.polygons[1].material_index = 1
    studio.wear(*materials, mesh=mesh)
    snapshot = extract()
    names = [snapshot.materials[index].name for index in snapshot.geometry.materials]
    assert names == ["UVMap", "second"]
    np.testing.assert_array_equal(snapshot.geometry.corner_uvs[0], [(0, 0), (1, 0), (0, 1)])
    np.testing.assert_allclose(snapshot.geometry.corner_uvs[1], 0.25 * np.array([[1, 3]] * 3))
    assert len(snapshot.images) == 1


def test_byte_vertex_colors_arrive_linear(studio, extract):
    mesh = studio.mesh()
    layer = mesh.color_attributes.new("Col", "BYTE_COLOR", "CORNER")
    for element in layer.data:
        element.color_srgb = (0.5, 0.5, 0.5, 1)
    material = studio.material()
    color = studio.node(material, "ShaderNodeVertexColor", {"layer_name": "Col"})
    studio.surface(material, studio.node(material, "ShaderNodeBsdfDiffuse", Color=color))
    studio.wear(material, mesh=mesh)
    snapshot = extract()
    assert snapshot.materials[0].base_color.vertex_color
    np.testing.assert_allclose(snapshot.geometry.corner_colors[..., :3], 0.2140, atol=0.003)


def test_missing_image_is_grey_and_named(studio, extract, tmp_path):
    path = tmp_path / "gone.png"
    image = studio.image(checkered())
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    loaded = studio.bpy.data.images.load(str(path))
    path.unlink()
    loaded.reload()
    material = studio.material()
    texture = studio.node(material, "ShaderNodeTexImage", {"image": loaded})
    studio.surface(material, studio.node(material, "ShaderNodeBsdfDiffuse", Color=texture))
    studio.wear(material)
    snapshot = extract()
    np.testing.assert_allclose(snapshot.materials[0].base_color.factor, 0.8)
    assert [text for text in notes(snapshot) if "gone.png" in text]


def test_procedural_texture_is_replaced_and_named_once(studio, read):
    record, snapshot = read(
        lambda m: principled(studio, m, Base_Color=(studio.node(m, "ShaderNodeTexNoise"), "Color")), "cloudy"
    )
    np.testing.assert_allclose(record.base_color.factor, 0.5)
    assert notes(snapshot) == ["'Noise Texture' node (material 'cloudy'): the constant 0.5"]


def test_many_materials_with_normal_maps_make_one_note(studio, extract):
    mesh = studio.mesh("m", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    materials = []
    for index in range(9):
        material = studio.material(f"m{index}")
        bump = studio.node(material, "ShaderNodeBump")
        studio.surface(material, principled(studio, material, Normal=bump))
        materials.append(material)
    for material in materials:
        studio.wear(material, mesh=mesh.copy())
    assert notes(extract()) == [
        "normal or bump map (material 'm0', material 'm1', material 'm2' and 6 more): the mesh's own normals"
    ]


def test_image_over_the_limit_is_averaged_down(studio, read, monkeypatch):
    from gi_volumes.operators import images

    monkeypatch.setattr(images, "MAX_SIZE", 2)
    pixels = checkered()
    image = studio.image(pixels, space="Non-Color")
    _, snapshot = read(
        lambda m: studio.node(m, "ShaderNodeBsdfDiffuse", Color=studio.node(m, "ShaderNodeTexImage", {"image": image}))
    )
    expected = pixels.reshape(2, 2, 2, 2, 4).mean((1, 3))
    np.testing.assert_allclose(decode(snapshot.images[0]), expected, atol=0.003)


def test_transparent_texels_are_black_where_alpha_is_not_used(studio, read):
    pixels = checkered()
    pixels[:2, :, 3] = 0
    image = studio.image(pixels)
    _, snapshot = read(
        lambda m: studio.node(m, "ShaderNodeBsdfDiffuse", Color=studio.node(m, "ShaderNodeTexImage", {"image": image}))
    )
    assert (snapshot.images[0].pixels[:2, :, :3] == 0).all()
    np.testing.assert_array_equal(snapshot.images[0].pixels[2:, :, :3], np.rint(pixels[2:, :, :3] * 255))
