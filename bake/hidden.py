"""Planes that stay: fitted to dense receivers for a whole cell once, and again around what changes after that.

Comes in: a cell with data points. Goes out: its planes. Dense receivers cost a third of a bake, and a revision of a
cell, or a bake after a change, touches a part of it alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..tree.lookup import Atlas
from ..tree.topology import Topology
from . import judges, occluders, receivers
from .blocks import BLOCK, Blocks, by_level, voxels_of
from .measured import Measured, move, take
from .memory import Memory
from .receivers import Receivers
from .scene import Scene
from .survey import State

__all__ = ["Hidden", "everywhere", "rows_in", "since"]


@dataclass(frozen=True, eq=False)
class Hidden:
    """Planes of a cell as it was.

    tree : Topology
    measured : Measured, its data points
    planes, plane : as in `Occluders`
    """

    tree: Topology
    measured: Measured
    planes: np.ndarray
    plane: np.ndarray


def everywhere(scene: Scene, state: State, threads: int) -> Hidden:
    """Fit planes for all data points of a cell.

    Parameters
    ----------
    scene : Scene
        What stands in the way.
    state : State
        The cell.
    threads : int
        As in `Effort`.

    Returns
    -------
    Hidden
        As dense receivers see them on all surfaces that the cell may light, those of other cells too.
    """
    at = judges.around(scene, state.data.grid, state.tree, threads)
    found = occluders.fit(scene, state.data, at, threads)
    return Hidden(state.tree, state.measured, found.planes, found.plane)


def of_memory(memory: Memory) -> Hidden:
    """Take what an earlier bake found.

    Parameters
    ----------
    memory : Memory
        The cell.

    Returns
    -------
    Hidden
        With its data points where they were in the end.
    """
    moved, measured = memory.moved, memory.measured
    there = move(measured, moved.row, moved.offset, moved.light) if len(moved.row) else measured
    return Hidden(memory.tree, there, memory.planes, memory.plane)


def since(scene: Scene, state: State, old: Hidden, new: np.ndarray, threads: int) -> Hidden:
    """Keep planes of before, but for some data points, and those around whatever is new, gone, or elsewhere.

    Parameters
    ----------
    scene : Scene
        What stands in the way.
    state : State
        The cell as it is now.
    old : Hidden
        As it was.
    new : (points,) bool ndarray
        Data points that need other planes anyway.
    threads : int
        As in `Effort`.

    Returns
    -------
    Hidden
        As it is now.
    """
    tree, measured = state.tree, state.measured
    new = new | by_level(_changed(state, old).beside, measured)
    row, plane = rows_in(tree, old.tree), old.plane
    planes = np.where(row[:, None] >= 0, old.planes[np.maximum(row, 0)], -1)
    if new.any():
        data = dataclasses.replace(state.data, planes=np.where(new[:, None], -1, planes), plane=plane)
        found = occluders.fit(scene, data, _judges(scene, state, new, threads), threads, only=new)
        planes[new] = np.where(found.planes[new] >= 0, found.planes[new] + len(plane), -1)
        plane = np.concatenate([plane, found.plane])
    return Hidden(tree, measured, *_distinct(planes, plane))


def rows_in(tree: Topology, other: Topology) -> np.ndarray:
    """Find the voxels of a tree in another one.

    Parameters
    ----------
    tree, other : Topology
        Of the same cell.

    Returns
    -------
    (size,) int64 ndarray
        Row of each in the other tree; -1 where it has none.
    """
    level, coords = tree.voxels()
    return Atlas([other]).find(level.astype(np.int64), coords)


def _changed(state: State, old: Hidden) -> Blocks:
    """Voxels that are new, are gone, or have another data point."""
    here, there = state.measured, old.measured
    row = rows_in(state.tree, old.tree)
    new = row < 0
    off = ~new & ((here.offset != there.offset[row]).any(axis=1) | (here.valid != there.valid[row]))
    gone = rows_in(old.tree, state.tree) < 0
    return Blocks([*voxels_of(take(here, new | off)).marks, *voxels_of(take(there, gone)).marks])


def _judges(scene: Scene, state: State, new: np.ndarray, threads: int) -> Receivers:
    """Receivers that some data points may light: dense around fine ones and leaves, around other coarse ones those
    whose light is traced."""
    tree, measured, at, grid = state.tree, state.measured, state.seen.at, state.data.grid
    if new.all():
        return judges.around(scene, grid, tree, threads)
    coarse = (measured.level < BLOCK) & ~tree.leaves
    close = by_level(voxels_of(take(measured, new & ~coarse)).beside, measured)
    dense = judges.around(scene, grid, tree, threads, close)
    others, seen = voxels_of(take(measured, new & coarse)), np.zeros(len(at.key), bool)
    for level in range(BLOCK):
        seen |= others.beside(level, grid.voxels_at(level, at.position))
    return receivers.join([dense, at.take(seen)])


def _distinct(planes: np.ndarray, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes that are used, each once, as `Occluders` has them."""
    used = planes >= 0
    table, row = np.unique(plane[planes[used]].reshape(-1, 5), axis=0, return_inverse=True)
    out = np.full(planes.shape, -1, np.int32)
    out[used] = row.reshape(-1)
    return out, table
