"""Occluders: up to three planes for each data point, behind which it lights nothing.

Comes in: a scene, data points, receivers. Goes out: rows of a table of planes. They hide the most of what the data
point must not light and the least of what it must, and leave no receiver without light that sees some. With s the
height of a point above the plane, the factor is clamp(1 + s / width, 0, 1): continuous, 1 before the wall and a little
into it, 0 before the wall's other side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree import interpolate
from ..tree.blend import ENOUGH
from . import blockers
from .halfspaces import SLOTS, Falloff, Trial, heights, ranges
from .parallel import run_tiles
from .receivers import Receivers
from .scene import Scene
from .sight import Pairs, look

LOSS = 0.1
"""What a unit of visible weight counts against one of invisible weight: it can be made up for by other data points."""

FAINT = ENOUGH / 10
"""A receiver that sees less weight than this is lit by coarser levels alone."""

WIDEST = 1 / 8
"""Greatest width [finest voxels]; each next one is a quarter of it."""

NARROWEST = 2.0**-20
"""Least width [cell sizes]: 0.12 mm in cells of 128 m, where heights are known to 0.01 mm."""

DEEPEST = 1 / 512
"""How far a plane may be moved into the wall [finest voxels]: 1 mm at 0.5 m, for the sake of depth buffers."""

BOOSTS = 4
"""Times that receivers without light raise the weight of their best data point."""

BOOST = 8.0
"""How much they raise it."""

CHUNK = 1 << 21
"""Pairs times candidates held at a time: about 100 MB."""

PASSED = 1 << 19
"""Pairs whose planes are evaluated at a time: about 60 MB."""


@dataclass(frozen=True)
class Occluders:
    """What hides what from the data points.

    planes : (n, 3) int32, rows of `plane`, -1 for none
    plane : (m, 5) float64, unit normal, distance and width [m], relative to the scene's origin; distinct rows
    unseen : (r,) bool, receivers that see none of their data points
    visible_kept : float, part that is left of the weight of data points that receivers see
    invisible_kept : float, the same for those that they don't see
    """

    planes: np.ndarray
    plane: np.ndarray
    unseen: np.ndarray
    visible_kept: float
    invisible_kept: float


def fit(
    scene: Scene,
    data: interpolate.DataPoints,
    receivers: Receivers,
    threads: int = 0,
    progress: Callable[[int], bool] | None = None,
    only: np.ndarray | None = None,
) -> Occluders:
    """Fit planes to what receivers see.

    Parameters
    ----------
    scene : Scene
        What stands in the way.
    data : DataPoints
        Data points.
    receivers : Receivers
        Where the planes are judged; several for each data point.
    threads : int
        Worker threads; 0 uses every core.
    progress : callable, optional
        As in `parallel.run_tiles`, counting receivers whose rays are traced.
    only : (n,) bool ndarray, optional
        Data points that need planes; all of them when left out.

    Returns
    -------
    Occluders
        The same for any number of threads.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Error: planes know nothing of receivers that are not given; on others the shares kept differ by about 0.01.
    Source: half-spaces as the conservative visibility of a sample are ours; row 10 of the talk has the cosine alone.
    """
    pairs = look(scene, data, receivers, threads, progress)
    return choose(scene, data, receivers, pairs, threads, only)


def choose(
    scene: Scene,
    data: interpolate.DataPoints,
    receivers: Receivers,
    pairs: Pairs,
    threads: int = 0,
    only: np.ndarray | None = None,
) -> Occluders:
    """Fit planes to pairs that are known.

    Parameters
    ----------
    scene : Scene
        The triangles.
    data : DataPoints
        Data points.
    receivers : Receivers
        Where the planes are judged.
    pairs : Pairs
        From `sight.look`.
    threads : int
        Worker threads; 0 uses every core.
    only : (n,) bool ndarray, optional
        As in `fit`.

    Returns
    -------
    Occluders
        As from `fit`.
    """
    task = _Task(scene, data, receivers, pairs, only)
    return task.result(task.solve(threads))


@dataclass(frozen=True)
class _Slots:
    """Chosen planes of all data points: (n, SLOTS, 4) normal and distance, (n, SLOTS) width, -1 for no plane."""

    plane: np.ndarray
    code: np.ndarray


class _Task:
    """Everything that the choice reads: pairs and their worth, candidates, widths."""

    def __init__(
        self, scene: Scene, data: interpolate.DataPoints, receivers: Receivers, pairs: Pairs, only: np.ndarray | None
    ) -> None:
        self.data, self.place = data, receivers.position
        let = 1.0 if only is None else np.where(only[pairs.point], 1.0, _let_through(data, pairs, self.place))
        self.lit = np.bincount(pairs.receiver, pairs.weight * pairs.visible * let, len(self.place))
        self.own = _within(data.boxes, self.place)
        chosen = slice(None) if only is None else only[pairs.point]
        self.value = _values(pairs, receivers.area.astype(np.float64))[chosen]
        self.pairs = pairs = pairs.take(chosen)
        self.weight, self.visible = pairs.weight, pairs.visible
        finest = float(data.grid.voxel_size(data.grid.levels - 1))
        self.candidates = blockers.find(scene, pairs, np.abs(self.value), data.position, finest)
        self.falloff = _falloff(finest, data.grid.cell_size)
        self.first = np.searchsorted(pairs.point, np.arange(len(data.valid) + 1))
        self.first_candidate = np.searchsorted(self.candidates.point, np.arange(len(data.valid) + 1))

    def solve(self, threads: int) -> _Slots:
        """Choose planes for all data points, then again for those that left receivers without light."""
        shape = (len(self.data.valid), SLOTS)
        slots = _Slots(np.zeros((*shape, 4)), np.full(shape, -1))
        self._solve_all(np.unique(self.pairs.point[~self.visible]), self.value, slots, threads)
        value = self.value.copy()
        for _ in range(BOOSTS):
            lost = self._best_of_lost(slots)
            value[lost] *= BOOST
            self._solve_all(np.unique(self.pairs.point[lost]), value, slots, threads)
        self._free(slots)
        return slots

    def _solve_all(self, points: np.ndarray, value: np.ndarray, slots: _Slots, threads: int) -> None:
        """Choose planes for some data points, tile by tile."""
        pairs, candidates = np.diff(self.first)[points], np.diff(self.first_candidate)[points]
        tile = np.cumsum(pairs * (candidates + 1)) // CHUNK
        tiles = np.split(points, np.flatnonzero(np.diff(tile)) + 1) if len(points) else []
        run_tiles(lambda rows: self._solve_tile(rows, value, slots), tiles, threads)

    def _solve_tile(self, points: np.ndarray, value: np.ndarray, slots: _Slots) -> int:
        """Choose planes for the data points of a tile."""
        pairs, count = ranges(self.first, points)
        rows, candidates = ranges(self.first_candidate, points)
        owner, part = np.repeat(np.arange(len(points)), count), self.pairs.take(pairs)
        own = self.data.position[points], self.data.size[points], owner
        trial = Trial(*own, self.place[part.receiver], part.reach, value[pairs], self.falloff)
        trial.choose(blockers.Candidates(np.repeat(np.arange(len(points)), candidates), self.candidates.plane[rows]))
        trial.separate()
        trial.widen()
        slots.plane[points], slots.code[points] = trial.plane.transpose(1, 0, 2), trial.code.T
        return len(points)

    def factors(self, slots: _Slots, rows: np.ndarray) -> np.ndarray:
        """(k, SLOTS) what the planes leave of some pairs."""
        point, receiver = self.pairs.point[rows], self.pairs.receiver[rows]
        out = np.ones((len(rows), SLOTS))
        for slot in range(SLOTS):
            has = np.flatnonzero(slots.code[point, slot] >= 0)
            height = heights(slots.plane[:, slot], self.place, point[has], receiver[has])
            out[has, slot] = self.falloff.factor(height, slots.code[point[has], slot])
        return out

    def passed(self, slots: _Slots, rows: np.ndarray) -> np.ndarray:
        """(k,) what all planes together leave of some pairs, a part of them at a time."""
        parts = np.split(rows, range(PASSED, len(rows), PASSED))
        return np.concatenate([self.factors(slots, part).prod(axis=1) for part in parts])

    def _best_of_lost(self, slots: _Slots) -> np.ndarray:
        """For each receiver whose visible data points are all but hidden, the pair that would bring back the most.

        Receivers in other cells have data points there that are not known here.
        """
        rows = np.flatnonzero(self.visible & (slots.code >= 0).any(axis=1)[self.pairs.point])
        hidden, gone = np.zeros(len(self.weight)), 1 - self.passed(slots, rows)
        gone *= self.weight[rows]
        hidden[rows] = gone
        left = self.lit - np.bincount(self.pairs.receiver, hidden, len(self.place))
        lost = (left < np.minimum(self.lit / 2, ENOUGH)) & (self.lit > FAINT) & self.own
        rows = rows[lost[self.pairs.receiver[rows]] & (hidden[rows] > 0)]
        order = rows[np.lexsort((rows, -hidden[rows], self.pairs.receiver[rows]))]
        return order[np.unique(self.pairs.receiver[order], return_index=True)[1]]

    def _free(self, slots: _Slots) -> None:
        """Drop the plane that hides the most of those pairs, until no receiver is without light."""
        while len(lost := self._best_of_lost(slots)):
            slots.code[self.pairs.point[lost], self.factors(slots, lost).argmin(axis=1)] = -1

    def result(self, slots: _Slots) -> Occluders:
        """The table of distinct planes, and what is left of the weights."""
        used = slots.code >= 0
        code = slots.code[used]
        table = np.concatenate([slots.plane[used], self.falloff.width[code][:, None]], axis=1)
        table[:, 3] -= self.falloff.moved[code]
        table, row = np.unique(table, axis=0, return_inverse=True)
        planes = np.full(used.shape, -1, np.int32)
        planes[used] = row.reshape(-1)
        planes = np.take_along_axis(planes, np.argsort(~used, axis=1, kind="stable"), axis=1)
        left = self.weight * self.passed(slots, np.arange(len(self.weight)))
        whole = self.weight.astype(np.float64)
        kept = [float(left[of].sum() / max(whole[of].sum(), 1e-30)) for of in (self.visible, ~self.visible)]
        return Occluders(planes, table, self.lit <= FAINT, *kept)


def _values(pairs: Pairs, area: np.ndarray) -> np.ndarray:
    """(m,) what hiding each pair gains: its part of the receiver's weight, negative where it is visible."""
    total = np.bincount(pairs.receiver, pairs.weight, len(area))
    part = (area / np.maximum(total, ENOUGH))[pairs.receiver]
    part *= pairs.weight
    part[pairs.visible] *= -LOSS
    return part


def _let_through(data: interpolate.DataPoints, pairs: Pairs, place: np.ndarray) -> np.ndarray:
    """(m,) what the planes that data points have leave of pairs."""
    out = np.ones(len(pairs.point))
    for slot in range(data.planes.shape[1]):
        row = data.planes[pairs.point, slot]
        has = np.flatnonzero(row >= 0)
        plane = data.plane[row[has]]
        height = (plane[:, :3] * place[pairs.receiver[has]]).sum(axis=1) - plane[:, 3]
        out[has] *= np.clip(1 + height / plane[:, 4], 0, 1)
    return out


def _falloff(finest: float, cell: float) -> Falloff:
    """Widths from a part of a voxel down to what float32 can tell apart."""
    steps = np.arange(1 + max(0, int(np.log2(WIDEST * finest / (NARROWEST * cell)) // 2)))
    width = WIDEST * finest * 4.0**-steps
    return Falloff(width, np.minimum(width / 2, DEEPEST * finest))


def _within(boxes: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) whether points lie in the dense grid of any cell, or above or below it."""
    inside = (place[:, None, :2] >= boxes[:, 0, :2]) & (place[:, None, :2] < boxes[:, 1, :2])
    return inside.all(axis=2).any(axis=1)
