"""The one place that knows how a bake interpolates and where its data points lie; the benchmarks ask here.

Comes in: a loaded bake, points and normals. Goes out: which data points light each point and with what weights, where
these data points are, and irradiance from any nine harmonics at them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from gi_volumes.bake import datapoints
from gi_volumes.tree import folder, harmonics
from gi_volumes.tree.cells import OFFSET_STEPS
from gi_volumes.tree.interpolate import weigh
from gi_volumes.tree.world import World


@dataclass(frozen=True)
class Stencil:
    """Data points that light surface points.

    used : (m,) int64, global indices of all data points that count somewhere
    place : (n, k) int64, rows of `used` for each point
    weight : (n, k) float64, 0 where there is no data point
    functions : (n, 9) float32, harmonics of the normals
    """

    used: np.ndarray
    place: np.ndarray
    weight: np.ndarray
    functions: np.ndarray

    def irradiance(self, values: np.ndarray) -> np.ndarray:
        """Interpolate and evaluate as the bake does.

        Parameters
        ----------
        values : (m, 9, 3) float32 ndarray
            Irradiance coefficients at the used data points [W/m2].

        Returns
        -------
        (n, 3) float64 ndarray
            Irradiance, not negative [W/m2].
        """
        total = np.zeros((len(self.weight), *values.shape[1:]))
        for column in range(self.weight.shape[1]):
            total += self.weight[:, column, None, None] * values[self.place[:, column]]
        return evaluate(self.functions, total)

    def mean(self, feature: np.ndarray) -> np.ndarray:
        """Weighted mean of a number over the data points of each point.

        Parameters
        ----------
        feature : (m,) ndarray
            A number for each used data point.

        Returns
        -------
        (n,) float64 ndarray
            0 where nothing counts.
        """
        return np.einsum("nk,nk->n", self.weight, np.asarray(feature, np.float64)[self.place])


@dataclass(frozen=True)
class Sites:
    """Where data points lie.

    position : (3, m) float32, relative to the scene's origin [m]
    key : (m,) uint32, their random keys
    level : (m,) int64
    moved : (m,) bool, whether they were moved out of a wall
    """

    position: np.ndarray
    key: np.ndarray
    level: np.ndarray
    moved: np.ndarray


def evaluate(functions: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Irradiance from coefficients.

    Parameters
    ----------
    functions : (n, k) ndarray
        Harmonics of the normals.
    coefficients : (n, k, 3) ndarray
        Irradiance coefficients [W/m2].

    Returns
    -------
    (n, 3) float64 ndarray
        Clamped at 0.
    """
    return np.maximum(np.einsum("nk,nkc->nc", functions, coefficients, dtype=np.float64), 0.0)


def stencil(world: World, points: np.ndarray, normals: np.ndarray) -> Stencil:
    """Ask a bake how it interpolates.

    Parameters
    ----------
    world : World
        The bake.
    points : (n, 3) float64 ndarray
        World space [m].
    normals : (n, 3) float64 ndarray
        Unit vectors.

    Returns
    -------
    Stencil
        What its `irradiance` uses.
    """
    row, weight = weigh(world._data, world.grid.to_local(points), normals)
    used, place = np.unique(np.where(weight > 0, row, -1), return_inverse=True)
    place = place.reshape(row.shape)
    if len(used) and used[0] < 0:
        used, place = used[1:], np.maximum(place - 1, 0)
    return Stencil(used, place, np.where(weight > 0, weight, 0.0), harmonics.basis(normals))


def sites(path: str | os.PathLike, world: World, used: np.ndarray) -> Sites:
    """Find where data points lie.

    Parameters
    ----------
    path : str or Path
        The bake's folder.
    world : World
        The same, loaded.
    used : (m,) int64 ndarray
        Global indices.

    Returns
    -------
    Sites
        As they were when they were baked.
    """
    cells = [folder.read_cell(path, tuple(entry["cell"])) for entry in world.header["cells"]]
    voxels = [cell.topology.voxels() for cell in cells]
    level = np.concatenate([found[0] for found in voxels])[used].astype(np.int64)
    coords = np.concatenate([found[1] for found in voxels])[used]
    offset = np.concatenate([cell.offset for cell in cells])[used]
    size = np.asarray(world.grid.voxel_size(level), np.float64)
    position = world.grid.centers(level, coords) + offset.astype(np.float64) * (size / OFFSET_STEPS)[:, None]
    key = datapoints.keys(level.astype(np.uint8), coords)
    return Sites(np.ascontiguousarray(position.T.astype(np.float32)), key, level, offset.any(axis=1))
