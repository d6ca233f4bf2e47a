"""Textures against a slow reference, one texel at a time in double precision."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gi_volumes.bake.snapshot import Image, Texture
from gi_volumes.bake.textures import EXTENSIONS, TexturePool

SIZES = [(1, 1), (3, 5), (4, 4), (2, 7), (1, 6)]
REACH = 2.5
"""Texture coordinates up to here: every wrap mode wraps more than once."""

EDGE = 1e-4
"""Distance from a texel's edge within which float32 may decide either way: a few steps at the reach times 7 texels."""

TOLERANCE = 1e-6
"""Decoded values are float32 at most one."""


def decode(image: Image, x: int, y: int) -> np.ndarray:
    """Linear RGBA of one texel."""
    texel = image.pixels[y, x].astype(np.float64)
    if image.encoding == "float":
        return texel
    texel = texel / 255
    if image.encoding == "srgb":
        texel[:3] = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in texel[:3]]
    return texel


def wrapped(index: int, size: int, extension: str) -> int | None:
    """Texel number inside the image, None where it is cut off."""
    if 0 <= index < size:
        return index
    if extension == "repeat":
        return index - size * math.floor(index / size)
    if extension == "extend":
        return 0 if index < 0 else size - 1
    if extension == "mirror":
        period = index - 2 * size * math.floor(index / (2 * size))
        return period if period < size else 2 * size - 1 - period
    return None


def fetch(image: Image, x: int, y: int, extension: str) -> np.ndarray:
    x, y = wrapped(x, image.pixels.shape[1], extension), wrapped(y, image.pixels.shape[0], extension)
    return np.zeros(4) if x is None or y is None else decode(image, x, y)


def reference(image: Image, texture: Texture, u: float, v: float) -> np.ndarray:
    """One lookup; hits read the closest texel, whatever the artist's interpolation."""
    m = texture.uv_from_mesh
    u, v = m[0] * u + m[1] * v + m[2], m[3] * u + m[4] * v + m[5]
    height, width = image.pixels.shape[:2]
    return fetch(image, math.floor(u * width), math.floor(v * height), texture.extension)


def random_images() -> tuple[Image, ...]:
    """Every size in every encoding."""
    rng = np.random.default_rng(1)
    images = []
    for encoding in ("srgb", "linear", "float"):
        for h, w in SIZES:
            pixels = (
                rng.random((h, w, 4)).astype(np.float16) if encoding == "float" else rng.integers(0, 256, (h, w, 4))
            )
            images.append(
                Image(f"{encoding} {h}x{w}", pixels.astype(np.float16 if encoding == "float" else np.uint8), encoding)
            )
    return tuple(images)


IMAGES = random_images()


def every_way() -> tuple[Texture, ...]:
    """Every image in every extension and interpolation, some turned and moved."""
    rng = np.random.default_rng(2)
    ways = []
    for image in range(len(IMAGES)):
        for extension in EXTENSIONS:
            for interpolation in ("linear", "closest"):
                affine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0) if rng.random() < 0.5 else tuple(rng.uniform(-0.7, 0.7, 6))
                ways.append(Texture(image, "rgb", affine, extension, interpolation))
    return tuple(ways)


def near_an_edge(texture: Texture, u: float, v: float) -> bool:
    """Whether rounding decides which texel is closest."""
    m, (height, width) = texture.uv_from_mesh, IMAGES[texture.image].pixels.shape[:2]
    x, y = (m[0] * u + m[1] * v + m[2]) * width, (m[3] * u + m[4] * v + m[5]) * height
    return min(abs(x - round(x)), abs(y - round(y))) < EDGE


def lookups() -> tuple[TexturePool, tuple[Texture, ...], np.ndarray, np.ndarray]:
    textures = every_way()
    rng = np.random.default_rng(3)
    row = np.repeat(np.arange(len(textures)), 25)
    return TexturePool(IMAGES, textures), textures, row, rng.uniform(-REACH, REACH, (2, len(row))).astype(np.float32)


def test_every_image_and_wrap_matches_the_slow_reference_in_one_mixed_batch():
    pool, textures, row, uv = lookups()
    found = pool.sample(row, uv)
    assert found.shape == (4, len(row))
    assert found.dtype == np.float32
    compared = 0
    for lane, (texture, u, v) in enumerate(zip(row, *uv.astype(np.float64), strict=True)):
        if near_an_edge(textures[texture], u, v):
            continue
        truth = reference(IMAGES[textures[texture].image], textures[texture], u, v)
        assert np.abs(found[:, lane] - truth).max() < TOLERANCE, (textures[texture], u, v)
        compared += 1
    assert compared > 0.99 * len(row)


def test_a_lookup_is_the_same_alone_and_among_others():
    pool, _, row, uv = lookups()
    whole = pool.sample(row, uv)
    some = np.random.default_rng(4).permutation(len(row))[:200]
    assert np.array_equal(pool.sample(row[some], np.ascontiguousarray(uv[:, some])), whole[:, some])
    assert np.array_equal(pool.sample(row[7:8], uv[:, 7:8]), whole[:, 7:8])


def test_the_reference_would_notice_a_shift_by_half_a_texel_or_another_wrap():
    pool, textures, row, uv = lookups()
    whole = pool.sample(row, uv)
    assert (np.abs(pool.sample(row, uv + np.float32(0.5 / 7)) - whole).max(axis=0) > TOLERANCE).mean() > 0.1
    others = tuple(
        Texture(t.image, t.channel, t.uv_from_mesh, {"mirror": "repeat"}.get(t.extension, t.extension), t.interpolation)
        for t in textures
    )
    assert np.abs(TexturePool(IMAGES, others).sample(row, uv) - whole).max() > 0.1


def ramp(extension: str = "repeat") -> TexturePool:
    pixels = np.zeros((1, 4, 4), np.uint8)
    pixels[0, :, 0] = (10, 80, 150, 220)
    return TexturePool((Image("ramp", pixels, "linear"),), (Texture(0, extension=extension),))


def red(pool: TexturePool, u) -> np.ndarray:
    u = np.asarray(u, np.float32)
    return pool.sample(np.zeros(len(u), np.int64), np.stack([u, np.full_like(u, 0.5)]))[0] * 255


def test_a_texel_begins_at_its_own_lower_edge():
    assert np.allclose(red(ramp(), [0.0, 0.2499, 0.25, 0.5, 0.75, 0.9999, 1.0]), [10, 10, 80, 150, 220, 220, 10])


def test_clipped_images_are_black_and_clear_outside():
    assert red(ramp("clip"), [-0.2, 1.2, 7.0, -1e-3]).tolist() == [0, 0, 0, 0]
    assert np.allclose(red(ramp("clip"), [0.0, 0.999]), [10, 220])


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("interpolation", ["linear", "closest"])
def test_huge_infinite_and_nan_coordinates_give_some_texel_of_the_image(extension, interpolation):
    textures = tuple(Texture(i, "rgb", (1e3, 0, 0, 0, 1, 0), extension, interpolation) for i in range(len(IMAGES)))
    pool = TexturePool(IMAGES, textures)
    bad = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e30, -1e20, 1e9, -16777217, 1e-45], np.float32)
    u, v = (a.ravel() for a in np.meshgrid(bad, bad))
    for row in range(len(textures)):
        with np.errstate(over="ignore", invalid="ignore"):
            found = pool.sample(np.full(len(u), row), np.stack([u, v]))
        assert np.isfinite(found).all()
        assert found.min() >= 0
        assert found.max() <= 1


def test_float_images_keep_values_above_one_and_srgb_alpha_is_linear():
    bright = Image("bright", np.full((2, 2, 4), 300.0, np.float16), "float")
    half = Image("half", np.full((2, 2, 4), 128, np.uint8), "srgb")
    pool = TexturePool((half, bright), (Texture(1), Texture(0)))
    found = pool.sample(np.array([0, 1]), np.full((2, 2), 0.3, np.float32))
    assert np.allclose(found[:, 0], 300)
    assert np.allclose(found[:, 1], [0.2158605] * 3 + [128 / 255], atol=1e-6)


def test_only_images_that_are_read_are_kept():
    big = Image("unused", np.zeros((64, 64, 4), np.uint8), "srgb")
    pool = TexturePool((big, IMAGES[1]), (Texture(1),))
    assert pool._bytes.size == IMAGES[1].pixels[..., 0].size
