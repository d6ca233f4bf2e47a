"""What captured probes cost, how large they are, how far off they are, and how they look.

    python benchmarks/capture.py SNAPSHOT... [--probes 8] [--sky 1.0] [--sun 0.2,0.3,1] [--quality preview]
                                 [--threads 1] [--pictures DIR] [--record]

Probes are placed and captured as a bake of these settings does it, by the surface cache. `rays_per_s` is what one
thread meets in a second of processor time, `embreex_per_s` the same rays with nothing around them. `noise` is what
probes say of themselves; `error` compares texels of the sharpest level with plain path tracing without a cache, 256
rays through each of 1,000 texels of every probe, whose own noise is taken off: root mean square, over the light there
plus the map's mean. `energy` is the mean of these texels over that of the tracing. Pictures show all directions,
upwards is above: as captured, path traced, and the difference.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import job, patches, paths, probe_job, probes, radiosity, snapshot_file
from gi_volumes.bake.capture import Studio, shoot
from gi_volumes.bake.gather import Effort
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.bake.lit_patches import are_lit
from gi_volumes.bake.picture import panels
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, choose_grid, model
from gi_volumes.bake.sobol import Sampler, scramble
from gi_volumes.benchmarks.results import add_row
from gi_volumes.benchmarks.transport import Recorder, replay
from gi_volumes.tree import octahedral, probe_file, probe_maps
from gi_volumes.tree.build import build, occupied_cells
from gi_volumes.tree.probe_atlas import fetch
from PIL import Image

TEXELS, RAYS = 1000, 256
"""Texels of a probe that are compared, and rays through each."""

BOUNCES = 24
"""Of the path tracing: what is left after them is less than its noise."""

WIDTH, PIXEL_RAYS = 384, 64
"""Of pictures, and rays of their pixels."""

SEED = 0xE4404
"""Of all that judges."""


class Bench:
    """A scene, its light, and captured probes.

    Parameters
    ----------
    path : Path
        Its snapshot.
    words : Namespace
        The command line.
    """

    def __init__(self, path: Path, words: argparse.Namespace) -> None:
        snapshot, self.settings = snapshot_file.load(path), Settings.of(words.quality)
        self.settings = dataclasses.replace(self.settings, sky=words.sky, sun=words.sun)
        self.scene = prepare(*model(snapshot, self.settings))
        self.mixture = job._judge(snapshot, self.settings, self.scene).mean
        self.effort = Effort(0, self.settings.bounces, 0, words.threads)
        grid = choose_grid(self.scene.soup.corners, snapshot.origin, 0.0)
        self.place = self._placed(grid, words.probes)
        start = time.perf_counter()
        self.cached = radiosity.around(self.scene, grid, radiosity.whole(self.scene), self.effort)
        self.cache_seconds = time.perf_counter() - start

    def _placed(self, grid, count: int) -> np.ndarray:
        """(k, 3) where probes stand."""
        corners = self.scene.soup.corners
        trees = tuple(build(corners, grid, tuple(cell)) for cell in occupied_cells(corners, grid))
        request = probes.Request(count, counts=functools.partial(are_lit, self.scene, self.effort))
        return probes.place(self.scene, patches.Forest(grid, trees), request, self.effort).position

    def studio(self, place: np.ndarray, threads: int) -> Studio:
        """Make room for some probes.

        Parameters
        ----------
        place : (k, 3) float64 ndarray
            Where [m].
        threads : int
            How many.

        Returns
        -------
        Studio
            With nothing done.
        """
        model, spending = self.scene.model, probe_job.spending_of(self.settings)
        parts = probe_maps.part_names(self.scene.has_local, len(model.suns.toward), model.sky_count)
        maps = probe_maps.empty(place + self.scene.origin, np.zeros(len(place), bool), spending.pitch, parts)
        return Studio.of(maps, self.mixture, spending, dataclasses.replace(self.effort, threads=threads))

    def light(self, channels: np.ndarray) -> np.ndarray:
        """Mix all parts.

        Parameters
        ----------
        channels : (parts, n, 3) ndarray
            Radiance.

        Returns
        -------
        (n, 3) ndarray
            As the scene shines.
        """
        return np.einsum("pnc,pc->nc", channels, self.mixture)

    def shown(self, studio: Studio, probe: int, direction: np.ndarray) -> np.ndarray:
        """Look up the sharpest level.

        Parameters
        ----------
        studio : Studio
            Captured probes.
        probe : int
            Which one.
        direction : (n, 3) ndarray
            Where to look.

        Returns
        -------
        (n, 3) ndarray
            Radiance.
        """
        levels = [part[0] for part in studio.maps.radiance.values()]
        number = np.full(len(direction), probe)
        return self.light(np.stack([fetch(level, studio.maps.layout, 0, number, direction) for level in levels]))

    def traced(self, place: np.ndarray, toward, count: int, rays: int) -> np.ndarray:
        """Trace paths to their end.

        Parameters
        ----------
        place : (3,) float64 ndarray
            From where [m].
        toward : callable
            Gives (3, n) directions of (n,) pixels and two uniform numbers for each.
        count, rays : int
            Pixels, and rays of each.

        Returns
        -------
        (2, count, 3) float64 ndarray
            Means over two halves of the rays.
        """
        found, step = np.zeros((2, count, 3)), max(1, (1 << 18) // rays)
        skipped = 0 if self.scene.has_local else 1
        for first in range(0, count, step):
            pixel = np.arange(first, min(first + step, count))
            point, sample = np.divmod(np.arange(len(pixel) * rays), rays)
            keys = scramble(pixel.astype(np.uint32), SEED)
            numbers, lanes = paths.Numbers(Sampler(keys, 0, rays), point, sample), np.arange(len(point))
            direction = toward(pixel[point], *numbers.draw(lanes, 0, 2))
            start = np.repeat(np.float32(place)[:, None], len(lanes), axis=1)
            wave = paths.Wave(lanes, start, direction, np.ones_like(start), np.full(len(lanes), paths.CERTAIN))
            light = paths.trace(self.scene, wave, numbers, BOUNCES).stacked()[skipped:]
            halves = light.reshape(*light.shape[:2], len(pixel), 2, rays // 2).mean(axis=4)
            found[:, pixel] = [self.light(halves[..., half].transpose(0, 2, 1)) for half in (0, 1)]
        return found


def cost(bench: Bench) -> dict[str, float]:
    """Measure rates on one probe and one thread.

    Parameters
    ----------
    bench : Bench
        Ready.

    Returns
    -------
    dict of str to float
        Rays per second of processor time, as they are and with nothing around them.
    """
    recorder, known, studio = Recorder(bench.cached.tracer), bench.cached.cache, bench.studio(bench.place[:1], 1)
    cache = dataclasses.replace(known, known=dataclasses.replace(known.known, tracer=recorder))
    shoot(dataclasses.replace(bench.cached, tracer=recorder, cache=cache), studio, np.arange(1))
    rays = sum(batch[1].shape[1] for batch in recorder.batches)
    start = time.process_time()
    shoot(bench.cached, studio, np.arange(1))
    seconds = time.process_time() - start
    return {"rays_per_s": rays / seconds, "embreex_per_s": rays / replay(recorder.batches)}


def errors(bench: Bench, studio: Studio) -> dict[str, float]:
    """Compare texels with plain path tracing.

    Parameters
    ----------
    bench : Bench
        Ready.
    studio : Studio
        Captured probes.

    Returns
    -------
    dict of str to float
        Error and energy, over all probes.
    """
    size, generator, found = studio.maps.layout.sizes[0], np.random.default_rng(SEED), []
    area = octahedral.solid_angles(size).reshape(-1) / (4 * np.pi)
    for probe, place in enumerate(bench.place):
        texel = generator.choice(size * size, TEXELS, p=area)
        row, column = np.divmod(texel, size)

        def toward(pixel, u, v, row=row, column=column):
            uv = np.stack([column[pixel] + u, row[pixel] + v], axis=-1).astype(np.float32) / np.float32(size)
            return np.ascontiguousarray(octahedral.decode(uv).T)

        truth = bench.traced(place, toward, len(texel), RAYS) @ LUMINANCE
        centers = octahedral.centers(size).reshape(-1, 3)
        light = bench.shown(studio, probe, centers) @ LUMINANCE
        scale = light[texel] + area @ light
        noise = ((truth[0] - truth[1]) / 2 / scale) ** 2
        found.append([((light[texel] - truth.mean(axis=0)) / scale) ** 2 - noise, light[texel], truth.mean(axis=0)])
    squared, light, truth = np.concatenate(found, axis=1)
    return {"error": float(np.sqrt(max(squared.mean(), 0))), "energy": float(light.sum() / truth.sum())}


def size_of(studio: Studio) -> dict[str, float]:
    """Measure the file.

    Parameters
    ----------
    studio : Studio
        Captured probes.

    Returns
    -------
    dict of str to float
        Kilobytes of a probe in the file, and in memory.
    """
    count = len(studio.maps.position)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        probe_file.write(folder, studio.maps, "", "")
        written = time.perf_counter()
        probe_file.read(Path(folder) / probe_file.PROBES)
        read = time.perf_counter()
        stored = (Path(folder) / probe_file.PROBES).stat().st_size
    memory = probe_job.probe_bytes(studio.maps.layout.pitch, len(studio.maps.radiance))
    times = {"write_ms": 1e3 * (written - start) / count, "read_ms": 1e3 * (read - written) / count}
    return {"file_kB": stored / count / 1e3, "memory_kB": memory / 1e3} | times


def picture(bench: Bench, studio: Studio, probe: int, path: Path) -> None:
    """Write what a probe shows beside what path tracing shows.

    Parameters
    ----------
    bench : Bench
        Ready.
    studio : Studio
        Captured probes.
    probe : int
        Which one.
    path : Path
        The PNG.
    """
    height = WIDTH // 2

    def toward(pixel, u, v):
        row, column = np.divmod(pixel, WIDTH)
        up, around = np.pi * (0.5 - (row + v) / height), -2 * np.pi * (column + u) / WIDTH
        parts = np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)
        return np.stack(parts).astype(np.float32)

    pixel = np.arange(WIDTH * height)
    baked = bench.shown(studio, probe, toward(pixel, 0.5, 0.5).T)
    traced = bench.traced(bench.place[probe], toward, WIDTH * height, PIXEL_RAYS).mean(axis=0)
    shape = (height, WIDTH, 3)
    image = panels(baked.reshape(shape), traced.reshape(shape), np.ones(shape[:2], bool))
    Image.fromarray(image).save(path)


def figures(path: Path, words: argparse.Namespace) -> dict[str, float]:
    """Measure one scene.

    Parameters
    ----------
    path : Path
        Its snapshot.
    words : Namespace
        The command line.

    Returns
    -------
    dict of str to float
        By name.
    """
    bench = Bench(path, words)
    studio = bench.studio(bench.place, words.threads)
    start = time.perf_counter()
    shoot(bench.cached, studio, np.arange(len(bench.place)))
    seconds = (time.perf_counter() - start) / len(bench.place)
    found = {"cache_s": bench.cache_seconds, "probe_s": seconds, "rays_per_texel": float(studio.rays.mean())}
    found |= {"noise": float(np.sqrt((studio.noise**2).mean()))} | cost(bench) | size_of(studio) | errors(bench, studio)
    for probe in range(min(words.shown, len(bench.place)) if words.pictures else 0):
        picture(bench, studio, probe, words.pictures / f"{path.stem}_{probe}.png")
    return found


def main() -> None:
    """Read the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshots", nargs="+", type=Path)
    parser.add_argument("--probes", type=int, default=8)
    parser.add_argument("--sky", default="1.0")
    parser.add_argument("--sun", default="0.2,0.3,1")
    parser.add_argument("--quality", default="preview")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", type=Path, help="folder")
    parser.add_argument("--shown", type=int, default=2, help="probes of which there are pictures")
    parser.add_argument("--record", action="store_true", help="append rows to results.csv")
    words = parser.parse_args()
    for path in words.snapshots:
        found = figures(path, words)
        print(path.stem, "  ".join(f"{name} {value:.4g}" for name, value in found.items()))
        if words.record:
            add_row("capture", f"{path.stem}, {words.quality}, sun {words.sun}", found)


if __name__ == "__main__":
    main()
