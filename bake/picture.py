"""Pictures for people: two irradiance images side by side and their signed difference.

Comes in: linear images. Goes out: a PNG to look at, or an OpenEXR file with every number.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import numpy as np

from ..tree.atomic import write_bytes_atomically
from .lamps import LUMINANCE
from .settings import SettingsError

BRIGHT = 0.9
"""Display value of the brightest pixels that count, those at the quantile below."""

QUANTILE = 0.97

DIFFERENCE_RANGE = 0.5
"""Difference over the image's mean at which red or blue is full."""

BACKGROUND = (24, 24, 28)
CAPTION_HEIGHT = 18
CAPTIONS = ("baked", "path traced", "difference, red: baked is brighter, full at 50 % of the mean")


def write_pictures(path: Path, baked: np.ndarray, traced: np.ndarray, covered: np.ndarray) -> None:
    """Write the comparison.

    Parameters
    ----------
    path : Path
        .png: three pictures beside each other; .exr: layers `baked`, `traced`, `difference`.
    baked, traced : (h, w, 3) float32 ndarray
        Linear Rec.709 [W/m2].
    covered : (h, w) float32 ndarray
        1 where there is a surface.

    Raises
    ------
    SettingsError
        Another kind of file.
    OSError
        The file cannot be written.
    """
    check_path(path)
    if path.suffix.lower() == ".exr":
        _write_exr(path, {"baked": baked, "traced": traced, "difference": baked - traced})
    else:
        _write_png(path, baked, traced, covered > 0)


def check_path(path: Path) -> None:
    """Refuse a name that no picture can be written to, before any work.

    Parameters
    ----------
    path : Path
        The picture.

    Raises
    ------
    SettingsError
        It is no .png or .exr.
    """
    if path.suffix.lower() not in (".exr", ".png"):
        raise SettingsError(f"{path}: write pictures as .png or .exr")


def panels(baked: np.ndarray, traced: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Make three pictures beside each other: baked, path traced, their difference.

    Parameters
    ----------
    baked, traced : (h, w, 3) float32 ndarray
        Linear Rec.709 [W/m2].
    covered : (h, w) bool ndarray
        Where there is a surface.

    Returns
    -------
    (h, 3 w, 3) uint8 ndarray
        sRGB, as bright as suits what was traced; the difference is white where there is none.
    """
    seen = (traced @ LUMINANCE)[covered]
    bright = float(np.quantile(seen, QUANTILE)) if seen.size else 1.0
    mean = float(seen.mean()) if seen.size else 1.0
    scale = BRIGHT / max(bright, 1e-30)
    shown = [
        _display(baked * scale),
        _display(traced * scale),
        _signed((baked - traced) @ LUMINANCE / max(mean, 1e-30)),
    ]
    return np.concatenate([np.where(covered[..., None], one, np.uint8(BACKGROUND)) for one in shown], axis=1)


def _write_png(path: Path, baked: np.ndarray, traced: np.ndarray, covered: np.ndarray) -> None:
    from PIL import Image, ImageDraw

    below = panels(baked, traced, covered)
    sheet = np.concatenate([np.full((CAPTION_HEIGHT, *below.shape[1:]), BACKGROUND, np.uint8), below])
    image = Image.fromarray(sheet)
    draw = ImageDraw.Draw(image)
    for number, caption in enumerate(CAPTIONS):
        draw.text((number * covered.shape[1] + 4, 3), caption, fill=(220, 220, 220))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    write_bytes_atomically(path, buffer.getvalue())


def _display(linear: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8, sRGB curve (IEC 61966-2-1)."""
    value = np.clip(linear, 0, 1)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(encoded * 255).astype(np.uint8)


def _signed(relative: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8: white where equal, red above, blue below."""
    share = np.clip(relative / DIFFERENCE_RANGE, -1, 1)
    fade = 1 - np.abs(share)
    red, blue = np.where(share >= 0, 1, fade), np.where(share <= 0, 1, fade)
    return np.round(np.stack([red, fade, blue], axis=-1) * 255).astype(np.uint8)


def _write_exr(path: Path, layers: dict[str, np.ndarray]) -> None:
    import OpenEXR

    channels = {
        f"{name}.{letter}": np.ascontiguousarray(layer[..., number])
        for name, layer in layers.items()
        for number, letter in enumerate("RGB")
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory(prefix="gi_volumes_") as scratch:
        written = Path(scratch) / "picture.exr"
        OpenEXR.File(header, channels).write(str(written))
        write_bytes_atomically(path, written.read_bytes())
