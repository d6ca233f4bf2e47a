"""A camera that is in no scene: it stands where one says and looks where one says.

Comes in: eye, target and field of view, as the command line has them. Goes out: a pinhole camera, level with the
horizon.
"""

from __future__ import annotations

import math

import numpy as np

from .settings import SettingsError, unit
from .snapshot import Camera

FIELD_OF_VIEW = 75.0
"""Horizontal [degrees]: a room is seen from within it, as by a lens of 23 mm on film of 36 mm."""

FARTHEST = 1e9
"""Coordinate [m] beyond which nobody means what they say, far from where single precision ends."""


def choose(name: str | None, eye: np.ndarray | None, target: np.ndarray | None, fov: float | None):
    """Decide between a camera of the scene and one that stands anywhere.

    Parameters
    ----------
    name : str or None
        A camera of the scene.
    eye, target : (3,) float64 ndarray or None
        World space [m].
    fov : float or None
        Horizontal field of view [degrees], above 0 and below 180.

    Returns
    -------
    Camera, str or None
        The camera that stands at the eye; otherwise the name.

    Raises
    ------
    SettingsError
        The choices contradict each other or are incomplete.
    """
    if eye is None and target is None:
        if fov is not None:
            raise SettingsError("--fov: only together with --eye and --target; cameras of the scene have their own")
        return name
    if name is not None:
        raise SettingsError("--camera: not together with --eye and --target; leave one or the other out")
    if eye is None or target is None:
        raise SettingsError("--eye and --target: give both, or neither")
    return look(eye, target, FIELD_OF_VIEW if fov is None else fov)


def look(eye: np.ndarray, target: np.ndarray, fov: float = FIELD_OF_VIEW) -> Camera:
    """Place a camera.

    Parameters
    ----------
    eye, target : (3,) float64 ndarray
        Where it stands and what is in the middle of its picture, world space [m].
    fov : float
        Horizontal field of view [degrees].

    Returns
    -------
    Camera
        With z upwards in the picture. Straight up and straight down the picture's right is x.

    Raises
    ------
    SettingsError
        The eye is the target, or either is out of reach.
    """
    places = np.array([eye, target], np.float64)
    if not (np.abs(places) <= FARTHEST).all():
        raise SettingsError(f"--eye and --target: at most {FARTHEST:g} m from the origin")
    if (places[0] == places[1]).all():
        raise SettingsError("--eye and --target: they are one point, which gives no direction to look")
    ahead = unit((places[1] - places[0])[None], "--target")[0]
    level = np.array([ahead[1], -ahead[0], 0.0]) if ahead[:2].any() else np.array([1.0, 0.0, 0.0])
    right = unit(level[None], "--target")[0]
    world_from_camera = np.column_stack([right, np.cross(right, ahead), -ahead, places[0]])
    return Camera("viewpoint", tuple(world_from_camera.ravel().tolist()), math.tan(math.radians(fov) / 2))
