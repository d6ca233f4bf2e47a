"""Probes of scenes that are traced on the spot: distances of all texels, and radiance as a function of the place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from gi_volumes.bake.prefilter import prefilter
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Scene
from gi_volumes.tree import octahedral, probe_maps
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.interpolate import DataPoints, join
from gi_volumes.tree.probe_atlas import put
from gi_volumes.tree.probe_maps import ProbeMaps
from gi_volumes.tree.topology import Topology

Shine = Callable[[np.ndarray], np.ndarray]


def traced(scene: Scene, position: np.ndarray, shine: Shine, sky: float, pitch: int = 32) -> ProbeMaps:
    """Maps of probes at local positions: `shine` gives (n, 3) radiance of (n, 3) places of surfaces."""
    maps = probe_maps.empty(position, np.zeros(len(position), bool), pitch, ("local",))
    size, blur = maps.layout.sizes[0], prefilter(maps.layout)
    direction = octahedral.centers(size).reshape(-1, 3)
    for number, place in enumerate(position):
        distance, light = meet(scene, np.broadcast_to(place, direction.shape), direction, shine, sky)
        put(maps.distance[..., None], maps.layout, 0, number, distance.reshape(size, size, 1))
        for level, image in enumerate(blur(light.reshape(size, size, 3))):
            put(maps.radiance["local"][level], maps.layout, level, number, image)
    return maps


def meet(scene: Scene, start: np.ndarray, direction: np.ndarray, shine: Shine, sky: float):
    """(n,) distances and (n, 3) radiance that rays meet, exactly."""
    origin, way = (np.ascontiguousarray(rows.T.astype(np.float32)) for rows in (start, direction))
    hits = scene.tracer.intersect(origin, way)
    met = hits.triangle != MISS
    distance = np.where(met, hits.distance, np.inf)
    place = start + direction * np.where(met, hits.distance, 0)[:, None]
    return distance, np.where(met[:, None], shine(place), sky).astype(np.float32)


def points_of(grid: Grid, trees: tuple[Topology, ...], valid: Callable[[np.ndarray], np.ndarray]) -> DataPoints:
    """Data points at the centres of all voxels for which `valid` says so."""
    centers = np.concatenate([grid.centers(*tree.voxels()) for tree in trees])
    return join(grid, trees, np.zeros(centers.shape, np.int8), valid(centers))
