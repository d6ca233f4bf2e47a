"""Refines a cell with what is left of its last bake: decides and measures only where something has changed.

Comes in: as for `refine`, and a `Past`. Goes out: a state as `refine` has it. Level by level the tree is the one that
`refine` would have; but what is known is not measured again, decisions are taken over where light is much as it was,
and errors and planes are looked at only around the others.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..tree import interpolate
from ..tree.grid import Grid
from ..tree.lookup import Atlas
from ..tree.outline import Outline
from ..tree.region import finder
from . import changes, hidden, parallel, receivers
from .blocks import by_level
from .changes import Past
from .hidden import rows_in
from .measured import Measured, join, move, take
from .memory import Memory
from .receivers import Receivers
from .refine import Refinement, Target
from .scene import Scene
from .survey import Judge, Seen, State

__all__ = ["Again", "refreshed", "remember", "settled"]

RINGS = 2
"""How far around receivers that are decided on others are looked at: receivers that share a data point, twice."""

SHARE = 0.05
"""Part of a receiver's light that a data point has to bring for the two to count as connected."""


class Again(Refinement):
    """A cell that has been baked before.

    Parameters
    ----------
    scene, outline, judge, target, progress
        As in `Refinement`.
    past : Past
        What is left of that bake.
    """

    def __init__(self, scene: Scene, outline: Outline, judge: Judge, target: Target, progress, past: Past) -> None:
        super().__init__(scene, outline, judge, target, progress)
        self.past, self.memory = past, past.memory
        self.kept = take(past.memory.measured, past.known)
        self.looked = [receivers.among(look.coords) for look in past.memory.looks]

    def _known(self) -> Measured:
        """What is known from before, and what has been measured since."""
        if self.state is None:
            return self.kept
        new = Atlas([self.state.tree]).find(self.kept.level.astype(np.int64), self.kept.coords) < 0
        return join(take(self.kept, new), self.state.measured)

    def _found(self, level: int, coords: np.ndarray) -> tuple[Seen, np.ndarray]:
        """Those that are known; others in voxels that are new or have other surfaces."""
        known = self._is_looked(level, coords) & ~self.past.surfaces.touch(level, coords)
        seen = self._seen_in(level, coords[~known])
        if not known.any():
            return seen, np.zeros(0, bool)
        look, has = self.memory.looks[level], receivers.among(coords[known])
        rows = np.flatnonzero(has(self.grid.voxels_at(level, look.seen.at.position)))
        return look.seen.take(rows).plus(seen), look.closer[rows]

    def _is_looked(self, level: int, coords: np.ndarray) -> np.ndarray:
        """(n,) which voxels had receivers of their level."""
        return self.looked[level](coords) if level < len(self.looked) else np.zeros(len(coords), bool)

    def _open(self, level: int, coords: np.ndarray) -> np.ndarray:
        """(n,) which voxels are to be decided on: where something has changed, and those that are new."""
        new = (Atlas([self.state.tree]).find(level, coords) >= 0) & ~self._is_looked(level, coords)
        return self.past.decide.touch(level, coords) | new

    def _is_open(self, at: Receivers) -> np.ndarray:
        """(n,) which receivers lie in such voxels of the level that was looked at last."""
        level = len(self.looks) - 1
        return self._open(level, self.grid.voxels_at(level, at.position))

    def _near(self, at: Receivers) -> np.ndarray:
        """Receivers in voxels to be decided on, and those that share data points with them."""
        chosen = self._is_open(at)
        row, weight = interpolate.weigh(self.state.data, at.position, at.normal)
        counts = weight > SHARE * weight.sum(axis=1, keepdims=True)
        for _ in range(RINGS):
            lit = np.zeros(len(self.state.data.valid), bool)
            lit[row[chosen][counts[chosen]]] = True
            chosen = chosen | (lit[row] & counts).any(axis=1)
        return np.flatnonzero(chosen)

    def _wanting(self, level: int) -> np.ndarray:
        """As it was where nothing has changed."""
        coords = self.outline.coords[level]
        value, is_open = super()._wanting(level), self._open(level, coords)
        if level >= len(self.memory.need):
            return value
        old, need = self.memory.need[level]
        row = finder(old)(coords)
        return np.where(is_open, value, np.where(row >= 0, need[row] if len(need) else 0.0, 0.0))

    def _unlit(self, level: int) -> np.ndarray:
        """With those of before, where nothing has changed."""
        old = self.memory.asked[level] if level < len(self.memory.asked) else np.zeros((0, 3), np.int64)
        old = old[~self.past.decide.touch(level, old)]
        return np.unique(np.concatenate([old, super()._unlit(level)]), axis=0)

    def _wrong(self) -> np.ndarray:
        """Only where it is to be decided."""
        return super()._wrong() & self._is_open(self.state.seen.at)

    def _fill_cracks(self) -> tuple[np.ndarray, np.ndarray]:
        """With those that were moved before, where nothing has changed."""
        row, offset = super()._fill_cracks()
        old = self._rows_of_moved()
        kept = np.flatnonzero((old >= 0) & ~np.isin(old, row))
        return np.concatenate([row, old[kept]]), np.concatenate([offset, self.memory.moved.offset[kept]])

    def _light_of_moved(self, row: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """As it is known."""
        old, moved = self._rows_of_moved(), self.memory.moved
        place = np.full(self.state.tree.size, -1)
        place[old[old >= 0]] = np.flatnonzero(old >= 0)
        found = place[row]
        same = np.flatnonzero((found >= 0) & (moved.offset[found] == offset).all(axis=1)) if len(old) else found[:0]
        out = np.zeros((len(row), *self.unmoved.light.shape[1:]), np.float32)
        new = np.setdiff1d(np.arange(len(row)), same)
        out[same], out[new] = moved.light[found[same]], super()._light_of_moved(row[new], offset[new])
        return out

    def _rows_of_moved(self) -> np.ndarray:
        """(m,) rows in the tree of the voxels whose data points were moved before; -1 where it is to be decided."""
        some = take(self.memory.measured, self.memory.moved.row)
        row = Atlas([self.state.tree]).find(some.level.astype(np.int64), some.coords)
        return np.where(by_level(self.past.decide.touch, some), -1, row)

    def _hide_midway(self) -> None:
        """Planes of before where nothing is decided, with data points in cracks where they were; others anew."""
        parallel.check()
        there = self._in_cracks()
        new = by_level(self.past.decide.touch, there.measured) | self._beside_surfaces()
        old = hidden.of_memory(self.memory)
        self.hidden = hidden.since(self.scene, there, old, new, self.target.effort.threads)
        self._set_planes(self.hidden.planes, self.hidden.plane)

    def _in_cracks(self) -> State:
        """The state with those data points moved that are likely to move again."""
        row, moved, state = self._rows_of_moved(), self.memory.moved, self.state
        kept = np.flatnonzero(row >= 0)
        return self._with(state.tree, move(state.measured, row[kept], moved.offset[kept], moved.light[kept]))

    def _beside_surfaces(self) -> np.ndarray:
        """(points,) which data points have, or light, surfaces that have changed."""
        tree, measured = self.state.tree, self.state.measured
        new = by_level(self.past.surfaces.touch, measured)
        for blocks in (self.past.surfaces, self.past.beyond):
            new |= changes.lights(blocks, tree, measured)
        return new


def settled(past: Past, scene: Scene, grid: Grid, threads: int = 0) -> State:
    """Give a cell the light of today where its tree stays as it is.

    Parameters
    ----------
    past : Past
        Without anything to decide.
    scene : Scene
        As it is now.
    grid : Grid
        The lattice.
    threads : int
        As in `Effort`.

    Returns
    -------
    State
        As it was, with other light, and other planes before surfaces beyond its border that have changed.
    """
    memory = past.memory
    old = hidden.of_memory(memory)
    data = interpolate.join(grid, [memory.tree], old.measured.offset, old.measured.valid, memory.planes, memory.plane)
    seen = memory.looks[0].seen
    for look in memory.looks[1:]:
        seen = seen.plus(look.seen)
    state = State(memory.tree, old.measured, data, seen.take(memory.current))
    new = changes.lights(past.beyond, memory.tree, old.measured)
    if not new.any():
        return state
    found = hidden.since(scene, state, old, new, threads)
    return dataclasses.replace(state, data=dataclasses.replace(data, planes=found.planes, plane=found.plane))


def remember(made: Refinement, causes: dict[str, str], rules: str, past: Past | None) -> Memory:
    """Put together what the next bake may use.

    Parameters
    ----------
    made : Refinement
        A cell that has been refined.
    causes : dict of str to str
        From `changes.causes`.
    rules : str
        Digest of the settings.
    past : Past, optional
        What was known before.

    Returns
    -------
    Memory
        Without the digest of its files.
    """
    state, scene = made.state, made.scene
    paths = np.zeros(made.unmoved.light.shape, np.float32)
    row = np.full(state.tree.size, -1) if past is None else rows_in(state.tree, past.memory.tree)
    kept = (row >= 0) & (past.known[row] if past is not None else False)
    if past is not None:
        paths[kept] = past.pilot[row[kept]]
    new = take(made.unmoved, ~kept)
    paths[~kept] = changes.pilot(scene, made.grid, new, made.target.effort)
    current = np.zeros(sum(len(look.seen.at.key) for look in made.looks), bool)
    current[made.current] = True
    need = [
        (coords[value > 0], value[value > 0]) for coords, value in zip(made.outline.coords, made.need, strict=False)
    ]
    surfaces = changes.triangles_near(scene, made.grid, state.tree.cell)
    own = made.unmoved, made.moved, paths, made.looks, current, need, made.asked
    return Memory(
        state.tree, *own, state.data.planes, state.data.plane, *surfaces, scene.cache is not None, causes, rules
    )


def refreshed(past: Past, state: State, scene: Scene, causes: dict[str, str]) -> Memory:
    """Put the same together for a cell whose tree stays as it is.

    Parameters
    ----------
    past : Past
        What was known before.
    state : State
        From `settled`.
    scene : Scene
        As it is now.
    causes : dict of str to str
        From `changes.causes`.

    Returns
    -------
    Memory
        Without the digest of its files.
    """
    corners, opaque = past.memory.corners, past.memory.opaque
    if past.beyond:
        corners, opaque = changes.triangles_near(scene, state.data.grid, state.tree.cell)
    return dataclasses.replace(
        past.memory,
        pilot=past.pilot,
        planes=state.data.planes,
        plane=state.data.plane,
        corners=corners,
        opaque=opaque,
        causes=causes,
    )
