"""Every instance of a snapshot as one list of triangles, relative to the snapshot's origin.

Comes in: meshes and instances. Goes out: corners in metres about the origin, and for each triangle where it
came from. Positions are transformed in double precision; mirrored instances have two corners swapped, so that
every front face stays a front face.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .snapshot import Geometry, Snapshot


@dataclass(frozen=True)
class Soup:
    """Triangles in the bake's own space.

    corners : (n, 3, 3) float32 [m], triangle, corner, axis; counter-clockwise seen from the front
    source : (n,) int32, row of `Geometry.triangles`
    instance : (n,) int32, row of `Geometry.instance_mesh`
    corner_order : (n, 3) int8, which corner of the source each corner is
    """

    corners: np.ndarray
    source: np.ndarray
    instance: np.ndarray
    corner_order: np.ndarray

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64 [m], lowest and highest corner."""
        flat = self.corners.reshape(-1, 3)
        return np.stack([flat.min(axis=0), flat.max(axis=0)]).astype(np.float64)


def flatten(snapshot: Snapshot) -> Soup:
    """Place every instance.

    Parameters
    ----------
    snapshot : Snapshot
        A checked scene.

    Returns
    -------
    Soup
        All triangles, in the order of the instances.

    Notes
    -----
    Error: a corner is off by at most half a unit in the last place of its float32 distance to the origin.
    """
    geometry = snapshot.geometry
    source, instance = _enumerate(geometry)
    corners = np.empty((len(source), 3, 3), np.float32)
    linear = geometry.instance_transform[:, :, :3]
    offset = geometry.instance_transform[:, :, 3] - snapshot.origin
    first = np.searchsorted(instance, np.arange(len(linear) + 1))
    for row in range(len(linear)):
        part = slice(first[row], first[row + 1])
        local = geometry.positions[geometry.triangles[source[part]]].astype(np.float64)
        corners[part] = local @ linear[row].T + offset[row]
    mirrored = np.linalg.det(linear)[instance] < 0
    order = np.where(mirrored[:, None], np.int8([0, 2, 1]), np.int8([0, 1, 2]))
    corners = np.take_along_axis(corners, order[:, :, None].astype(np.int64), axis=1)
    return Soup(corners, source, instance, order)


def _enumerate(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """(source triangle, instance) of every triangle that is placed."""
    first = geometry.mesh_first_triangle[geometry.instance_mesh]
    count = geometry.mesh_first_triangle[geometry.instance_mesh + 1] - first
    instance = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(instance)) - np.repeat(np.cumsum(count) - count, count)
    return (first[instance] + within).astype(np.int32), instance.astype(np.int32)
