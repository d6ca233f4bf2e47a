"""All reflection probes of a bake: what each sees, on octahedral maps in one atlas, apart for every transport.

Comes in: maps, or a folder. Goes out: one record that the look-up and the shader read. Light is linear in its sources,
so the radiance for a sun and a sky is the sum of the parts times the factors that irradiance has for these:

    local                   lamps and emissive surfaces: what they light, and the surfaces that shine themselves
    sun.0, sun.1, ...       one for each sun key, per 1 W/m2 of sun irradiance; the sun's own disk is not there
    sky, or sky.0, ...      the sky that is seen and what it lights: a fixed one, or for each of its functions
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .probe_atlas import Layout

__all__ = ["LARGEST", "ProbeMaps", "empty", "part_names", "rounded"]

LARGEST = np.float32(65408)
"""Largest number that half precision holds in nine binary digits."""

DROPPED = 15
"""Binary digits of single precision that are rounded away: nine are left, the first of them not stored. Noise is some
ten times as much, and files are a sixth smaller than with all eleven of half precision."""


@dataclass(frozen=True, eq=False)
class ProbeMaps:
    """Maps of k probes; probe i is tile i of the layout.

    layout : Layout, where tiles lie
    position : (k, 3) float64 [m], world coordinates
    pinned : (k,) bool, whether an artist put them there
    radiance : dict of str to tuple of (rows_l, columns_l, 3) float16, of each part by mip level [W/(m2 sr), or as the
        part says], `rounded`; `ggx.ladder` gives the levels' roughness
    distance : (rows, columns) float16 [m], to what the middle of each texel of level 0 sees; inf is the sky
    normal : (rows, columns, 3) float16, of that surface's side, unit length; 0 is the sky
    albedo : (rows, columns, 3) float16, its diffuse reflectance, 0 to 1, `rounded`; 0 is the sky
    """

    layout: Layout
    position: np.ndarray
    pinned: np.ndarray
    radiance: dict[str, tuple[np.ndarray, ...]]
    distance: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray


def rounded(values: np.ndarray) -> np.ndarray:
    """Round to what is worth storing of radiance and albedo.

    Parameters
    ----------
    values : float32 ndarray
        Finite numbers.

    Returns
    -------
    float16 ndarray
        Of nine binary digits, held at `LARGEST`.

    Notes
    -----
    Error: 2**-9 of each number, 0.2 %; below 6e-5 up to 3e-8.

    Examples
    --------
    >>> rounded(np.float32([1, 1.0015, 1.0025, 1e6]))
    array([1.000e+00, 1.000e+00, 1.004e+00, 6.541e+04], dtype=float16)
    """
    bits = np.clip(values, -LARGEST, LARGEST).view(np.uint32)
    half = np.uint32((1 << DROPPED - 1) - 1) + (bits >> np.uint32(DROPPED) & np.uint32(1))  # ties go to even numbers
    kept = bits + half & ~np.uint32((1 << DROPPED) - 1)
    return kept.view(np.float32).astype(np.float16)


def part_names(has_local: bool, suns: int, functions: int) -> tuple[str, ...]:
    """Name the parts of radiance.

    Parameters
    ----------
    has_local : bool
        Whether there is local light.
    suns : int
        Sun keys.
    functions : int
        Functions of the sky.

    Returns
    -------
    tuple of str
        In the order of `paths.Radiance.stacked`.

    Examples
    --------
    >>> part_names(True, 2, 1)
    ('local', 'sun.0', 'sun.1', 'sky')
    """
    skies = [f"sky.{number}" for number in range(functions)] if functions > 1 else ["sky"] * functions
    return tuple(["local"] * has_local + [f"sun.{number}" for number in range(suns)] + skies)


def empty(position: np.ndarray, pinned: np.ndarray, pitch: int, parts: tuple[str, ...]) -> ProbeMaps:
    """Make room for probes that see nothing but a black sky.

    Parameters
    ----------
    position : (k, 3) float64 ndarray
        World coordinates [m]; there may be none.
    pinned : (k,) bool ndarray
        Whether an artist put them there.
    pitch : int
        Width of a tile [texels].
    parts : tuple of str
        As from `part_names`.

    Returns
    -------
    ProbeMaps
        Whose arrays may be written to.
    """
    layout = Layout.of(len(position), pitch)
    shapes = [layout.shape(level) for level in range(layout.levels)]
    radiance = {name: tuple(np.zeros((*shape, 3), np.float16) for shape in shapes) for name in parts}
    normal, albedo = np.zeros((2, *shapes[0], 3), np.float16)
    return ProbeMaps(layout, position, pinned, radiance, np.full(shapes[0], np.inf, np.float16), normal, albedo)
