"""What has changed in a cell since it was baked: where surfaces are others, and where other light arrives.

Comes in: what the cell remembers, and the scene as it is now. Goes out: what still holds. Surfaces are compared
triangle by triangle. Light is compared at every data point by a few paths, the same ones then and now, and their
differences are averaged over the data points that share a parent. What is below the tolerance counts as unchanged, and
is kept together with the paths that it was compared by, so that small changes cannot add up unseen.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..tree.dualcells import CORNERS
from ..tree.grid import Grid
from ..tree.pairs import voxels_in
from ..tree.topology import Topology
from . import datapoints, receivers, snapshot_file
from .blocks import BLOCK, Blocks, by_level, pool_keys, pool_level, pools
from .gather import Effort, gather
from .measured import Measured, moved_light, positions, split, stack, take
from .memory import Look, Memory, Moved, digest
from .receivers import Receivers
from .scene import Scene, SunDirections
from .sensors import HarmonicsSensor
from .snapshot import LightKind, Snapshot
from .sobol import scramble
from .surfels import Surfels
from .survey import Judge, Seen, trace, trace_closer

__all__ = ["Past", "causes", "compare", "pilot", "triangles_near"]

PILOT = 16
"""Paths at each data point that light is compared by."""

TOLERANCE = 0.5
"""Relative change of a pool's light that counts as none, and 1 that of a data point: in what storing an entry may
change it by."""

DECIDE = 0.25
"""Relative change of a pool's light from which on the tree is decided on anew: errors count relative to light."""

DARK = 0.01
"""Changes count relative to the light there, and to this part of the cell's mean where it is darker."""

MOST_BLOCKS = 1 << 18
"""Blocks with other surfaces beyond which nothing is kept."""

REACH = 2
"""First-level voxels around a cell whose triangles matter to its tree."""


@dataclass(frozen=True, eq=False)
class Past:
    """What is left of an earlier bake of a cell.

    memory : Memory, where everything that is trusted has the light of today
    pilot : as in `Memory`, of the data points as `memory` has them now
    surfaces : Blocks, where other surfaces are, and nothing is known
    beyond : Blocks, the same outside of the cell, as far as its data points may light them
    decide : Blocks, those and where the tree is to be decided on anew
    changed : bool, whether anything differs from what was stored
    kept : int, data points that were not measured again
    """

    memory: Memory
    pilot: np.ndarray
    surfaces: Blocks
    beyond: Blocks
    decide: Blocks
    changed: bool
    kept: int

    @cached_property
    def known(self) -> np.ndarray:
        """(size,) bool, data points that need not be measured."""
        return ~by_level(self.surfaces.touch, self.memory.measured)


def causes(snapshot: Snapshot, scene: Scene, judge: Judge) -> dict[str, str]:
    """Digest what the light of each transport depends on.

    Parameters
    ----------
    snapshot : Snapshot
        The scene, with the sky that is baked.
    scene : Scene
        The same, prepared.
    judge : Judge
        What errors are measured in.

    Returns
    -------
    dict of str to str
        "matter" for all of them, "local", "sun", "sky"; "judge" for decisions.
    """
    lights = snapshot.lights
    names = [field.name for field in dataclasses.fields(lights) if field.name != "names"]
    lamps, none = np.flatnonzero(lights.kind != LightKind.SUN), np.zeros(0, np.int64)
    bare = dataclasses.replace(lights, names=(), **{name: getattr(lights, name)[none] for name in names})
    black = np.zeros((1, 1, 3), np.float32)
    matter = dataclasses.replace(snapshot, lights=bare, sky=black)
    return {
        "matter": snapshot_file.digest(matter),
        "judge": digest(judge.views, judge.mean),
        "local": digest(*(getattr(lights, name)[lamps] for name in names)),
        "sun": digest(scene.model.suns.toward, scene.model.suns.diameter),
        "sky": digest(snapshot.sky if scene.model.sky == "fixed" else scene.model.sky),
    }


def triangles_near(scene: Scene, grid: Grid, cell: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Take the triangles that a cell's tree depends on.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    grid : Grid
        The lattice.
    cell : (2,) int
        World cell (i, j).

    Returns
    -------
    corners : (t, 3, 3) float32 ndarray
        Those in the cell and close to it [m].
    opaque : (t,) bool ndarray
        Which of them hide anything.
    """
    flat, reach = scene.soup.corners[:, :, :2], REACH * grid.first_size
    low = np.array(cell) * grid.cell_size - reach
    high = low + grid.cell_size + 2 * reach
    rows = np.flatnonzero(((flat.min(axis=1) <= high) & (flat.max(axis=1) >= low)).all(axis=1))
    return scene.soup.corners[rows], ~scene.surfaces.transparent[rows]


def pilot(scene: Scene, grid: Grid, measured: Measured, effort: Effort) -> np.ndarray:
    """Measure light at data points by few paths.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    grid : Grid
        The lattice.
    measured : Measured
        Data points.
    effort : Effort
        As they were measured.

    Returns
    -------
    (n, functions, 9, 3) float32 ndarray
        Irradiance harmonics; 0 where not valid.
    """
    out = np.zeros(measured.light.shape, np.float32)
    rows = np.flatnonzero(measured.valid)
    if len(rows) and out.shape[1]:
        some = take(measured, rows)
        position = _places(grid, some).T.astype(np.float32)
        order = datapoints.morton_order(position)
        key = datapoints.keys(some.level, some.coords)[order]
        few = dataclasses.replace(effort, samples=min(PILOT, effort.samples))
        found = gather(scene, HarmonicsSensor(), np.ascontiguousarray(position[:, order]), key, few)
        out[rows[order]] = stack(scene, found)
    return out


def compare(memory: Memory, scene: Scene, grid: Grid, now: dict[str, str], effort: Effort, samples: int) -> Past | None:
    """Find what of a cell's memory holds in a scene, and bring its light up to date where it does not.

    Parameters
    ----------
    memory : Memory
        The cell.
    scene : Scene
        As it is now, with the cell's surface cache if it has one.
    grid : Grid
        The lattice.
    now : dict of str to str
        From `causes`.
    effort : Effort
        Paths per data point.
    samples : int
        Paths per receiver.

    Returns
    -------
    Past or None
        None where so much has changed that nothing is worth keeping.
    """
    same_matter = now["matter"] == memory.causes["matter"]
    others = _other_surfaces(memory, scene, grid, same_matter)
    if others is None:
        return None
    surfaces, beyond = others
    measured, known = memory.measured, ~by_level(surfaces.touch, memory.measured)
    columns = {name: rows[0] for name, rows in split(scene, np.arange(measured.light.shape[1])[None]).items()}
    names = [name for name in columns if not (same_matter and now[name] == memory.causes[name])]
    paths = memory.pilot.copy()
    if names:
        paths[known] = pilot(scene, grid, take(measured, known), effort)
    pooled, own = _relative_changes(grid, memory, paths, known, [columns[name] for name in names])
    bound = np.array([memory.bounds[name] for name in names])
    wide, alone = known & ~(pooled <= TOLERANCE * bound).all(axis=1), known & ~(own <= bound).all(axis=1)
    for name in names:
        if now[name] != memory.causes[name]:
            alone |= known & _is_unseen(memory, paths, columns[name])
    stale = wide | alone
    restless = known & _bear(memory.tree, measured) & ~(pooled <= DECIDE).all(axis=1)
    decide = [(int(pool_level(grid, level)), coords) for level, coords in pools(grid, take(measured, restless))]
    decide = Blocks([*surfaces.marks, *decide])
    if now["judge"] != memory.causes["judge"]:
        decide = Blocks([(0, measured.coords[measured.level == 0])])
    paths[~stale] = memory.pilot[~stale]
    number = np.concatenate([np.zeros(0, np.int64), *(columns[name] for name in names)])
    known_there = _Around(grid, take(measured, known & measured.valid), take(measured, wide), take(measured, alone))
    update = _Update(_only(scene, names), grid, number, effort, samples)
    memory = dataclasses.replace(
        memory,
        measured=update.measured(measured, stale),
        moved=update.moved(memory, stale),
        looks=[update.look(look, known_there.rows(level, look.seen.at)) for level, look in enumerate(memory.looks)],
    )
    changed = bool(surfaces) or bool(beyond) or bool(decide) or bool(stale.any())
    return Past(memory, paths, surfaces, beyond, decide, changed, int((known & ~stale).sum()))


@dataclass(frozen=True, eq=False)
class _Update:
    """Measures some functions of light anew, with the paths that they would have been measured by."""

    scene: Scene
    grid: Grid
    columns: np.ndarray
    effort: Effort
    samples: int

    def measured(self, measured: Measured, stale: np.ndarray) -> Measured:
        """Data points, some of them with light of today."""
        light = measured.light.copy()
        for count in np.unique(measured.paths):
            rows = np.flatnonzero(stale & measured.valid & (measured.paths == count))
            order = rows[datapoints.morton_order(_places(self.grid, take(measured, rows)).T)]
            found = self._light(measured, order, measured.offset[order], int(count))
            light[order[:, None], self.columns] = found
        return dataclasses.replace(measured, light=light)

    def moved(self, memory: Memory, stale: np.ndarray) -> Moved:
        """Those in cracks."""
        moved, light = memory.moved, memory.moved.light.copy()
        rows = np.flatnonzero(stale[moved.row] | ~memory.measured.valid[moved.row])
        light[rows[:, None], self.columns] = self._light(
            memory.measured, moved.row[rows], moved.offset[rows], self.effort.samples
        )
        return dataclasses.replace(moved, light=light)

    def look(self, look: Look, rows: np.ndarray) -> Look:
        """Receivers of a level, some of them with light of today."""
        if not len(self.columns):
            return look
        effort = dataclasses.replace(self.effort, samples=self.samples)
        fresh = trace(self.scene, look.seen.at.take(rows), effort)
        found, light, closer = fresh.light.copy(), look.seen.light.copy(), np.flatnonzero(look.closer[rows])
        found[:, closer] = trace_closer(self.scene, fresh.take(closer), effort)
        light[:, rows[:, None], self.columns] = found
        return Look(look.coords, Seen(look.seen.at, light), look.closer)

    def _light(self, measured: Measured, rows: np.ndarray, offset: np.ndarray, paths: int) -> np.ndarray:
        """(m, columns, 9, 3) light in some voxels."""
        effort = dataclasses.replace(self.effort, samples=paths)
        return moved_light(self.scene, self.grid, measured, rows, offset, effort)


class _Around:
    """Says for which receivers light has changed: those with a data point of their level around them that has changed
    by itself or with its pool; of the next coarser level, where theirs are not complete; and those without any that is
    known."""

    def __init__(self, grid: Grid, known: Measured, wide: Measured, alone: Measured) -> None:
        self.grid = grid
        self.wide = dict(pools(grid, wide))
        self.known, self.alone = (
            {int(level): part.coords[part.level == level] for level in np.unique(part.level)} for part in (known, alone)
        )

    def rows(self, level: int, at: Receivers) -> np.ndarray:
        """(m,) which receivers of a level."""
        number, changed = self._of_level(level, at)
        coarse, coarsely = self._of_level(level - 1, at) if level else (number, changed)
        return np.flatnonzero(changed | (coarsely & (number < len(CORNERS))) | (number + coarse == 0))

    def _of_level(self, level: int, at: Receivers) -> tuple[np.ndarray, np.ndarray]:
        """(n,) how many data points of a level are known around receivers, and whether any of them has changed."""
        none, size = np.zeros((0, 3), np.int64), float(self.grid.voxel_size(level))
        is_known, is_wide, is_alone = (
            receivers.among(part.get(level, none)) for part in (self.known, self.wide, self.alone)
        )
        ratio = round(float(self.grid.voxel_size(int(pool_level(self.grid, level)))) / size)
        number, changed = np.zeros(len(at.key), np.int64), np.zeros(len(at.key), bool)
        for corner in CORNERS - 0.5:
            voxel = np.floor(at.position / size + corner).astype(np.int64)
            number, changed = number + is_known(voxel), changed | is_wide(voxel // ratio) | is_alone(voxel)
        return number, changed


def _only(scene: Scene, names: list[str]) -> Scene:
    """The scene with the light of some transports."""
    model, suns = scene.model, len(scene.model.suns.toward)
    part = dataclasses.replace(
        model,
        local=model.local and "local" in names,
        suns=model.suns if "sun" in names else SunDirections(),
        sky=model.sky if "sky" in names else "none",
    )
    cache = scene.cache
    if cache is not None:
        wanted = np.repeat([True, "sun" in names, "sky" in names], [1, suns, model.sky_count])
        light, indirect = (np.ascontiguousarray(values[:, wanted]) for values in (cache.light, cache.indirect))
        cache = Surfels(cache.known, light, indirect)
    return dataclasses.replace(scene, model=part, cache=cache)


def _other_surfaces(memory: Memory, scene: Scene, grid: Grid, same_matter: bool) -> tuple[Blocks, Blocks] | None:
    """Where triangles are that are only here or only there, and data points that are placed or judged otherwise for
    them; the same close to the cell, outside; None for too many."""
    if same_matter:
        return Blocks([]), Blocks([])
    corners, opaque = triangles_near(scene, grid, memory.tree.cell)
    old, new = _names(memory.corners, memory.opaque), _names(corners, opaque)
    other = np.concatenate([memory.corners[~np.isin(old, new)], corners[~np.isin(new, old)]]).astype(np.float64)
    level = min(BLOCK, grid.levels - 1)
    size = float(grid.voxel_size(level))
    box = np.stack([other.min(axis=1) - size, other.max(axis=1) + size], axis=1)
    box = np.unique(np.floor(box / size).astype(np.int64).reshape(-1, 6), axis=0).reshape(-1, 2, 3)
    if np.prod(box[:, 1] - box[:, 0] + 1.0, axis=1).sum() > MOST_BLOCKS:
        return None
    parts = [np.zeros((0, 3), np.int64), *(coords for _, coords in voxels_in(box[:, 0], box[:, 1]))]
    blocks = np.unique(np.concatenate(parts), axis=0)
    inside = (blocks[:, :2] // round(grid.cell_size / size) == memory.tree.cell).all(axis=1)
    marks, outside = Blocks([(level, blocks[inside])]), Blocks([(level, blocks[~inside])])
    marks = Blocks([*marks.marks, *_misplaced(memory, scene, grid, ~by_level(marks.touch, memory.measured))])
    return marks, outside if lights(outside, memory.tree, memory.measured).any() else Blocks([])


def lights(surfaces: Blocks, tree: Topology, measured: Measured) -> np.ndarray:
    """Say which data points of a cell light surfaces somewhere.

    Parameters
    ----------
    surfaces : Blocks
        Where the surfaces are.
    tree : Topology
        The cell.
    measured : Measured
        Its data points.

    Returns
    -------
    (size,) bool ndarray
        Those close by.
    """
    return _bear(tree, measured) & by_level(surfaces.around, measured)


def _bear(tree: Topology, measured: Measured) -> np.ndarray:
    """(size,) data points that surfaces are lit by: of the first level only leaves, as others bring next to nothing."""
    return (measured.level > 0) | tree.leaves


def _misplaced(memory: Memory, scene: Scene, grid: Grid, known: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Pools of data points that would lie elsewhere today, as one of each shows: backs of distant surfaces count."""
    measured, rows = memory.measured, np.flatnonzero(known)
    pool = pool_keys(grid, take(measured, rows))
    rows = rows[np.unique(pool, axis=0, return_index=True)[1]]
    some = take(measured, rows)
    size = np.asarray(grid.voxel_size(some.level.astype(np.int64)), np.float64)
    key = datapoints.keys(some.level, some.coords)
    placed = datapoints.place(scene, grid.centers(some.level, some.coords), size, key)
    off = (placed.valid != some.valid) | (placed.valid & (placed.offset != some.offset).any(axis=1))
    return [(int(pool_level(grid, level)), coords) for level, coords in pools(grid, take(some, off))]


def _names(corners: np.ndarray, opaque: np.ndarray) -> np.ndarray:
    """(t,) int64 hashes of triangles."""
    words = np.ascontiguousarray(corners, np.float32).reshape(len(corners), 9).view(np.uint32)
    halves = []
    for salt in (1, 2):
        half = scramble(opaque.astype(np.uint32), salt)
        for number in range(9):
            half = scramble(half ^ words[:, number], salt + 2 * number)
        halves.append(half.astype(np.int64))
    return halves[0] << 32 | halves[1]


def _relative_changes(
    grid: Grid, memory: Memory, paths: np.ndarray, known: np.ndarray, columns: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(size, transports) how much the light of some functions differs from then, relative to it, averaged over each
    pool, and by itself; 0 where that is not known."""
    measured, out = memory.measured, np.zeros((2, len(known), len(columns)))
    rows = np.flatnonzero(known & measured.valid)
    if not len(rows):
        return tuple(out)
    _, pool = np.unique(pool_keys(grid, take(measured, rows)), axis=0, return_inverse=True)
    pool = pool.reshape(-1)
    for number, functions in enumerate(columns):
        light = memory.pilot[rows][:, functions].astype(np.float64)
        off = paths[rows][:, functions] - light
        least = DARK * _length(light).mean()
        pooled = (_length(_mean_over(pool, values)) for values in (off, light))
        out[0, rows, number] = _ratio(*pooled, least)[pool]
        out[1, rows, number] = _ratio(_length(off), _length(light), least)
    return tuple(out)


def _is_unseen(memory: Memory, paths: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """(size,) data points with light that few paths find neither then nor now, so that they say nothing about it."""
    found = memory.pilot[:, functions].any(axis=(1, 2, 3)) | paths[:, functions].any(axis=(1, 2, 3))
    light = _length(memory.measured.light[:, functions])
    return ~found & (light > DARK * light.mean())


def _mean_over(pool: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(pools, ...) means of (n, ...) values over those that share a number."""
    count = np.bincount(pool)
    sums = [np.bincount(pool, column, len(count)) for column in values.reshape(len(values), -1).T]
    return (np.array(sums) / count).T.reshape(len(count), *values.shape[1:])


def _length(values: np.ndarray) -> np.ndarray:
    """(n,) of (n, functions, 9, 3) harmonics."""
    return np.sqrt((values**2).sum(axis=(1, 2, 3)))


def _ratio(off: np.ndarray, light: np.ndarray, least: float) -> np.ndarray:
    """(n,) off over light; without any light every change is infinite."""
    scale = np.maximum(light, least)
    return np.divide(off, scale, out=np.where(off > 0, np.inf, 0.0), where=scale > 0)


def _places(grid: Grid, measured: Measured) -> np.ndarray:
    """(n, 3) where data points are [m]."""
    return positions(grid, measured.level, measured.coords, measured.offset)
