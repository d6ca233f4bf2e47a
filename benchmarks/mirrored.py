"""What surfaces mirror, path-traced: random places, mirror directions, and the radiance that a lobe about them gathers.

Comes in: a bake. Goes out: rays and truth. The lobe is that of `tree/ggx.py` about the mirror direction; what of it
lies below the surface is left out, and the rest counts for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from gi_volumes.bake import patches, snapshot_file, warp
from gi_volumes.bake.parallel import run_tiles, tiles
from gi_volumes.bake.paths import Numbers, Radiance, Wave, trace
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.receivers import lifted
from gi_volumes.bake.reference import sun_strength
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.settings import from_header, model, of_reference
from gi_volumes.bake.sobol import Sampler, points, scramble
from gi_volumes.tree import ggx, world
from gi_volumes.tree.cells import read_cell

SHIFT = 1.83
"""Spacing of points over that of the placement of probes: others of the same surfaces, as in `placement.py`."""

CERTAIN = np.float32(1e30)
"""Density of a ray that is no choice: emitters on it count fully."""

HORIZON = 1e-3
"""Least cosine at the surface of a ray of a lobe."""

LANES = 1 << 17
"""Paths of a tile."""

NODES = 20_000
"""Of the table that turns uniform numbers into cosines of a lobe."""


@dataclass(frozen=True, eq=False)
class Baked:
    """A bake and its scene, without a surface cache.

    world : World
    scene : Scene
    strength : (keys, 3) float64, irradiance of its suns [W/m2]
    bounces : int
    trees : Forest
    """

    world: world.World
    scene: Scene
    strength: np.ndarray
    bounces: int
    trees: patches.Forest

    @classmethod
    def load(cls, folder: Path) -> Baked:
        """Load a bake.

        Parameters
        ----------
        folder : Path
            With the snapshot that was baked.

        Returns
        -------
        Baked
            Ready for rays.
        """
        loaded = world.load(folder)
        settings = of_reference(from_header(loaded.header["settings"]))
        snapshot, light = model(snapshot_file.load(folder / SNAPSHOT_NAME), settings)
        scene, keys = prepare(snapshot, light), len(light.suns.toward)
        cells = (read_cell(folder, tuple(cell)).topology for cell in loaded.cells)
        forest = patches.Forest(loaded.grid, tuple(cells))
        return cls(loaded, scene, sun_strength(snapshot, keys), settings.bounces, forest)

    def local(self, position: np.ndarray) -> np.ndarray:
        """Local metres, of (n, 3) world space."""
        return position - self.scene.origin


@dataclass(frozen=True, eq=False)
class Mirrors:
    """Places and directions.

    point : (n, 3) float64 [m], world space, just off surfaces
    normal, direction : (n, 3) float32, unit vectors
    """

    point: np.ndarray
    normal: np.ndarray
    direction: np.ndarray


def choose(baked: Baked, count: int, seed: int) -> Mirrors:
    """Choose points by area, and views, so mirror directions too, by the cosine.

    Parameters
    ----------
    baked : Baked
        The bake.
    count : int
        How many.
    seed : int
        Another one chooses others.

    Returns
    -------
    Mirrors
        On surfaces that others see, or in first-level voxels with varied geometry.
    """
    generator = np.random.default_rng(seed)
    at = patches.spread_over(baked.scene, baked.trees, 0, SHIFT)
    rows = generator.choice(len(at.area), count, p=at.area / at.area.sum(dtype=np.float64))
    start, normal = lifted(baked.scene, at)[:, rows], np.ascontiguousarray(at.normal[rows].T)
    direction = warp.cosine(*generator.random((2, count), np.float32), normal)
    return Mirrors(start.T + baked.scene.origin, normal.T, direction.T)


def gathered(baked: Baked, mirrors: Mirrors, roughness: float, samples: int, seed: int) -> np.ndarray:
    """Path-trace what lobes gather.

    Parameters
    ----------
    baked : Baked
        The bake.
    mirrors : Mirrors
        Where, and about which directions.
    roughness : float
        Of the lobe; 0 is the direction alone.
    samples : int
        Rays of each lobe.
    seed : int
        Another one is independent.

    Returns
    -------
    (n, 3) float64 ndarray
        Radiance [W/(m2 sr)], all transports at the scene's own strength.
    """
    direction, weight = _lobes(mirrors, roughness, samples, seed)
    found = np.zeros((len(direction), 3), np.float32)
    rows = np.flatnonzero(weight.reshape(-1))

    def work(part: np.ndarray) -> int:
        some = rows[part]
        start = np.ascontiguousarray(baked.local(mirrors.point)[some // samples].T.astype(np.float32))
        light = _mixed(baked, _traced(baked, start, np.ascontiguousarray(direction[some].T), some, seed))
        found[some] = light.T
        return len(part)

    run_tiles(work, tiles(len(rows), LANES), 0)
    total = found.reshape(-1, samples, 3).sum(axis=1, dtype=np.float64)
    return total / np.maximum(weight.sum(axis=1), 1)[:, None]


def _lobes(mirrors: Mirrors, roughness: float, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(n * samples, 3) float32 directions, (n, samples) whether they lie above the surface."""
    count = len(mirrors.point)
    shift = np.random.default_rng(seed).random((2, count, 1))
    net = points(0, samples)[:2].astype(np.float64) / 2.0**32
    u, v = ((net[axis] + shift[axis]) % 1 for axis in (0, 1))
    cosine = 1 - np.concatenate([[0], np.logspace(-9, 0, NODES)])
    z = np.interp(u, ggx.share(cosine, roughness), cosine) if roughness else np.ones_like(u)
    radius, turn = np.sqrt(np.maximum(0, 1 - z * z)), 2 * np.pi * v
    axis = np.ascontiguousarray(mirrors.direction.T)
    tangent, bitangent = (part.T[:, None] for part in warp.frame(axis))
    around = tangent * (radius * np.cos(turn))[..., None] + bitangent * (radius * np.sin(turn))[..., None]
    direction = (mirrors.direction[:, None] * z[..., None] + around).astype(np.float32)
    weight = np.einsum("nkc,nc->nk", direction, mirrors.normal) > HORIZON
    return direction.reshape(-1, 3), weight


def _traced(baked: Baked, start: np.ndarray, direction: np.ndarray, number: np.ndarray, seed: int) -> Radiance:
    """Radiance along rays; each has its own random numbers."""
    count = len(number)
    lane = np.arange(count)
    keys = scramble(number.astype(np.uint32), seed + 1)
    wave = Wave(lane, start, direction, np.ones_like(direction), np.full(count, CERTAIN))
    numbers = Numbers(Sampler(keys, 0, 1), lane, np.zeros(count, np.int64))
    return trace(replace(baked.scene, cache=None), wave, numbers, baked.bounces)


def _mixed(baked: Baked, light: Radiance) -> np.ndarray:
    """(3, n) all transports together."""
    suns = np.einsum("kcn,kc->cn", light.sun, baked.strength)
    return light.local + suns + light.sky.sum(axis=0)
