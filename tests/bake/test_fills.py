"""Cracks: what voxels hold back of the light that fills up where no fine data point is seen."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
from gi_volumes.bake import fills
from gi_volumes.bake.receivers import Receivers
from gi_volumes.bake.survey import Judge, Seen, State, luminance, mean_view
from gi_volumes.tree import build, interpolate
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.stencil import Taps

DARK = 0.3
JUDGE = Judge(np.ones((1, 1, 3)), np.ones((1, 3)))


def dark_side() -> State:
    """A box whose fine data points are all hidden, and receivers around it: on one side they get less light."""
    grid, walls = Grid(levels=3), build_scenes.box((1, 1, 1), (7, 6, 5)).astype(np.float32)
    tree = build.build(walls, grid, (0, 0))
    plane = np.array([[0, 0, 1.0, 1000.0, 0.1]])  # 1 km above everything
    planes = np.full((tree.size, 3), -1, np.int32)
    planes[tree.voxels()[0] > 0, 0] = 0
    offset, valid = np.zeros((tree.size, 3), np.int8), np.ones(tree.size, bool)
    data = interpolate.join(grid, [tree], offset, valid, planes, plane)
    position = np.random.default_rng(1).uniform((1, 1, 1), (7, 6, 5), (4000, 3))
    position[:, 2] = np.where(np.arange(4000) % 2, 1, 5)
    normal = np.tile(np.array([0, 0, 1], np.float32), (4000, 1))
    area, key = np.ones(4000, np.float32), np.arange(4000, dtype=np.uint32)
    light = np.where(position[:, 0] < 4, DARK, 1.0).astype(np.float32)[None, :, None, None]
    at = Receivers(position, normal, area, key, np.ones(4000, bool))
    return State(tree, None, data, Seen(at, np.broadcast_to(light, (2, 4000, 1, 3)).copy()))


def constant(state: State) -> np.ndarray:
    """Harmonics of irradiance 1 everywhere."""
    light = np.zeros((state.tree.size, 1, 9, 3), np.float32)
    light[:, 0, 0] = np.sqrt(4 * np.pi)
    return light


def test_voxels_hold_back_what_receivers_do_not_get():
    state = dark_side()
    light = constant(state)
    fill = fills.fills(state, light, JUDGE) / np.float32(255)
    dim = dataclasses.replace(state, data=dataclasses.replace(state.data, fill=fill))
    found, x = luminance(dim, mean_view(light, JUDGE)), state.seen.at.position[:, 0]
    for side, value in ((x < 3.5, DARK), (x > 4.5, 1)):
        assert np.sqrt(np.mean((found[side] - value) ** 2)) < 0.03
    before = luminance(state, mean_view(light, JUDGE))
    assert np.abs(before - 1).max() < 1e-5


def test_noise_of_receivers_darkens_next_to_nothing():
    state = dark_side()
    noisy = np.random.default_rng(2).normal(1, 0.15, state.seen.light.shape[1]).astype(np.float32)
    seen = Seen(state.seen.at, np.broadcast_to(noisy[None, :, None, None], state.seen.light.shape).copy())
    fill = fills.fills(dataclasses.replace(state, seen=seen), constant(state), JUDGE)
    assert (fill < 255).mean() < 0.01
    dim = dataclasses.replace(state, data=dataclasses.replace(state.data, fill=fill / np.float32(255)))
    assert abs(luminance(dim, mean_view(constant(state), JUDGE)).mean() - 1) < 0.002


def test_voxels_hold_nothing_back_where_what_fills_up_is_right():
    state = dark_side()
    seen = Seen(state.seen.at, np.ones_like(state.seen.light))
    assert (fills.fills(dataclasses.replace(state, seen=seen), constant(state), JUDGE) == 255).all()


def test_what_voxels_hold_back_is_the_bounded_least_squares_solution():
    """Targets that some choice of voxels reaches are reached, but for the prior; impossible ones end at the bounds."""
    rng = np.random.default_rng(2)
    count, voxels = 400, 20
    row = rng.integers(0, voxels, (8, count))
    weight = rng.random((8, count)).astype(np.float32)
    weight /= weight.sum(axis=0)
    found = Taps(np.arange(count), row, weight, np.zeros((3, count)), np.zeros((3, count), np.float32), 0)
    target, matter = (weight * rng.random(voxels)[row]).sum(axis=0), rng.random(count)
    held = fills._solve(found, target, matter, voxels + 1)
    assert np.sqrt(np.mean((target - (weight * held[row]).sum(axis=0)) ** 2)) < 0.1 * np.sqrt(np.mean(target**2))
    assert held[voxels] == 0  # nobody looks there
    assert (fills._solve(found, target + 9, matter, voxels) > 0.99).all()
    assert (fills._solve(found, target - 9, matter, voxels) == 0).all()
