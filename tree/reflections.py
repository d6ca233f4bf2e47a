"""What a ray from a point shows: the radiance that reflection probes have of what it meets.

Comes in: points, directions, roughness. Goes out: radiance, and how surely a probe sees what the ray meets. The voxels
around the point, weighed as for irradiance, say which probes; for each of them the ray is followed through what it sees
(`parallax.py`), and its maps are looked up in that direction. The mean counts each probe by

    weight of the point's voxels * how surely it sees what the ray meets * q / (1 + q),   q = (NEAR ratio)^2,

where ratio is the ray's length over the distance from the probe: what is far from a probe has few texels there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import ggx
from .blend import shares
from .interpolate import DataPoints
from .parallax import Nearness, march
from .payload import NO_DATA
from .probe_atlas import fetch_between
from .probe_maps import ProbeMaps
from .probe_sets import WHOLE, ProbeSets

__all__ = ["ENOUGH", "Rays", "Reflections", "Used"]

MOST = 8
"""Probes that count at a point; four make errors no more than 2 % larger (`docs/accuracy.md`)."""

ENOUGH = 0.1
"""Weight of probes that see what a ray meets below which a part comes from elsewhere: with 0.02 rays in full rooms are
a fifth more wrong, with 0.2 rays to the sky a tenth."""

NEAR = np.float32(4)
"""Distance from a probe at which it counts by a half, in lengths of the ray; as in `bake/views.py`."""

SHARPER = 0.5
"""Levels by which distances are sharper than radiance: on sharper ones rough surfaces show the edges of what is far as
speckles, on others errors grow (`docs/accuracy.md`)."""

LEAST = np.float32(0.1)
"""What a probe counts at least: where rays are short, none is to count alone for seeing something far behind."""

WIDEST = np.float32(1)
"""Largest ratio that a lobe is widened by."""

LARGEST = np.float32(np.finfo(np.float32).max / 100)
"""Limit of radiance, so that no sum of it overflows."""


@dataclass(frozen=True, eq=False)
class Rays:
    """What is asked for.

    point : (n, 3) float64 [m], relative to the grid's origin, as from `blend.clamp`
    direction : (n, 3) float32, unit vectors
    roughness : (n,) float64, 0 to 1
    normal : (n, 3) float32, of the surfaces that the points lie on, unit vectors; zero where there is none
    """

    point: np.ndarray
    direction: np.ndarray
    roughness: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True, eq=False)
class Used:
    """Probes that count at points, each once for a point, `MOST` of each at most.

    point : (m,) int64, ascending
    probe : (m,) int64, for each point the heaviest first
    weight : (m,) float32, above 0; those of a point sum to at most 1
    """

    point: np.ndarray
    probe: np.ndarray
    weight: np.ndarray


class Reflections:
    """The probes of a bake, ready for look-up.

    Parameters
    ----------
    data : DataPoints
        The bake's data points.
    maps : ProbeMaps
        What probes see.
    sets : sequence of ProbeSets
        Of the trees of all cells, in their order.
    """

    def __init__(self, data: DataPoints, maps: ProbeMaps, sets: Sequence[ProbeSets]):
        self._data, self._layout, self._parts = data, maps.layout, maps.radiance
        self._remembered: tuple[tuple, tuple[np.ndarray, ...]] = (("nothing",), ())
        self._near = Nearness.of(maps.layout, maps.distance)
        self._position = maps.position - np.array(data.grid.origin)
        self._ladder = ggx.ladder(maps.layout.sizes)
        self._index, self._probe, self._weight = _joined(sets)

    def mixed(self, factors: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Mix the parts of radiance for a sun and a sky; the last mixture is remembered.

        Parameters
        ----------
        factors : dict of str to (K, 3) float64 ndarray
            Of each transport's functions, as those of irradiance.

        Returns
        -------
        tuple of (rows_l, columns_l, 3) float32 ndarray
            Radiance by mip level [W/(m2 sr)], finite and not negative; each transport is clamped by itself.
        """
        key = tuple((name, factor.tobytes()) for name, factor in factors.items())
        remembered = self._remembered
        if remembered[0] != key:
            remembered = key, tuple(self._mixed(level, factors) for level in range(self._layout.levels))
            self._remembered = remembered
        return remembered[1]

    def _mixed(self, level: int, factors: dict[str, np.ndarray]) -> np.ndarray:
        """One mip level."""
        total = np.zeros((*self._layout.shape(level), 3), np.float32)
        for name, factor in factors.items():
            part = np.zeros_like(total)
            for number, row in enumerate(factor.astype(np.float32)):
                single = len(factor) == 1 and name in self._parts
                found = self._parts.get(name if single else f"{name}.{number}")
                if found is not None and row.any():
                    part += found[level].astype(np.float32) * row
            total += np.clip(part, 0, LARGEST, out=part)
        return total

    def used(self, points: np.ndarray, normals: np.ndarray) -> Used:
        """Find the probes that count at points.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            Relative to the grid's origin [m], as from `blend.clamp`.
        normals : (n, 3) float ndarray
            Of the surfaces that they lie on, unit length; zero where there is none.

        Returns
        -------
        Used
            None where no voxel that the point sees has any.
        """
        none = np.zeros(0, np.int64)
        parts = [(none, none, np.zeros(0, np.float32))]
        for to, row, share in shares(self._data, points, normals, resort=False):
            entry = self._index[row]
            weight = share[:, :, None] * self._weight[entry]
            tap, point, slot = np.nonzero(weight)
            parts.append((to[point], self._probe[entry[tap, point], slot], weight[tap, point, slot]))
        point, probe, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        return _gathered(point, probe, weight, max(len(self._position), 1))

    def look(self, rays: Rays, levels: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Look up what rays show.

        Parameters
        ----------
        rays : Rays
            The rays.
        levels : tuple of (rows_l, columns_l, 3) float32 ndarray
            Radiance of the atlas by mip level, as from `mixed`.

        Returns
        -------
        radiance : (n, 3) float32 ndarray
            In the levels' unit; 0 where no probe sees what the ray meets.
        seen : (n,) float32 ndarray
            How much of the radiance is known, 0 to 1; continuous.
        """
        used, count = self.used(rays.point, rays.normal), len(rays.point)
        total, weights = np.zeros((count, 3)), np.zeros((2, count))
        offset = (rays.point[used.point] - self._position[used.probe]).astype(np.float32)
        sharp = np.maximum(ggx.level_of(rays.roughness, self._ladder) - SHARPER, 0)
        for found in march(self._near, used.probe, offset, rays.direction[used.point], sharp[used.point]):
            point, weight = used.point[found.row], used.weight[found.row] * found.weight
            q = np.square(NEAR * found.ratio)
            worth = weight * np.maximum(q / (1 + q), LEAST)
            blur = rays.roughness[point] * np.sqrt(np.minimum(found.ratio, WIDEST))
            level = ggx.level_of(blur, self._ladder)
            light = fetch_between(levels, self._layout, level, used.probe[found.row], found.toward)
            for channel in range(3):
                total[:, channel] += np.bincount(point, worth * light[:, channel], count)
            for row, values in enumerate((weight, worth)):
                weights[row] += np.bincount(point, values, count)
        mean = total / np.where(weights[1] > 0, weights[1], 1)[:, None]
        return mean.astype(np.float32), np.minimum(weights[0] / ENOUGH, 1).astype(np.float32)


def _joined(sets: Sequence[ProbeSets]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows,) entry of each voxel, (entries, slots) probes and weights; the last entry has none."""
    slots = max((part.probe.shape[1] for part in sets), default=1)
    first = np.cumsum([0, *(len(part.probe) for part in sets)])
    rows = [part.index.astype(np.int64) for part in sets]
    index = [np.where(row == NO_DATA, first[-1], row + start) for row, start in zip(rows, first, strict=False)]
    tables = []
    for name in ("probe", "weight"):
        parts = [getattr(part, name).astype(np.int64) for part in sets] + [np.zeros((1, slots), np.int64)]
        tables.append(np.concatenate([np.pad(part, [(0, 0), (0, slots - part.shape[1])]) for part in parts]))
    index = np.concatenate([np.zeros(0, np.int64), *index]).astype(np.int64)
    return index, tables[0], tables[1].astype(np.float32) / np.float32(WHOLE)


def _gathered(point: np.ndarray, probe: np.ndarray, weight: np.ndarray, probes: int) -> Used:
    """Each probe once for a point, its weights summed in the order in which they came."""
    key = point * probes + probe
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    weight = np.add.reduceat(weight[order], first) if len(first) else weight
    return _heaviest(point[order[first]], probe[order[first]], weight)


def _heaviest(point: np.ndarray, probe: np.ndarray, weight: np.ndarray) -> Used:
    """`MOST` probes of each point, less the weight of the next one, so that none comes or goes at once."""
    order = np.lexsort((probe, -weight, point))
    point, probe, weight = point[order], probe[order], weight[order]
    start = np.flatnonzero(np.diff(point, prepend=-1))
    rank = np.arange(len(point)) - np.repeat(start, np.diff(start, append=len(point)))
    next_one = np.zeros(point[-1] + 1 if len(point) else 0, np.float32)
    next_one[point[rank == MOST]] = weight[rank == MOST]
    weight = weight - next_one[point]
    kept = np.flatnonzero((rank < MOST) & (weight > 0))
    return Used(point[kept], probe[kept], weight[kept])
