"""Node graphs: what is evaluated here shows what Cycles shows, texel by texel."""

from __future__ import annotations

import numpy as np
import pytest

SIZE = 8


def texels(seed=1, low=0.05, high=0.95):
    """(SIZE, SIZE, 4) stored values, opaque."""
    pixels = np.random.default_rng(seed).uniform(low, high, (SIZE, SIZE, 4)).astype(np.float32)
    pixels = np.rint(pixels * 255) / np.float32(255)
    pixels[..., 3] = 1
    return pixels


def picture(studio, material, seed=1, **settings):
    image = settings.pop("image", None) or studio.image(texels(seed), f"image {seed}")
    return studio.node(material, "ShaderNodeTexImage", {"image": image, "interpolation": "Closest", **settings})


def sampled(snapshot, channel, uv, colors=None):
    """(n, 3) values of a channel at mesh UVs, by the definitions of `Channel` and `Texture`, nearest texel."""
    value = np.broadcast_to(np.array(channel.factor), (len(uv), 3)).copy()
    if channel.texture is not None:
        value = value * looked_up(snapshot, channel.texture, uv)
    if channel.vertex_color:
        value = value * colors
    return value


def looked_up(snapshot, texture, uv):
    from gi_volumes.operators.images import decode

    image = decode(snapshot.images[texture.image])
    height, width = image.shape[:2]
    placed = np.column_stack([uv, np.ones(len(uv))]) @ np.array(texture.uv_from_mesh).reshape(2, 3).T
    outside = ((placed < 0) | (placed >= 1)).any(1)
    if texture.extension == "mirror":
        placed = 1 - np.abs(np.mod(placed, 2) - 1)
    cell = np.floor(placed * [width, height]).astype(int)
    limits = np.array([width, height])
    cell = np.mod(cell, limits) if texture.extension == "repeat" else np.clip(cell, 0, limits - 1)
    found = image[cell[:, 1], cell[:, 0]]
    if texture.extension == "clip":
        found = np.where(outside[:, None], 0, found)
    return found[:, :3] if texture.channel == "rgb" else found[:, ["rgba".index(texture.channel)]]


@pytest.fixture
def compare(studio, extract):
    """Check that the emission of a material is what Cycles renders of it; returns the snapshot."""

    def check(material, color=None, output=0, strength=None, atol=0.004, colors=None, share=1.0):
        inputs = {"Color": (color, output)} if color is not None else {"Color": (1, 1, 1, 1)}
        if strength is not None:
            inputs["Strength"] = (strength, output)
        studio.surface(material, studio.node(material, "ShaderNodeEmission", **inputs))
        corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        mesh = studio.mesh("plane", corners, [(0, 1, 2, 3)])
        if colors is not None:
            attribute = mesh.color_attributes.new("Col", "FLOAT_COLOR", "POINT")
            for element in attribute.data:
                element.color = colors
        studio.wear(material, mesh=mesh)
        snapshot = extract()
        shown = rendered(studio)
        middles = (np.arange(SIZE) + 0.5) / SIZE
        uv = np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2)
        found = sampled(snapshot, snapshot.materials[0].emission, uv, colors and np.array(colors[:3]))
        close = np.isclose(found, shown.reshape(-1, 3), atol=atol, rtol=0.02).all(1)
        assert close.mean() >= share, (
            f"{(~close).sum()} texels differ: {found[~close][:2]} for {shown.reshape(-1, 3)[~close][:2]}"
        )
        return snapshot

    return check


def rendered(studio):
    """(SIZE, SIZE, 3) radiance at the middles of the plane's texels."""
    bpy, scene = studio.bpy, studio.scene
    data = bpy.data.cameras.new("camera")
    data.type, data.ortho_scale = "ORTHO", 1.0
    scene.camera = studio.place(data, "camera", (0.5, 0.5, 1))
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 4, False, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 0.01
    scene.render.filter_size = 0.01
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    return studio.rendered(scene)


MATH = [
    ("ADD", 0.3), ("SUBTRACT", 0.2), ("MULTIPLY", 1.7), ("DIVIDE", 0.6), ("POWER", 2.2), ("SQRT", 0), ("ABSOLUTE", 0),
    ("MINIMUM", 0.4), ("MAXIMUM", 0.4), ("LESS_THAN", 0.4), ("GREATER_THAN", 0.4), ("ROUND", 0), ("FRACT", 0),
    ("MODULO", 0.3), ("PINGPONG", 0.2), ("SNAP", 0.25), ("SINE", 0), ("EXPONENT", 0), ("LOGARITHM", 2.0),
    ("INVERSE_SQRT", 0), ("ARCTANGENT", 0), ("FLOORED_MODULO", 0.3),
]  # fmt: skip
BLENDS = [
    "MIX", "ADD", "MULTIPLY", "SUBTRACT", "DIVIDE", "DIFFERENCE", "EXCLUSION", "DARKEN", "LIGHTEN", "SCREEN",
    "OVERLAY", "SOFT_LIGHT", "LINEAR_LIGHT", "DODGE", "BURN", "HUE", "SATURATION", "VALUE", "COLOR",
]  # fmt: skip


@pytest.mark.parametrize(("operation", "second"), MATH)
def test_math_is_that_of_cycles(studio, compare, operation, second):
    material = studio.material()
    node = studio.node(material, "ShaderNodeMath", {"operation": operation}, _0=picture(studio, material), _1=second)
    compare(material, strength=studio.node(material, "ShaderNodeMath", {"operation": "MAXIMUM"}, _0=node, _1=0.0))


@pytest.mark.parametrize("factor", [0.35, 1.0])
@pytest.mark.parametrize("mode", BLENDS)
def test_blend_modes_are_those_of_cycles(studio, compare, mode, factor):
    material = studio.material()
    settings = {"data_type": "RGBA", "blend_type": mode, "clamp_result": True}
    compare(
        material,
        studio.node(
            material,
            "ShaderNodeMix",
            settings,
            Factor=factor,
            A=picture(studio, material, 1),
            B=picture(studio, material, 2),
        ),
        output=2,
    )


GRAPHS = {
    "an image": lambda s, m: picture(s, m),
    "hue, saturation and value": lambda s, m: s.node(
        m, "ShaderNodeHueSaturation", Hue=0.7, Saturation=1.4, Value=0.8, Color=picture(s, m)
    ),
    "gamma": lambda s, m: s.node(m, "ShaderNodeGamma", Color=picture(s, m), Gamma=1.8),
    "invert": lambda s, m: s.node(m, "ShaderNodeInvert", _0=0.8, _1=picture(s, m)),
    "brightness and contrast": lambda s, m: s.node(m, "ShaderNodeBrightContrast", _0=picture(s, m), _1=0.1, _2=0.3),
    "grey": lambda s, m: s.node(m, "ShaderNodeRGBToBW", Color=picture(s, m)),
    "a clamp": lambda s, m: s.node(m, "ShaderNodeClamp", Value=picture(s, m), Min=0.2, Max=0.5),
    "a map range": lambda s, m: s.node(
        m, "ShaderNodeMapRange", {"interpolation_type": "SMOOTHSTEP"}, _0=picture(s, m), _1=0.1, _2=0.8, _3=0.2, _4=0.9
    ),
    "a stepped map range": lambda s, m: s.node(
        m, "ShaderNodeMapRange", {"interpolation_type": "STEPPED"}, _0=picture(s, m),
        _1=0.0, _2=1.0, _3=0.2, _4=0.9, _5=4.0,
    ),
    "a ramp": lambda s, m: ramp(s, m),
    "curves": lambda s, m: curves(s, m),
    "hue as red": lambda s, m: swapped(s, m, "HSV", "RGB"),
    "red as hue": lambda s, m: swapped(s, m, "RGB", "HSV"),
    "swapped channels": lambda s, m: swapped(s, m, "RGB", "RGB"),
    "a blackbody": lambda s, m: s.node(m, "ShaderNodeBlackbody", _0=4000.0),
    "two sizes": lambda s, m: s.node(
        m, "ShaderNodeVectorMath", {"operation": "ADD"}, _0=picture(s, m),
        _1=picture(s, m, image=s.image(np.kron(texels(5)[:4, :4], np.ones((1, 1, 1))), "small")),
    ),
}  # fmt: skip


def ramp(studio, material):
    node = studio.node(material, "ShaderNodeValToRGB", _0=picture(studio, material))
    node.color_ramp.elements.new(0.4).color = (0.1, 0.9, 0.2, 1)
    return node


def curves(studio, material):
    node = studio.node(material, "ShaderNodeRGBCurve", _1=picture(studio, material))
    node.mapping.curves[0].points.new(0.5, 0.7)
    node.mapping.curves[3].points.new(0.3, 0.2)
    node.mapping.update()
    return node


def swapped(studio, material, apart, together):
    parts = studio.node(material, "ShaderNodeSeparateColor", {"mode": apart}, _0=picture(studio, material))
    return studio.node(
        material, "ShaderNodeCombineColor", {"mode": together}, _0=(parts, 2), _1=(parts, 1), _2=(parts, 0)
    )


@pytest.mark.parametrize("name", GRAPHS)
def test_color_nodes_show_what_cycles_shows(studio, compare, name):
    material = studio.material()
    snapshot = compare(material, GRAPHS[name](studio, material), atol=0.03 if name == "a blackbody" else 0.006)
    assert not snapshot.notes


@pytest.mark.parametrize("extension", ["REPEAT", "EXTEND", "CLIP", "MIRROR"])
@pytest.mark.parametrize("kind", ["POINT", "TEXTURE", "VECTOR"])
def test_mapped_texture_lies_where_cycles_puts_it(studio, compare, extension, kind):
    material = studio.material()
    coordinates = studio.node(material, "ShaderNodeTexCoord")
    inputs = {"Scale": (2.0, -1.5, 1.0), "Rotation": (0.0, 0.0, 0.5)}
    if kind != "VECTOR":
        inputs["Location"] = (0.237, -0.324, 0.0)
    mapping = studio.node(material, "ShaderNodeMapping", {"vector_type": kind}, Vector=(coordinates, "UV"), **inputs)
    image = picture(studio, material, extension=extension)
    material.node_tree.links.new(mapping.outputs[0], image.inputs[0])
    # Cycles' samples are spread a little, so that some meet the neighbour of a texel's edge.
    assert not compare(material, image, share=0.95).notes


@pytest.mark.parametrize("output", ["Generated", "Object"])
def test_position_coordinates_are_followed(studio, compare, output):
    material = studio.material()
    coordinates = studio.node(material, "ShaderNodeTexCoord")
    image = picture(studio, material)
    material.node_tree.links.new(coordinates.outputs[output], image.inputs[0])
    compare(material, image)


@pytest.mark.parametrize("mode", ["STRAIGHT", "CHANNEL_PACKED", "NONE"])
@pytest.mark.parametrize("alpha_used", [True, False])
def test_colors_of_transparent_texels_are_those_of_cycles(studio, compare, mode, alpha_used):
    material = studio.material()
    pixels = texels()
    pixels[:4, :, 3] = 0.4
    image = studio.image(pixels)
    image.alpha_mode = mode
    node = picture(studio, material, image=image)
    if alpha_used:
        one = studio.node(material, "ShaderNodeMath", {"operation": "MAXIMUM"}, _0=(node, "Alpha"), _1=1.0)
        node = studio.node(material, "ShaderNodeVectorMath", {"operation": "SCALE"}, _0=node, Scale=one)
    compare(material, node, atol=0.01)


def test_vertex_color_times_texture_times_constant_stays_exact(studio, compare):
    material = studio.material()
    settings = {"data_type": "RGBA", "blend_type": "MULTIPLY"}
    color = studio.node(material, "ShaderNodeVertexColor", {"layer_name": "Col"})
    first = studio.node(material, "ShaderNodeMix", settings, Factor=1.0, A=picture(studio, material), B=color)
    second = studio.node(material, "ShaderNodeMix", settings, Factor=1.0, A=(first, 2), B=(0.5, 0.7, 0.9, 1))
    snapshot = compare(material, second, output=2, colors=(0.9, 0.5, 0.25, 1.0))
    emission = snapshot.materials[0].emission
    assert emission.vertex_color
    assert emission.texture is not None
    assert snapshot.images[0].name == "image 1", "the image itself, not a painted one"


def test_groups_reroutes_and_muted_nodes_are_followed(studio, compare):
    bpy = studio.bpy
    group = bpy.data.node_groups.new("tint", "ShaderNodeTree")
    group.interface.new_socket("In", in_out="INPUT", socket_type="NodeSocketColor")
    group.interface.new_socket("Tint", in_out="INPUT", socket_type="NodeSocketColor").default_value = (0.2, 0.4, 0.6, 1)
    group.interface.new_socket("Out", in_out="OUTPUT", socket_type="NodeSocketColor")
    inner_in, inner_out = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    mix = studio.node(
        group,
        "ShaderNodeMix",
        {"data_type": "RGBA", "blend_type": "MULTIPLY"},
        Factor=1.0,
        A=(inner_in, 0),
        B=(inner_in, 1),
    )
    group.links.new(mix.outputs[2], inner_out.inputs[0])
    material = studio.material()
    muted = studio.node(material, "ShaderNodeGamma", Color=picture(studio, material), Gamma=5.0)
    muted.mute = True
    reroute = studio.node(material, "NodeReroute", _0=muted)
    outer = material.node_tree.nodes.new("ShaderNodeGroup")
    outer.node_tree = group
    material.node_tree.links.new(reroute.outputs[0], outer.inputs[0])
    again = material.node_tree.nodes.new("ShaderNodeGroup")
    again.node_tree = group
    again.inputs[1].default_value = (1, 0.5, 1, 1)
    material.node_tree.links.new(outer.outputs[0], again.inputs[0])
    snapshot = compare(material, again)
    np.testing.assert_allclose(snapshot.materials[0].emission.factor, (0.2, 0.2, 0.6), rtol=1e-6)


def test_planted_error_in_a_blend_mode_is_caught(studio, compare, monkeypatch):
    from gi_volumes.operators import node_math

    monkeypatch.setitem(node_math.BLEND, "SCREEN", lambda a, b: 1 - (1 - a) * (1 - 0.95 * b))
    material = studio.material()
    settings = {"data_type": "RGBA", "blend_type": "SCREEN"}
    mix = studio.node(
        material, "ShaderNodeMix", settings, Factor=1.0, A=picture(studio, material, 1), B=picture(studio, material, 2)
    )
    with pytest.raises(AssertionError):
        compare(material, mix, output=2)


@pytest.mark.parametrize("kelvin", [1500, 3000, 5500, 6500, 12000])
def test_blackbody_is_blenders_lamp_color(studio, kelvin):
    from gi_volumes.operators import blackbody

    lamp = studio.bpy.data.lights.new("lamp", "POINT")
    lamp.use_temperature, lamp.temperature = True, kelvin
    np.testing.assert_allclose(blackbody.color(kelvin), lamp.temperature_color, atol=0.03 if kelvin >= 3000 else 0.1)
