"""What finding lit spots from the lamps' side gains: noise and time with and without, at surface points of a scene.

    python benchmarks/lit_spots.py SNAPSHOT.giv [--points 1000] [--samples 256] [--record]

Noise is the scatter of three seeds, root mean square over points, relative to the mean. Efficiency is how many times
as long paths alone would take for the same noise. Seconds are the processor's, of two threads.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from gi_volumes.bake import snapshot_file
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import Settings, model
from gi_volumes.benchmarks import receivers
from gi_volumes.benchmarks.results import add_row

SEEDS = (1, 2, 3)
ABOVE = 0.05
"""Height of the points above surfaces [m]: half of a finest voxel."""


def measure(scene: Scene, points: int, effort: Effort) -> dict[str, float]:
    """Measure one way to find light.

    Parameters
    ----------
    scene : Scene
        With its lit spots, or without.
    points : int
        How many, on surfaces.
    effort : Effort
        Paths, bounces and threads.

    Returns
    -------
    dict of str to float
        Mean irradiance of local light [W/m2], noise relative to it, microseconds a path.
    """
    chosen = receivers.spread(scene, points, 5, None)
    position = (chosen.point - scene.origin + ABOVE * chosen.normal).T.astype(np.float32)
    keys, found, start = np.arange(position.shape[1], dtype=np.uint32), [], time.process_time()
    for seed in SEEDS:
        once = dataclasses.replace(effort, seed=seed)
        found.append(gather(scene, HarmonicsSensor(), position, keys, once).local[:, 0].mean(axis=1))
    seconds, mean = time.process_time() - start, float(np.mean(found))
    noise = float(np.sqrt(np.var(found, axis=0, ddof=1).mean())) / mean
    return {"mean": mean, "noise": noise, "us a path": seconds / len(SEEDS) / len(keys) / effort.samples * 1e6}


def main() -> None:
    """Measure a scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshot", type=Path)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--record", action="store_true", help="add rows to results.csv")
    options = parser.parse_args()
    scene = prepare(*model(snapshot_file.load(options.snapshot), Settings()))
    without = dataclasses.replace(scene, lit_spots=type(scene.lit_spots)(scene.lamps, scene.tracer, scene.surfaces))
    without.lit_spots.count = 0
    effort = Effort(options.samples, threads=2)
    measure(scene, 50, effort)
    chance, both = (measure(each, options.points, effort) for each in (without, scene))
    gain = (chance["noise"] / both["noise"]) ** 2 * chance["us a path"] / both["us a path"]
    rows = {f"{name}, by chance": value for name, value in chance.items()} | both | {"efficiency": gain}
    rows["lamps that light spots"] = scene.lit_spots.count
    if options.record:
        add_row("lit_spots", options.snapshot.stem, rows)
    else:
        print(options.snapshot.stem, {name: round(value, 4) for name, value in rows.items()})


if __name__ == "__main__":
    main()
