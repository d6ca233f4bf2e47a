"""The definition of the interpolated value, by brute force: the judge of dilation.

On every level, V(i) is the data of voxel i if it exists, else the value of the coarser level at its centre; the value
of a level is the trilinear interpolation of V, and the value of the tree is that of the finest level.
"""

import itertools

import numpy as np
from gi_volumes.tree.lookup import Atlas

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


class Definition:
    """A field sampled at the data points of some trees.

    Values are NaN where a voxel outside of all dense grids would be needed; `levels` is a bit for each level whose
    data has a weight.
    """

    def __init__(self, trees, grid, field):
        self.atlas, self.grid, self.field = Atlas(trees), grid, field

    def at(self, points, level=None):
        """(n,) values and (n,) bits of the levels."""
        level = self.grid.levels - 1 if level is None else level
        place = points / self.grid.voxel_size(level) - 0.5
        base = np.floor(place).astype(np.int64)
        coords, inverse = np.unique((base[:, None] + CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
        value, levels = self._voxels(coords, level)
        inverse = inverse.reshape(-1, 8)
        weight = np.where(CORNERS, (place - base)[:, None], 1 - (place - base)[:, None]).prod(axis=2)
        levels = np.where(weight > 0, levels[inverse], 0)
        return (value[inverse] * weight).sum(axis=1), np.bitwise_or.reduce(levels, axis=1)

    def _voxels(self, coords, level):
        center = self.grid.centers(np.full(len(coords), level), coords)
        exists = self.atlas.find(level, coords) >= 0
        value, levels = np.where(exists, self.field(center), np.nan), np.where(exists, 1 << level, 0)
        missing = np.flatnonzero(~exists)
        if level and len(missing):
            value[missing], levels[missing] = self.at(center[missing], level - 1)
        return value, levels


def one_or_two_levels(bits):
    """Whether the bits are one, or two in succession."""
    lowest = bits & -bits
    return (bits == lowest) | (bits == 3 * lowest)


def probes(trees, grid, seed=0, count=20_000):
    """Points around data points of all levels, up to one and a half voxels away, and in dual cells of the finest."""
    rng, found = np.random.default_rng(seed), []
    for tree in trees:
        level, coords = tree.voxels()
        for depth in range(grid.levels):
            near = np.repeat(coords[level == depth], 8, axis=0)
            near = near[rng.permutation(len(near))[: count // len(trees)]]
            found.append((near + 0.5 + rng.uniform(-1.6, 1.6, near.shape)) * grid.voxel_size(depth))
        finest = coords[level == grid.levels - 1]
        finest = (finest[:, None] + CORNERS).reshape(-1, 3)
        finest = finest[rng.permutation(len(finest))[: 4 * count]]
        found.append((finest + rng.uniform(-0.5, 0.5, finest.shape)) * grid.voxel_size(grid.levels - 1))
    return np.concatenate(found)
