"""Which surfaces are worth a probe's view: those that any light arrives at.

Comes in: a scene, patches of its surfaces. Goes out: which of these are not dark, by a few paths from each. Closed
rooms that nobody has lit have as many surfaces as others, and reflections there are black without a probe.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .gather import Effort, gather
from .measured import stack
from .patches import Patches
from .scene import Scene
from .sensors import SurfaceSensor
from .sobol import scramble

__all__ = ["DARK", "are_lit"]

PATHS, BOUNCES = 32, 8
"""Paths from a patch, and reflections on their way: dim rooms whose light few of them find have fewer patches."""

DARK = 1e-3
"""Irradiance below this part of the mean over all surfaces is none."""

USE = 0x117
"""Tells keys of lit patches from others."""


def are_lit(scene: Scene, effort: Effort, seen: Patches) -> np.ndarray:
    """Look for light on patches.

    Parameters
    ----------
    scene : Scene
        Its light: of lamps, of every direction of the sun, of the sky.
    effort : Effort
        Seed, threads.
    seen : Patches
        Pieces of surfaces.

    Returns
    -------
    (n,) bool ndarray
        Those that any of these lights arrives at, straight or by way of other surfaces; all where no light does.
    """
    keys = scramble(np.arange(len(seen.weight), dtype=np.uint32), USE)
    effort = dataclasses.replace(effort, samples=PATHS, bounces=BOUNCES)
    light = stack(scene, gather(scene, SurfaceSensor(seen.normal), seen.start, keys, effort))[:, :, 0]
    light = np.abs(light).sum(axis=2, dtype=np.float64)
    weight = seen.weight[:, None].astype(np.float64)
    mean = (light * weight).sum(axis=0) / max(weight.sum(), np.finfo(np.float64).tiny)
    found = ((light > 0) & (light >= DARK * mean)).any(axis=1)
    return found if found.any() else ~found
