"""The one unit of work: bake cells of a snapshot into a folder.

Comes in: a snapshot, settings, which cells. Goes out: one set of files per cell, and the folder's `world.json`.
Cells whose files are whole and were made from the same input are kept as they are, so the command can be run
again, by anybody, after anything. Each cell's files appear at once or not at all.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..tree import build, folder
from ..tree.grid import FIRST_SIZE, Grid
from ..tree.outline import Outline, outline
from ..tree.planes import of_cell
from ..tree.topology import Topology
from . import changes, memory, radiosity, snapshot_file, summary
from .again import Again, remember, settled
from .check import VOXELS, Check, check
from .fills import fills
from .gather import Effort
from .measured import split
from .parallel import CancelledError, Room, held, run_jobs
from .place import Place, check_target
from .progress import Progress
from .reference import sun_strength
from .refine import Refinement, Target, sketch
from .scene import Model, Scene, prepare
from .settings import (
    ERRORS,
    LEVELS,
    RECEIVER_SAMPLES,
    Settings,
    SettingsError,
    check_scene,
    check_triangles,
    choose_grid,
    has_free_sun,
    model,
)
from .snapshot import Snapshot
from .summary import Outcome
from .survey import Judge, State, fitted, shade, shaded

FORMAT = "gi_volumes bake 3"
"""Part of every bake's hash: files of another definition are baked anew."""

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

TOGETHER = 3 << 17
"""Most voxels that geometry lists in cells that are baked at once, as memory is bounded: a large cell and a half."""

EARLY_LEVELS, EARLY_SAMPLES, EARLY_BOUNCES = 2, 64, 6
"""Levels, paths and bounces of an early look: voxels of 2 m, within seconds."""

WHITE = np.array([[np.sqrt(4 * np.pi)] * 3] + [[0.0] * 3] * 8)
"""Harmonics of a sky of radiance 1 W/(m2 sr)."""

STEPS = 1000
"""Units of progress in a cell."""

RECHECKED = VOXELS // 8
"""Voxels at which the surface cache of a cell that has been baked before is checked."""


def bake(
    snapshot: Snapshot,
    target: Path,
    settings: Settings,
    cells: list[tuple[int, int]] | None = None,
    threads: int = 0,
    progress: Progress | None = None,
    early: bool = False,
    incremental: bool = False,
) -> Outcome:
    """Bake some or all cells of a scene.

    Parameters
    ----------
    snapshot : Snapshot
        A checked scene.
    target : Path
        Folder of the bake; it is made if needed.
    settings : Settings
        What to bake and how well.
    cells : list of (i, j), optional
        Only these world cells.
    threads : int
        Worker threads; 0 uses every core.
    progress : Progress, optional
        Where to say how far it is.
    early : bool
        Whether to write a coarse look at every cell first, within seconds, for those who watch the folder; not where
        it would take the place of another bake. What is there in the end is the same.
    incremental : bool
        Whether to keep what is measured in files of its own, and to measure again only what has changed since an
        earlier bake of the folder kept it.

    Returns
    -------
    Outcome
        Counts, sizes, times, what was modelled and what was left out.

    Raises
    ------
    SnapshotError, SettingsError
        The scene or a setting cannot be baked.
    OSError
        The folder cannot be written.
    KeyboardInterrupt
        The user stopped it; finished cells are kept and listed.
    """
    progress = progress or Progress()
    check_scene(snapshot)
    check_target(target)
    progress.stage("Preparing")
    effective, light = model(snapshot, settings)
    identity = bake_hash(effective, settings, light, incremental)
    scene = prepare(effective, light)
    check_triangles(scene.soup.corners)
    levels = LEVELS if settings.error else LEVELS - 1
    grid = choose_grid(scene.soup.corners, snapshot.origin, settings.finest, levels)
    occupied = [tuple(int(v) for v in cell) for cell in build.occupied_cells(scene.soup.corners, grid)]
    header = summary.header(snapshot, settings, scene, grid, identity) | {"expected_cells": occupied}
    wanted = _in_view(snapshot, grid, _wanted(cells, occupied))
    place = Place(target, snapshot, header, incremental)
    effort = Effort(settings.samples, settings.bounces, settings.seed, threads)
    goal = Target(settings.error, settings.max_points, settings.dilation, effort, settings.receiver_samples)
    room = Room(TOGETHER)
    judge = _judge(snapshot, settings, scene)
    history = _History(_rules(settings, scene, grid), changes.causes(effective, scene, judge)) if incremental else None
    work = _Work(scene, grid, place, settings, judge, goal, room, history)
    try:
        if early and place.taken:
            _look_early(work, wanted, progress)
        trees = _bake_cells(work, wanted, progress)
        place.take()
        _forget(target, occupied)
    finally:
        listed = [entry for entry in place.close() if not entry.get("early")]
    outcome = summary.describe(snapshot, settings, scene, trees)
    outcome.voxels = {"first": grid.first_size, "finest": float(grid.voxel_size(grid.levels - 1))}
    if not settings.finest and grid.first_size != FIRST_SIZE:
        outcome.warnings.append(
            f"first-level voxels of {grid.first_size:g} m suit this scene's size; --finest changes it"
        )
    made = Check.join([work.checks[cell] for cell in sorted(work.checks)], len(work.judge.views))
    outcome.checked = summary.checked(made, list(header["transports"]))
    outcome.kept = sum(work.kept.values())
    outcome.warnings += sorted(work.warnings)
    if len(work.arriving) == len(wanted):
        outcome.warnings += summary.dark(list(header["transports"]), list(work.arriving.values()))
    if len(listed) < len(occupied):
        outcome.warnings.append(f"{len(occupied) - len(listed)} of the scene's {len(occupied)} cells are not baked yet")
    outcome.folder = str(target.absolute())
    outcome.seconds = progress.seconds
    outcome.rays = scene.tracer.rays
    outcome.bytes = summary.file_sizes(listed)
    return outcome


def bake_hash(snapshot: Snapshot, settings: Settings, light: Model, incremental: bool = False) -> str:
    """Identify everything that a cell's values depend on.

    Parameters
    ----------
    snapshot : Snapshot
        The scene, with the sky that is baked.
    settings : Settings
        How it is baked; the words for sun and sky count by what they mean.
    light : Model
        What is baked.
    incremental : bool
        Whether values may be an earlier bake's.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    words = dataclasses.asdict(settings) | {"sun": light.suns.toward.tolist(), "sky": light.sky}
    words |= {"incremental": True} if incremental else {}
    text = json.dumps([FORMAT, snapshot_file.digest(snapshot), words, light.suns.diameter.tolist()], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class _History:
    """What an incremental bake compares: digests of its settings, and of what each transport's light depends on."""

    rules: str
    causes: dict[str, str]


def _rules(settings: Settings, scene: Scene, grid: Grid) -> str:
    """Digest of all that has to be the same for an earlier bake to be of use."""
    words = dataclasses.asdict(settings) | {"sun": len(scene.model.suns.toward), "sky": scene.model.sky}
    return memory.digest(FORMAT, sorted(words.items()), grid, scene.has_local)


def _wanted(cells: list[tuple[int, int]] | None, occupied: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The cells that were asked for, all of them with geometry."""
    empty = sorted(set(cells or ()) - set(occupied))
    if empty:
        raise SettingsError(f"--cells {_list(empty)}: no geometry there; this scene has cells {_list(occupied)}")
    return occupied if cells is None else sorted(set(cells))


def _in_view(snapshot: Snapshot, grid: Grid, cells: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Cells in the order in which they are baked: those close to the camera first."""
    place = np.array(grid.origin[:2]) + grid.cell_size / 2
    if snapshot.cameras:
        place = np.array(snapshot.cameras[0].world_from_camera).reshape(3, 4)[:2, 3]
    middle = np.array(grid.origin[:2]) + (np.array(cells, np.float64).reshape(-1, 2) + 0.5) * grid.cell_size
    return [cells[row] for row in np.argsort(((middle - place) ** 2).sum(axis=1), kind="stable")]


@dataclass(frozen=True, eq=False)
class _Work:
    """What all cells of a bake share."""

    scene: Scene
    grid: Grid
    place: Place
    settings: Settings
    judge: Judge
    target: Target
    room: Room
    history: _History | None
    warnings: list[str] = field(default_factory=list)
    shared: list[Scene] = field(default_factory=list)
    arriving: dict[tuple[int, int], set[str]] = field(default_factory=dict)
    checks: dict[tuple[int, int], Check] = field(default_factory=dict)
    kept: dict[tuple[int, int], int] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def light_in(self, voxels: _Voxels, show: Callable[[float], bool]) -> Scene:
        """The scene, with a surface cache if there is to be one, and it is worth the paths that it takes."""
        expected = self.settings.samples * sum(len(coords) for coords in voxels.coords)
        return self.scene if self.settings.method != "cache" or expected < WORTH else self.cached(voxels, show)

    def cached(self, voxels: _Voxels, show: Callable[[float], bool]) -> Scene:
        """The scene with a surface cache: of a scene no larger than a cell the same for all."""
        bounds, effort = self.scene.soup.bounds, self.target.effort
        if np.ptp(bounds[:, :2], axis=0).max() > self.grid.cell_size:
            dense = voxels.dense * self.grid.first_size
            return radiosity.around(self.scene, self.grid, dense, effort, lambda share: show(CACHED * share))
        with held(self.lock):
            if not self.shared:
                box = np.stack([bounds[0], np.nextafter(bounds[1], np.inf)])
                found = radiosity.around(self.scene, self.grid, box, effort, lambda share: show(CACHED * share))
                self.shared.append(found)
            return self.shared[0]

    def trusted(self, cached: Scene, voxels: _Voxels, count: int = VOXELS) -> Scene:
        """The scene with the cache, or without where that is off by more than the bake's error."""
        if cached is self.scene:
            return cached
        made = check(cached, self.scene, self.grid, voxels.coords, self.judge, self.target.effort, count)
        self.checks[voxels.cell] = made
        if not made.fails(self.settings.error or ERRORS["preview"]):
            return cached
        self.warnings.append(
            f"cell {_list([voxels.cell])}: the surface cache is too far off, so paths went to their end"
        )
        return self.scene


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Where light in a cell is measured: voxels by level, and the box of first-level ones."""

    cell: tuple[int, int]
    coords: list[np.ndarray]
    dense: np.ndarray

    @classmethod
    def of_outline(cls, found: Outline) -> _Voxels:
        return cls(found.cell, list(found.coords), np.stack([found.dense.low, found.dense.low + found.dense.shape]))

    @classmethod
    def of_tree(cls, tree: Topology) -> _Voxels:
        level, coords = tree.voxels()
        low = np.array(tree.grid_min)
        parts = [coords[level == own] for own in range(tree.levels)]
        return cls(tree.cell, parts, np.stack([low, low + tree.grid_shape]))


def _judge(snapshot: Snapshot, settings: Settings, scene: Scene) -> Judge:
    """Local light, sun and sky as they are when nobody says otherwise; of a free sun the mean of its directions; for
    functions of a black sky a white one."""
    suns = len(scene.model.suns.toward)
    strength = sun_strength(snapshot, suns) / (max(suns, 1) if has_free_sun(settings.sun) else 1)
    sky = scene.sky.harmonics() if scene.model.sky == "harmonics" else np.ones((scene.model.sky_count, 3))
    sky = sky if sky.any() else WHITE[: len(sky)]
    parts = [np.ones((int(scene.has_local), 3)), strength if suns else np.zeros((0, 3)), sky]
    views = []
    for number, part in enumerate(parts):
        if len(part):
            others = [np.zeros_like(other) for other in parts]
            others[number] = part
            views.append(np.concatenate(others))
    mean = np.concatenate(parts)
    return Judge(np.array(views).reshape(len(views), len(mean), 3), mean)


@dataclass(frozen=True)
class _Counts:
    """What a summary says of a cell's tree."""

    size: int
    dilated: int
    left_out: int

    @classmethod
    def of(cls, tree: Topology) -> _Counts:
        return cls(tree.size, tree.dilated, tree.left_out)


def _look_early(work: _Work, cells: list[tuple[int, int]], progress: Progress) -> None:
    """Write cells of few levels and few paths, where there are none of this bake."""
    progress.stage("First look", len(cells))
    grid = dataclasses.replace(work.grid, levels=min(EARLY_LEVELS, work.grid.levels))
    effort = dataclasses.replace(work.target.effort, samples=EARLY_SAMPLES, bounces=EARLY_BOUNCES)
    quick = dataclasses.replace(work.target, error=0.0, effort=effort, samples=RECEIVER_SAMPLES)
    done, lock = itertools.count(1), threading.Lock()

    def look(number: int) -> None:
        if folder.bake_of_cell(work.place.target, cells[number]) != work.place.identity:
            found = outline(work.scene.soup.corners, grid, cells[number])
            _check_cap(found, quick.max_points)
            refined = sketch(work.scene, found, work.judge, quick)
            tree = dataclasses.replace(refined.tree, levels=work.grid.levels)
            _write(work, cells[number], dataclasses.replace(refined, tree=tree), early=True)
        with lock:
            progress.show(next(done))

    run_jobs(look, len(cells), quick.effort.threads)
    work.place.list_cells()


def _bake_cells(work: _Work, cells: list[tuple[int, int]], progress: Progress) -> list[_Counts]:
    """All cells, some of them at once, of which nothing stays in memory; the ones already there are only read."""
    progress.stage("Baking", STEPS * len(cells))
    done, lock = [0] * len(cells), threading.Lock()

    def show(number: int, share: float) -> bool:
        with lock:
            done[number] = int(share * STEPS)
            return progress.show(sum(done))

    def bake_one(number: int) -> _Counts:
        if folder.has_cell(work.place.target, cells[number], work.place.identity):
            tree = folder.read_cell(work.place.target, cells[number]).topology
        else:
            tree = _bake_cell(work, cells[number], lambda share: show(number, share))
        show(number, 1.0)
        return _Counts.of(tree)

    return run_jobs(bake_one, len(cells), work.target.effort.threads)


def _bake_cell(work: _Work, cell: tuple[int, int], show: Callable[[float], bool]) -> Topology:
    """Grow the tree of one cell, measure and fit its light, write its files; again with fewer data points where it
    takes more bytes than it may."""
    if work.history:
        known = memory.load(work.place.target, cell, work.grid, work.history.rules)
        tree = known and _bake_again(work, known, show)
        if tree:
            return tree
    found = outline(work.scene.soup.corners, work.grid, cell, by_light=work.target.error > 0)
    _check_cap(found, work.target.max_points)
    with work.room.hold(sum(len(coords) for coords in found.coords)):
        return _fill_cell(work, cell, found, show)


def _bake_again(work: _Work, known: memory.Memory, show: Callable[[float], bool]) -> Topology | None:
    """The same for a cell that has been baked before; None where that is of no help."""
    cell, voxels, now = known.tree.cell, _Voxels.of_tree(known.tree), work.history.causes
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
    if not (past.decide or past.beyond):
        refined = settled(past, work.grid)
        made = dataclasses.replace(past.memory, pilot=past.pilot, causes=now)
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


def _fill_cell(work: _Work, cell: tuple[int, int], found: Outline, show: Callable[[float], bool]) -> Topology:
    """The same for a cell whose outline is known."""
    voxels, target, limit = _Voxels.of_outline(found), work.target, work.settings.max_bytes
    scene = work.trusted(work.light_in(voxels, show), voxels)
    if found.cell in work.checks:
        whole, show = show, lambda share: whole(CACHED + (1 - CACHED) * share)
    for attempt in range(BUDGET_TRIES):
        last = attempt == BUDGET_TRIES - 1
        made = Refinement(scene, found, work.judge, target, _part_of(show, attempt) if limit else show)
        size = _write(work, cell, made.run(), limit=0 if last else limit)
        if last or not limit or size <= limit:
            break
        points = int(made.state.tree.size * BUDGET_MARGIN * limit / size)
        target = dataclasses.replace(target, max_points=max(points, int(np.prod(found.dense.shape)) + 1))
    if limit and size > limit:
        work.warnings.append(f"cell {_list([cell])} takes {size:,} bytes, {size - limit:,} more than --max-bytes")
    if work.history:
        _keep(work, remember(made, work.history.causes, work.history.rules, None))
    return made.state.tree


def _keep(work: _Work, made: memory.Memory) -> None:
    """Write down what the next bake may use of a cell whose files are there."""
    found = folder.read_cell(work.place.target, made.tree.cell)
    bounds = {name: payload.relative_error for name, payload in found.payloads.items()}
    memory.save(dataclasses.replace(made, bounds=bounds, content=folder.digest_of_cell(found)), work.place.target)


def _forget(target: Path, occupied: list[tuple[int, int]]) -> None:
    """Remove what is known of cells that the scene no longer has."""
    for path in set(memory.files(target)) - {memory.memory_path(target, cell) for cell in occupied}:
        path.unlink(missing_ok=True)


def _check_cap(found: Outline, max_points: int) -> None:
    """Refuse a cap that not even the first level fits under."""
    least = int(np.prod(found.dense.shape))
    if max_points < least:
        place = f"--max-points {max_points}: cell {found.cell[0]},{found.cell[1]}"
        raise SettingsError(f"{place} has {least} first-level voxels; allow as many data points at least")


def _part_of(show: Callable[[float], bool], attempt: int) -> Callable[[float], bool]:
    """Progress of one of several attempts: each takes half of what is left."""
    return lambda share: show(1 - (2 - share) / 2 ** (attempt + 1))


def _write(work: _Work, cell: tuple[int, int], refined: State, limit: int = 0, early: bool = False) -> int:
    """Fit the data of a cell and write its files; their bytes."""
    light = fitted(work.scene, refined, work.target.effort.threads) if work.settings.fit else refined.measured.light
    measured, data = refined.measured, refined.data
    corner = np.array([*cell, 0]) * work.grid.cell_size
    dim = shade(refined, light, work.judge) if light.shape[1] else 1.0
    fill = fills(shaded(refined, dim), light, work.judge) if light.shape[1] else None
    planes = of_cell(data.planes, data.plane, data.position, corner, dim, fill)
    payloads = split(work.scene, light)
    work.arriving[cell] = {name for name, part in payloads.items() if part.any()}
    return work.place.write_cell(refined.tree, payloads, measured.valid, measured.offset, planes, limit, early)


def _list(cells) -> str:
    """Cells as the command line writes them; of many only the first."""
    text = "/".join(f"{i},{j}" for i, j in cells[:LISTED])
    return text + (" ..." if len(cells) > LISTED else "")


__all__ = ["CancelledError", "Outcome", "bake", "bake_hash"]
