"""Prefiltered maps: time to blur one, and error of a look-up between levels against the lobe itself.

    python benchmarks/prefilter.py SNAPSHOT... [--pitch 128] [--record]

Maps are traced from three free places: what surfaces reflect of a light from above, and three round lamps of six
degrees that are twenty times as bright. Look-ups in 500 random directions are compared with the lobe, integrated over
16 parts of each texel: root mean square of the difference, relative to that of the truth. `equal steps` is the same
with a roughness that rises by 1/4 from level to level.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from unittest import mock

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import prefilter, snapshot_file
from gi_volumes.bake.candidates import judge
from gi_volumes.bake.rays import MISS
from gi_volumes.bake.scene import Model, Scene, prepare
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import ggx, octahedral
from gi_volumes.tree.probe_atlas import Layout, fetch

PARTS = 4
"""Parts of a texel along either axis."""

ROUGHNESS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
PLACES, DIRECTIONS, LAMPS = 3, 500, 3


def free_places(scene: Scene, generator: np.random.Generator) -> np.ndarray:
    """Choose places.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    generator : numpy.random.Generator
        Where the numbers come from.

    Returns
    -------
    (PLACES, 3) float64 ndarray
        Free points of the middle half of the box around the scene [m].
    """
    low, high = scene.soup.bounds
    position = generator.uniform((3 * low + high) / 4, (low + 3 * high) / 4, (256, 3))
    free = judge(scene, position, np.arange(len(position), dtype=np.uint32), 0).is_free
    return position[free][:PLACES]


def radiance(scene: Scene, place: np.ndarray, direction: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """Look around.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    place : (3,) float64 ndarray
        Where [m].
    direction : (n, 3) float64 ndarray
        Unit vectors.
    lamps : (m, 3) float64 ndarray
        Directions to lamps.

    Returns
    -------
    (n,) float64 ndarray
        Something like light.
    """
    toward = np.ascontiguousarray(direction.T.astype(np.float32))
    hits = scene.tracer.intersect(np.repeat(place.astype(np.float32)[:, None], len(direction), axis=1), toward)
    triangle = np.maximum(hits.triangle, 0)
    up = np.maximum(hits.facing(toward)[2], 0.2)
    light = np.where(hits.triangle == MISS, 1, up * scene.surfaces.reflectance(triangle, hits.u, hits.v).mean(axis=0))
    return light.astype(np.float64) + 20 * (direction @ lamps.T > np.cos(0.1)).any(axis=1)


def errors(layout: Layout, lights: list[np.ndarray], rungs: np.ndarray, level_of) -> dict[float, float]:
    """Compare look-ups with the lobe.

    Parameters
    ----------
    layout : Layout
        Sizes.
    lights : list of (n,) float64 ndarray
        Radiance in the parts of all texels, of each place.
    rungs : (levels,) float64 ndarray
        Roughness of each level.
    level_of : callable
        From roughness to level.

    Returns
    -------
    dict of float to float
        By roughness, the mean over places.
    """
    size = layout.sizes[0]
    part, area = octahedral.centers(PARTS * size).reshape(-1, 3), octahedral.solid_angles(PARTS * size).reshape(-1)
    toward = np.random.default_rng(1).normal(size=(DIRECTIONS, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    with mock.patch.object(ggx, "ladder", return_value=rungs):
        blur = prefilter.prefilter(layout)
    atlases = []
    for light in lights:
        split = (values.reshape(size, PARTS, size, PARTS).sum(axis=(1, 3)) for values in (light * area, area))
        image = np.divide(*split)[:, :, None].astype(np.float32)
        atlases.append([octahedral.add_border(level) for level in blur(image)])
    found = {}
    for roughness in ROUGHNESS:
        lobes = [ggx.density(part @ axis, roughness) * area for axis in toward]
        truth = np.stack([[lobe @ light / lobe.sum() for lobe in lobes] for light in lights])
        level = float(level_of(roughness))
        low = min(int(level), layout.levels - 2)
        seen = np.stack([_mixed(layout, atlas, low, level - low, toward) for atlas in atlases])
        found[roughness] = float(np.sqrt(((seen - truth) ** 2).mean(axis=1) / (truth**2).mean(axis=1)).mean())
    return found


def _mixed(layout: Layout, atlas: list[np.ndarray], low: int, part: float, toward: np.ndarray) -> np.ndarray:
    """(n,) look-ups between two levels."""
    none = np.zeros(len(toward), np.int64)
    one, other = (fetch(atlas[level], layout, level, none, toward)[:, 0] for level in (low, low + 1))
    return one + part * (other - one)


def blur_times(layout: Layout) -> dict[str, float]:
    """Take the time.

    Parameters
    ----------
    layout : Layout
        Sizes.

    Returns
    -------
    dict of str to float
        Making the matrices [s], their size [MB], blurring a map of three channels [ms], the median of 5.
    """
    start = time.perf_counter()
    blur = prefilter.prefilter(layout)
    made, times = time.perf_counter() - start, []
    image = np.random.default_rng(0).random((layout.sizes[0],) * 2 + (3,)).astype(np.float32)
    for _ in range(5):
        start = time.perf_counter()
        blur(image)
        times.append(time.perf_counter() - start)
    size = sum(level.matrix.nbytes for level in blur.levels) / 1e6
    return {"matrices_s": made, "matrices_MB": size, "map_ms": 1e3 * float(np.median(times))}


def main() -> None:
    """Read the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshots", nargs="+", type=Path)
    parser.add_argument("--pitch", type=int, default=128)
    parser.add_argument("--record", action="store_true", help="append rows to results.csv")
    words = parser.parse_args()
    layout = Layout(words.pitch, 1, 1)
    rows = [("any", blur_times(layout))]
    rungs, steps = ggx.ladder(layout.sizes), layout.levels - 1
    equal = np.maximum(np.arange(layout.levels) / steps, 1e-6)
    for path in words.snapshots:
        scene, generator = prepare(snapshot_file.load(path), Model(local=False)), np.random.default_rng(0)
        part = octahedral.centers(PARTS * layout.sizes[0]).reshape(-1, 3)
        lamps = generator.normal(size=(LAMPS, 3))
        lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
        lights = [radiance(scene, place, part, lamps) for place in free_places(scene, generator)]
        for name, levels, level_of in (
            ("ours", rungs, lambda roughness: ggx.level_of(roughness, rungs)),
            ("equal steps", equal, lambda roughness: steps * roughness),
        ):
            found = errors(layout, lights, levels, level_of)
            rows.append((path.stem, {f"{name}, roughness {key}": value for key, value in found.items()}))
    for scene, figures in rows:
        print(scene, "  ".join(f"{name} {value:.3g}" for name, value in figures.items()))
        if words.record:
            add_row("prefilter", scene, figures)


if __name__ == "__main__":
    main()
