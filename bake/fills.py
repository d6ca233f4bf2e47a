"""Fills: what voxels leave of the light that coarser levels fill up with where no fine data point is seen.

Comes in: a cell, fitted, with receivers. Goes out: one factor for each voxel. Behind furniture and in the joints of
doors no data point of the finest level is seen, and coarser ones stand in the open: far too bright. Receivers there
say what is left. With w the linear weights of the voxels around a receiver on its finest level, and d what they
hold back,

    light there = what is seen + (1 - sum of w d) * what fills up,     0 <= d <= 1

is solved for d by least squares, coarse levels first.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..tree.blend import ENOUGH
from ..tree.stencil import Taps, taps
from .survey import Judge, State, brightness, confidence, luminance, mean_view

__all__ = ["fills"]

LEAST = 0.2
"""Voxels that would hold back less than this hold back nothing: light has noise, and it must not darken on average."""

PRIOR = 0.1
"""What speaks for holding nothing back, in receivers of mean worth: few that see little of a voxel do not count."""

ROUNDS = 20
"""Iterations; later ones change next to nothing."""


def fills(state: State, light: np.ndarray, judge: Judge) -> np.ndarray:
    """Fit what is left of the light that fills up.

    Parameters
    ----------
    state : State
        A cell, with its shade.
    light : (points, functions, 9, 3) float32 ndarray
        What is stored.
    judge : Judge
        Its mean view counts.

    Returns
    -------
    (points,) uint8 ndarray
        255 where all of it is left, and where no receiver needs it.

    Notes
    -----
    Source: ours; the iteration is SART (Andersen and Kak 1984), clipped to what is possible.
    """
    fill, mixed = np.ones(len(light), np.float32), mean_view(light, judge)
    unlit = dataclasses.replace(state, seen=state.seen.take(np.flatnonzero(confidence(state) < ENOUGH)))
    place, start = np.ascontiguousarray(unlit.seen.at.position.T), np.full(len(unlit.seen.at.key), -1)
    for found in taps(state.data.grid, state.data.dual_cells, place, state.data.grid.levels - 1):
        start[found.point] = np.maximum(start[found.point], found.level)
    for level in range(state.data.grid.levels):
        here = dataclasses.replace(unlit, seen=unlit.seen.take(np.flatnonzero(start == level)))
        if len(here.seen.at.key):
            _fit(here, mixed, brightness(here.seen, judge)[0], level, fill)
    return np.round(255 * fill).astype(np.uint8)


def _fit(state: State, mixed: np.ndarray, wanted: np.ndarray, level: int, fill: np.ndarray) -> None:
    """Fit the voxels of one level to receivers whose finest level it is."""
    of_level = state.data.level == level
    seen, full = (_received(state, mixed, np.where(of_level, value, fill)) for value in (0.0, 1.0))
    given, place = full - seen, np.ascontiguousarray(state.seen.at.position.T)
    found = next(taps(state.data.grid, state.data.dual_cells, place, level))
    matter = np.where(given > 0, state.seen.at.area * given * given, 0)
    held = _solve(found, 1 - (wanted - seen) / np.where(given > 0, given, 1), matter, len(fill))
    fill[of_level] = 1 - np.where(held > LEAST, held, 0)[of_level]


def _received(state: State, mixed: np.ndarray, fill: np.ndarray) -> np.ndarray:
    """(n,) luminance at the receivers with other fills."""
    data = dataclasses.replace(state.data, fill=fill.astype(np.float32))
    return luminance(dataclasses.replace(state, data=data), mixed)


def _solve(found: Taps, target: np.ndarray, matter: np.ndarray, count: int) -> np.ndarray:
    """(count,) d with sum of w d as close to the targets as possible, 0 to 1, 0 where nothing is known."""
    weight, target, matter = found.weight.astype(np.float64), target[found.point], matter[found.point]
    held, whole = np.zeros(count), np.maximum(weight.sum(axis=0), 1e-6)
    prior = PRIOR * matter.mean() + np.finfo(float).tiny
    share = np.bincount(found.row.ravel(), (weight * matter).ravel(), count) + prior
    for _ in range(ROUNDS):
        error = matter * (target - (weight * held[found.row]).sum(axis=0)) / whole
        step = np.bincount(found.row.ravel(), (weight * error).ravel(), count) - prior * held
        held = np.clip(held + step / share, 0, 1)
    return held
