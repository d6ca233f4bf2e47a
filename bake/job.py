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
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..tree import build, folder
from ..tree.grid import FIRST_SIZE, Grid
from ..tree.topology import Topology
from . import changes, memory, probe_job, snapshot_file, summary
from .cell_job import History, Work, bake_cell, list_of, look_early
from .check import Check
from .deadline import Deadline
from .gather import Effort
from .parallel import CancelledError, Room, run_jobs
from .place import Place, check_target
from .probe_job import Made, Wish
from .progress import Progress
from .reference import sun_strength
from .refine import Target
from .scene import Model, Scene, prepare
from .settings import (
    LEVELS,
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
from .survey import Judge

FORMAT = "gi_volumes bake 4"
"""Part of every bake's hash: files of another definition are baked anew."""

TOGETHER = 3 << 17
"""Most voxels that geometry lists in cells that are baked at once, as memory is bounded: a large cell and a half."""

EARLY_LEVELS = 2
"""Levels of an early look: voxels of 2 m at human scale."""

WHITE = np.array([[np.sqrt(4 * np.pi)] * 3] + [[0.0] * 3] * 8)
"""Harmonics of a sky of radiance 1 W/(m2 sr)."""

STEPS = 1000
"""Units of progress in a cell."""


def bake(
    snapshot: Snapshot,
    target: Path,
    settings: Settings,
    cells: list[tuple[int, int]] | None = None,
    manner: Manner | None = None,
    progress: Progress | None = None,
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
    manner : Manner, optional
        How to go about it; as usual when left out.
    progress : Progress, optional
        Where to say how far it is.

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
    progress, manner = progress or Progress(), manner or Manner()
    deadline = Deadline(manner.seconds)
    check_scene(snapshot)
    check_target(target)
    progress.stage("Preparing")
    effective, light = model(snapshot, settings)
    identity = bake_hash(effective, settings, light, manner.incremental)
    scene = prepare(effective, light)
    check_triangles(scene.soup.corners)
    levels = LEVELS if settings.error else LEVELS - 1
    grid = choose_grid(scene.soup.corners, snapshot.origin, settings.finest, levels)
    occupied = [tuple(int(v) for v in cell) for cell in build.occupied_cells(scene.soup.corners, grid)]
    header = summary.header(snapshot, settings, scene, grid, identity) | {"expected_cells": occupied}
    wanted = _in_view(snapshot, grid, _wanted(cells, occupied))
    place = Place(target, snapshot, header, manner.incremental)
    effort = Effort(settings.samples, settings.bounces, settings.seed, manner.threads)
    goal = Target(settings.error, settings.max_points, settings.dilation, effort, settings.receiver_samples)
    room = Room(TOGETHER)
    judge = _judge(snapshot, settings, scene)
    history = None
    if manner.incremental:
        history = History(_rules(settings, scene, grid), changes.causes(effective, scene, judge))
    work = Work(scene, grid, place, settings, judge, goal, room, history, deadline)
    try:
        if manner.seconds or (manner.early and place.taken):
            _look_early(work, wanted, progress)
        trees = _bake_cells(work, wanted, progress)
        place.take()
        _forget(target, occupied)
    finally:
        listed = [entry for entry in place.close() if not entry.get("early") or tuple(entry["cell"]) in work.cut]
    probes, no_probes = _make_probes(work, manner.probes, listed, len(occupied) - len(listed), progress)
    outcome = summary.describe(snapshot, settings, scene, trees, no_probes)
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
    if work.cut:
        text = "time was too short for {} of {} cells ({}): a bake with more of it refines them to the end"
        outcome.warnings.append(text.format(len(work.cut), len(wanted), list_of(sorted(work.cut))))
    if len(listed) < len(occupied):
        outcome.warnings.append(f"{len(occupied) - len(listed)} of the scene's {len(occupied)} cells are not baked yet")
    outcome.folder = str(target.absolute())
    outcome.seconds = progress.seconds
    outcome.rays = scene.tracer.rays
    outcome.bytes = summary.file_sizes(listed) | {"probes": probes.bytes}
    if not no_probes:
        outcome.probes = {"count": probes.count, "rays": probes.rays, "noise": probes.noise}
        if probes.count < manner.probes.count and not manner.probes.least_gain:
            outcome.warnings.append(f"{manner.probes.count} reflection probes were asked for: {probes.why}")
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
class Manner:
    """How a bake goes about its work; unless time runs out, what is there in the end is the same.

    threads : int, worker threads; 0 uses every core
    early : bool, whether to write a coarse look at every cell first, within seconds, for those who watch the folder;
        not where it would take the place of another bake
    incremental : bool, whether to keep what is measured in files of its own, and to measure again only what has changed
        since an earlier bake of the folder kept it
    seconds : float, time after which cells are not refined any further [s], 0 for no limit; all cells have an early
        look before. Not together with `incremental`
    probes : Wish, which reflection probes to make once all cells are there; None for none
    """

    threads: int = 0
    early: bool = False
    incremental: bool = False
    seconds: float = 0.0
    probes: Wish | None = None


def _rules(settings: Settings, scene: Scene, grid: Grid) -> str:
    """Digest of all that has to be the same for an earlier bake to be of use."""
    words = dataclasses.asdict(settings) | {"sun": len(scene.model.suns.toward), "sky": scene.model.sky}
    return memory.digest(FORMAT, sorted(words.items()), grid, scene.has_local)


def _wanted(cells: list[tuple[int, int]] | None, occupied: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The cells that were asked for, all of them with geometry."""
    empty = sorted(set(cells or ()) - set(occupied))
    if empty:
        raise SettingsError(f"--cells {list_of(empty)}: no geometry there; this scene has cells {list_of(occupied)}")
    return occupied if cells is None else sorted(set(cells))


def _in_view(snapshot: Snapshot, grid: Grid, cells: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Cells in the order in which they are baked: those close to the camera first."""
    place = np.array(grid.origin[:2]) + grid.cell_size / 2
    if snapshot.cameras:
        place = np.array(snapshot.cameras[0].world_from_camera).reshape(3, 4)[:2, 3]
    middle = np.array(grid.origin[:2]) + (np.array(cells, np.float64).reshape(-1, 2) + 0.5) * grid.cell_size
    return [cells[row] for row in np.argsort(((middle - place) ** 2).sum(axis=1), kind="stable")]


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
    def of(cls, tree: Topology, is_cut: bool) -> _Counts:
        """What time was too short for is left out neither by the cap nor by anything else."""
        return cls(tree.size, tree.dilated, 0 if is_cut else tree.left_out)


def _look_early(work: Work, cells: list[tuple[int, int]], progress: Progress) -> None:
    """Early looks at cells, where there are none of this bake."""
    progress.stage("First look", len(cells))
    grid = dataclasses.replace(work.grid, levels=min(EARLY_LEVELS, work.grid.levels))
    done, lock = itertools.count(1), threading.Lock()

    def look(number: int) -> None:
        if folder.bake_of_cell(work.place.target, cells[number]) != work.place.identity:
            look_early(work, cells[number], grid)
        with lock:
            progress.show(next(done))

    run_jobs(look, len(cells), work.target.effort.threads)
    work.place.list_cells()


def _bake_cells(work: Work, cells: list[tuple[int, int]], progress: Progress) -> list[_Counts]:
    """All cells, some of them at once, of which nothing stays in memory; the ones already there are only read."""
    progress.stage("Baking", STEPS * len(cells))
    done, lock = [0] * len(cells), threading.Lock()

    def show(number: int, share: float) -> bool:
        with lock:
            done[number] = int(share * STEPS)
            return progress.show(sum(done))

    def bake_one(number: int) -> _Counts:
        cell, target, identity = cells[number], work.place.target, work.place.identity
        is_there = folder.has_cell(target, cell, identity)
        is_late = not is_there and not work.deadline.left and folder.bake_of_cell(target, cell) == identity
        if is_late:
            work.cut.add(cell)
        if is_there or is_late:
            tree = folder.read_cell(target, cell).topology
        else:
            tree = bake_cell(work, cell, lambda share: show(number, share))
        show(number, 1.0)
        return _Counts.of(tree, cell in work.cut)

    return run_jobs(bake_one, len(cells), work.target.effort.threads)


def _make_probes(work: Work, wish: Wish | None, listed: list[dict], missing: int, progress: Progress):
    """Reflection probes (Made), and why there are none; older ones go where there are to be none."""
    settings, target = work.settings, work.place.target
    effort = Effort(0, settings.bounces, settings.seed, work.target.effort.threads)
    trusted = settings.method == "cache" and not any(entry.get("by_paths") for entry in listed)
    job = probe_job.Job(work.scene, work.grid, target, work.judge.mean, wish or Wish(), effort, trusted)
    why = probe_job.why_none(job) if wish else "none were asked for"
    if missing and wish:
        why = f"{missing} of the scene's cells are not baked yet, and probes look at all of them"
    elif why and not missing:
        probe_job.remove(target)
    elif not (why or work.deadline.left or probe_job.is_made(job)):
        why = "the time was too short"
    if why:
        return Made(0, 0), why
    progress.stage("Probes", STEPS)
    made = probe_job.run(job, lambda share: progress.show(int(share * STEPS)))
    return made, "" if made.count else made.why


def _forget(target: Path, occupied: list[tuple[int, int]]) -> None:
    """Remove what is known of cells that the scene no longer has."""
    for path in set(memory.files(target)) - {memory.memory_path(target, cell) for cell in occupied}:
        path.unlink(missing_ok=True)


__all__ = ["CancelledError", "Manner", "Outcome", "bake", "bake_hash"]
