"""The definition of the interpolated value, by brute force: the judge of the stencil and of dilation.

On a level, the eight voxels whose centres surround a point have trilinear weights. Those that exist count; what
belongs to the others is the value of the coarser level at their centroid, or at the point itself where none exists.
"""

import itertools

import numpy as np
from gi_volumes.tree.lookup import Atlas

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
ROUNDING = 1e-13
"""Weight of missing voxels that is none."""


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
        if level < 0:
            return np.full(len(points), np.nan), np.zeros(len(points), np.int64)
        center, weight, exists = self.corners(points, level)
        value = (np.where(exists, self.field(center.reshape(-1, 3)).reshape(-1, 8), 0) * weight).sum(axis=1)
        bits = np.where((exists & (weight > 0)).any(axis=1), 1 << level, 0)
        lost = np.where(exists, 0, weight)
        on = np.flatnonzero(lost.sum(axis=1) > ROUNDING)
        share = lost[on].sum(axis=1)
        moved = (center[on] * lost[on, :, None]).sum(axis=1) / share[:, None]
        moved = np.where(exists[on].any(axis=1)[:, None], moved, points[on])
        rest, more = self.at(moved, level - 1) if len(on) else (0.0, 0)
        value[on] += share * rest
        bits[on] |= more
        return value, bits

    def corners(self, points, level):
        """(n, 8, 3) centres, (n, 8) weights, (n, 8) whether the voxels exist."""
        place = points / self.grid.voxel_size(level) - 0.5
        base = np.floor(place).astype(np.int64)
        coords = (base[:, None] + CORNERS).reshape(-1, 3)
        exists = self.atlas.find(level, coords).reshape(-1, 8) >= 0
        weight = np.where(CORNERS, (place - base)[:, None], 1 - (place - base)[:, None]).prod(axis=2)
        return self.grid.centers(np.full(len(coords), level), coords).reshape(-1, 8, 3), weight, exists


def one_or_two_levels(bits):
    """Whether the bits are one, or two in succession."""
    lowest = bits & -bits
    return (bits == lowest) | (bits == 3 * lowest)


def surrounded(trees, grid, points):
    """Whether first-level voxels surround points and all that their neighbourhoods on finer levels may ask for."""
    atlas, reach, whole = Atlas(trees), grid.voxel_size(min(1, grid.levels - 1)), np.ones(len(points), bool)
    for shift in CORNERS * 2 - 1:
        base = np.floor((points + shift * reach) / grid.first_size - 0.5).astype(np.int64)
        exists = atlas.find(0, (base[:, None] + CORNERS).reshape(-1, 3)) >= 0
        whole &= exists.reshape(-1, 8).all(axis=1)
    return whole


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
