"""Whether a scene has surfaces that show reflections.

Comes in: a scene. Goes out: the part of its surfaces that is glossy, looked at in the middle of each triangle.
"""

from __future__ import annotations

import numpy as np

from .scene import Scene

__all__ = ["ROUGH", "glossy_share"]

ROUGH = 0.4
"""Roughness from which on a reflection is blurred so much that irradiance will do: the lobe is 40 degrees wide."""

LEAST = 0.01
"""Least share of light that a surface must be able to reflect."""

THIRD = np.float32(1 / 3)


def glossy_share(scene: Scene) -> float:
    """Say how much of a scene is glossy.

    Parameters
    ----------
    scene : Scene
        Its surfaces.

    Returns
    -------
    float
        Part of their area, 0 to 1.
    """
    corners = scene.soup.corners.astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = np.full(len(corners), THIRD)
    roughness, smooth = scene.surfaces.gloss(np.arange(len(corners)), middle, middle)
    return float(area[(roughness < ROUGH) & (smooth >= LEAST)].sum() / area.sum())
