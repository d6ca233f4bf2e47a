"""Decides where a world cell's tree is subdivided: where what surfaces see differs from what the data say.

Comes in: what the tree could be, a target error. Goes out: the tree, its data points, and receivers with their light.
Level by level receivers show how wrong surfaces are lit. Voxels whose mean relative error is above the target are
subdivided, those first where a data point buys most, until the cap on data points binds. Sides of thin surfaces that
no data point lights get voxels in front of them, and in cracks the voxel's own data point moves there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ..tree import build, interpolate
from ..tree.blend import ENOUGH
from ..tree.dualcells import CORNERS
from ..tree.lookup import Atlas
from ..tree.outline import Outline
from ..tree.region import finder
from ..tree.topology import Topology
from . import cracks, hidden, occluders, parallel, receivers
from .deadline import Pace
from .gather import Effort
from .hidden import Hidden
from .lamps import LUMINANCE
from .measured import Measured, Sampling, functions, measure, move, moved_light
from .memory import Look, Moved
from .receivers import Receivers
from .scene import Scene
from .survey import Judge, Seen, State, confidence, squared_errors, trace, trace_closer

FEWEST = 2
"""Receivers without which a voxel is not judged."""

WEAK = 0.1
"""Confidence below which a receiver is hardly lit; one data point straight before a wall gives up to a half."""

CLEAR = 0.2
"""Relative error of a single receiver that is worth a data point of its own."""

SURE = 2.0
"""Standard deviations of noise that an error must exceed to count."""

FRONT = 0.05
"""Height above the surface at which a voxel's centre is in front of it [voxels]."""

NOISE = 0.35
"""Noise of a data point to aim at, as a part of the target error. It is estimated as if paths were spread by chance; as
they are not, it is about a quarter then, which adds a thirtieth to the error."""

GEOMETRY = 1e30
"""Need of first-level voxels with varied geometry: they come before everything that light asks for."""

FINER = 1e-6
"""What that need is multiplied with on each finer level."""


@dataclass(frozen=True)
class Target:
    """What a cell is to reach.

    error : relative error of irradiance on surfaces, root mean square over a voxel, above which it is subdivided; 0
        subdivides wherever geometry is not flat
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


def refine(
    scene: Scene,
    outline: Outline,
    judge: Judge,
    target: Target,
    progress: Callable[[float], bool] | None = None,
) -> State:
    """Grow the tree of a cell until its surfaces see what they should.

    Parameters
    ----------
    scene : Scene
        What light travels through.
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
    State
        The same for any number of threads.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Source: row 6 of the talk subdivides where there is geometry; by error as Unreal's and Activision's volumes do.
    """
    return Refinement(scene, outline, judge, target, progress).run()


def sketch(scene: Scene, outline: Outline, judge: Judge, target: Target) -> State:
    """Grow the tree of a cell by geometry alone, and look at it once.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    outline : Outline
        What the tree could be.
    judge : Judge
        Not used for decisions here.
    target : Target
        Its error is 0.

    Returns
    -------
    State
        The same for any number of threads.
    """
    made = Refinement(scene, outline, judge, target, None)
    made._grow()
    made._look(len(outline.coords) - 1)
    return made.state


class Refinement:
    """One cell on its way: what has been decided, by level, and what has been measured.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    outline : Outline
        What the tree could be.
    judge : Judge
        What the error is measured in.
    target : Target
        When to stop.
    progress : callable or None
        As in `refine`.

    Attributes
    ----------
    looks : list of Look
        Receivers of each level, those that finer ones have replaced too.
    fresh : list of (n,) bool ndarray
        Which receivers of each look were not known before.
    current : (n,) int64 ndarray
        Rows of all looks that the state has.
    unmoved : Measured
        Data points before some were moved into cracks.
    moved : Moved
        Those.
    hidden : Hidden or None
        Planes before the last revision.
    pace : Pace or None
        Limits data points, so that the cell is done in time.
    cut : bool
        Whether time has been too short for what is needed.
    """

    def __init__(self, scene: Scene, outline: Outline, judge: Judge, target: Target, progress):
        self.scene, self.outline, self.judge, self.target = scene, outline, judge, target
        self.grid, self.progress, self.stage = outline.grid, progress, 0
        self.need = [np.zeros(len(mask)) for mask in outline.wanted]
        for level in range(len(self.need) if target.error == 0 else min(1, len(self.need))):
            first = GEOMETRY * FINER**level * (1.0 + outline.need[level])
            self.need[level] = np.where(outline.need[level] > 0, first, 0.0)
        self.asked = [np.zeros((0, 3), np.int64)] * self.grid.levels
        self.looks: list[Look] = []
        self.fresh: list[np.ndarray] = []
        self.current = np.zeros(0, np.int64)
        self.state: State | None = None
        self.judged: tuple | None = None
        self.unmoved: Measured | None = None
        self.moved: Moved | None = None
        self.hidden: Hidden | None = None
        self.pace: Pace | None = None
        self.cut = False

    def run(self) -> State:
        """Go level by level, coarse to fine.

        Returns
        -------
        State
            As `refine` returns it.
        """
        for level in range(self.grid.levels):
            self._grow()
            self._look(level)
            self._ask([level])
            if level == self.grid.levels - 1:
                break
            if self.target.error:
                self.need[level] = np.maximum(self.need[level], self._wanting(level))
            if not (self.need[level] > 0).any():
                break
        if self.target.error and self.grid.levels > 1:
            self._hide_midway()
            self._revise()
        self.unmoved = self.state.measured
        self._take_moved(self._fill_cracks())
        self._hide_finally()
        return self.state

    def _revise(self) -> None:
        """Subdivide coarse voxels that are poor now: finer neighbours, and the planes that will stay, change what they
        show."""
        before = Atlas([self.state.tree])
        for level in range(self.grid.levels - 1):
            self.need[level] = np.maximum(self.need[level], self._wanting(level))
        self._grow()
        of_level, coords = self.state.tree.voxels()
        for level in range(self.grid.levels):
            own = coords[of_level == level]
            self._look_in(level, own[before.find(level, own) < 0])
        self._hide(self.state.seen.at)
        self._ask(range(len(self.looks)))

    def _ask(self, levels: Iterable[int]) -> None:
        """Add voxels that are missing in front of receivers."""
        found = [(level, self._unlit(level)) for level in levels]
        for level, coords in found:
            self.asked[level] = np.unique(np.concatenate([self.asked[level], coords]), axis=0)
        if any(len(coords) for _, coords in found):
            self._grow()
            self._hide(self.state.seen.at)

    def _grow(self) -> None:
        """The tree of what is needed so far, measured."""
        target = self.target
        cap = self._cap()
        tree = build.fit(self.outline, self.need, target.dilation, cap, self.asked)
        self.cut |= cap < target.max_points and tree.left_out > self.outline.left_out
        sampling = Sampling(target.effort, self.judge.views * LUMINANCE, NOISE * target.error)
        measured = measure(self.scene, self.grid, tree, sampling, self._known(), self._show())
        self.state = self._with(tree, measured)
        if self.pace:
            self.pace.grown(tree.size)

    def _with(self, tree: Topology, measured: Measured) -> State:
        """The state with other data points, without planes."""
        data = interpolate.join(self.grid, [tree], measured.offset, measured.valid)
        return State(tree, measured, data, self.state and self.state.seen)

    def _cap(self) -> int:
        """Most data points that there may be, and that there is time for."""
        affordable = self.pace and self.pace.affordable()
        return self.target.max_points if affordable is None else min(affordable, self.target.max_points)

    def _known(self) -> Measured | None:
        """Data points that need not be measured any more."""
        return self.state and self.state.measured

    def _look(self, level: int) -> None:
        """Receivers for every level up to one; those of voxels that were subdivided are replaced by denser ones."""
        of_level, coords = self.state.tree.voxels()
        self._look_in(level, coords[of_level == level])
        self._hide(self.state.seen.at)
        if self.target.error and level < self.grid.levels - 1:
            self._look_closer(level)

    def _look_closer(self, level: int) -> None:
        """More paths for new receivers in voxels of a level that may be too wrong, but not beyond doubt."""
        first = sum(len(look.seen.at.key) for look in self.looks[:level])
        own = self.current - first
        own = np.where((own >= 0) & (own < len(self.fresh[level])), own, -1)
        voxel, squared, allowed, sure = self._judged(level)
        doubtful = (squared > allowed) & (squared <= sure) & np.isfinite(sure)
        rows = np.flatnonzero((voxel >= 0) & (own >= 0))
        rows = rows[doubtful[voxel[rows]] & self.fresh[level][own[rows]]]
        if not len(rows):
            return
        seen, looked = self.state.seen, self.looks[level]
        light, kept, closer = seen.light.copy(), looked.seen.light.copy(), looked.closer.copy()
        effort = dataclasses.replace(self.target.effort, samples=self.target.samples)
        light[:, rows] = trace_closer(self.scene, seen.take(rows), effort)
        kept[:, own[rows]], closer[own[rows]] = light[:, rows], True
        self.looks[level] = Look(looked.coords, Seen(looked.seen.at, kept), closer)
        self.state = dataclasses.replace(self.state, seen=Seen(seen.at, light))

    def _look_in(self, level: int, coords: np.ndarray) -> None:
        """Receivers in voxels of a level that have none of that level yet."""
        while len(self.looks) <= level:
            self.looks.append(Look(coords[:0], Seen.none(functions(self.scene)), np.zeros(0, bool)))
            self.fresh.append(np.zeros(0, bool))
        (found, known), old = self._found(level, coords), self.looks[level]
        fresh = np.arange(len(found.at.key)) >= len(known)
        self.fresh[level] = np.append(self.fresh[level], fresh)
        end = sum(len(look.seen.at.key) for look in self.looks[: level + 1])
        closer = np.concatenate([old.closer, known, np.zeros(fresh.sum(), bool)])
        self.looks[level] = Look(np.concatenate([old.coords, coords]), old.seen.plus(found), closer)
        new, current = np.arange(len(found.at.key)), self.current
        current = np.where(current >= end, current + len(new), current)
        seen = found if self.state.seen is None else self.state.seen
        if self.state.seen is not None:
            kept = ~receivers.among(coords)(self.grid.voxels_at(level, seen.at.position))
            seen, current = seen.take(kept).plus(found), current[kept]
        self.state, self.current = dataclasses.replace(self.state, seen=seen), np.concatenate([current, end + new])

    def _found(self, level: int, coords: np.ndarray) -> tuple[Seen, np.ndarray]:
        """Receivers on all surfaces in voxels of a level, with their light, and of those that were known before, which
        come first, whether they have been looked at closer."""
        return self._seen_in(level, coords), np.zeros(0, bool)

    def _seen_in(self, level: int, coords: np.ndarray) -> Seen:
        """Receivers in some of the tree's voxels of a level, traced."""
        size, effort = float(self.grid.voxel_size(level)), self.target.effort
        low, high = (coords.min(axis=0) * size, (coords.max(axis=0) + 1) * size) if len(coords) else np.zeros((2, 3))
        spacing, has = receivers.spacing(level, size), receivers.among(coords)
        near = receivers.touching(coords, size)

        def inside(position: np.ndarray) -> np.ndarray:
            return has(self.grid.voxels_at(level, position))

        at = receivers.spread(self.scene, low, high, spacing, inside, effort.threads, touches=near)
        return trace(self.scene, at, dataclasses.replace(effort, samples=self.target.samples), self._show())

    def _near(self, at: Receivers) -> np.ndarray:
        """Rows of the receivers that decisions of this level depend on."""
        return np.arange(len(at.key))

    def _hide(self, at: Receivers) -> None:
        """Planes for all data points, as receivers with light see them, which are there anyway."""
        parallel.check()
        found = occluders.fit(self.scene, self.state.data, at.take(self._near(at)), self.target.effort.threads)
        self._set_planes(found.planes, found.plane)

    def _hide_midway(self) -> None:
        """Planes for all data points, as dense receivers on all surfaces see them that the cell may light, those of
        other cells too."""
        parallel.check()
        self.hidden = hidden.everywhere(self.scene, self.state, self.target.effort.threads)
        self._set_planes(self.hidden.planes, self.hidden.plane)

    def _hide_finally(self) -> None:
        """The same for what has changed since."""
        if self.hidden is None:
            self._hide_midway()
        parallel.check()
        none = np.zeros(self.state.tree.size, bool)
        found = hidden.since(self.scene, self.state, self.hidden, none, self.target.effort.threads)
        self._set_planes(found.planes, found.plane)

    def _set_planes(self, planes: np.ndarray, plane: np.ndarray) -> None:
        """Give the data points their planes."""
        self.state = dataclasses.replace(
            self.state, data=dataclasses.replace(self.state.data, planes=planes, plane=plane)
        )

    def _errors(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) relative squared errors at the receivers, and (n,) what part of that may be noise, 0 where no decision
        depends on it; once for each state, as they take a fit."""
        if self.judged is None or self.judged[0] is not self.state:
            rows = self._near(self.state.seen.at)
            state = dataclasses.replace(self.state, seen=self.state.seen.take(rows))
            found = np.zeros((2, len(self.state.seen.at.key)), np.float32)
            found[:, rows] = squared_errors(state, self.judge, self.target.effort.threads)
            self.judged = self.state, found
        return self.judged[1]

    def _judged(self, level: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(receivers,) row among the solid voxels of a level that each lies in, -1 for none; and of these voxels the
        squared error over the area, what of it is allowed, and what is too much beyond doubt, infinite for those of too
        few receivers."""
        coords, at = self.outline.coords[level], self.state.seen.at
        voxel = finder(coords)(self.grid.voxels_at(level, at.position))
        inside, count = np.flatnonzero(voxel >= 0), len(coords)
        row, area = voxel[inside], at.area[inside]
        squared, noise = (np.bincount(row, values[inside] * area, count) for values in self._errors())
        number = np.bincount(row, minlength=count)
        allowed = self.target.error**2 * np.bincount(row, area, count)
        sure = allowed + SURE * noise * np.sqrt(2 / np.maximum(number, 1))
        return voxel, squared, allowed, np.where(number >= FEWEST, sure, np.inf)

    def _wanting(self, level: int) -> np.ndarray:
        """What subdivision of each solid voxel of a level buys for each data point; 0 where it is good enough."""
        _, squared, _, sure = self._judged(level)
        return np.where(squared > sure, squared / np.maximum(self.outline.cost(level), 1), 0.0)

    def _unlit(self, level: int) -> np.ndarray:
        """(m, 3) missing voxels in front of receivers that hardly any data point lights, and that are wrong for it:
        a thin surface has two sides, and the data point of its voxel is on one of them."""
        at, tree, size = self.state.seen.at, self.state.tree, float(self.grid.voxel_size(level))
        atlas = Atlas([tree])
        chosen = (atlas.find(level, self.grid.voxels_at(level, at.position)) >= 0) & (confidence(self.state) < WEAK)
        chosen &= self._wrong()
        position, normal = at.position[chosen], at.normal[chosen]
        corner = np.floor(position / size - 0.5).astype(np.int64)[:, None] + CORNERS
        height = np.einsum("nci,ni->nc", (corner + 0.5) * size - position[:, None], normal)
        corner = np.unique(corner[height > FRONT * size], axis=0)
        return corner[atlas.find(level, corner) < 0]

    def _wrong(self) -> np.ndarray:
        """(n,) receivers whose error is too large to be noise."""
        squared, noise = self._errors()
        return squared > max(self.target.error, CLEAR) ** 2 + SURE**2 * noise

    def _fill_cracks(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of data points that move to where receivers have none, and their offsets."""
        unlit = np.flatnonzero((confidence(self.state) < ENOUGH) & self._wrong())
        return cracks.find(self.scene, self.state, unlit)

    def _take_moved(self, chosen: tuple[np.ndarray, np.ndarray]) -> None:
        """Measure some data points elsewhere."""
        row, offset = chosen
        light = self._light_of_moved(row, offset)
        self.moved = Moved(row, offset, light)
        if len(row):
            self.state = self._with(self.state.tree, move(self.unmoved, row, offset, light))

    def _light_of_moved(self, row: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """(m, functions, 9, 3) what data points measure elsewhere in their voxels."""
        return moved_light(self.scene, self.grid, self.unmoved, row, offset, self.target.effort)

    def _show(self) -> Callable[[float], bool] | None:
        """What the next stage is to call with the part of it that is done; each level has up to three, the revision one
        for each level and two."""
        parallel.check()
        show, stage, levels = self.progress, self.stage, self.grid.levels
        count = 4 * levels + 2
        self.stage += 1
        return None if show is None else lambda share: show((stage + share) / count)
