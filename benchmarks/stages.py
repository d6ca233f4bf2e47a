"""A bake at surface points, stage by stage between the truth and what is stored, and the error that each stage adds.

Comes in: a bake's folder, points. Goes out: for each transport the light by path tracing, by nine harmonics at the
point itself, by the bake's interpolation of noiseless data, of data as they were traced, and as they are stored,
which includes whatever a bake does with its data after tracing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gi_volumes.bake import snapshot_file
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.settings import Settings, from_header
from gi_volumes.bake.sobol import scramble
from gi_volumes.benchmarks import errors
from gi_volumes.benchmarks.receivers import Receivers
from gi_volumes.benchmarks.stencils import Sites, Stencil, evaluate, functions
from gi_volumes.benchmarks.traced import Traced
from gi_volumes.tree import harmonics, world
from gi_volumes.tree.world import World

SEEDS = (1_000_003, 2_000_003)
"""Of the two halves; far from those of bakes."""

LIFT = 2e-3
"""Distance of the point's own harmonics from its surface, in finest voxels: a millimetre at half a metre."""


@dataclass(frozen=True)
class Bake:
    """A bake and the scene that it is of.

    path : its folder
    world : the same, loaded
    settings : how it was baked
    traced : its scene
    """

    path: Path
    world: World
    settings: Settings
    traced: Traced

    @property
    def bytes(self) -> int:
        """Size of all files of its cells."""
        return sum(file["bytes"] for cell in self.world.header["cells"] for file in cell["files"].values())

    @property
    def functions(self) -> int:
        """Functions of light that it holds, over all transports."""
        return functions(self.world)


def open_bake(path: Path, cache: Path | None = None, threads: int = 0) -> Bake:
    """Load a bake and its scene.

    Parameters
    ----------
    path : Path
        Folder of the bake.
    cache : Path, optional
        Folder for traced light.
    threads : int
        Worker threads; 0 uses every core.

    Returns
    -------
    Bake
        Ready to be measured.
    """
    loaded = world.load(path)
    settings = from_header(loaded.header["settings"])
    return Bake(path, loaded, settings, Traced(snapshot_file.load(path / SNAPSHOT_NAME), settings, cache, threads))


def stages(bake: Bake, paths: tuple[int, int], points: Receivers, used: Stencil, sites: Sites) -> dict:
    """Luminance of irradiance at every stage between the truth and what is stored.

    Parameters
    ----------
    bake : Bake
        The bake.
    paths : (2,) int
        At each point for each half of the reference, and at each data point for each half of its noiseless value.
    points : Receivers
        Where.
    used : Stencil
        The bake's weights there.
    sites : Sites
        The data points that count.

    Returns
    -------
    dict of str to dict of str to ndarray
        For each transport and "all": (2, n) `reference`, `point` and `exact`, halves of the path-traced value, of nine
        harmonics at the point and of noiseless data; (n,) `repeated` and `stored`, of the bake's own paths.
    """
    traced, normals = bake.traced, points.normal
    lift = LIFT * float(bake.world.grid.voxel_size(bake.world.grid.levels - 1))
    place = (points.point - traced.scene.origin + lift * normals).T.astype(np.float32)
    keys = scramble(np.arange(len(normals), dtype=np.uint32), 0xACE)
    basis = harmonics.basis(normals)
    reference = [traced.surface(points.point, normals, paths[0], seed) for seed in SEEDS]
    own = [traced.harmonics(place, keys, paths[0], seed) for seed in SEEDS]
    exact = [traced.harmonics(sites.position, sites.key, paths[1], seed) for seed in SEEDS]
    repeated = traced.harmonics(sites.position, sites.key, bake.settings.samples, bake.settings.seed)
    values = {}
    for name in traced.transports:
        stored = bake.world.irradiance(points.point, normals, transport=name)
        values[name] = {
            "reference": np.stack([half[name] for half in reference]) @ LUMINANCE,
            "point": np.stack([evaluate(basis, half[name]) for half in own]) @ LUMINANCE,
            "exact": np.stack([used.irradiance(half[name]) for half in exact]) @ LUMINANCE,
            "repeated": used.irradiance(repeated[name]) @ LUMINANCE,
            "stored": stored * (bake.world.sun_irradiance if name == "sun" else 1.0) @ LUMINANCE,
        }
    values["all"] = {stage: sum(values[name][stage] for name in traced.transports) for stage in values[name]}
    return values


def split(values: dict[str, np.ndarray]) -> dict[str, float]:
    """Split the error.

    Parameters
    ----------
    values : dict of str to ndarray
        From `stages`, of one transport.

    Returns
    -------
    dict of str to float
        Root mean square of what each stage adds, relative to the mean reference; `ideal` is the error that noiseless
        data would leave, angular and spatial together.
    """
    truth, own, exact = values["reference"], values["point"], values["exact"]
    mean = float(truth.mean())
    if not mean > 0:
        return {}
    pairs = {
        "angular": own - truth,
        "spatial": exact - own,
        "ideal": exact - truth,
        "transport": values["repeated"] - exact,
        "compression": np.stack([values["stored"] - values["repeated"]] * 2),
    }
    return {name: errors.root(errors.mean_product(*pair)[0]) / mean for name, pair in pairs.items()}
