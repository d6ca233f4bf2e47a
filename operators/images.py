"""Images of a scene, read once, and the pictures painted from them, as `Image` records.

Comes in: image data-blocks and pictures. Goes out: 8-bit pixels where they hold what the scene shows, 16-bit
floats where 8 bits would not, in a list that materials index.
"""

from __future__ import annotations

import bpy
import numpy as np

from ..bake.snapshot import Image
from .fields import Picture, Placement
from .notes import Notes

LINEAR_SPACES = {"Non-Color", "Raw", "Linear", "Linear Rec.709", "Linear Rec.709 (sRGB)", "Generic Data"}
HALF_MAX = 65504.0
# Larger images are box-filtered to half size until they fit [px].
MAX_SIZE = 4096
MISSING_GREY = 0.8


class Images:
    """Images read so far.

    Parameters
    ----------
    notes : Notes
        Gathers what cannot be represented.

    Attributes
    ----------
    records : list of Image
        In the order of their indices.
    """

    def __init__(self, notes: Notes) -> None:
        self.records: list[Image] = []
        self._notes = notes
        self._read: dict[tuple[str, bool], Image | None] = {}
        self._indices: dict[int, int] = {}
        # Kept alive, so that their ids stay their own.
        self._holders: list[Image | Picture] = []

    def picture(self, image: bpy.types.Image, placement: Placement, alpha_used: bool) -> Picture | None:
        """Return an image laid on a mesh.

        Parameters
        ----------
        image : bpy.types.Image
            The image.
        placement : Placement
            How it lies.
        alpha_used : bool
            Whether its alpha is read too; where it is not, Blender shows transparent texels black.

        Returns
        -------
        Picture or None
            None when the image cannot be loaded, which is noted.
        """
        record = self._image(image, alpha_used)
        return None if record is None else Picture(record.name, placement, lambda: decode(record), record)

    def index(self, picture: Picture) -> int:
        """Return the index of a picture's pixels, storing them when they are new.

        Parameters
        ----------
        picture : Picture
            An image, or painted.

        Returns
        -------
        int
            Index into `records`.
        """
        holder = picture.image or picture
        if id(holder) not in self._indices:
            self._indices[id(holder)] = len(self.records)
            self._holders.append(holder)
            self.records.append(picture.image or encode(picture))
        return self._indices[id(holder)]

    def _image(self, image: bpy.types.Image, alpha_used: bool) -> Image | None:
        """The pixels of a data-block, read once."""
        image = image.original
        key = (image.name_full, alpha_used)
        if key not in self._read:
            self._read[key] = self._load(image, alpha_used)
        return self._read[key]

    def _load(self, image: bpy.types.Image, alpha_used: bool) -> Image | None:
        """Read the pixels of an image, noting what differs."""
        loaded_before = image.has_data
        width, height = image.size
        if not image.has_data or width * height == 0:
            path = image.filepath or image.name
            self._notes.add("missing image file", f"plain grey ({MISSING_GREY})", f"'{path}'")
            return None
        self._note_kind(image)
        values = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(values)
        values = _four_channels(values.reshape(height, width, image.channels))
        if not loaded_before and not image.is_dirty and image.source == "FILE" and not image.packed_file:
            image.buffers_free()
        record = self._encode_file(image, values, alpha_used)
        return self._fitted(record)

    def _encode_file(self, image: bpy.types.Image, values: np.ndarray, alpha_used: bool) -> Image:
        """Pixels as they are stored, in the encoding of the image's colour space."""
        space = image.colorspace_settings.name
        linear = space in LINEAR_SPACES or image.colorspace_settings.is_data
        if image.alpha_mode == "NONE":
            values[..., 3] = 1
        see_through = image.alpha_mode in ("STRAIGHT", "PREMUL") and not linear and bool((values[..., 3] < 1).any())
        if image.is_float:
            if image.alpha_mode == "PREMUL" and alpha_used and see_through:
                values[..., :3] /= np.maximum(values[..., 3:], 1e-6)
            if not np.isfinite(values).all() or np.abs(values).max() > HALF_MAX:
                self._notes.add("texels beyond the range of 16-bit floats", "the largest ones", f"image '{image.name}'")
            values = np.clip(np.nan_to_num(values, posinf=HALF_MAX, neginf=-HALF_MAX), -HALF_MAX, HALF_MAX)
            return Image(image.name, values.astype(np.float16), "float")
        if not linear and space != "sRGB":
            self._notes.add(f"colour space '{space}'", "sRGB", f"image '{image.name}'")
        if see_through and not alpha_used:
            # Cycles multiplies the stored values, before it decodes them.
            values[..., :3] *= values[..., 3:]
        return Image(image.name, _bytes(values), "linear" if linear else "srgb")

    def _note_kind(self, image: bpy.types.Image) -> None:
        """Images that are more than one picture."""
        if image.source in ("SEQUENCE", "MOVIE", "TILED"):
            what = {"SEQUENCE": "image sequence", "MOVIE": "movie", "TILED": "UDIM tiles"}[image.source]
            instead = "the first tile everywhere" if image.source == "TILED" else "one frame"
            self._notes.add(what, instead, f"image '{image.name}'")

    def _fitted(self, record: Image) -> Image:
        """An image no larger than the limit."""
        shape = record.pixels.shape
        if max(shape[:2]) <= MAX_SIZE:
            return record
        texels = decode(record)
        while max(texels.shape[:2]) > MAX_SIZE:
            rows, columns = ((size // 2) * 2 if size > 1 else size for size in texels.shape[:2])
            step = (2 if rows > 1 else 1, 2 if columns > 1 else 1)
            texels = (
                texels[:rows, :columns].reshape(rows // step[0], step[0], columns // step[1], step[1], 4).mean((1, 3))
            )
        self._notes.add(f"image larger than {MAX_SIZE} px", "a smaller copy, averaged", f"image '{record.name}'")
        return _encoded(record.name, texels, record.encoding)


def decode(image: Image) -> np.ndarray:
    """Return an image's texels as linear values.

    Parameters
    ----------
    image : Image
        Any encoding.

    Returns
    -------
    (h, w, 4) float32
        Linear, not premultiplied.
    """
    if image.encoding == "float":
        return image.pixels.astype(np.float32)
    table = np.arange(256, dtype=np.float32) / np.float32(255)
    if image.encoding == "linear":
        return table[image.pixels]
    curve = np.where(table <= 0.04045, table / 12.92, ((table + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.dstack([curve[image.pixels[..., :3]], table[image.pixels[..., 3]]])


def encode(picture: Picture) -> Image:
    """Return a painted picture as an image: 8 bits when its values are within 0 and 1, else floats.

    Parameters
    ----------
    picture : Picture
        Linear texels.

    Returns
    -------
    Image
        sRGB for colours, linear for greys, float beyond 0 and 1.
    """
    texels = picture.texels
    color = texels[..., :3]
    if color.min() < 0 or color.max() > 1:
        return _encoded(picture.name, texels, "float")
    grey = bool((color[..., 0] == color[..., 1]).all() and (color[..., 0] == color[..., 2]).all())
    return _encoded(picture.name, texels, "linear" if grey else "srgb")


def _encoded(name: str, texels: np.ndarray, encoding: str) -> Image:
    """Linear texels in a given encoding."""
    if encoding == "float":
        return Image(name, np.clip(texels, -HALF_MAX, HALF_MAX).astype(np.float16), encoding)
    color = _srgb(texels[..., :3]) if encoding == "srgb" else texels[..., :3]
    return Image(name, _bytes(np.dstack([color, texels[..., 3]])), encoding)


def _srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def _bytes(values: np.ndarray) -> np.ndarray:
    """0..1 as 0..255."""
    return np.clip(np.rint(values * 255), 0, 255).astype(np.uint8)


def _four_channels(values: np.ndarray) -> np.ndarray:
    """(h, w, 4) from one to four channels."""
    channels = values.shape[2]
    if channels == 4:
        return values
    color = np.repeat(values[..., :1], 3, 2) if channels < 3 else values[..., :3]
    alpha = values[..., 1:2] if channels == 2 else np.ones_like(values[..., :1])
    return np.dstack([color, alpha])
