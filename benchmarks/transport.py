"""How close the path tracer comes to embreex alone: the same rays, with and without everything around them.

    python benchmarks/transport.py SNAPSHOT.giv [--points 1024] [--samples 256] [--bounces 4] [--repeat 5]

Gathers light at data points of a scene, records every batch of rays that a run traces, and replays the batches
through embreex with nothing between. Prints rays per second of processor time of both, on one thread, and their
ratio: medians of several alternating runs after one to warm up. The speed-up of two threads is of wall time. A scene
without a sky or a sun gets one. Adds rows to `benchmarks/results.csv`.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import datapoints, snapshot_file
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.rays import Tracer
from gi_volumes.bake.scene import prepare, scene_suns
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import Settings, model
from gi_volumes.benchmarks.results import add_row


class Recorder(Tracer):
    """A tracer that keeps the batches it is asked to trace."""

    def __init__(self, tracer: Tracer) -> None:
        self.__dict__.update(tracer.__dict__)
        self.batches: list[tuple] = []

    def _first_hit(self, scene, origin, direction, far):
        self.batches.append((scene, origin.copy(), np.array(direction), None if far is None else far.copy(), True))
        return super()._first_hit(scene, origin, direction, far)

    def blocked(self, origin, direction, far):
        self.batches.append((self._opaque, origin.copy(), np.array(direction), far.copy(), False))
        return super().blocked(origin, direction, far)


def replay(batches: list[tuple]) -> float:
    """Seconds that embreex alone takes for recorded batches."""
    start = time.process_time()
    for scene, origin, direction, far, first_hit in batches:
        limit = None if far is None else far.astype(np.float32)
        if first_hit:
            scene.run(origin.T, direction.T, limit, output=True)
        else:
            scene.run(origin.T, direction.T, limit, query="OCCLUDED")
    return time.process_time() - start


def main() -> None:
    """Measure one scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshot", type=Path)
    parser.add_argument("--name", help="of the scene, for the results")
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--bounces", type=int, default=4)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    snapshot = snapshot_file.load(options.snapshot)
    sky = "scene" if snapshot.sky.any() else "1.0"
    sun = "scene" if len(scene_suns(snapshot).toward) else "0.2,0.3,1"
    scene = prepare(*model(snapshot, Settings(sky=sky, sun=sun)))
    position, keys = data_points(scene, options.points)
    effort = Effort(options.samples, options.bounces, threads=1)

    def run(tracing_scene) -> float:
        start = time.process_time()
        gather(tracing_scene, HarmonicsSensor(), position, keys, effort)
        return time.process_time() - start

    recorder = Recorder(scene.tracer)
    run(type(scene)(**{**scene.__dict__, "tracer": recorder}))
    rays = sum(batch[1].shape[1] for batch in recorder.batches)
    replay(recorder.batches)
    pairs = [(run(scene), replay(recorder.batches)) for _ in range(options.repeat)]
    whole, alone = np.median(pairs, axis=0)
    wall = [[run_threads(scene, position, keys, options, n) for n in (1, 2)] for _ in range(options.repeat)]
    figures = {
        "rays": rays,
        "mrays_per_s": rays / whole / 1e6,
        "embree_mrays_per_s": rays / alone / 1e6,
        "ratio": float(np.median([b / a for a, b in pairs])),
        "us_per_path": whole / position.shape[1] / options.samples * 1e6,
        "two_threads_speedup": float(np.median([one / two for one, two in wall])),
    }
    add_row("transport", options.name or options.snapshot.stem, figures)


def run_threads(scene, position, keys, options, threads: int) -> float:
    """Seconds that pass while some threads do the work."""
    start = time.perf_counter()
    gather(scene, HarmonicsSensor(), position, keys, Effort(options.samples, options.bounces, threads=threads))
    return time.perf_counter() - start


def data_points(scene, count: int):
    """Points in free space, spread over the scene's bounds, in the order that a bake takes."""
    rng = np.random.default_rng(0)
    low, high = scene.soup.bounds
    inner = low + (high - low) * 0.05, high - (high - low) * 0.05
    center = rng.uniform(*inner, (3 * count, 3))
    placed = datapoints.place(scene, center, np.full(len(center), 0.5), np.arange(len(center), dtype=np.uint32))
    position = placed.position[:, placed.valid][:, :count]
    order = datapoints.morton_order(position)
    return np.ascontiguousarray(position[:, order]), order.astype(np.uint32)


if __name__ == "__main__":
    main()
