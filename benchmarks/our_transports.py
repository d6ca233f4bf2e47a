"""Our estimators of all transports at the data points of the open scene: paths, and the surface cache.

Comes in: the scene that is open in `bpy`. Goes out: irradiance on the six axes for local light, 16 suns and nine
functions of the sky, and what it cost.
"""

from __future__ import annotations

import bpy
import numpy as np
from gi_volumes.bake import measured, radiosity
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.settings import CACHED_BOUNCES, Settings, model
from gi_volumes.benchmarks.cost import Clock, Cost
from gi_volumes.benchmarks.cycles_transports import Transport
from gi_volumes.benchmarks.tree_points import tree_points
from gi_volumes.operators import extract
from gi_volumes.tree import harmonics

AXES = np.concatenate([np.eye(3), -np.eye(3)])
CLEAR = 0.005
"""Errors are measured at points that have no surface so near [m]: a few quads of Cycles' across."""

STRETCH, STRETCHES = 64, 16
"""Neighbouring data points, and groups of them, on which paths and the cache are timed against each other."""


class Ours:
    """Our estimators at data points of the open scene.

    Parameters
    ----------
    points, judged : int
        Data points, and those of them at which errors are measured.
    threads : int
        As in `Effort`.
    """

    def __init__(self, points: int, judged: int, threads: int) -> None:
        self.threads = threads
        self.scene = prepare(*model(extract.extract(bpy.context), Settings(sun="hemisphere", sky="harmonics")))
        self.grid, self.position, self.key = tree_points(self.scene, points)
        count = len(self.key)
        self.judged = self._clear(np.linspace(0, count - 1, min(2 * judged, count)).astype(np.int64), judged)
        starts = np.linspace(0, max(count - STRETCH, 0), STRETCHES).astype(np.int64)
        self.stretches = np.unique((starts[:, None] + np.arange(min(STRETCH, count))).ravel())

    def _clear(self, rows: np.ndarray, count: int) -> np.ndarray:
        """Some of the points that lie in no surface: there, half of a quad would be behind it for Cycles."""
        directions = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
        directions = np.delete(directions, len(directions) // 2, axis=0).astype(np.float32).T
        origin = np.ascontiguousarray(np.repeat(self.position[:, rows], directions.shape[1], axis=1))
        ends = np.full(origin.shape[1], CLEAR, np.float32)
        touches = self.scene.tracer.intersect_opaque(origin, np.tile(directions, len(rows)), ends).triangle != MISS
        free = rows[~touches.reshape(len(rows), -1).any(axis=1)]
        return free[np.linspace(0, len(free) - 1, min(count, len(free))).astype(np.int64)]

    @property
    def points(self) -> np.ndarray:
        """(n, 3) float64 judged points in world space [m]."""
        return self.position[:, self.judged].T.astype(np.float64) + self.scene.origin

    @property
    def transports(self) -> list[Transport]:
        """Everything that is measured, in the order of our functions."""
        suns = [Transport("sun", tuple(map(float, toward))) for toward in self.scene.model.suns.toward]
        sky = [Transport("sky", (), function) for function in range(self.scene.model.sky_count)]
        return [Transport("local")] * self.scene.has_local + suns + sky

    @property
    def groups(self) -> dict[str, slice]:
        """Functions by what they are of."""
        names = [transport.group for transport in self.transports]
        return {name: slice(names.index(name), names.index(name) + names.count(name)) for name in dict.fromkeys(names)}

    def fill(self, seed: int) -> tuple[Cost, Scene]:
        """Fill the cache for the whole scene.

        Parameters
        ----------
        seed : int
            As in `Effort`.

        Returns
        -------
        cost : Cost
        cached : Scene
        """
        low, high = self.scene.soup.bounds
        box = np.stack([low, np.nextafter(high, np.inf)])
        with Clock() as clock:
            cached = radiosity.around(self.scene, self.grid, box, Effort(1, CACHED_BOUNCES, seed, self.threads))
        return clock.cost, cached

    def measure(self, scene: Scene, rows: np.ndarray, samples: int, seed: int) -> tuple[Cost, np.ndarray]:
        """Measure harmonics.

        Parameters
        ----------
        scene : Scene
            With a cache or without.
        rows : (n,) int64 ndarray
            Data points.
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        cost : Cost
        values : (n, functions, 6, 3) float64 ndarray
            Irradiance on the axes.
        """
        effort = Effort(samples, CACHED_BOUNCES, seed, self.threads)
        with Clock() as clock:
            found = gather(scene, HarmonicsSensor(), self.position[:, rows], self.key[rows], effort)
        return clock.cost, np.einsum("nfrc,ar->nfac", measured.stack(scene, found), harmonics.basis(AXES))

    def whole(self, scene: Scene, samples: int, seed: int) -> Cost:
        """Measure all data points, and time it.

        Parameters
        ----------
        scene : Scene
            With a cache or without.
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        Cost
        """
        effort = Effort(samples, CACHED_BOUNCES, seed, self.threads)
        with Clock() as clock:
            gather(scene, HarmonicsSensor(), self.position, self.key, effort)
        return clock.cost

    def exact(self, samples: int, seed: int) -> np.ndarray:
        """Paths for each axis apart, at the judged points.

        Parameters
        ----------
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        (n, functions, 6, 3) float32 ndarray
            Irradiance without truncation.
        """
        count = len(self.judged)
        position, normals = np.repeat(self.position[:, self.judged], 6, axis=1), np.tile(AXES.T, count)
        effort = Effort(samples, CACHED_BOUNCES, seed, self.threads)
        keys = np.arange(6 * count, dtype=np.uint32)
        found = gather(self.scene, SurfaceSensor(normals.astype(np.float32)), position, keys, effort)
        stacked = measured.stack(self.scene, found)
        return stacked.reshape(count, 6, -1, 3).transpose(0, 2, 1, 3)
