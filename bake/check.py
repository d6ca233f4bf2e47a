"""The check of a surface cache: what it brings to some voxels of a cell, beside what paths followed to their end bring.

Comes in: a scene with a cache and without. Goes out: how far off the cache is on average, how well that is known, and
the noise of a data point. It costs about as much as a hundredth of the bake.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..tree.grid import Grid
from . import datapoints
from .gather import Effort, gather
from .lamps import LUMINANCE
from .measured import stack
from .scene import Scene
from .sensors import HarmonicsSensor
from .sobol import scramble
from .survey import Judge

VOXELS = 128
"""Voxels that are looked at in a cell."""

SEEDS = (0xCAC4E, 0x9A745, 0xA6A14)
"""Added to the seed for light by the cache, by paths, and by the cache again."""

SURE = 2.0
"""Standard deviations beyond the target error at which a cache is not used."""


@dataclass(frozen=True, eq=False)
class Check:
    """Mean irradiance around n places, over all directions, in every view of a judge.

    cached, paths, again : (n, views) float64
    """

    cached: np.ndarray
    paths: np.ndarray
    again: np.ndarray

    @classmethod
    def join(cls, parts: list[Check], views: int) -> Check:
        """Put the checks of some cells together.

        Parameters
        ----------
        parts : list of Check
            Of any number of cells.
        views : int
            Views of the judge.

        Returns
        -------
        Check
            All of them.
        """
        none = cls(*(np.zeros((0, views)) for _ in range(3)))
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in (none, *parts)]) for name in names))

    def bias(self) -> tuple[np.ndarray, np.ndarray]:
        """Say how far off the cache is on average.

        Returns
        -------
        bias : (views,) float64 ndarray
            Mean by the cache over that by paths, less 1; 0 without light.
        error : (views,) float64 ndarray
            Standard error of that.
        """
        off, doubt, scale = self._off()
        return off / scale, doubt / scale

    def noise(self) -> np.ndarray:
        """Say how noisy data points are by the cache, before they are fitted.

        Returns
        -------
        (views,) float64 ndarray
            Root mean square, relative to the mean.
        """
        light = (self.cached + self.again).mean(axis=0) / 2
        squared = ((self.cached - self.again) ** 2).mean(axis=0) / 2
        return np.sqrt(squared) / np.where(light > 0, light, np.inf)

    def fails(self, error: float) -> bool:
        """Say whether the cache is certainly too far off.

        Parameters
        ----------
        error : float
            Target error of the bake, relative to all light together.

        Returns
        -------
        bool
            Whether the bias of any view, or of all of them together, is larger, beyond doubt; or not a number.
        """
        if len(self.paths) < 2:
            return False
        parts = (self.cached, self.paths, self.again)
        off, doubt, _ = Check(*(np.column_stack([part, part.sum(axis=1)]) for part in parts))._off()
        return not (np.abs(off) <= error * self.paths.sum(axis=1).mean() + SURE * doubt).all()

    def _off(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(views,) how far off means are, the standard error of that, and the light that it is relative to.

        The error is that of a ratio: a cache that is off by the same factor everywhere is known to be so exactly,
        however uneven the light is (Cochran 1977, "Sampling Techniques", section 2.11).
        """
        light, off = self.paths.mean(axis=0), (self.cached + self.again) / 2 - self.paths
        scale = np.where(light > 0, light, np.inf)
        residual = off - off.mean(axis=0) / scale * self.paths
        return off.mean(axis=0), residual.std(axis=0, ddof=1) / np.sqrt(len(off)), scale


def check(
    cached: Scene,
    scene: Scene,
    grid: Grid,
    coords: Sequence[np.ndarray],
    judge: Judge,
    effort: Effort,
    voxels: int = VOXELS,
) -> Check:
    """Measure some of the voxels that a cell may have, by the cache twice and by paths.

    Parameters
    ----------
    cached, scene : Scene
        With the cache and without.
    grid : Grid
        The lattice.
    coords : sequence of (n, 3) int64 ndarray
        Voxels that the cell may have, by level.
    judge : Judge
        What is looked at.
    effort : Effort
        As data points are measured.
    voxels : int
        How many to look at.

    Returns
    -------
    Check
        Those of them that are not inside walls; the same for any number of threads.

    Notes
    -----
    Error: bias and noise are those of one draw of paths; the standard error of the bias says how well it is known.
    """
    level = np.repeat(np.arange(len(coords)), [len(part) for part in coords]).astype(np.uint8)
    coords = np.concatenate(coords)
    key = datapoints.keys(level, coords)
    rows = np.argsort(scramble(key, SEEDS[0]), kind="stable")[:voxels]
    level, coords, key = level[rows], coords[rows], key[rows]
    size = np.asarray(grid.voxel_size(level.astype(np.int64)), np.float64)
    placed = datapoints.place(scene, grid.centers(level, coords), size, key, effort.threads)
    position, key = np.ascontiguousarray(placed.position[:, placed.valid]), key[placed.valid]
    found = []
    for light, seed in zip((cached, scene, cached), SEEDS, strict=True):
        salted = dataclasses.replace(effort, seed=effort.seed ^ seed)
        found.append(_views(stack(scene, gather(light, HarmonicsSensor(), position, key, salted)), judge))
    return Check(*found)


def _views(light: np.ndarray, judge: Judge) -> np.ndarray:
    """(n, views) luminance of the mean irradiance, of (n, functions, 9, 3) harmonics."""
    return np.einsum("nfc,vfc->nv", light[:, :, 0].astype(np.float64), judge.views * LUMINANCE) / np.sqrt(4 * np.pi)
