"""One cell of a bake: its tree grown, its light fitted, its files written; from scratch, again, or as an early look.

Comes in: what all cells of a bake share, and which cell. Goes out: files in the bake's folder. A cell whose surface
cache is off goes by paths, one that takes too many bytes has fewer data points, and one that an earlier bake
remembers measures only what has changed.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..tree import folder
from ..tree.grid import Grid
from ..tree.outline import Outline, outline
from ..tree.planes import of_cell
from ..tree.topology import Topology
from . import changes, memory, radiosity
from .again import Again, refreshed, remember, settled
from .check import VOXELS, Check, check
from .deadline import Deadline
from .fills import fills
from .measured import split
from .parallel import Room, held
from .place import Place
from .refine import Refinement, Target, sketch
from .scene import Scene
from .settings import ERRORS, RECEIVER_SAMPLES, Settings, SettingsError
from .survey import Judge, State, fitted, shade, shaded

__all__ = ["History", "Work", "bake_cell", "list_of", "look_early"]

LISTED = 12
"""Cells that a message names."""

BUDGET_TRIES = 4
"""Times that a cell is baked to find how many data points its bytes allow; the last one counts, whatever it takes."""

BUDGET_MARGIN = 0.97
"""Part of the bytes that the next try aims at."""

CACHED = 0.1
"""Part of a cell's progress that its surface cache takes."""

WORTH = 1 << 20
"""Paths that a cell is expected to take, below which they are followed to their end: finding surfels takes as many."""

EARLY_SAMPLES, EARLY_BOUNCES = 64, 6
"""Paths and bounces of an early look."""

RECHECKED = VOXELS // 8
"""Voxels at which the surface cache of a cell that has been baked before is checked."""


@dataclass(frozen=True)
class History:
    """What an incremental bake compares: digests of its settings, and of what each transport's light depends on."""

    rules: str
    causes: dict[str, str]


@dataclass(frozen=True, eq=False)
class Work:
    """What all cells of a bake share.

    scene : Scene, grid : Grid, the scene without a cache and the lattice
    place : Place, the bake's folder
    settings : Settings, judge : Judge, target : Target, what is wanted
    room : Room, lets cells in as far as memory goes
    history : History or None, what an incremental bake compares
    deadline : Deadline, when the bake is to be done
    warnings : list of str, for the summary
    shared : list of Scene, the scene with a cache that all cells share, once it is there
    arriving : dict, by cell the transports of which any light arrives
    checks : dict, by cell how far off its cache is
    kept : dict, by cell the data points that were taken over from an earlier bake
    cut : set, cells that time was too short for
    lock : Lock, held by whoever fills `shared`
    """

    scene: Scene
    grid: Grid
    place: Place
    settings: Settings
    judge: Judge
    target: Target
    room: Room
    history: History | None
    deadline: Deadline
    warnings: list[str] = field(default_factory=list)
    shared: list[Scene] = field(default_factory=list)
    arriving: dict[tuple[int, int], set[str]] = field(default_factory=dict)
    checks: dict[tuple[int, int], Check] = field(default_factory=dict)
    kept: dict[tuple[int, int], int] = field(default_factory=dict)
    cut: set[tuple[int, int]] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def light_in(self, voxels: Voxels, show: Callable[[float], bool]) -> Scene:
        """Choose how light travels.

        Parameters
        ----------
        voxels : Voxels
            Where light is measured.
        show : callable
            Progress, 0 to 1.

        Returns
        -------
        Scene
            With a surface cache if there is to be one, and it is worth the paths that it takes.
        """
        expected = self.settings.samples * sum(len(coords) for coords in voxels.coords)
        return self.scene if self.settings.method != "cache" or expected < WORTH else self.cached(voxels, show)

    def cached(self, voxels: Voxels, show: Callable[[float], bool]) -> Scene:
        """Give the scene a surface cache.

        Parameters
        ----------
        voxels : Voxels
            Where light is measured.
        show : callable
            Progress, 0 to 1.

        Returns
        -------
        Scene
            With a cache around the cell; a scene no larger than a cell has the same for all.
        """
        effort = self.target.effort
        if not radiosity.is_shared(self.scene, self.grid):
            dense = voxels.dense * self.grid.first_size
            return radiosity.around(self.scene, self.grid, dense, effort, lambda share: show(CACHED * share))
        with held(self.lock):
            if not self.shared:
                box = radiosity.whole(self.scene)
                found = radiosity.around(self.scene, self.grid, box, effort, lambda share: show(CACHED * share))
                self.shared.append(found)
            return self.shared[0]

    def trusted(self, cached: Scene, voxels: Voxels, count: int = VOXELS) -> Scene:
        """Check a cache against paths.

        Parameters
        ----------
        cached : Scene
            From `light_in`.
        voxels : Voxels
            Where light is measured.
        count : int
            How many of them are checked.

        Returns
        -------
        Scene
            With the cache, or without where that is off by more than the bake's error.
        """
        if cached is self.scene:
            return cached
        made = check(cached, self.scene, self.grid, voxels.coords, self.judge, self.target.effort, count)
        self.checks[voxels.cell] = made
        if not self.fails(made):
            return cached
        self.warnings.append(
            f"cell {list_of([voxels.cell])}: the surface cache is too far off, so paths went to their end"
        )
        return self.scene

    def fails(self, made: Check) -> bool:
        """Say whether a cache is too far off for this bake.

        Parameters
        ----------
        made : Check
            Of a cell.

        Returns
        -------
        bool
            Beyond doubt.
        """
        return made.fails(self.settings.error or ERRORS["preview"])


@dataclass(frozen=True, eq=False)
class Voxels:
    """Where light in a cell is measured.

    cell : (i, j)
    coords : list of (n, 3) int64 ndarray, voxels by level
    dense : (2, 3) int64 ndarray, first and last but one of the first level
    """

    cell: tuple[int, int]
    coords: list[np.ndarray]
    dense: np.ndarray

    @classmethod
    def of_outline(cls, found: Outline) -> Voxels:
        """Take all that a tree may have.

        Parameters
        ----------
        found : Outline
            The cell.

        Returns
        -------
        Voxels
            Many more than it will have.
        """
        return cls(found.cell, list(found.coords), np.stack([found.dense.low, found.dense.low + found.dense.shape]))

    @classmethod
    def of_tree(cls, tree: Topology) -> Voxels:
        """Take those of a tree.

        Parameters
        ----------
        tree : Topology
            The cell.

        Returns
        -------
        Voxels
            All of its.
        """
        level, coords = tree.voxels()
        low = np.array(tree.grid_min)
        parts = [coords[level == own] for own in range(tree.levels)]
        return cls(tree.cell, parts, np.stack([low, low + tree.grid_shape]))


def look_early(work: Work, cell: tuple[int, int], grid: Grid) -> None:
    """Write a cell of few levels and few paths.

    Parameters
    ----------
    work : Work
        The bake.
    cell : (i, j)
        Which cell.
    grid : Grid
        The lattice, with as few levels.

    Raises
    ------
    SettingsError
        Its first level has more voxels than there may be data points.
    OSError
        A file cannot be written.
    """
    effort = dataclasses.replace(work.target.effort, samples=EARLY_SAMPLES, bounces=EARLY_BOUNCES)
    quick = dataclasses.replace(work.target, error=0.0, effort=effort, samples=RECEIVER_SAMPLES)
    found = outline(work.scene.soup.corners, grid, cell)
    _check_cap(found, quick.max_points)

    def sketched(target: Target, attempt: int, limit: int) -> tuple[int, int]:
        refined = sketch(work.scene, found, work.judge, target)
        tree = dataclasses.replace(refined.tree, levels=work.grid.levels)
        return tree.size, _write(work, cell, dataclasses.replace(refined, tree=tree), limit, early=True)

    _in_budget(found, quick, work.settings.max_bytes, sketched)


def bake_cell(work: Work, cell: tuple[int, int], show: Callable[[float], bool]) -> Topology:
    """Grow the tree of one cell, measure and fit its light, write its files; again with fewer data points where it
    takes more bytes than it may.

    Parameters
    ----------
    work : Work
        The bake.
    cell : (i, j)
        Which cell.
    show : callable
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Topology
        Its tree.

    Raises
    ------
    SettingsError
        Its first level has more voxels than there may be data points.
    OSError
        A file cannot be written.
    CancelledError
        `show` returned False.
    """
    if work.history:
        known = memory.load(work.place.target, cell, work.grid, work.history.rules)
        tree = known and _bake_again(work, known, show)
        if tree:
            return tree
    found = outline(work.scene.soup.corners, work.grid, cell, by_light=work.target.error > 0)
    _check_cap(found, work.target.max_points)
    with work.room.hold(sum(len(coords) for coords in found.coords)):
        return _fill_cell(work, cell, found, show)


def _bake_again(work: Work, known: memory.Memory, show: Callable[[float], bool]) -> Topology | None:
    """The same for a cell that has been baked before; None where that is of no help."""
    cell, voxels, now = known.tree.cell, Voxels.of_tree(known.tree), work.history.causes
    scene = work.trusted(work.cached(voxels, show), voxels, RECHECKED) if known.cached else work.scene
    if known.cached and scene is work.scene:
        return None
    effort, samples = work.target.effort, work.target.samples
    past = changes.compare(known, scene, work.grid, now, effort, samples)
    if past is None:
        return None
    copied = None if past.changed else work.place.keep_cell(cell, known.content)
    if copied:
        work.kept[cell] = past.kept
        work.arriving[cell] = {name for name, part in copied.payloads.items() if part.table.coefficient.any()}
        return known.tree
    if not past.decide:
        refined = settled(past, scene, work.grid, effort.threads)
        made = refreshed(past, refined, scene, now)
    else:
        found = outline(work.scene.soup.corners, work.grid, cell, by_light=work.target.error > 0)
        again = Again(scene, found, work.judge, work.target, show, past)
        with work.room.hold(sum(len(coords) for coords in found.coords)):
            refined = again.run()
        made = remember(again, now, known.rules, past)
    limit = work.settings.max_bytes
    size = _write(work, cell, refined, limit=limit)
    if limit and size > limit:
        return None
    work.kept[cell] = past.kept
    _keep(work, made)
    return refined.tree


def _fill_cell(work: Work, cell: tuple[int, int], found: Outline, show: Callable[[float], bool]) -> Topology:
    """The same for a cell whose outline is known."""
    voxels, target, limit = Voxels.of_outline(found), work.target, work.settings.max_bytes
    scene = work.trusted(work.light_in(voxels, show), voxels)
    if found.cell in work.checks:
        whole, show = show, lambda share: whole(CACHED + (1 - CACHED) * share)
    made, cut = None, False

    def refined(target: Target, attempt: int, most: int) -> tuple[int, int]:
        nonlocal made, cut
        made = Refinement(scene, found, work.judge, target, _part_of(show, attempt) if limit else show)
        made.pace = work.deadline.pace()
        state = made.run()
        cut |= made.cut
        return state.tree.size, _write(work, cell, state, most, early=cut)

    size = _in_budget(found, target, limit, refined)
    if limit and size > limit:
        work.warnings.append(f"cell {list_of([cell])} takes {size:,} bytes, {size - limit:,} more than --max-bytes")
    if cut:
        work.cut.add(cell)
    elif work.history:
        _keep(work, remember(made, work.history.causes, work.history.rules, None))
    return made.state.tree


def _in_budget(
    found: Outline, target: Target, limit: int, attempted: Callable[[Target, int, int], tuple[int, int]]
) -> int:
    """Bake a cell with as many data points as its bytes allow; its bytes.

    `attempted(target, attempt, limit)` returns data points and bytes, and writes no files of more than so many bytes;
    0 for any number of them.
    """
    for attempt in range(BUDGET_TRIES):
        last = attempt == BUDGET_TRIES - 1
        count, size = attempted(target, attempt, 0 if last else limit)
        if last or not limit or size <= limit:
            return size
        points = int(count * BUDGET_MARGIN * limit / size)
        target = dataclasses.replace(target, max_points=max(points, int(np.prod(found.dense.shape)) + 1))


def _keep(work: Work, made: memory.Memory) -> None:
    """Write down what the next bake may use of a cell whose files are there."""
    found = folder.read_cell(work.place.target, made.tree.cell)
    bounds = {name: payload.relative_error for name, payload in found.payloads.items()}
    memory.save(dataclasses.replace(made, bounds=bounds, content=folder.digest_of_cell(found)), work.place.target)


def _check_cap(found: Outline, max_points: int) -> None:
    """Refuse a cap that not even the first level fits under."""
    least = int(np.prod(found.dense.shape))
    if max_points < least:
        place = f"--max-points {max_points}: cell {found.cell[0]},{found.cell[1]}"
        raise SettingsError(f"{place} has {least} first-level voxels; allow as many data points at least")


def _part_of(show: Callable[[float], bool], attempt: int) -> Callable[[float], bool]:
    """Progress of one of several attempts: each takes half of what is left."""
    return lambda share: show(1 - (2 - share) / 2 ** (attempt + 1))


def _write(work: Work, cell: tuple[int, int], refined: State, limit: int = 0, early: bool = False) -> int:
    """Fit the data of a cell and write its files; their bytes."""
    light = (
        fitted(work.scene, refined, work.judge, work.target.effort.threads)
        if work.settings.fit
        else refined.measured.light
    )
    measured, data = refined.measured, refined.data
    corner = np.array([*cell, 0]) * work.grid.cell_size
    dim = shade(refined, light, work.judge) if light.shape[1] else 1.0
    fill = fills(shaded(refined, dim), light, work.judge) if light.shape[1] else None
    planes = of_cell(data.planes, data.plane, data.position, corner, dim, fill)
    payloads = split(work.scene, light)
    work.arriving[cell] = {name for name, part in payloads.items() if part.any()}
    marks = {"early": early, "by_paths": cell in work.checks and work.fails(work.checks[cell])}
    return work.place.write_cell(refined.tree, payloads, measured.valid, measured.offset, planes, limit, marks)


def list_of(cells) -> str:
    """Name cells.

    Parameters
    ----------
    cells : iterable of (i, j)
        Which.

    Returns
    -------
    str
        As the command line writes them; of many only the first.
    """
    text = "/".join(f"{i},{j}" for i, j in cells[:LISTED])
    return text + (" ..." if len(cells) > LISTED else "")
