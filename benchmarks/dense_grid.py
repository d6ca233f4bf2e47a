"""The comparator: a regular grid of probes with the first four harmonics, as large on disk as a bake.

Comes in: a traced scene and a number of bytes. Goes out: irradiance at surface points by trilinear interpolation over
the valid probes. A probe costs 24 bytes for each function, four coefficients x rgb x float16, and less where zstd finds
something; probes inside walls are left out and the weights of the others renormalised.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from gi_volumes.bake import datapoints
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Scene
from gi_volumes.benchmarks.receivers import FEELERS, sphere
from gi_volumes.benchmarks.stencils import evaluate
from gi_volumes.benchmarks.traced import Traced
from gi_volumes.tree import container, harmonics

COUNT = 4
"""Coefficients of a probe."""

PROBE_BYTES = COUNT * 3 * 2
"""For each function."""

SEED = 77
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)), np.int64)
WIDE = np.array(list(itertools.product((-1, 0, 1, 2), repeat=3)), np.int64)
USABLE = 1e-6
CHUNK = 1 << 13
"""Probes judged at a time: half a million rays."""

MOST_SAMPLED = 40_000
"""Probes of the planes that stand for a larger grid where only its compression is asked for."""


@dataclass(frozen=True)
class DenseGrid:
    """Probes on a cubic lattice over a box.

    low : (3,) float64, the first probe, relative to the scene's origin [m]
    spacing : float [m]
    shape : (3,) int64, probes along x, y, z
    valid : (probes,) bool, not inside a wall
    """

    low: np.ndarray
    spacing: float
    shape: np.ndarray
    valid: np.ndarray

    def position(self, rows: np.ndarray) -> np.ndarray:
        """Where probes are.

        Parameters
        ----------
        rows : (m,) int64 ndarray
            Which.

        Returns
        -------
        (m, 3) float64 ndarray
            Relative to the scene's origin [m].
        """
        return _positions(self.low, self.spacing, self.shape, rows)

    def weigh(self, points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Trilinear weights of the valid probes around points.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            Relative to the scene's origin [m].
        normals : (n, 3) float64 ndarray, optional
            Weights are multiplied by the cosine towards each probe, where any is left then.

        Returns
        -------
        row : (n, 8) int64 ndarray
            Probes; the nearest valid one within 64 where none of the eight is.
        weight : (n, 8) float64 ndarray
            Sum 1.
        """
        place = np.clip((points - self.low) / self.spacing, 0, self.shape - 1.000001)
        base = np.minimum(place.astype(np.int64), np.maximum(self.shape - 2, 0))
        part = place - base
        corners = np.minimum(base[:, None] + CORNERS, self.shape - 1)
        row = corners @ self._strides
        weight = np.where(CORNERS, part[:, None], 1 - part[:, None]).prod(axis=2) * self.valid[row]
        if normals is not None:
            arm = self.position(row.ravel()).reshape(*row.shape, 3) - points[:, None]
            facing = weight * np.maximum(np.einsum("nkc,nc->nk", arm, normals), 0) / np.linalg.norm(arm, axis=2)
            weight = np.where((facing.sum(axis=1) > USABLE)[:, None], facing, weight)
        lost = np.flatnonzero(weight.sum(axis=1) <= USABLE)
        row[lost, 0], weight[lost] = self._nearest(base[lost], points[lost]), 0.0
        weight[lost, 0] = 1.0
        return row, weight / weight.sum(axis=1, keepdims=True)

    @property
    def _strides(self) -> np.ndarray:
        return np.array([self.shape[1] * self.shape[2], self.shape[2], 1])

    def _nearest(self, base: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The nearest valid probe of the 64 around, or any of them."""
        around = np.clip(base[:, None] + WIDE, 0, self.shape - 1) @ self._strides
        arm = self.position(around.ravel()).reshape(*around.shape, 3) - points[:, None]
        distance = np.where(self.valid[around], np.einsum("nkc,nkc->nk", arm, arm), np.inf)
        return np.take_along_axis(around, distance.argmin(axis=1)[:, None], axis=1)[:, 0]


def build(scene: Scene, probes: float, inset: float = 0.5) -> DenseGrid:
    """Lay a grid over the scene's surfaces.

    Parameters
    ----------
    scene : Scene
        A prepared scene.
    probes : float
        At most so many.
    inset : float
        Distance of the outermost probes from the box in spacings: 0.5 puts them at the centres of cubes that fill the
        box, 0 at their corners.

    Returns
    -------
    DenseGrid
        With the smallest spacing that allows.
    """
    low, high = scene.soup.bounds
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    more = 1 - 2 * inset
    fine, coarse = 1e-6 * extent.max(), extent.max() * 2
    for _ in range(60):
        spacing = np.sqrt(fine * coarse)
        fits = np.prod(np.ceil(extent / spacing) + more) <= probes
        fine, coarse = (fine, spacing) if fits else (spacing, coarse)
    shape = (np.ceil(extent / coarse) + more).astype(np.int64)
    low = low - ((shape - 1) * coarse - extent) / 2
    rows = np.arange(np.prod(shape))
    parts = [_are_free(scene, _positions(low, coarse, shape, rows[k : k + CHUNK])) for k in range(0, len(rows), CHUNK)]
    return DenseGrid(low, float(coarse), shape, np.concatenate(parts))


def trace(traced: Traced, grid: DenseGrid, rows: np.ndarray, samples: int) -> dict[str, np.ndarray]:
    """Measure light at probes, and round it to what is stored.

    Parameters
    ----------
    traced : Traced
        The scene.
    grid : DenseGrid
        The probes.
    rows : (m,) int64 ndarray
        Which of them.
    samples : int
        Paths for each.

    Returns
    -------
    dict of str to (m, 4, 3) float16 ndarray
        Irradiance coefficients [W/m2]; zeros for those that are not valid.
    """
    position = np.ascontiguousarray(grid.position(rows).T.astype(np.float32))
    found = traced.harmonics(position, rows.astype(np.uint32), samples, SEED)
    valid = grid.valid[rows][:, None, None]
    return {name: np.where(valid, values[:, :COUNT], 0).astype(np.float16) for name, values in found.items()}


def planes(grid: DenseGrid) -> np.ndarray:
    """Choose probes whose compression stands for the grid's.

    Parameters
    ----------
    grid : DenseGrid
        The probes.

    Returns
    -------
    (m,) int64 ndarray
        All of them, or whole planes of constant x spread over a large grid.
    """
    plane = int(grid.shape[1] * grid.shape[2])
    count = int(np.clip(MOST_SAMPLED // plane, 1, grid.shape[0]))
    chosen = np.unique(np.linspace(0, grid.shape[0] - 1, count).round().astype(np.int64))
    return (chosen[:, None] * plane + np.arange(plane)).ravel()


def ratio(values: dict[str, np.ndarray]) -> float:
    """How far the container's codec compresses probes.

    Parameters
    ----------
    values : dict of str to (probes, 4, 3) float16 ndarray
        Neighbours next to each other.

    Returns
    -------
    float
        Compressed over raw bytes, by the better of two orders: probe after probe, or coefficient after coefficient.
    """
    arrays = {name: array.reshape(-1, COUNT * 3) for name, array in values.items()}
    orders = (arrays, {name: np.ascontiguousarray(array.T) for name, array in arrays.items()})
    return min(len(container.encode("grid", each, {})) for each in orders) / sum(a.nbytes for a in arrays.values())


def irradiance(
    grid: DenseGrid, rows: np.ndarray, values: np.ndarray, points: np.ndarray, normals: np.ndarray, facing: bool
) -> np.ndarray:
    """Look up irradiance.

    Parameters
    ----------
    grid : DenseGrid
        The probes.
    rows : (m,) int64 ndarray
        Sorted: the probes that `values` holds.
    values : (m, 4, 3) float16 ndarray
        Their coefficients [W/m2].
    points : (n, 3) float64 ndarray
        Relative to the scene's origin [m].
    normals : (n, 3) float64 ndarray
        Unit vectors.
    facing : bool
        Whether probes are weighted by the cosine too.

    Returns
    -------
    (n, 3) float64 ndarray
        Irradiance [W/m2].
    """
    row, weight = grid.weigh(points, normals if facing else None)
    place = np.minimum(np.searchsorted(rows, row), len(rows) - 1)
    coefficients = np.einsum("nk,nkjc->njc", weight, values[place].astype(np.float64))
    return evaluate(harmonics.basis(normals)[:, :COUNT], coefficients)


def _are_free(scene: Scene, position: np.ndarray) -> np.ndarray:
    """(m,) whether probes are not inside something, by the rule for data points."""
    direction = np.tile(sphere(FEELERS).T.astype(np.float32), len(position))
    origin = np.repeat(position.T.astype(np.float32), FEELERS, axis=1)
    hits = scene.tracer.intersect(origin, direction)
    back = (hits.triangle != MISS) & (np.einsum("cn,cn->n", hits.normal, direction) > 0)
    back &= ~scene.surfaces.transparent[hits.triangle]
    return back.reshape(-1, FEELERS).mean(axis=1) <= datapoints.BACKFACE_LIMIT


def _positions(low: np.ndarray, spacing: float, shape: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(m, 3) places of probes, z fastest."""
    x, rest = np.divmod(rows, shape[1] * shape[2])
    y, z = np.divmod(rest, shape[2])
    return low + np.stack([x, y, z], axis=1) * spacing
