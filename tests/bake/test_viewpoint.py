"""Cameras that stand anywhere: what is where in their pictures."""

from __future__ import annotations

import numpy as np
import pytest
from gi_volumes.bake import compare, viewpoint
from gi_volumes.bake.settings import SettingsError
from gi_volumes.bake.snapshot import Camera

EYE = np.array([3.0, -2.0, 1.5])


def rays(offset, fov: float = 90.0, size=(3, 3)) -> np.ndarray:
    """(height, width, 3) directions through the pixels of a picture from `EYE` of a place beside it."""
    camera = viewpoint.look(EYE, EYE + np.array(offset), fov)
    start, direction = compare.camera_rays(camera, size, np.zeros(3))
    assert np.allclose(start.T, EYE)
    return direction.T.reshape(size[1], size[0], 3)


@pytest.mark.parametrize("offset", [(4, 0, 0), (-1, 2, 0.5), (0, -3, -7), (1e-9, 0, -1), (0, 0, 1), (0, 0, -1)])
def test_the_target_is_in_the_middle_and_the_axes_are_a_rotation(offset):
    assert np.allclose(rays(offset)[1, 1], np.array(offset) / np.linalg.norm(offset), atol=1e-6)
    axes = np.reshape(viewpoint.look(EYE, EYE + offset).world_from_camera, (3, 4))[:, :3]
    assert np.allclose(axes.T @ axes, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[2, 0] == 0, "the horizon leans"
    assert axes[2, 1] >= 0, "the picture is upside down"


@pytest.mark.parametrize(("upwards", "up"), [(1, -1), (-1, 1)])
def test_straight_up_and_straight_down_have_x_to_the_right(upwards, up):
    seen = rays((0, 0, upwards))
    assert np.allclose(seen[1, 2] - seen[1, 0], [2 * seen[1, 2, 0], 0, 0], atol=1e-6)
    assert seen[1, 2, 0] > 0
    assert seen[0, 1, 1] * up > 0


@pytest.mark.parametrize("fov", [1.0, 75.0, 170.0])
def test_the_field_of_view_is_the_angle_between_the_sides_of_the_picture(fov):
    across = rays((2, 1, 0), fov, (4001, 3))[1]
    angle = np.degrees(np.arccos(across[0].astype(np.float64) @ across[-1]))
    assert angle == pytest.approx(fov, rel=2e-3)


def test_a_camera_of_the_scene_is_left_to_its_name():
    assert viewpoint.choose("above", None, None, None) == "above"
    assert viewpoint.choose(None, None, None, None) is None
    assert isinstance(viewpoint.choose(None, EYE, EYE + 1, None), Camera)


def test_a_place_out_of_reach_and_a_look_at_nothing_are_refused():
    with pytest.raises(SettingsError, match="at most"):
        viewpoint.look(EYE, np.array([0, 0, 2 * viewpoint.FARTHEST]))
    with pytest.raises(SettingsError, match="one point"):
        viewpoint.look(EYE, EYE)
