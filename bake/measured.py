"""Light measured at the data points of a tree that grows: what is known is kept, what is new is traced.

Comes in: a tree, and what an earlier tree of the same cell had. Goes out: position, validity and coefficients of
every voxel, in the order of the tree. A voxel's measure depends on the voxel alone, not on when it was asked for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree.cells import OFFSET_STEPS
from ..tree.grid import Grid
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
    """

    level: np.ndarray
    coords: np.ndarray
    offset: np.ndarray
    valid: np.ndarray
    light: np.ndarray


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


def measure(
    scene: Scene,
    grid: Grid,
    tree: Topology,
    effort: Effort,
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
    effort : Effort
        Paths per data point.
    known : Measured, optional
        What has been measured already with the same effort.
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
    """
    level, coords = tree.voxels()
    row = _rows_in(known, level, coords)
    new = np.flatnonzero(row < 0)
    fresh = _trace(scene, grid, level[new], coords[new], effort, progress)
    out = Measured(level, coords, *(np.empty((tree.size, *part.shape[1:]), part.dtype) for part in fresh))
    for target, part, name in zip((out.offset, out.valid, out.light), fresh, ("offset", "valid", "light"), strict=True):
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
    return Measured(measured.level, measured.coords, *parts)


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


def _trace(scene: Scene, grid: Grid, level: np.ndarray, coords: np.ndarray, effort: Effort, progress):
    """(offset, valid, light) of some voxels."""
    size = np.asarray(grid.voxel_size(level.astype(np.int64)), np.float64)
    key = datapoints.keys(level, coords)
    placed = datapoints.place(scene, grid.centers(level, coords), size, key, effort.threads)
    light = np.zeros((len(level), functions(scene), 9, 3), np.float32)
    rows = np.flatnonzero(placed.valid)
    order = rows[datapoints.morton_order(placed.position[:, rows])]
    if light.shape[1]:
        position = np.ascontiguousarray(placed.position[:, order])
        show = progress and (lambda done: progress(done / max(len(order), 1)))
        light[order] = stack(scene, gather(scene, HarmonicsSensor(), position, key[order], effort, show))
    return placed.offset, placed.valid, light


def _rows_in(known: Measured | None, level: np.ndarray, coords: np.ndarray) -> np.ndarray:
    """Row of each voxel in what is known, -1 for those that are new."""
    out = np.full(len(level), -1)
    for own in np.unique(level) if known is not None else ():
        there, here = np.flatnonzero(known.level == own), np.flatnonzero(level == own)
        row = finder(known.coords[there])(coords[here])
        out[here[row >= 0]] = there[row[row >= 0]]
    return out
