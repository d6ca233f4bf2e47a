"""Decides where a world cell's tree is subdivided: where what surfaces see differs from what the data say.

Comes in: what the tree could be, a target error. Goes out: the tree, its data points, and receivers with their light.
Level by level receivers on the surfaces are path-traced twice, independently; the product of both differences from
the interpolated value is an estimate of its squared error that noise doesn't raise. Voxels whose mean relative error
is above the target are subdivided, those first where a data point buys most, until the cap on data points binds.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree import build, harmonics, interpolate
from ..tree.blend import ENOUGH
from ..tree.dualcells import CORNERS
from ..tree.grid import Grid
from ..tree.lookup import Atlas
from ..tree.outline import Outline
from ..tree.region import Region, finder
from ..tree.stencil import taps
from ..tree.topology import Topology
from . import fit, occluders, receivers, reference
from .gather import Effort
from .lamps import LUMINANCE
from .measured import Measured, measure, stack
from .receivers import Receivers
from .scene import Scene

SPACING = 0.5
"""Distance between receivers, in voxels of the level that they judge: about four on a voxel's face."""

FEWEST = 2
"""Receivers without which a voxel is not judged."""

DARK = 0.1
"""Errors count relative to the light at the receiver, and to this part of the cell's mean where it is darker."""

WEAK = 0.1
"""Confidence below which a receiver is hardly lit; one data point straight before a wall gives up to a half."""

FRONT = 0.05
"""Height above the surface at which a voxel's centre is in front of it [voxels]."""

INSIDE = 0.9
"""Part of a receiver's linear weights that must lie in the cell itself for the receiver to have a say in the fit."""

GEOMETRY = 1e30
"""Need of first-level voxels with varied geometry: they come before everything that light asks for."""

HALVES = (0x51ED, 0xA11E)
"""Added to the seed for either half of the receivers' paths."""


@dataclass(frozen=True)
class Target:
    """What a cell is to reach.

    error : relative error of irradiance on surfaces, root mean square over a voxel, above which it is subdivided
    max_points : most data points of the cell
    dilation : as for `build.grow`
    effort : paths per data point, bounces, seed, threads
    samples : paths per receiver, both halves together
    """

    error: float
    max_points: int
    dilation: str
    effort: Effort
    samples: int


@dataclass(frozen=True, eq=False)
class Judge:
    """What the error is measured in: mixtures of the modelled functions.

    views : (v, functions, 3) float64, each looked at by itself, their squared errors are added
    mean : (functions, 3) float64, the mixture that errors are relative to
    """

    views: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True, eq=False)
class Seen:
    """Receivers and the light that arrives at them.

    at : Receivers
    light : (2, n, functions, 3) float32, two independent halves
    """

    at: Receivers
    light: np.ndarray

    def take(self, rows: np.ndarray) -> Seen:
        """Some of them: rows (m,) int64 or (n,) bool."""
        return Seen(self.at.take(rows), self.light[:, rows])


@dataclass(frozen=True, eq=False)
class Refined:
    """A cell's tree with its data.

    tree : Topology
    measured : Measured, its data points
    data : DataPoints, the same for look-up, with occluding planes
    seen : Seen, receivers all over it
    unseen : int, receivers that none of their data points sees
    """

    tree: Topology
    measured: Measured
    data: interpolate.DataPoints
    seen: Seen
    unseen: int


def refine(
    scene: Scene,
    grid: Grid,
    outline: Outline,
    judge: Judge,
    target: Target,
    progress: Callable[[float], bool] | None = None,
) -> Refined:
    """Grow the tree of a cell until its surfaces see what they should.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    grid : Grid
        The lattice.
    outline : Outline
        What the tree could be.
    judge : Judge
        What the error is measured in.
    target : Target
        When to stop.
    progress : callable, optional
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Refined
        The same for any number of threads.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Source: row 6 of the talk subdivides where there is geometry; by error as Unreal's and Activision's volumes do.
    """
    plan, stages = _Plan.of(outline, target.error), _Stages(3 * grid.levels, progress)
    state = None
    for level in range(grid.levels):
        state = _grow(scene, grid, plan, target, state, stages.next())
        state = _occlude(scene, state, _look(scene, grid, state, level, target, stages.next()), target)
        plan.asked[level] = _asked(grid, level, state, judge)
        shown = stages.next()
        if len(plan.asked[level]):
            state = _occlude(scene, _grow(scene, grid, plan, target, state, shown), state.seen, target)
        if level == grid.levels - 1:
            break
        if level and target.error:
            plan.need[level] = _need(grid, outline, level, state, judge, target)
        if not (plan.need[level] > 0).any():
            break
    return state


class _Stages:
    """Progress through a number of stages, as if all took as long."""

    def __init__(self, count: int, show: Callable[[float], bool] | None):
        self._count, self._show, self._done = count, show, -1

    def next(self) -> Callable[[float], bool] | None:
        """What the next stage is to call with the part of it that is done."""
        self._done += 1
        show, done, count = self._show, self._done, self._count
        return None if show is None else lambda share: show((done + share) / count)


def fitted(state: Refined, threads: int) -> np.ndarray:
    """Fit the data points of a cell to what its receivers see.

    Parameters
    ----------
    state : Refined
        The cell.
    threads : int
        As in `Effort`.

    Returns
    -------
    (points, functions, 9, 3) float32 ndarray
        Irradiance harmonics. Receivers whose neighbourhood reaches into other cells have no say: their data
        points are not known here.
    """
    light, at = state.measured.light, state.seen.at
    row, weight = interpolate.weigh(state.data, at.position, at.normal)
    total = weight.sum(axis=1)
    reached = np.zeros(len(total))
    for found in taps(
        state.data.grid, state.data.dual_cells, np.ascontiguousarray(at.position.T), state.tree.levels - 1
    ):
        reached[found.point] += found.weight.sum(axis=0)
    use = np.flatnonzero((total > ENOUGH) & (reached > INSIDE))
    if not len(use) or not light.shape[1]:
        return light
    basis = harmonics.basis(at.normal[use].astype(np.float64))
    system = fit.System(len(light), row[use], weight[use] / total[use, None], basis, np.ones(len(use)))
    return fit.fit(system, light, state.seen.light[:, use].mean(axis=0), threads=threads or os.cpu_count() or 1)


def trace(scene: Scene, at: Receivers, target: Target, progress: Callable[[float], bool] | None = None) -> np.ndarray:
    """Path-trace receivers twice.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    at : Receivers
        Points on surfaces.
    target : Target
        Its `samples` are shared by both halves.
    progress : callable, optional
        As in `refine`.

    Returns
    -------
    (2, n, functions, 3) float32 ndarray
        Irradiance of every modelled function.
    """
    halves = []
    for number, salt in enumerate(HALVES):
        effort = dataclasses.replace(target.effort, samples=max(1, target.samples // 2), seed=target.effort.seed ^ salt)
        show = progress and (lambda done, n=number: progress((n + done / len(at.key)) / len(HALVES)))
        found = reference.at(scene, at.position + scene.origin, at.normal, effort, show, at.key)
        halves.append(stack(scene, found)[:, :, 0])
    return np.stack(halves)


@dataclass(frozen=True, eq=False)
class _Plan:
    """What has been decided: need of every solid voxel, voxels asked for by themselves; by level."""

    outline: Outline
    need: list[np.ndarray]
    asked: list[np.ndarray]

    @classmethod
    def of(cls, outline: Outline, error: float) -> _Plan:
        """Varied geometry is subdivided once; from there on light decides, unless no error is allowed to."""
        need = [np.zeros(len(mask)) for mask in outline.wanted]
        for level in range(len(need) if error == 0 else min(1, len(need))):
            need[level] = np.where(outline.wanted[level], GEOMETRY * (1.0 + outline.need[level]) / 1e6**level, 0.0)
        return cls(outline, need, [np.zeros((0, 3), np.int64)] * (len(need) + 1))


def _grow(scene, grid: Grid, plan: _Plan, target: Target, state: Refined | None, progress) -> Refined:
    """The tree of what is needed so far, measured."""
    tree = build.fit(plan.outline, plan.need, target.dilation, target.max_points, plan.asked)
    measured = measure(scene, grid, tree, target.effort, state.measured if state else None, progress)
    data = interpolate.join(grid, [tree], measured.offset, measured.valid)
    return Refined(tree, measured, data, state.seen if state else None, 0)


def _occlude(scene: Scene, state: Refined, seen: Seen, target: Target) -> Refined:
    """The same with occluding planes."""
    hidden = occluders.fit(scene, state.data, seen.at, target.effort.threads)
    data = dataclasses.replace(state.data, planes=hidden.planes, plane=hidden.plane)
    return dataclasses.replace(state, data=data, seen=seen, unseen=int(hidden.unseen.sum()))


def _look(scene: Scene, grid: Grid, state: Refined, level: int, target: Target, progress) -> Seen:
    """Receivers for every level up to one; those of voxels that have been subdivided are replaced by denser ones."""
    inside, seen, size = _voxels_of(grid, state.tree, level), state.seen, float(grid.voxel_size(level))
    low = np.array(state.tree.grid_min) * grid.first_size
    high = low + np.array(state.tree.grid_shape) * grid.first_size
    at = receivers.spread(scene, low, high, SPACING * size, inside, target.effort.threads)
    new = Seen(at, trace(scene, at, target, progress))
    if seen is None:
        return new
    kept = seen.take(np.flatnonzero(~inside(seen.at.position)))
    at = Receivers(*(np.concatenate(pair) for pair in zip(_parts(kept.at), _parts(new.at), strict=True)))
    return Seen(at, np.concatenate([kept.light, new.light], axis=1))


def _voxels_of(grid: Grid, tree: Topology, level: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function that says which positions lie in a tree's voxels of a level."""
    atlas, size = Atlas([tree]), float(grid.voxel_size(level))
    return lambda position: atlas.find(level, np.floor(position / size).astype(np.int64)) >= 0


def _parts(at: Receivers) -> tuple[np.ndarray, ...]:
    """The arrays of receivers."""
    return at.position, at.normal, at.area, at.key


def squared_errors(state: Refined, judge: Judge) -> np.ndarray:
    """Estimate the squared error of what receivers see, relative to the light there.

    Parameters
    ----------
    state : Refined
        A cell.
    judge : Judge
        What is looked at.

    Returns
    -------
    (n,) float64 ndarray
        Unbiased, so that single ones may be negative; 0 where the data points of the cell don't reach.
    """
    at = state.seen.at
    row, weight = interpolate.weigh(state.data, at.position, at.normal)
    total = weight.sum(axis=1)
    weight = weight / np.maximum(total, ENOUGH)[:, None]
    basis = harmonics.basis(at.normal.astype(np.float64)).astype(np.float32)
    squared = np.zeros(len(row))
    for view in judge.views:
        stored = _looked_at(state.measured.light, view)
        value = np.einsum("nt,ntk,nk->n", weight, stored[row], basis)
        one, other = (_looked_at(half, view) for half in state.seen.light)
        squared += (value - one) * (value - other)
    bright, typical = _brightness(state.seen, judge)
    squared /= np.maximum(bright**2 + (DARK * typical) ** 2, 1e-30)
    return np.where(total > ENOUGH, squared, 0.0)


def _looked_at(light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(n, ...) luminance of a mixture of functions, of (n, functions, ..., 3) light."""
    factors = (view * LUMINANCE).astype(np.float32)
    out = np.zeros((len(light), *light.shape[2:-1]), np.float32)
    for number in np.flatnonzero(factors.any(axis=1)):
        out += light[:, number] @ factors[number]
    return out


def _need(grid: Grid, outline: Outline, level: int, state: Refined, judge: Judge, target: Target) -> np.ndarray:
    """What subdivision of each solid voxel of a level buys for each data point; 0 where it is good enough."""
    squared, area = squared_errors(state, judge), state.seen.at.area
    voxel = np.floor(state.seen.at.position / float(grid.voxel_size(level))).astype(np.int64)
    near = np.flatnonzero(Region.around(outline.coords[level]).contains(voxel))
    row, count = np.full(len(voxel), -1), len(outline.coords[level])
    row[near] = finder(outline.coords[level])(voxel[near])
    inside = np.flatnonzero(row >= 0)
    total = np.bincount(row[inside], (squared * area)[inside], count)
    allowed = target.error**2 * np.bincount(row[inside], area[inside], count)
    judged = np.bincount(row[inside], minlength=count) >= FEWEST
    return np.where(judged & (total > allowed), total / np.maximum(outline.cost(level), 1), 0.0)


def _asked(grid: Grid, level: int, state: Refined, judge: Judge) -> np.ndarray:
    """Missing voxels in front of receivers that hardly any data point lights: a thin surface has two sides, and the
    data point of its voxel is on one of them."""
    at, size = state.seen.at, float(grid.voxel_size(level))
    weak = interpolate.weigh(state.data, at.position, at.normal)[1].sum(axis=1) < WEAK
    bright, typical = _brightness(state.seen, judge)
    chosen = np.flatnonzero(weak & (bright > DARK * typical) & _voxels_of(grid, state.tree, level)(at.position))
    base = np.floor(at.position[chosen] / size - 0.5).astype(np.int64)
    corner = (base[:, None] + CORNERS).reshape(-1, 3)
    arm = (corner + 0.5) * size - np.repeat(at.position[chosen], 8, axis=0)
    front = (arm * np.repeat(at.normal[chosen], 8, axis=0)).sum(axis=1) > FRONT * size
    corner = np.unique(corner[front], axis=0)
    return corner[Atlas([state.tree]).find(level, corner) < 0]


def _brightness(seen: Seen, judge: Judge) -> tuple[np.ndarray, float]:
    """Luminance at each receiver, and its mean over the area."""
    bright = _looked_at(seen.light.mean(axis=0), judge.mean)
    return bright, float((bright * seen.at.area).sum() / max(float(seen.at.area.sum()), 1e-30))
