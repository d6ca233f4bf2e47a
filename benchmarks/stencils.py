"""The one place that knows how a bake interpolates and where its data points lie; the benchmarks ask here.

Comes in: a loaded bake, points and normals. Goes out: which data points light each point and with what weights, where
these data points are, and irradiance from any nine harmonics at them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gi_volumes.bake import datapoints
from gi_volumes.tree import blend, harmonics
from gi_volumes.tree.interpolate import DataPoints, last_resort, layers
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
    data = world._data
    local = np.ascontiguousarray(blend.clamp(data, world.grid.to_local(points)).T)
    facing = np.ascontiguousarray(normals.T, np.float32)
    parts = list(_taps(data, local, facing, data.grid.levels - 1, np.ones(len(points)), np.arange(len(points))))
    point, row, weight = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    used, place = np.unique(row, return_inverse=True)
    places, weights = _padded(len(points), point, place.reshape(-1), weight)
    return Stencil(used, places, weights, harmonics.basis(normals))


def functions(world: World) -> int:
    """Count the functions of light that a bake holds.

    Parameters
    ----------
    world : World
        The bake.

    Returns
    -------
    int
        Over all transports: one, or one for each sun direction or function of the sky.
    """
    return sum(values.functions for values in world._values.values())


def sites(world: World, used: np.ndarray) -> Sites:
    """Find where data points lie.

    Parameters
    ----------
    world : World
        The bake.
    used : (m,) int64 ndarray
        Global indices.

    Returns
    -------
    Sites
        As they were when they were baked.
    """
    data = world._data
    position = np.ascontiguousarray(data.position[used].T.astype(np.float32))
    key = datapoints.keys(data.level[used], data.coords[used])
    return Sites(position, key, data.level[used].astype(np.int64), data.offset[used].any(axis=1))


def _taps(data: DataPoints, points: np.ndarray, normals: np.ndarray, level: int, share: np.ndarray, which: np.ndarray):
    """(point, row, weight) of every tap with weight: the sums of `blend`, taken apart.

    points : (3, n) [m], normals : (3, n), share : (n,) what the taps' weights sum to, which : (n,) number of the point
    """
    found = list(layers(data, points, normals, level) if level >= 0 else last_resort(data, points))
    total = np.zeros(points.shape[1])
    for part in found:
        total[part.point] += part.weight.sum(axis=0)
    scale = share / np.maximum(total, blend.ENOUGH) if level >= 0 else share
    for part in found:
        corner, column = np.nonzero(part.weight > 0)
        point = part.point[column]
        yield which[point], part.row[corner, column].astype(np.int64), part.weight[corner, column] * scale[point]
    low = np.flatnonzero(total < blend.ENOUGH)
    if level >= 0 and len(low):
        rest = scale[low] * (blend.ENOUGH - total[low])
        yield from _taps(data, points[:, low], normals[:, low], level - 1, rest, which[low])


def _padded(count: int, point: np.ndarray, place: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(count, k) places and weights from a list of taps."""
    order = np.argsort(point, kind="stable")
    taps = np.bincount(point, minlength=count)
    column = np.arange(len(point)) - np.repeat(np.cumsum(taps) - taps, taps)
    places = np.zeros((count, max(1, int(taps.max(initial=0)))), np.int64)
    weights = np.zeros(places.shape)
    places[point[order], column], weights[point[order], column] = place[order], weight[order]
    return places, weights
