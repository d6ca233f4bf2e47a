"""What light finds at a hit: how much is reflected, passed through, emitted.

Comes in: triangle numbers and barycentrics. Goes out: colours, by component. Reflection is diffuse: the
specular layer's energy is kept, its direction is not, as in every irradiance volume.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from .gloss import ROUGHNESS, layer_shares
from .snapshot import Channel, Material, Snapshot, Texture
from .soup import Soup
from .textures import TexturePool

_SOURCES = {"r": 0, "g": 1, "b": 2, "a": 3}
"""Textures that are read as a single channel, in gray."""


class Surfaces:
    """The materials of a scene, ready to be evaluated at hits.

    Parameters
    ----------
    snapshot : Snapshot
        A checked scene.
    soup : Soup
        Its triangles.
    """

    def __init__(self, snapshot: Snapshot, soup: Soup) -> None:
        geometry, materials = snapshot.geometry, snapshot.materials
        self.material = geometry.materials[soup.source]
        self._uvs = _corner_values(geometry.corner_uvs, soup)
        self._colors = _corner_values(geometry.corner_colors, soup)
        names = ("base_color", "emission", "alpha", "metallic", "transmission", "roughness")
        channels = {name: [getattr(material, name) for material in materials] for name in names}
        textures = tuple({_whole(c.texture): None for row in channels.values() for c in row if c.texture is not None})
        self._pool = TexturePool(snapshot.images, textures)
        self._channel = {name: _ChannelTable(row, textures) for name, row in channels.items()}
        self._shares = layer_shares(materials)
        self._cutoff = np.array([m.alpha_cutoff if m.alpha_mode == "mask" else -1 for m in materials], np.float32)
        self._opaque_alpha = np.array([m.alpha_mode == "opaque" for m in materials], bool)
        self._transmits = np.array([m.transmission.factor[0] > 0 for m in materials], bool)
        self.transparent = np.array([_lets_light_pass(m) for m in materials], bool)[self.material]
        self.emissive = np.array([max(m.emission.factor) > 0 for m in materials], bool)[self.material]

    def reflectance(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Diffuse reflectance that holds all reflected energy of an opaque surface.

        Parameters
        ----------
        triangle : (n,) int ndarray
            Hits.
        u, v : (n,) float32 ndarray
            Their barycentric coordinates.

        Returns
        -------
        (3, n) float32 ndarray
            In [0, 1].

        Notes
        -----
        Source: energy balance of the Principled shader's lobes: metal reflects the base colour; a dielectric
        reflects the share F of its specular layer, averaged over directions, in white, and
        (1 - F)(1 - transmission) of the base colour.
        """
        lanes = self._lanes(triangle, u, v)
        base, metallic, transmission = self._base_layers(lanes)
        layer = self._layer(lanes)
        diffuse = metallic + (1 - metallic) * (1 - layer) * (1 - transmission)
        return np.minimum(base * diffuse + (1 - metallic) * layer, 1)

    def through(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light that goes straight on, and how much of the surface is there.

        Parameters
        ----------
        triangle : (n,) int ndarray
            Hits.
        u, v : (n,) float32 ndarray
            Their barycentric coordinates.

        Returns
        -------
        passed : (3, n) float32 ndarray
            Fraction of light that passes: the uncovered part, and transmission tinted by the base colour.
        covered : (n,) float32 ndarray
            Alpha: what reflection and emission are multiplied with.
        """
        lanes = self._lanes(triangle, u, v)
        covered = self._coverage(lanes)
        passed = np.repeat((1 - covered)[None], 3, axis=0)
        rows = np.flatnonzero(self._transmits[lanes.material])
        if len(rows):
            clear = self._lanes(triangle[rows], u[rows], v[rows])
            base, metallic, transmission = self._base_layers(clear)
            share = covered[rows] * (1 - metallic) * (1 - self._layer(clear)) * transmission
            passed[:, rows] += share * base
        return np.minimum(passed, 1), covered

    def emission(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Radiance that surfaces emit, on both sides.

        Parameters
        ----------
        triangle : (n,) int ndarray
            Hits.
        u, v : (n,) float32 ndarray
            Their barycentric coordinates.

        Returns
        -------
        (3, n) float32 ndarray
            Radiance [W/(m2 sr)].
        """
        return self._evaluate("emission", self._lanes(triangle, u, v))

    def gloss(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What decides how sharp reflections are.

        Parameters
        ----------
        triangle : (n,) int ndarray
            Hits.
        u, v : (n,) float32 ndarray
            Their barycentric coordinates.

        Returns
        -------
        roughness : (n,) float32 ndarray
            Principled's, 0 to 1.
        smooth : (n,) float32 ndarray
            Share of light that a surface as it is would reflect if it were smooth: of metal all, of a dielectric what
            its layer does.
        """
        lanes = self._lanes(triangle, u, v)
        metallic = np.minimum(self._evaluate("metallic", lanes)[0], 1)
        layer = self._shares[lanes.material, 0]
        return np.minimum(self._evaluate("roughness", lanes)[0], 1), metallic + (1 - metallic) * layer

    def _lanes(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> _Lanes:
        """Hits, with what their channels share."""
        return _Lanes(self.material[triangle], triangle, u, v, self._uvs, self._colors)

    def _base_layers(self, lanes: _Lanes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Base colour, metallic, transmission."""
        base = np.minimum(self._evaluate("base_color", lanes), 1)
        metallic = np.minimum(self._evaluate("metallic", lanes)[0], 1)
        transmission = np.minimum(self._evaluate("transmission", lanes)[0], 1)
        return base, metallic, transmission

    def _layer(self, lanes: _Lanes) -> np.ndarray:
        """(n,) share of light that the specular layer reflects, at the roughness of each hit."""
        place = np.minimum(self._evaluate("roughness", lanes)[0], 1) * np.float32(len(ROUGHNESS) - 1)
        below = np.minimum(place.astype(np.int64), len(ROUGHNESS) - 2)
        row = lanes.material * len(ROUGHNESS) + below
        first, second = self._shares.ravel()[row], self._shares.ravel()[row + 1]
        return first + (second - first) * (place - below)

    def _coverage(self, lanes: _Lanes) -> np.ndarray:
        """Alpha after the material's mode: opaque, cut, or as it is."""
        alpha = np.minimum(self._evaluate("alpha", lanes)[0], 1)
        cutoff = self._cutoff[lanes.material]
        alpha = np.where(cutoff >= 0, (alpha >= cutoff).astype(np.float32), alpha)
        return np.where(self._opaque_alpha[lanes.material], np.float32(1), alpha)

    def _evaluate(self, name: str, lanes: _Lanes) -> np.ndarray:
        """(k, n) values of one channel; float images and vertex colours may hold negative ones, light may not."""
        table = self._channel[name]
        value = table.factor[:, lanes.material]
        if table.has_texture:
            rows, rgba = self._texels(table, lanes)
            if len(rows) == len(lanes.material):
                value *= table.pick(lanes.material, rgba)
            elif len(rows):
                value[:, rows] *= table.pick(lanes.material[rows], rgba)
        if table.has_color:
            rows = np.flatnonzero(table.color[lanes.material])
            rgba = lanes.color[:, rows]
            value[:, rows] *= rgba[:3] if len(value) == 3 else rgba[3:]
        if table.has_texture or table.has_color:
            np.maximum(value, 0, out=value)
        return value

    def _texels(self, table: _ChannelTable, lanes: _Lanes) -> tuple[np.ndarray, np.ndarray]:
        """Rows (m,) of the lanes that have a texture there, and its RGBA (4, m), which several channels may share."""
        if table.images not in lanes.texels:
            texture = table.texture[lanes.material]
            rows = np.flatnonzero(texture >= 0)
            every = len(rows) == len(texture)
            rgba = self._pool.sample(texture if every else texture[rows], lanes.uv if every else lanes.uv[:, rows])
            lanes.texels[table.images] = rows, rgba
        return lanes.texels[table.images]


@dataclass
class _Lanes:
    """Hits, and their attributes, interpolated or read when the first channel asks and kept for the others."""

    material: np.ndarray
    triangle: np.ndarray
    u: np.ndarray
    v: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    texels: dict[bytes, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @cached_property
    def uv(self) -> np.ndarray:
        """(2, n) texture coordinates."""
        return _interpolate(self.uvs, self.triangle, self.u, self.v)

    @cached_property
    def color(self) -> np.ndarray:
        """(4, n) vertex colours."""
        return _interpolate(self.colors, self.triangle, self.u, self.v)


class _ChannelTable:
    """One input of every material, as arrays over materials."""

    def __init__(self, channels: list[Channel], textures: tuple) -> None:
        self.factor = np.ascontiguousarray(np.array([c.factor for c in channels], np.float32).T)
        rows = [-1 if c.texture is None else textures.index(_whole(c.texture)) for c in channels]
        self.texture = np.array(rows, np.int64)
        self.images = self.texture.tobytes()
        self.color = np.array([c.vertex_color for c in channels], bool)
        self.has_texture = bool((self.texture >= 0).any())
        self.has_color = bool(self.color.any())
        self._source = np.array([_SOURCES.get(c.texture.channel, -1) if c.texture else -1 for c in channels])

    def pick(self, material: np.ndarray, rgba: np.ndarray) -> np.ndarray:
        """(k, n) texture values in the channel that each material asks for."""
        color = rgba[:3] if len(self.factor) == 3 else rgba[:3].mean(axis=0, keepdims=True)
        source = self._source[material]
        single = source >= 0
        if single.any():
            picked = np.take_along_axis(rgba, np.maximum(source, 0)[None], axis=0)
            color = np.where(single, picked, color)
        return color


def _whole(texture: Texture) -> Texture:
    """The texture with all its channels: inputs that read different ones share its texels."""
    return replace(texture, channel="rgb")


def _lets_light_pass(material: Material) -> bool:
    """Whether any light can go straight through the surface."""
    return material.alpha_mode != "opaque" or material.transmission.factor[0] > 0


def _corner_values(values: np.ndarray, soup: Soup) -> np.ndarray:
    """(n, 3, k) corner attributes in the corner order of the soup, or no rows when the scene has none."""
    if not len(values):
        return values
    return np.take_along_axis(values[soup.source], soup.corner_order[:, :, None].astype(np.int64), axis=1)


def _interpolate(corners: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(k, n) attributes at barycentric coordinates; ones where the scene has no such attribute."""
    if not len(corners):
        return np.ones((corners.shape[2], len(triangle)), np.float32)
    value = corners[triangle]
    return (value[:, 0].T * (1 - u - v)) + value[:, 1].T * u + value[:, 2].T * v
