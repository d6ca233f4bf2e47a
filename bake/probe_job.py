"""The reflection probes of a bake, from its cells to `probes.exr` and its entry in `world.json`.

Comes in: a scene, the folder of its bake, what is asked for. Goes out: probes where they show most (`probes.py`), and
what they see (`capture.py`). A file that was made of the same input is kept; a new one takes its place at once or not
at all. Surface caches are those of cells: around a cell, or one for a scene that is no larger than a cell.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..tree import folder, probe_cells, probe_file, probe_maps
from ..tree.cells import TREE, cell_path, read_cell, read_tree
from ..tree.grid import Grid
from ..tree.interpolate import join
from ..tree.probe_atlas import Layout
from ..tree.probe_sets import KIND
from ..tree.topology import Topology
from . import radiosity
from .capture import FIRST_RAYS, HALVES, Spending, Studio, shoot
from .gather import Effort
from .glossiness import ROUGH, glossy_share
from .lit_patches import are_lit
from .patches import Forest
from .probe_visibility import see
from .probes import LEAST_GAIN, Request, place
from .scene import Scene
from .settings import ERRORS, Settings

__all__ = ["AUTOMATIC", "Job", "Made", "Wish", "is_made", "probe_bytes", "remove", "run", "spending_of", "why_none"]

FORMAT = "gi_volumes probes 1"
"""Part of every file's hash: probes of another definition are captured anew."""

PLACED, CACHED, SEEN = 0.1, 0.1, 0.05
"""Parts of the progress that placing and the surface caches take, and finding out which probes count where."""

WORTH = 1 << 23
"""Rays of a cell's probes below which paths are followed to their end. A surface cache takes 4 to 17 s, and saves a
fifth of a probe's time outdoors, a third to two fifths in dim interiors: it pays from 5 probes in sponza on, from some
60 outdoors."""

AUTOMATIC = 32.0
"""Most that maps take where nobody says otherwise [MB]: 51 probes with parts for lamps, a sun and a sky, which are
captured in about the time that the cells take."""

LEAST_GLOSSY = 0.01
"""Part of the surfaces that has to be glossy for probes to be made where nobody asks for them."""

PATHS = 2
"""Paths of a data point for each ray of a texel, at most."""

SURFACE_BYTES = 2 + 6 + 6
"""Distance, normal and albedo of a texel."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What is asked for.

    count : most probes, pinned ones among them
    megabytes : most that all maps take in memory, as textures of half precision [MB]; None for no limit
    least_gain : as in `probes.Request`
    spending : Spending, how good maps are to be
    pinned : (m, 3) float64, probes that are there anyway, world coordinates [m]
    deleted : (b, 2, 3) float64, lowest and highest corners of boxes that get no others, world coordinates [m]
    only_if_glossy : whether there are to be none but pinned ones where hardly any surface shows reflections
    """

    count: int = 1000
    megabytes: float | None = None
    least_gain: float = LEAST_GAIN
    spending: Spending = field(default_factory=Spending)
    pinned: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    deleted: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    only_if_glossy: bool = False


@dataclass(frozen=True, eq=False)
class Job:
    """All that probes are made of.

    scene : Scene, without a cache, with the light that the bake models
    grid : Grid, the bake's lattice
    target : Path, its folder, with the cells that are finished
    mixture : (parts, 3) float64, as in `capture.Studio`
    wish : Wish
    effort : Effort, bounces, seed, threads
    cached : bool, whether paths end in surface caches, where the bake's checks have found nothing wrong with them
    """

    scene: Scene
    grid: Grid
    target: Path
    mixture: np.ndarray
    wish: Wish
    effort: Effort
    cached: bool

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts of radiance."""
        model = self.scene.model
        return probe_maps.part_names(self.scene.has_local, len(model.suns.toward), model.sky_count)


@dataclass(frozen=True)
class Made:
    """What became of it.

    count : probes
    bytes : length of the file, and of those that say which probes count where
    why : why there are no more, in words
    kept : whether the file was there
    rays, noise : mean number of rays of a texel, and root mean square of what they left, as `capture.Spending` has it
    """

    count: int
    bytes: int
    why: str = ""
    kept: bool = False
    rays: float = 0.0
    noise: float = 0.0


def spending_of(settings: Settings) -> Spending:
    """Say how good maps are to be.

    Parameters
    ----------
    settings : Settings
        Of the bake.

    Returns
    -------
    Spending
        Half of its error, as noise of a mirror shows; with at most half as many rays as a data point has paths.
    """
    error = (settings.error or ERRORS["preview"]) / 2
    return Spending(error, max(settings.samples // PATHS, HALVES * FIRST_RAYS))


def why_none(job: Job) -> str:
    """Say why a bake needs no probes.

    Parameters
    ----------
    job : Job
        What they would be made of.

    Returns
    -------
    str
        In words; empty where it does.
    """
    if not job.parts:
        return "there is no light to reflect"
    return "" if len(job.wish.pinned) else _dullness(job)


def run(job: Job, show: Callable[[float], bool] = lambda share: True) -> Made:
    """Make the probes of a bake, unless they are there.

    Parameters
    ----------
    job : Job
        What they are made of; finished cells lie in its folder.
    show : callable
        Called with the part that is done, 0 to 1, from the calling thread; returns False to stop.

    Returns
    -------
    Made
        How many, how large, how good; `probes.exr` and `world.json` are written.

    Raises
    ------
    RequestError
        The wish makes no sense.
    FileError, OSError
        A cell cannot be read, or the file cannot be written; an older one stays.
    CancelledError
        `show` returned False; an older file stays.
    """
    header = folder.load_header(job.target)
    trees = tuple(_trees(job.target, header))
    made = _digest(job, trees)
    kept = probe_file.made_of(job.target, header["bake"]) == made
    if not kept:
        _capture(job, trees, header["bake"], made, _part_of(show, 0, 1 - SEEN))
    _see_all(job, folder.list_again(job.target), _part_of(show, 1 - SEEN, SEEN))
    listed = folder.list_again(job.target)
    said, file = listed["probes"]["said"], listed["probes"]["file"]
    size = file["bytes"] + sum(entry["files"].get("probes", {"bytes": 0})["bytes"] for entry in listed["cells"])
    return Made(len(listed["probes"]["positions"]), size, said["why"], kept, said["rays"], said["noise"])


def is_made(job: Job) -> bool:
    """Say whether a bake has its probes.

    Parameters
    ----------
    job : Job
        What they would be made of.

    Returns
    -------
    bool
        Whether there is a whole file of just these; which of them count where may be missing.

    Raises
    ------
    FileError, OSError
        A cell cannot be read.
    """
    header = folder.load_header(job.target)
    return probe_file.made_of(job.target, header["bake"]) == _digest(job, tuple(_trees(job.target, header)))


def remove(target: Path) -> None:
    """Remove the probes of a bake.

    Parameters
    ----------
    target : Path
        Its folder; other programs' files stay.

    Raises
    ------
    OSError
        A file cannot be removed.
    """
    paths = [path for path in folder.files(target) if path.name == probe_file.PROBES or path.suffix == f".{KIND}"]
    for path in sorted(paths, key=lambda path: path.suffix == f".{KIND}"):
        path.unlink(missing_ok=True)
    if paths:
        folder.list_again(target)


def _capture(job: Job, trees: tuple[Topology, ...], bake: str, made: str, show: Callable[[float], bool]) -> None:
    """Place probes, and write what they see."""
    placed = place(job.scene, Forest(job.grid, trees), _request(job), job.effort, _part_of(show, 0, PLACED))
    maps = probe_maps.empty(placed.position + job.scene.origin, placed.pinned, job.wish.spending.pitch, job.parts)
    studio = Studio.of(maps, job.mixture, job.wish.spending, job.effort)
    _shoot_all(job, studio, trees, _part_of(show, PLACED, 1 - PLACED))
    rays, noise = (part if len(part) else np.zeros(1) for part in (studio.rays, studio.noise))
    said = {"why": placed.reason, "rays": float(rays.mean()), "noise": float(np.sqrt((noise**2).mean()))}
    probe_file.write(job.target, maps, bake, made, said)


def _see_all(job: Job, listed: dict, show: Callable[[float], bool]) -> None:
    """Write which of the listed probes count where, for cells that do not say so yet."""
    bake, made = listed["bake"], listed["probes"]["made"]
    place = np.array(listed["probes"]["positions"], np.float64).reshape(-1, 3) - job.scene.origin
    cells = [tuple(entry["cell"]) for entry in listed["cells"] if not entry.get("early")]
    for number, name in enumerate(cells):
        if probe_cells.is_of(probe_cells.path_of(job.target, name), bake, made):
            continue
        cell = read_cell(job.target, name)
        data = join(job.grid, [cell.topology], cell.offset, cell.valid)
        part = _part_of(show, number / len(cells), 1 / len(cells))
        count = max(int(cell.valid.sum()), 1)
        sets = see(job.scene, data, place, job.effort, lambda done, part=part, count=count: part(done / count))
        probe_cells.write(job.target, cell, sets, made)


def probe_bytes(pitch: int, parts: int) -> int:
    """Say what a probe takes in memory.

    Parameters
    ----------
    pitch : int
        Width of a tile [texels].
    parts : int
        Parts of radiance.

    Returns
    -------
    int
        Of all levels in half precision, and of the surfaces behind the first one [bytes]; files are smaller.

    Examples
    --------
    >>> probe_bytes(128, 3)
    622208
    """
    return Layout(pitch, 1, 1).texels * parts * 6 + pitch * pitch * SURFACE_BYTES


def _trees(target: Path, header: dict) -> Iterator[Topology]:
    """The trees of the bake's cells that are there to stay."""
    for entry in header["cells"]:
        if not entry.get("early"):
            yield read_tree(cell_path(target, tuple(entry["cell"]), TREE))[0]


def _digest(job: Job, trees: tuple[Topology, ...]) -> str:
    """Hash of all that probes depend on besides the bake."""
    wish, effort = job.wish, job.effort
    asked = [wish.count, wish.megabytes, wish.least_gain, wish.spending.error, wish.spending.most, wish.spending.pitch]
    asked += [wish.only_if_glossy]
    asked += [np.asarray(wish.pinned, np.float64).tolist(), np.asarray(wish.deleted, np.float64).tolist()]
    done = [effort.bounces, effort.seed, job.cached, [tree.cell for tree in trees]]
    return hashlib.blake2b(json.dumps([FORMAT, asked, done]).encode(), digest_size=16).hexdigest()


def _dullness(job: Job) -> str:
    """Why surfaces ask for no probes; empty where they do, or where that does not count."""
    share = glossy_share(job.scene) if job.wish.only_if_glossy else 1.0
    if share >= LEAST_GLOSSY:
        return ""
    return f"{100 * share:.1f} % of all surfaces are smoother than roughness {ROUGH}; --probes N makes them anyway"


def _request(job: Job) -> Request:
    """The wish in the terms of placement."""
    wish, size = job.wish, probe_bytes(job.wish.spending.pitch, len(job.parts))
    pinned, deleted = (np.asarray(part, np.float64) - job.scene.origin for part in (wish.pinned, wish.deleted))
    counts = functools.partial(are_lit, job.scene, job.effort) if job.parts else None
    count = len(pinned) if _dullness(job) else wish.count
    return Request(count, wish.megabytes, size, wish.least_gain, pinned, deleted, counts)


def _shoot_all(job: Job, studio: Studio, trees: tuple[Topology, ...], show: Callable[[float], bool]) -> None:
    """Fill all maps, cell by cell where a surface cache holds no more than a cell."""
    done, total = 0, len(studio.maps.position)
    for box, rows in _groups(job, studio, trees):
        _shoot_some(job, studio, box, rows, _part_of(show, done / total, len(rows) / total))
        done += len(rows)


def _part_of(show: Callable[[float], bool], first: float, share: float) -> Callable[[float], bool]:
    """Progress of a part of the work."""
    return lambda part: show(first + share * part)


def _shoot_some(job: Job, studio: Studio, box: np.ndarray | None, rows: np.ndarray, show) -> None:
    """Fill maps that share a surface cache, if there is to be one: how many rays the first probe takes by paths says
    whether it is worth it for the others."""
    scene, done, rest = job.scene, 1 / len(rows), rows[1:]
    shoot(scene, studio, rows[:1], lambda count: show(done * count))
    rays = float(studio.rays[rows[0]]) * studio.maps.layout.sizes[0] ** 2 * len(rest)
    if box is not None and len(rest) and rays >= WORTH:
        part = CACHED * (1 - done)
        scene, done = radiosity.around(scene, job.grid, box, job.effort, _part_of(show, done, part)), done + part
    shoot(scene, studio, rest, lambda count: show(done + (1 - done) * count / len(rest)))


def _groups(job: Job, studio: Studio, trees: tuple[Topology, ...]) -> Iterator[tuple[np.ndarray | None, np.ndarray]]:
    """Boxes for surface caches, None where there can be none, and the probes that look from there."""
    rows = np.arange(len(studio.maps.position))
    if radiosity.is_shared(job.scene, job.grid):
        boxes, owner = [radiosity.whole(job.scene)], np.zeros(len(rows), np.int64)
    else:
        boxes = [radiosity.of_cell(job.grid, tree) for tree in trees]
        owner = _owners(job.grid, studio.maps.position - job.scene.origin, trees)
    for number in np.unique(owner):
        yield boxes[number] if job.cached and number >= 0 else None, rows[owner == number]


def _owners(grid: Grid, position: np.ndarray, trees: tuple[Topology, ...]) -> np.ndarray:
    """(k,) number of the tree whose cell each place lies in; -1 for none."""
    cell = np.floor(position[:, :2] / grid.cell_size).astype(np.int64)
    number = {tuple(tree.cell): row for row, tree in enumerate(trees)}
    return np.array([number.get(tuple(pair), -1) for pair in cell.tolist()], np.int64)
