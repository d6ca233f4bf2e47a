"""Which kinds of points hold the error: beside contacts, on thin things, where levels meet, at moved data points.

Comes in: points, the data points that light them, and the light of every stage there. Goes out: for each kind its share
of the points and of the squared error.
"""

from __future__ import annotations

import numpy as np
from gi_volumes.bake.rays import MISS
from gi_volumes.benchmarks import errors
from gi_volumes.benchmarks.receivers import LIFT, Receivers, feel
from gi_volumes.benchmarks.stages import Bake
from gi_volumes.benchmarks.stencils import Sites, Stencil

NEAREST = 3
"""The fourth nearest of the feelers says how near another surface is: one alone may graze the point's own."""

COUNTS = 0.05
"""Least weight of a data point that counts."""


def circumstances(bake: Bake, points: Receivers, used: Stencil, sites: Sites, values: dict[str, np.ndarray]) -> dict:
    """Share the squared error out.

    Parameters
    ----------
    bake : Bake
        The bake.
    points : Receivers
        Where.
    used : Stencil
        The bake's weights there.
    sites : Sites
        The data points that count.
    values : dict of str to ndarray
        From `stages.stages`, of all transports together.

    Returns
    -------
    dict of str to dict of str to float
        For each kind of points: the share of `points`, of squared `error`, of squared `spatial` error, and `rmse` and
        `spatial_rms` among them relative to the mean of all points' reference. Kinds overlap.
    """
    total = np.prod(values["stored"] - values["reference"], axis=0)
    spatial = np.prod(values["exact"] - values["point"], axis=0)
    mean = float(values["reference"].mean())
    out = {}
    for name, rows in kinds(bake, points, used, sites, values["reference"].mean(axis=0)).items():
        if not rows.any():
            continue
        out[name] = {
            "points": float(rows.mean()),
            "error": float(total[rows].sum() / total.sum()),
            "spatial": float(spatial[rows].sum() / spatial.sum()),
            "rmse": errors.root(float(total[rows].mean())) / mean,
            "spatial_rms": errors.root(float(spatial[rows].mean())) / mean,
        }
    return out


def kinds(bake: Bake, points: Receivers, used: Stencil, sites: Sites, light: np.ndarray) -> dict[str, np.ndarray]:
    """Tell kinds of points apart.

    Parameters
    ----------
    bake : Bake
        The bake.
    points : Receivers
        Where.
    used : Stencil
        The bake's weights there.
    sites : Sites
        The data points that count.
    light : (n,) ndarray
        Reference.

    Returns
    -------
    dict of str to (n,) bool ndarray
        By what they are.
    """
    tracer, origin = bake.traced.scene.tracer, bake.traced.scene.origin
    finest = bake.world.grid.levels - 1
    size = float(bake.world.grid.voxel_size(finest))
    local = points.point - origin
    distance, _, met = feel(tracer, local + LIFT * points.normal, points.normal)
    near = np.partition(np.where(met, distance, np.inf), NEAREST, axis=1)[:, NEAREST]
    level = used.mean(sites.level)
    behind = _behind(tracer, local, points.normal)
    count = (used.weight > COUNTS).sum(axis=1)
    out = {
        "front": points.front,
        "back side": ~points.front,
        "surface within 1/4 voxel": near < size / 4,
        "surface within 1/2 voxel": near < size / 2,
        "surface within 1 voxel": near < size,
        "no surface within 1 voxel": near >= size,
        "sheet, nothing behind": ~np.isfinite(behind),
        "thinner than 1/4 voxel": behind < size / 4,
        "solid of 1/4 to 1 voxel": (behind >= size / 4) & (behind < size),
        "thicker than 1 voxel": (behind >= size) & np.isfinite(behind),
        "finest level": level > finest - 1e-6,
        "levels mixed": (level <= finest - 1e-6) & (level % 1 > 1e-6),
        "one coarser level": (level <= finest - 1e-6) & (level % 1 <= 1e-6),
        "moved points > 1/2 weight": used.mean(sites.moved) > 0.5,
        "moved points 0 to 1/2": (used.mean(sites.moved) <= 0.5) & (used.mean(sites.moved) > 0),
        "no moved points": used.mean(sites.moved) == 0,
        "1 or 2 data points": count <= 2,
        "3 data points": count == 3,
        "4 or more data points": count >= 4,
    }
    seen = {f"data points seen {name}": rows for name, rows in _sight(bake, local, points, used, sites).items()}
    dark = np.argsort(np.argsort(light)) / len(light)
    tenths = {f"light, {name}": rows for name, rows in (("darkest half", dark < 0.5), ("brightest tenth", dark >= 0.9))}
    return out | seen | tenths


def _behind(tracer, local: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) how far it is to the other side of what the point lies on [m], infinite where there is none."""
    rays = (local - LIFT * normals, -normals)
    hits = tracer.intersect(*(np.ascontiguousarray(array.T, np.float32) for array in rays))
    return np.where(hits.triangle != MISS, hits.distance, np.inf)


def _sight(bake: Bake, local: np.ndarray, points: Receivers, used: Stencil, sites: Sites) -> dict[str, np.ndarray]:
    """By the weight of the data points that a point sees."""
    scene = bake.traced.scene
    start = (local + LIFT * points.normal).astype(np.float32)
    target = sites.position.T[used.place.ravel()]
    origin = np.repeat(start, used.place.shape[1], axis=0)
    arm = np.ascontiguousarray((target - origin).T)
    far = np.full(arm.shape[1], 0.999, np.float32)
    free = ~scene.tracer.blocked(np.ascontiguousarray(origin.T), arm, far).reshape(used.weight.shape)
    weight = (used.weight * free).sum(axis=1)
    return {"all": weight > 0.99, "some": (weight <= 0.99) & (weight > 0.01), "none": weight <= 0.01}
