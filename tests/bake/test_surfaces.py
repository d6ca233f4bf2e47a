"""Surfaces: energy over random materials, the lobes' balance, textures, vertex colours and coverage."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.gloss import average_fresnel, rough_share
from gi_volumes.bake.snapshot import Channel, Image, Material, Snapshot, Texture
from gi_volumes.bake.soup import flatten
from gi_volumes.bake.surfaces import Surfaces

ROUNDING = 5e-7
"""Energies are sums of a few rounded float32 products near one."""

FRESNEL_FIT = 7e-3
"""Largest error of the fit for indices of refraction from 1.05 to 3 (Kulla and Conty 2017)."""

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)[None]


def scene(materials, uvs=None, colors=None, images=()) -> tuple[Surfaces, Snapshot]:
    """One triangle of each material."""
    snapshot = build_scenes.snapshot([(TRIANGLE, material) for material in materials], images=tuple(images))
    count = len(materials)
    geometry = dataclasses.replace(
        snapshot.geometry,
        corner_uvs=np.zeros((0, 3, 2), np.float32) if uvs is None else np.broadcast_to(uvs, (count, 3, 2)).copy(),
        corner_colors=np.zeros((0, 3, 4), np.float32)
        if colors is None
        else np.broadcast_to(colors, (count, 3, 4)).copy(),
    )
    snapshot = dataclasses.replace(snapshot, geometry=geometry)
    return Surfaces(snapshot, flatten(snapshot)), snapshot


def evaluate(material: Material, **geometry):
    """(reflectance, passed, covered, emission) at the centre of one triangle."""
    surfaces, _ = scene([material], **geometry)
    at = (np.zeros(1, int), np.full(1, 1 / 3, np.float32), np.full(1, 1 / 3, np.float32))
    passed, covered = surfaces.through(*at)
    return surfaces.reflectance(*at)[:, 0], passed[:, 0], covered[0], surfaces.emission(*at)[:, 0]


def gray(value: float, **textures) -> Channel:
    return Channel((value,), **textures)


def random_material(rng, number: int) -> Material:
    """Any inputs, also beyond one, with and without textures and vertex colours."""

    def channel(size: int) -> Channel:
        texture = None
        if rng.random() < 0.4:
            texture = Texture(int(rng.integers(0, 3)), str(rng.choice(["rgb", "r", "g", "b", "a"])))
        factor = rng.choice([0.0, 1.0, rng.random(), 2.0], size=size)
        return Channel(tuple(float(v) for v in factor), texture, bool(rng.random() < 0.3))

    return Material(
        f"random {number}",
        base_color=channel(3),
        alpha=channel(1),
        metallic=channel(1),
        transmission=channel(1),
        ior=float(rng.choice([1.0, 1.2, 1.5, 2.4, 10.0])),
        specular_level=float(rng.choice([0.0, 0.5, 1.0, 4.0])),
        alpha_mode=str(rng.choice(["opaque", "mask", "blend"])),
    )


def test_no_random_material_reflects_and_passes_more_than_arrives_or_less_than_nothing():
    rng = np.random.default_rng(1)
    count, repeats = 400, 20
    materials = [random_material(rng, k) for k in range(count)]
    images = [
        Image("bytes", rng.integers(0, 256, (4, 4, 4), dtype=np.uint8)),
        Image("bright", rng.uniform(0, 50, (4, 4, 4)).astype(np.float16), "float"),
        Image("negative", rng.uniform(-2, 1, (4, 4, 4)).astype(np.float16), "float"),
    ]
    colors = rng.uniform(-0.5, 1.5, (count, 3, 4)).astype(np.float32)
    uvs = rng.uniform(-3, 3, (count, 3, 2)).astype(np.float32)
    surfaces, _ = scene(materials, uvs, colors, images)
    triangle = np.repeat(np.arange(count), repeats)
    u, v = rng.dirichlet((1, 1, 1), len(triangle)).T[:2].astype(np.float32)
    reflected = surfaces.reflectance(triangle, u, v)
    passed, covered = surfaces.through(triangle, u, v)
    total = covered * reflected + passed
    for values in (reflected, passed, covered):
        assert np.isfinite(values).all()
        assert values.min() >= 0
        assert values.max() <= 1
    assert total.max() <= 1 + ROUNDING
    assert (covered * (reflected + 0.02) + passed).max() > 1 + ROUNDING
    opaque = ~surfaces.transparent[triangle]
    assert np.all(passed[:, opaque] == 0)
    assert np.all(covered[opaque] == 1)


def test_a_metal_reflects_its_base_colour_and_nothing_passes():
    metal = Material("m", Channel((0.9, 0.5, 0.1)), metallic=gray(1.0), transmission=gray(1.0), specular_level=2.0)
    reflected, passed, covered, _ = evaluate(metal)
    assert np.allclose(reflected, [0.9, 0.5, 0.1], atol=ROUNDING)
    assert np.allclose(passed, 0, atol=ROUNDING)
    assert covered == 1


def test_glass_without_a_specular_layer_passes_its_base_colour_and_reflects_nothing():
    glass = Material("g", Channel((0.9, 0.5, 0.1)), transmission=gray(1.0), specular_level=0.0)
    reflected, passed, _, _ = evaluate(glass)
    assert np.allclose(reflected, 0, atol=ROUNDING)
    assert np.allclose(passed, [0.9, 0.5, 0.1], atol=ROUNDING)


def test_a_specular_layer_adds_its_fresnel_share_in_white_and_takes_it_from_what_is_below():
    share = rough_share(1.5, 0.5, 0.5)
    base = np.array([0.8, 0.4, 0.0])
    reflected = evaluate(Material("p", Channel(tuple(base))))[0]
    assert np.allclose(reflected, share + (1 - share) * base, atol=ROUNDING)
    assert np.allclose(evaluate(Material("d", Channel(tuple(base)), specular_level=0.0))[0], base, atol=ROUNDING)
    half = Material("h", Channel(tuple(base)), metallic=gray(0.5), transmission=gray(0.25))
    reflected, passed, _, _ = evaluate(half)
    below = 0.5 * (1 - share)
    assert np.allclose(reflected, base * (0.5 + below * 0.75) + 0.5 * share, atol=ROUNDING)
    assert np.allclose(passed, below * 0.25 * base, atol=ROUNDING)


def exact_fresnel(ior: float) -> float:
    """Cosine-weighted average of Fresnel's equations by quadrature."""
    cosine = (np.arange(20000) + 0.5) / 20000
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    parallel = (ior * cosine - inside) / (ior * cosine + inside)
    across = (cosine - ior * inside) / (cosine + ior * inside)
    return float(np.mean((parallel**2 + across**2) / 2 * 2 * cosine))


@pytest.mark.parametrize("ior", [1.05, 1.2, 1.33, 1.5, 1.8, 2.4, 3.0])
def test_the_average_fresnel_share_is_the_integral_of_fresnel_s_equations(ior):
    assert average_fresnel(ior, 0.5) == pytest.approx(exact_fresnel(ior), abs=FRESNEL_FIT)
    assert average_fresnel(ior, 0.0) == 0
    assert average_fresnel(ior, 0.5) < average_fresnel(ior, 1.0) < 1


@pytest.mark.parametrize("ior", [1.05, 1.5, 2.4])
def test_a_nearly_smooth_layer_has_the_share_of_a_smooth_one_and_rougher_ones_have_less(ior):
    shares = [rough_share(ior, 0.5, roughness) for roughness in (0.05, 0.3, 0.5, 0.8, 1.0)]
    assert shares[0] == pytest.approx(average_fresnel(ior, 0.5), rel=0.01)
    assert all(np.diff(shares) < 0)


def rough_share_by_chance(ior: float, roughness: float, count: int = 400_000) -> float:
    """Part of diffuse light that facets (GGX, Smith) reflect once: lobe times cosines over both hemispheres."""
    generator = np.random.default_rng(5)
    z_in, z_out = np.sqrt(generator.random((2, count)))
    angle = 2 * np.pi * generator.random(count)
    to, out = (
        np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z])
        for z, a in ((z_in, 0 * angle), (z_out, angle))
    )
    half = (to + out) / np.sqrt(((to + out) ** 2).sum(axis=0))
    width = roughness**4
    facets = width / (np.pi * (half[2] ** 2 * (width - 1) + 1) ** 2)
    hidden = [(np.sqrt(1 + width * (1 / z**2 - 1)) - 1) / 2 for z in (z_in, z_out)]
    cosine = (to * half).sum(axis=0)
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (ior * cosine - inside) / (ior * cosine + inside)
    lobe = (across**2 + along**2) / 2 * facets / (1 + hidden[0] + hidden[1]) / (4 * z_in * z_out)
    return float(np.mean(np.pi * lobe))


@pytest.mark.parametrize("roughness", [0.6, 0.8, 1.0])
def test_the_share_of_a_rough_layer_is_the_integral_of_its_lobe(roughness):
    share = rough_share(1.5, 0.5, roughness)
    assert share == pytest.approx(rough_share_by_chance(1.5, roughness), rel=0.01, abs=1.5e-3)
    assert share != pytest.approx(average_fresnel(1.5, 0.5), rel=0.05)


def test_a_layer_whose_roughness_is_a_texture_has_the_share_of_the_texel_that_is_hit():
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[..., 1] = [[0, 255]]
    rough = Material("m", Channel((0.0, 0.0, 0.0)), roughness=Channel((1.0,), Texture(0, channel="g")))
    for column, share in ((0.25, average_fresnel(1.5, 0.5)), (0.75, rough_share(1.5, 0.5, 1.0))):
        reflected = evaluate(rough, uvs=np.full((3, 2), column), images=[Image("i", pixels, "linear")])[0]
        assert np.allclose(reflected, share, atol=ROUNDING)


def test_extreme_indices_of_refraction_and_levels_stay_between_nothing_and_everything():
    for ior in (0.0, 0.5, 1.0, 1.0 + 1e-9, 1000.0):
        for level in (0.0, 0.5, 1.0, 1e6):
            assert 0 <= average_fresnel(ior, level) < 1
            assert 0 <= rough_share(ior, level, 0.5) < 1


@pytest.mark.parametrize(
    ("mode", "alpha", "covered"),
    [
        ("opaque", 0.3, 1.0),
        ("mask", 0.3, 0.0),
        ("mask", 0.5, 1.0),
        ("mask", 0.7, 1.0),
        ("blend", 0.3, 0.3),
        ("blend", 0.0, 0.0),
        ("blend", 1.7, 1.0),
    ],
)
def test_coverage_follows_the_alpha_mode(mode, alpha, covered):
    material = Material("m", Channel((0.6,) * 3), alpha=gray(alpha), alpha_mode=mode, specular_level=0.0)
    reflected, passed, found, _ = evaluate(material)
    assert found == pytest.approx(covered)
    assert np.allclose(passed, 1 - covered, atol=ROUNDING)
    assert np.allclose(reflected, 0.6, atol=ROUNDING)
    surfaces, _ = scene([material])
    assert surfaces.transparent[0] == (mode != "opaque")


def test_a_cutoff_of_zero_keeps_everything_and_one_above_alpha_nothing():
    for cutoff, covered in ((0.0, 1.0), (0.2, 1.0), (0.31, 0.0)):
        material = Material("m", alpha=gray(0.3), alpha_mode="mask", alpha_cutoff=cutoff)
        assert evaluate(material)[2] == covered


RGBA = (51, 102, 153, 204)


@pytest.mark.parametrize(("channel", "value"), [("r", 0.2), ("g", 0.4), ("b", 0.6), ("a", 0.8), ("rgb", 0.4)])
def test_a_scalar_reads_the_channel_it_names_and_the_mean_of_a_colour(channel, value):
    image = Image("i", np.full((2, 2, 4), RGBA, np.uint8), "linear")
    material = Material("m", alpha=gray(0.5, texture=Texture(0, channel)), alpha_mode="blend")
    covered = evaluate(material, uvs=np.zeros((3, 2), np.float32), images=[image])[2]
    assert covered == pytest.approx(0.5 * value, abs=ROUNDING)


@pytest.mark.parametrize(
    ("channel", "value"), [("r", 0.2), ("g", 0.4), ("b", 0.6), ("a", 0.8), ("rgb", (0.2, 0.4, 0.6))]
)
def test_a_colour_reads_all_three_channels_or_the_one_it_names_in_gray(channel, value):
    image = Image("i", np.full((2, 2, 4), RGBA, np.uint8), "linear")
    material = Material("m", emission=Channel((1.0, 2.0, 3.0), Texture(0, channel)))
    emitted = evaluate(material, uvs=np.zeros((3, 2), np.float32), images=[image])[3]
    assert np.allclose(emitted, np.array([1.0, 2.0, 3.0]) * value, atol=3 * ROUNDING)


def test_vertex_colours_are_interpolated_and_their_alpha_drives_scalars():
    colors = np.array([[1, 0, 0, 0.2], [0, 1, 0, 0.4], [0, 0, 1, 0.9]], np.float32)
    material = Material(
        "m",
        Channel((1.0,) * 3, vertex_color=True),
        alpha=gray(1.0, vertex_color=True),
        alpha_mode="blend",
        specular_level=0.0,
    )
    surfaces, _ = scene([material], colors=colors)
    rng = np.random.default_rng(2)
    weights = rng.dirichlet((1, 1, 1), 100).astype(np.float32)
    at = (np.zeros(100, int), np.ascontiguousarray(weights[:, 1]), np.ascontiguousarray(weights[:, 2]))
    assert np.allclose(surfaces.reflectance(*at).T, weights, atol=ROUNDING)
    assert np.allclose(surfaces.through(*at)[1], weights @ [0.2, 0.4, 0.9], atol=ROUNDING)


def test_texture_coordinates_are_interpolated_between_corners():
    pixels = np.zeros((1, 256, 4), np.uint8)
    pixels[0, :, :3] = np.arange(256)[:, None]
    uvs = np.array([[0, 0.5], [1, 0.5], [0, 0.5]], np.float32)
    material = Material("m", Channel((1.0,) * 3, Texture(0, extension="extend")), specular_level=0.0)
    surfaces, _ = scene([material], uvs, images=[Image("ramp", pixels, "linear")])
    u = (np.arange(256, dtype=np.float32) + 0.5) / 256
    found = surfaces.reflectance(np.zeros(256, int), u, np.zeros(256, np.float32))[0]
    assert np.allclose(found, np.arange(256) / 255, atol=ROUNDING)


def test_a_material_that_asks_for_colours_or_coordinates_that_the_scene_lacks_gets_white_and_some_texel():
    image = Image("i", np.full((2, 2, 4), 255, np.uint8))
    material = Material("m", Channel((0.5,) * 3, Texture(0), vertex_color=True), specular_level=0.0)
    assert np.allclose(evaluate(material, images=[image])[0], 0.5, atol=ROUNDING)


def test_emission_is_the_factor_and_only_factors_above_zero_emit():
    dark, lit = Material("d", emission=Channel((0.0,) * 3)), Material("l", emission=Channel((0.0, 7.5, 1e6)))
    surfaces, _ = scene([dark, lit])
    assert surfaces.emissive.tolist() == [False, True]
    assert np.allclose(evaluate(lit)[3], [0, 7.5, 1e6])
