"""Light measured at the data points of a tree that grows: what is known is kept, what is new is traced.

Comes in: a tree, and what an earlier tree of the same cell had. Goes out: position, validity and coefficients of
every voxel, in the order of the tree. A voxel's paths depend on the voxel alone, their number on its parent's noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree.cells import OFFSET_STEPS
from ..tree.grid import BRANCH, Grid
from ..tree.region import finder
from ..tree.topology import Topology
from . import datapoints
from .gather import Effort, Gathered, gather
from .scene import Scene
from .sensors import HarmonicsSensor


@dataclass(frozen=True, eq=False)
class Measured:
    """Data points of one cell.

    level : (n,) uint8, coords : (n, 3) int64, the voxels
    offset : (n, 3) int8, data point minus voxel centre in steps of the voxel size / 254
    valid : (n,) bool, False inside walls
    light : (n, functions, 9, 3) float32, irradiance harmonics of every modelled function; zero where not valid
    noise : (n, views) float32, standard error of the first harmonic of each transport, relative to it, had the voxel as
        many paths as those of the first level; zero likewise
    paths : (n,) int32, how many it had
    """

    level: np.ndarray
    coords: np.ndarray
    offset: np.ndarray
    valid: np.ndarray
    light: np.ndarray
    noise: np.ndarray
    paths: np.ndarray


DARK = 0.1
"""Noise counts relative to the light at a data point, and to this part of the first level's mean where it is darker."""

DOUBLINGS = (-2, 1)
"""A quarter of the paths for the least noisy data points, twice as many for the noisiest."""

FEWEST = 32
"""Paths that a data point has at least, unless all have fewer."""

FAINT = 1e-3
"""Least light that noise is relative to, in that noise."""

BRANCH_BITS = BRANCH.bit_length() - 1
"""Binary digits of a coordinate that one level adds."""

PARTS = tuple(field.name for field in dataclasses.fields(Measured))[2:]
"""What is measured of a voxel."""


def take(measured: Measured, rows: np.ndarray) -> Measured:
    """Choose some data points.

    Parameters
    ----------
    measured : Measured
        Data points.
    rows : (m,) int64 or (n,) bool ndarray
        Which.

    Returns
    -------
    Measured
        Copies.
    """
    return Measured(*(getattr(measured, field.name)[rows] for field in dataclasses.fields(Measured)))


def join(one: Measured, other: Measured) -> Measured:
    """Put data points together.

    Parameters
    ----------
    one, other : Measured
        Data points of different voxels.

    Returns
    -------
    Measured
        All of them.
    """
    names = [field.name for field in dataclasses.fields(Measured)]
    return Measured(*(np.concatenate([getattr(part, name) for part in (one, other)]) for name in names))


@dataclass(frozen=True, eq=False)
class Sampling:
    """How many paths data points get: more where light is noisy.

    effort : Effort, as for the first level
    views : (v, functions, 3) float64, mixtures of functions that noise is judged in: one for each transport
    aim : float, the noise to aim at, relative to the light there; 0 gives all data points the same number
    """

    effort: Effort
    views: np.ndarray
    aim: float


def measure(
    scene: Scene,
    grid: Grid,
    tree: Topology,
    sampling: Sampling,
    known: Measured | None = None,
    progress: Callable[[float], bool] | None = None,
) -> Measured:
    """Measure light at every data point of a tree.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    grid : Grid
        The lattice.
    tree : Topology
        The cell.
    sampling : Sampling
        Paths per data point.
    known : Measured, optional
        What has been measured already in the same way.
    progress : callable, optional
        Called with the part of the new data points that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Measured
        In the order of the tree's indices.

    Raises
    ------
    CancelledError
        `progress` returned False.

    Notes
    -----
    Error: a data point's number of paths follows from its parent's noise. Its own would not do: who stops when all
    looks even has missed what is rare, so that the mean would be too dark.
    """
    level, coords = tree.voxels()
    row = _rows_in(known, level, coords)
    new = np.flatnonzero(row < 0)
    count = _counts(known, level[new], coords[new], sampling)
    fresh = _trace(scene, grid, (level[new], coords[new], count), sampling, progress)
    out = Measured(level, coords, *(np.empty((tree.size, *part.shape[1:]), part.dtype) for part in fresh))
    for name, part in zip(PARTS, fresh, strict=True):
        target = getattr(out, name)
        target[new] = part
        if known is not None:
            target[row >= 0] = getattr(known, name)[row[row >= 0]]
    return out


def moved_light(
    scene: Scene, grid: Grid, measured: Measured, rows: np.ndarray, offset: np.ndarray, effort: Effort
) -> np.ndarray:
    """Measure light elsewhere in some voxels.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    grid : Grid
        The lattice.
    measured : Measured
        A cell.
    rows : (m,) int64 ndarray
        Which data points.
    offset : (m, 3) int8 ndarray
        Where, in free space: data point minus voxel centre in steps of the voxel size / 254.
    effort : Effort
        As they were measured before.

    Returns
    -------
    (m, functions, 9, 3) float32 ndarray
        Irradiance harmonics there.
    """
    level, coords = measured.level[rows], measured.coords[rows]
    if not (len(rows) and functions(scene)):
        return np.zeros((len(rows), functions(scene), 9, 3), np.float32)
    position = _columns(positions(grid, level, coords, offset))
    return stack(scene, gather(scene, HarmonicsSensor(), position, datapoints.keys(level, coords), effort))


def move(measured: Measured, rows: np.ndarray, offset: np.ndarray, light: np.ndarray) -> Measured:
    """Put some data points elsewhere in their voxels.

    Parameters
    ----------
    measured : Measured
        A cell.
    rows : (m,) int64 ndarray
        Which data points.
    offset : (m, 3) int8 ndarray
        Where to.
    light : (m, functions, 9, 3) float32 ndarray
        What was measured there.

    Returns
    -------
    Measured
        The cell with these data points moved, and valid.
    """
    parts = [measured.offset.copy(), measured.valid.copy(), measured.light.copy()]
    for part, new in zip(parts, (offset, True, light), strict=True):
        part[rows] = new
    return Measured(measured.level, measured.coords, *parts, measured.noise, measured.paths)


def positions(grid: Grid, level: np.ndarray, coords: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Say where data points are.

    Parameters
    ----------
    grid : Grid
        The lattice.
    level : (n,) uint8 ndarray
        Levels of voxels.
    coords : (n, 3) int64 ndarray
        Their global coordinates.
    offset : (n, 3) int8 ndarray
        Data point minus voxel centre in steps of the voxel size / 254.

    Returns
    -------
    (n, 3) float64 ndarray
        Relative to the scene's origin [m].
    """
    size = np.asarray(grid.voxel_size(level.astype(np.int64)), np.float64)[:, None]
    return grid.centers(level, coords) + offset.astype(np.float64) * size / OFFSET_STEPS


def _columns(position: np.ndarray) -> np.ndarray:
    """(3, n) float32."""
    return np.ascontiguousarray(position.T.astype(np.float32))


def stack(scene: Scene, found: Gathered) -> np.ndarray:
    """Join the functions of all transports: local, then sun keys, then functions of the sky.

    Parameters
    ----------
    scene : Scene
        Says what is modelled.
    found : Gathered
        n points.

    Returns
    -------
    (n, functions, responses, 3) float32 ndarray
        Only what is modelled; `split` undoes it.
    """
    present = scene.has_local, len(scene.model.suns.toward), scene.model.sky_count
    parts = [found.local[:, None], found.sun, found.sky]
    return np.concatenate([part for part, count in zip(parts, present, strict=True) if count], axis=1)


def split(scene: Scene, light: np.ndarray) -> dict[str, np.ndarray]:
    """Take the functions of all transports apart.

    Parameters
    ----------
    scene : Scene
        Says what is modelled.
    light : (n, functions, ...) ndarray
        As `stack` joins them.

    Returns
    -------
    dict of str to (n, K, ...) ndarray
        By transport: "local", "sun", "sky"; those that are modelled.
    """
    counts = {"local": int(scene.has_local), "sun": len(scene.model.suns.toward), "sky": scene.model.sky_count}
    ends = np.cumsum(list(counts.values()))
    return {name: light[:, end - count : end] for (name, count), end in zip(counts.items(), ends, strict=True) if count}


def functions(scene: Scene) -> int:
    """Count the functions that are modelled.

    Parameters
    ----------
    scene : Scene
        Says what is modelled.

    Returns
    -------
    int
        Local light, sun keys and functions of the sky together.
    """
    return int(scene.has_local) + len(scene.model.suns.toward) + scene.model.sky_count


def _trace(scene: Scene, grid: Grid, voxels: tuple, sampling: Sampling, progress):
    """(offset, valid, light, noise, paths) of some voxels, given as levels, coordinates and numbers of paths."""
    level, coords, count = voxels
    size = np.asarray(grid.voxel_size(level.astype(np.int64)), np.float64)
    key = datapoints.keys(level, coords)
    placed = datapoints.place(scene, grid.centers(level, coords), size, key, sampling.effort.threads)
    light = np.zeros((len(level), functions(scene), 9, 3), np.float32)
    noise = np.zeros((len(level), len(sampling.views)), np.float32)
    sensor, done = HarmonicsSensor(_watched(scene, sampling.views)), 0
    for number in np.unique(count[placed.valid]) if light.shape[1] else ():
        rows = np.flatnonzero(placed.valid & (count == number))
        order = rows[datapoints.morton_order(placed.position[:, rows])]
        show = progress and _share_of(progress, done, len(order), int(placed.valid.sum()))
        effort = dataclasses.replace(sampling.effort, samples=int(number))
        found = gather(scene, sensor, np.ascontiguousarray(placed.position[:, order]), key[order], effort, show)
        light[order], done = stack(scene, found), done + len(order)
        seen = np.maximum(_seen(light[order], sampling.views), FAINT * found.noise)
        noise[order] = found.noise / np.where(seen > 0, seen, 1) * np.sqrt(number / sampling.effort.samples)
    return placed.offset, placed.valid, light, noise, count.astype(np.int32)


def _seen(light: np.ndarray, views: np.ndarray) -> np.ndarray:
    """(n, v) first harmonic of each transport."""
    return np.abs(np.einsum("nfc,vfc->nv", light[:, :, 0], views))


def _share_of(progress: Callable[[float], bool], before: int, count: int, total: int) -> Callable[[int], bool]:
    """Progress of some data points among all that are new."""
    return lambda done: progress((before + done) / max(total, 1))


def _watched(scene: Scene, views: np.ndarray) -> np.ndarray:
    """(v, 1 + keys + functions, 3) mixtures of all channels of paths, of those that are modelled."""
    missing = np.zeros((len(views), 0 if scene.has_local else 1, 3))
    return np.concatenate([missing, views], axis=1)


def _counts(known: Measured | None, level: np.ndarray, coords: np.ndarray, sampling: Sampling) -> np.ndarray:
    """(n,) int64 paths for each voxel, by the noise of its parent."""
    base = sampling.effort.samples
    count = np.full(len(level), base)
    if known is None or not sampling.aim:
        return count
    row = _rows_in(known, level.astype(np.int64) - 1, coords >> BRANCH_BITS)
    judged = np.flatnonzero((row >= 0) & known.valid[row]) if len(known.level) else row[:0]
    relative = _relative_noise(known, sampling.views)[row[judged]]
    doublings = np.round(2 * np.log2(np.maximum(relative, 1e-9) / sampling.aim))
    scaled = base * 2.0 ** np.clip(doublings, *DOUBLINGS)
    count[judged] = np.maximum(scaled, min(base, FEWEST)).astype(np.int64)
    return count


def _relative_noise(known: Measured, views: np.ndarray) -> np.ndarray:
    """(n,) noise over light, where each transport counts relative to its mean on the first level: how strong lamps, sun
    and sky are is for others to choose."""
    light = _seen(known.light, views)
    mean = light[known.valid & (known.level == 0)].mean(axis=0) if (known.valid & (known.level == 0)).any() else 0.0
    share = np.divide(1.0, mean, out=np.zeros(light.shape[1]), where=np.broadcast_to(mean, light.shape[1:]) > 0)
    bright, noise = (light * share).sum(axis=1), np.sqrt(((known.noise * light * share) ** 2).sum(axis=1))
    return noise / np.maximum(np.hypot(bright, DARK * np.count_nonzero(share)), 1e-30)


def _rows_in(known: Measured | None, level: np.ndarray, coords: np.ndarray) -> np.ndarray:
    """Row of each voxel in what is known, -1 for those that are new."""
    out = np.full(len(level), -1)
    for own in np.unique(level) if known is not None else ():
        there, here = np.flatnonzero(known.level == own), np.flatnonzero(level == own)
        row = finder(known.coords[there])(coords[here])
        out[here[row >= 0]] = there[row[row >= 0]]
    return out
