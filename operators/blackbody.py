"""The colour of a glowing body, as Blender's Blackbody node and lamp temperatures have it: luminance 1."""

from __future__ import annotations

import numpy as np

from .fields import LUMINANCE

# Second radiation constant [nm K].
C2 = 1.438777e7
WAVELENGTHS_NM = np.arange(380.0, 781.0, 5.0)
LOWEST_K, HIGHEST_K = 800.0, 40000.0
REC709_FROM_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.969266, 1.8760108, 0.041556], [0.0556434, -0.2040259, 1.0572252]]
)


def color(temperature: float) -> np.ndarray:
    """Return the colour of a black body.

    Parameters
    ----------
    temperature : float
        In kelvin.

    Returns
    -------
    (3,) float64
        Linear Rec.709 of luminance 1.

    Notes
    -----
    Error: within 0.1 of Blender's own table from 1,500 K on, within 0.03 from 3,000 to 12,000 K
    (`test_nodes_extract.py`). Source: Wyman, Sloan and Shirley 2013, "Simple Analytic Approximations to the CIE XYZ
    Color Matching Functions", table 1.
    """
    kelvin = min(max(temperature, LOWEST_K), HIGHEST_K)
    spectrum = WAVELENGTHS_NM**-5 / np.expm1(C2 / (WAVELENGTHS_NM * kelvin))
    rgb = REC709_FROM_XYZ @ (_matching_functions(WAVELENGTHS_NM) @ spectrum)
    return np.maximum(rgb / (LUMINANCE @ rgb), 0)


def _matching_functions(nm: np.ndarray) -> np.ndarray:
    """(3, n) CIE 1931 x, y, z, as sums of lobes of unequal halves."""
    x = _lobe(nm, 1.056, 599.8, 37.9, 31.0) + _lobe(nm, 0.362, 442.0, 16.0, 26.7) + _lobe(nm, -0.065, 501.1, 20.4, 26.2)
    y = _lobe(nm, 0.821, 568.8, 46.9, 40.5) + _lobe(nm, 0.286, 530.9, 16.3, 31.1)
    z = _lobe(nm, 1.217, 437.0, 11.8, 36.0) + _lobe(nm, 0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def _lobe(nm: np.ndarray, height: float, center: float, below: float, above: float) -> np.ndarray:
    """A Gaussian with different widths on its two sides."""
    return height * np.exp(-0.5 * ((nm - center) / np.where(nm < center, below, above)) ** 2)
