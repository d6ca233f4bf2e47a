"""Time for all transports of a changing sun and sky at equal error: the surface cache, paths, Cycles, in one run.

    python benchmarks/all_transports.py [SCENE...] [--points 65536] [--judged 256] [--repeat 1] [--record]

Local light, 16 suns and nine functions of the sky, at data points of a tree that geometry alone asks for. The cache has
256 paths a point; paths get what they need for the same error of every group of transports, Cycles for each bake apart.
Both are then run with that, so that errors are shown. Last come the least paths with which the median point is off by
5 % at most in every group, or 1,024; others follow by their slopes. Times are of some points, scaled; `--whole` takes
all for the cache. Light bounces up to 64 times, and roulette ends paths.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import bpy
import numpy as np
from gi_volumes.bake.settings import CACHED_BOUNCES
from gi_volumes.benchmarks import coincident_faces, scene_edits
from gi_volumes.benchmarks.cost import Cost, median
from gi_volumes.benchmarks.cycles_agreement import open_scene
from gi_volumes.benchmarks.cycles_transports import Bakes
from gi_volumes.benchmarks.equal_error import KINDS
from gi_volumes.benchmarks.equal_transports import TIMED, Comparison
from gi_volumes.benchmarks.our_transports import AXES, Ours
from gi_volumes.benchmarks.results import add_row

COURTYARD = Path(__file__).parent.parent / "build" / "demo" / "courtyard.blend"
WANTED = 65536
"""Data points that times are given for."""


def compare(scene: Path, options: argparse.Namespace) -> tuple[Comparison, Cost]:
    """Measure one scene.

    Parameters
    ----------
    scene : Path
        A .blend, .glb or .gltf file.
    options : Namespace
        Of the command line.

    Returns
    -------
    found : Comparison
    whole : Cost
        Of all data points with the cache, which is filled; scaled from some, if not asked for.
    """
    print(f"{scene.name}, Blender {bpy.app.version_string}: added {', '.join(open_scene(scene)) or 'nothing'}")
    coincident_faces.remove_coincident()
    ours = Ours(options.points, options.judged, options.threads)
    scene_edits.make_diffuse()
    diameter = float(ours.scene.model.suns.diameter[0])
    found = Comparison(
        ours,
        Bakes(ours.points, AXES, CACHED_BOUNCES, options.threads, diameter),
        options.reference,
        (options.samples, options.repeat),
    )
    found.run()
    if options.whole:
        return found, ours.whole(found.caches[0], found.samples, 1)
    timed = len(ours.stretches) * TIMED
    return found, median(found.timed.costs["cache"]) * (len(ours.key) * found.samples / timed)


def seconds(found: Comparison, whole: Cost, kind: str, paths: int = 0) -> dict[str, Cost]:
    """Times of all `WANTED` points at equal error.

    Parameters
    ----------
    found : Comparison
        All runs.
    whole : Cost
        As `compare` returns it.
    kind : str
        One of `KINDS`, which error is equal.
    paths : int
        Of the cache for a point; 0 for those at which errors were made equal.

    Returns
    -------
    dict of str to Cost
        The cache with its filling, paths, Cycles, Cycles with no more samples than were run, and Cycles by group.
    """
    count, timed = len(found.ours.key), len(found.ours.stretches) * TIMED
    each = found.needed("cycles", kind, paths)[2]
    costs = {
        "cache": median(found.filling) + whole * (WANTED / count * (paths or found.samples) / found.samples),
        "paths": median(found.timed.costs["paths"])
        * (WANTED * max(found.needed("paths", kind, paths)[1].values()) / timed),
    }
    bakes = [found.cycles_cost(function)[0] * (WANTED * samples) for function, samples in enumerate(each)]
    costs["cycles"] = sum(bakes, Cost(0, 0))
    run = np.minimum(each, found.equal["cycles"])
    costs["cycles, samples as run at most"] = sum(
        (found.cycles_cost(function)[0] * (WANTED * samples) for function, samples in enumerate(run)), Cost(0, 0)
    )
    return costs | {f"cycles {name}": sum(bakes[part], Cost(0, 0)) for name, part in found.ours.groups.items()}


def figures(found: Comparison, whole: Cost) -> dict[str, float]:
    """Say what was found.

    Parameters
    ----------
    found : Comparison
        All runs.
    whole : Cost
        As `compare` returns it.

    Returns
    -------
    dict of str to float
        By name; times are of `WANTED` points, [cpu s] of the processor, [s] on the clock.
    """
    ours, timed = found.ours, len(found.ours.stretches) * TIMED
    out = {
        "data points": len(ours.key),
        "judged points": len(ours.judged),
        "surfels": len(found.caches[0].cache.light),
        "cache, paths of a point": found.samples,
        "paths, paths of a point": int(found.equal["paths"][0]),
        "filling [cpu s]": median(found.filling).cpu,
        "filling [s]": median(found.filling).wall,
        "cache, all data points [cpu s]": whole.cpu,
        "cache, all data points [s]": whole.wall,
    }
    out |= {
        f"{name} [cpu us per path]": 1e6 * median(found.timed.costs[name]).cpu / timed for name in ("cache", "paths")
    }
    for kind, paths, label in [
        *((kind, 0, kind) for kind in KINDS),
        ("median", found.enough, f"median, {found.enough} paths"),
    ]:
        costs = seconds(found, whole, kind, paths)
        for name, cost in costs.items():
            out |= {f"{label}: {name} [cpu s]": cost.cpu, f"{label}: {name} [s]": cost.wall}
        for name in ("paths", "cycles"):
            out[f"{label}: cache faster than {name} [cpu]"] = costs[name].cpu / costs["cache"].cpu
            out[f"{label}: cache faster than {name} [clock]"] = costs[name].wall / costs["cache"].wall
        least = costs["cycles, samples as run at most"]
        out[f"{label}: cache faster than cycles, samples as run at most [cpu]"] = least.cpu / costs["cache"].cpu
    for kind in KINDS:
        out |= _errors(found, kind)
    for samples, errors in found.cache_errors().items():
        out |= {f"median: {group} error, cache of {samples} paths": error for group, error in errors.group.items()}
    for function, transport in enumerate(ours.transports):
        sample, overhead = found.cycles_cost(function)
        out.setdefault(f"cycles {transport.group} [cpu us per sample of an axis]", 1e6 * sample.cpu / len(AXES))
        out.setdefault(f"cycles {transport.group} overhead of a bake [cpu s]", overhead.cpu)
    return out


def _errors(found: Comparison, kind: str) -> dict[str, float]:
    """Errors at equal error, truncation, and how samples and errors go together."""
    out, truncation = {}, found.truth.apart(found.exact, kind).group
    errors = found.errors_at_equal(kind)
    for group in found.ours.groups:
        out |= {f"{kind}: {group} error, {name}": each.group[group] for name, each in errors.items()}
        out[f"{kind}: {group} truncation"] = truncation[group]
        for name in ("paths", "cycles"):
            slope, samples, _ = found.needed(name, kind)
            out |= {f"{kind}: {group} {name} needed": samples[group], f"{kind}: {group} {name} slope": slope[group]}
    return out


def table(scene: str, found: dict[str, float], groups: list[str]) -> str:
    """Lay figures out for people.

    Parameters
    ----------
    scene : str
        Its name.
    found : dict
        As `figures` returns it.
    groups : list of str
        Transports.

    Returns
    -------
    str
        Lines.
    """
    lines = [
        f"{scene}: {WANTED} points, {' + '.join(groups)}; {found['data points']} data points, "
        f"{found['judged points']} judged; cache {found['cache, paths of a point']} paths"
    ]
    for kind in KINDS:
        for name in ("cache", "paths", "cycles"):
            errors = ", ".join(f"{group} {100 * found[f'{kind}: {group} error, {name}']:.1f} %" for group in groups)
            times = f"{found[f'{kind}: {name} [cpu s]']:8.1f} cpu s {found[f'{kind}: {name} [s]']:8.1f} s"
            ratio = found[f"{kind}: {name} [cpu s]"] / found[f"{kind}: cache [cpu s]"]
            lines.append(f"  equal {kind:6} {name:6} {times} {ratio:6.1f} x   run with error {errors}")
    return "\n".join(lines)


def main() -> None:
    """Measure scenes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", default=[COURTYARD])
    parser.add_argument("--points", type=int, default=WANTED, help="data points at most")
    parser.add_argument("--samples", type=int, default=256, help="paths of a point with the cache: 64, 128, ... 1024")
    parser.add_argument("--judged", type=int, default=256, help="points at which errors are measured")
    parser.add_argument("--reference", type=int, default=2048, help="paths of each half of the reference")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--whole", action="store_true", help="measure all data points with the cache, not only some")
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    for scene in options.scenes:
        comparison, whole = compare(scene, options)
        found = figures(comparison, whole)
        for name, value in found.items() if not options.record else ():
            print(f"{scene.stem}: {name} = {value:.5g}")
        if options.record:
            add_row("all_transports", scene.stem, found)
        print(table(scene.stem, found, list(comparison.ours.groups)), flush=True)


if __name__ == "__main__":
    main()
