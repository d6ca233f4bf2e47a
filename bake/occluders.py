"""Occluders: up to three planes for each data point, behind which it lights nothing.

Comes in: a scene, data points, receivers. Goes out: rows of a table of planes. The planes are those of the triangles
that block shadow rays; a greedy choice hides the most of what the data point must not light and the least of what it
must, and then no receiver is left without light. With s the height of a point above the plane, the factor is
clamp(1 + s / width, 0, 1): continuous, 1 before the wall and a little into it, 0 before the wall's other side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree import interpolate
from . import blockers
from .blockers import Planes
from .gather import run_tiles
from .receivers import Receivers
from .scene import Scene
from .sight import Pairs, look

SLOTS = 3
"""Planes of a data point."""

TURNS = 2 * SLOTS
"""Each slot is filled, then filled again knowing the others."""

LOSS = 0.7
"""What a unit of visible weight counts against one of invisible weight: it can be made up for by other data points."""

WORTH = 2e-3
"""Part of a data point's weight that a plane must gain: less is not worth the bytes, and too few receivers say so."""

CONFIDENT = 0.02
"""Weight that a receiver's value wants; below it, coarser levels fill in (tree/interpolate.py)."""

FAINT = CONFIDENT / 10
"""A receiver that sees less weight than this is lit by coarser levels alone."""

WIDEST = 1 / 8
"""Greatest width [finest voxels]; each next one is a quarter of it."""

NARROWEST = 2.0**-20
"""Least width [cell sizes]: 0.12 mm in cells of 128 m, where heights are known to 0.01 mm."""

DEEPEST = 1 / 512
"""How far a plane may be moved into the wall [finest voxels]: 1 mm at 0.5 m, for the sake of depth buffers."""

WIDER = 0.98
"""A wider plane is taken when it gains at least this part of the best one's gain."""

BOOSTS = 4
"""Times that receivers without light raise the weight of their best data point."""

BOOST = 8.0
"""How much they raise it."""

CHUNK = 1 << 21
"""Pairs times candidates held at a time: about 100 MB."""


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
        As in `gather.run_tiles`, counting receivers whose rays are traced.

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
    return choose(scene, data, receivers, pairs, threads)


def choose(
    scene: Scene, data: interpolate.DataPoints, receivers: Receivers, pairs: Pairs, threads: int = 0
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

    Returns
    -------
    Occluders
        As from `fit`.
    """
    task = _Task(scene, data, receivers, pairs)
    slots = task.solve(threads)
    boost = np.ones(len(pairs.point))
    for _ in range(BOOSTS):
        lost = task.best_of_lost(slots)
        if not len(lost):
            break
        boost[lost] *= BOOST
        task.solve(threads, slots, boost, np.unique(pairs.point[lost]))
    task.free(slots)
    return task.result(slots)


@dataclass(frozen=True)
class _Slots:
    """Chosen planes of all data points: (n, SLOTS) row of the planes or -1, side, exponent of the width."""

    plane: np.ndarray
    side: np.ndarray
    code: np.ndarray


class _Task:
    """Everything that the choice reads: pairs and their worth, candidates, widths."""

    def __init__(self, scene: Scene, data: interpolate.DataPoints, receivers: Receivers, pairs: Pairs) -> None:
        self.pairs, self.place = pairs, receivers.position
        self.weight, self.visible = pairs.weight.astype(np.float64), pairs.visible
        self.receivers, self.points = len(receivers.key), len(data.valid)
        finest = float(data.grid.voxel_size(data.grid.levels - 1))
        self.value = self._values(receivers.area.astype(np.float64))
        position = data.position
        self.planes, self.candidates = blockers.find(scene, pairs, np.abs(self.value), position, finest)
        steps = np.arange(1 + int(np.log2(WIDEST * finest / (NARROWEST * data.grid.cell_size)) // 2))
        self.width = WIDEST * finest * 4.0**-steps
        self.moved = np.minimum(self.width / 2, DEEPEST * finest)
        self.first = np.searchsorted(pairs.point, np.arange(self.points + 1))
        self.first_candidate = np.searchsorted(self.candidates.point, np.arange(self.points + 1))

    def _values(self, area: np.ndarray) -> np.ndarray:
        """(m,) what hiding each pair gains: its part of the receiver's weight, negative where it is visible."""
        total = np.bincount(self.pairs.receiver, self.weight, self.receivers)
        part = self.weight * (area / np.maximum(total, CONFIDENT))[self.pairs.receiver]
        return np.where(self.visible, -LOSS * part, part)

    def solve(self, threads: int, slots: _Slots | None = None, boost=None, points: np.ndarray | None = None) -> _Slots:
        """Choose planes for some data points, or for all that have candidates; the others keep theirs."""
        if slots is None:
            empty = np.full((self.points, SLOTS), -1)
            slots = _Slots(empty, np.ones(empty.shape), np.zeros(empty.shape, np.int64))
        candidates, pairs = np.diff(self.first_candidate), np.diff(self.first)
        points = np.flatnonzero(candidates) if points is None else points
        value = self.value if boost is None else self.value * boost
        tile = np.cumsum(candidates[points] * pairs[points]) // CHUNK
        tiles = np.split(points, np.flatnonzero(np.diff(tile)) + 1) if len(points) else []
        run_tiles(lambda rows: self._solve(rows, value, slots), tiles, threads)
        return slots

    def _solve(self, points: np.ndarray, value: np.ndarray, slots: _Slots) -> int:
        """The greedy choice for a tile of data points."""
        trial = _Trial(self, points, value)
        for turn in range(TURNS):
            trial.fill(turn % SLOTS)
        for slot in range(SLOTS):
            code, kept = trial.widen(slot)
            chosen = trial.chosen[:, slot]
            slots.plane[points, slot] = np.where(kept, trial.candidates.plane[chosen], -1)
            slots.side[points, slot] = trial.candidates.side[chosen]
            slots.code[points, slot] = code
        return len(points)

    def factors(self, slots: _Slots, rows: np.ndarray) -> np.ndarray:
        """(k, SLOTS) what the planes leave of some pairs."""
        point, place = self.pairs.point[rows], self.place[self.pairs.receiver[rows]]
        out = np.ones((len(rows), SLOTS))
        for slot in range(SLOTS):
            has = np.flatnonzero(slots.plane[point, slot] >= 0)
            plane, side = slots.plane[point[has], slot], slots.side[point[has], slot]
            height = side * _heights(self.planes, plane, place[has])
            out[has, slot] = self.falloff(height, slots.code[point[has], slot])
        return out

    def falloff(self, height: np.ndarray, code: np.ndarray | int) -> np.ndarray:
        """The factor of a height above a plane."""
        return np.clip(1 + (height + self.moved[code]) / self.width[code], 0, 1)

    def best_of_lost(self, slots: _Slots) -> np.ndarray:
        """For each receiver whose visible data points are all hidden, the pair that would bring back the most."""
        rows = np.flatnonzero(self.visible & (slots.plane >= 0).any(axis=1)[self.pairs.point])
        hidden = np.zeros(len(self.weight))
        hidden[rows] = self.weight[rows] * (1 - self.factors(slots, rows).prod(axis=1))
        total = self.lit()
        left = total - np.bincount(self.pairs.receiver, hidden, self.receivers)
        lost = (left < np.minimum(total / 2, CONFIDENT)) & (total > FAINT)
        rows = rows[lost[self.pairs.receiver[rows]] & (hidden[rows] > 0)]
        order = rows[np.lexsort((rows, -hidden[rows], self.pairs.receiver[rows]))]
        return order[np.unique(self.pairs.receiver[order], return_index=True)[1]]

    def lit(self) -> np.ndarray:
        """(r,) weight of what each receiver sees."""
        return np.bincount(self.pairs.receiver, self.weight * self.visible, self.receivers)

    def free(self, slots: _Slots) -> None:
        """Drop the plane that hides the most of those pairs, until no receiver is without light."""
        while len(lost := self.best_of_lost(slots)):
            slot = self.factors(slots, lost).argmin(axis=1)
            slots.plane[self.pairs.point[lost], slot] = -1

    def result(self, slots: _Slots) -> Occluders:
        """The table of distinct planes, and what is left of the weights."""
        used = slots.plane >= 0
        key = np.stack([slots.plane[used], slots.side[used] > 0, slots.code[used]], axis=1).astype(np.int64)
        distinct, row = np.unique(key, axis=0, return_inverse=True)
        planes = np.full(used.shape, -1, np.int32)
        planes[used] = row.reshape(-1)
        planes = np.take_along_axis(planes, np.argsort(~used, axis=1, kind="stable"), axis=1)
        side, code = 2.0 * distinct[:, 1] - 1, distinct[:, 2]
        normal = self.planes.normal[distinct[:, 0]] * side[:, None]
        distance = self.planes.distance[distinct[:, 0]] * side - self.moved[code]
        plane = np.concatenate([normal, distance[:, None], self.width[code][:, None]], axis=1)
        left = self.weight * self.factors(slots, np.arange(len(self.weight))).prod(axis=1)
        kept = [float(left[of].sum() / max(self.weight[of].sum(), 1e-30)) for of in (self.visible, ~self.visible)]
        return Occluders(planes, plane, self.lit() <= FAINT, *kept)


class _Trial:
    """Candidates of a tile of data points against all their pairs, and the choice so far.

    `candidate` and `pair` enumerate all combinations; `pair` counts within the tile. `hidden` is the number of
    chosen planes that hide each pair, `chosen` the candidate in each slot.
    """

    def __init__(self, task: _Task, points: np.ndarray, value: np.ndarray) -> None:
        self.task = task
        pairs, count = _ranges(task.first, points)
        rows, self.candidates_of = _ranges(task.first_candidate, points)
        self.candidates = task.candidates.take(rows)
        self.owner = np.repeat(np.arange(len(points)), self.candidates_of)
        start = (np.cumsum(count) - count)[self.owner]
        self.candidate = np.repeat(np.arange(len(rows)), count[self.owner])
        within = np.cumsum(count[self.owner]) - count[self.owner]
        self.pair = np.arange(len(self.candidate)) - (within - start)[self.candidate]
        self.value = value[pairs]
        place = task.place[task.pairs.receiver[pairs]][self.pair]
        height = _heights(task.planes, self.candidates.plane[self.candidate], place)
        self.height = height * self.candidates.side[self.candidate]
        self.out = self.height < -(task.moved[-1] + task.width[-1])
        self.hidden = np.zeros(len(pairs), np.int8)
        self.chosen = np.full((len(points), SLOTS), -1)
        self.least = WORTH * np.add.reduceat(np.abs(self.value), np.cumsum(count) - count)

    def fill(self, slot: int) -> None:
        """Choose the best candidate for a slot, given the others."""
        self.hidden[self.pair[self._of(slot) & self.out]] -= 1
        open_value = np.where(self.hidden == 0, self.value, 0.0)[self.pair]
        gain = np.bincount(self.candidate, open_value * self.out, len(self.owner))
        start = np.cumsum(self.candidates_of) - self.candidates_of
        best = np.maximum.reduceat(gain, start)
        row = np.where(gain == best[self.owner], np.arange(len(gain)), len(gain))
        self.chosen[:, slot] = np.where(best > self.least, np.minimum.reduceat(row, start), -1)
        self.hidden[self.pair[self._of(slot) & self.out]] += 1

    def widen(self, slot: int) -> tuple[np.ndarray, np.ndarray]:
        """The widest falloff of the slot's planes that costs next to nothing, and whether they are worth it."""
        rows = np.flatnonzero(self._of(slot))
        pair, owner = self.pair[rows], self.owner[self.candidate[rows]]
        alone = np.where(self.hidden[pair] == self.out[rows], self.value[pair], 0.0)
        codes = range(len(self.task.width))
        gains = [(1 - self.task.falloff(self.height[rows], code)) * alone for code in codes]
        gain = np.stack([np.bincount(owner, part, len(self.chosen)) for part in gains])
        best = gain.max(axis=0)
        return (gain >= WIDER * best).argmax(axis=0), (self.chosen[:, slot] >= 0) & (best > self.least)

    def _of(self, slot: int) -> np.ndarray:
        """Combinations whose candidate is in the slot."""
        held = np.zeros(len(self.owner) + 1, bool)
        held[self.chosen[:, slot]] = True
        held[-1] = False
        return held[self.candidate]


def _heights(planes: Planes, plane: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(k,) heights of points above planes [m]."""
    normal = planes.normal[plane].T
    height = normal[0] * place[:, 0] + normal[1] * place[:, 1] + normal[2] * place[:, 2]
    return height - planes.distance[plane]


def _ranges(first: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers from first[row] to first[row + 1] of each row, and how many."""
    count = first[rows + 1] - first[rows]
    return np.repeat(first[rows] - np.cumsum(count) + count, count) + np.arange(count.sum()), count
