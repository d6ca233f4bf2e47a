"""How well a bake reconstructs irradiance on surfaces, where the error comes from, and what a dense grid would do.

    python benchmarks/reconstruction.py BAKE... [--points 2000] [--near METRES] [--view] [--cache DIR] [--record]

The error is split by four values at each point, all compared with path tracing: nine harmonics at the point itself
(angular), the bake's interpolation of noiseless data (spatial), of the data as they were traced (transport), and as
they are stored (compression). Two independent halves of everything that is traced take its noise out of all squares.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.benchmarks import dense_grid, errors, receivers, stencils
from gi_volumes.benchmarks.circumstances import circumstances
from gi_volumes.benchmarks.dense_grid import DenseGrid
from gi_volumes.benchmarks.receivers import Receivers
from gi_volumes.benchmarks.results import add_row
from gi_volumes.benchmarks.stages import Bake, open_bake, split, stages

__all__ = ["Bake", "Plan", "choose", "measure", "open_bake", "record", "table"]

GRIDS = ("grid", "grid, facing")
INSETS = (0.5, 0.0)
"""Alignments of the grid with the scene's box; chance decides which suits the walls."""


@dataclass(frozen=True)
class Plan:
    """What to measure and how well.

    points : on surfaces
    seed : another one chooses other points
    near : only within this distance of the middle of the triangles [m]
    view : what the scene's cameras see instead of all surfaces
    samples : paths at each point for each half of the reference
    data_samples : paths at each data point for each half of its noiseless value
    grid : whether to measure the dense grid too
    """

    points: int = 2000
    seed: int = 0
    near: float | None = None
    view: bool = False
    samples: int = 2048
    data_samples: int = 2048
    grid: bool = True


def choose(bake: Bake, plan: Plan) -> Receivers:
    """Choose the points of a plan.

    Parameters
    ----------
    bake : Bake
        The bake.
    plan : Plan
        How many and where.

    Returns
    -------
    Receivers
        The same for every bake of a scene.

    Raises
    ------
    ValueError
        There are too few such points.
    """
    if not plan.view:
        return receivers.spread(bake.traced.scene, plan.points, plan.seed, plan.near)
    found = receivers.seen(bake.traced.scene, bake.traced.snapshot, plan.points)
    if not len(found.point):
        raise ValueError("the scene has no camera that sees a surface")
    return found


def measure(bake: Bake, plan: Plan, points: Receivers | None = None) -> dict:
    """Measure a bake.

    Parameters
    ----------
    bake : Bake
        From `open_bake`.
    plan : Plan
        How well.
    points : Receivers, optional
        Where, instead of at the plan's points.

    Returns
    -------
    dict
        `errors`: for each transport and "all", what `errors.compare` returns and the parts `angular`, `spatial`,
        `transport`, `compression`, all relative to the mean reference; `circumstances`: see there; `grid`: for each
        kind of grid, its spacing, probes, compressed bytes over raw ones, and errors by transport; `bytes` of the
        bake; `points` and `data_points` used.
    """
    points = choose(bake, plan) if points is None else points
    used = stencils.stencil(bake.world, points.point, points.normal)
    sites = stencils.sites(bake.world, used.used)
    values = stages(bake, (plan.samples, plan.data_samples), points, used, sites)
    found = {
        "bytes": bake.bytes,
        "points": len(points.point),
        "data_points": len(used.used),
        "errors": {name: errors.compare(v["stored"], v["reference"]) | split(v) for name, v in values.items()},
        "circumstances": circumstances(bake, points, used, sites, values["all"]),
    }
    if plan.grid:
        found["grid"] = compare_grids(bake, points, {name: v["reference"] for name, v in values.items()})
    return found


def compare_grids(bake: Bake, points: Receivers, references: dict[str, np.ndarray]) -> dict:
    """Measure a dense grid of four harmonics with as many bytes as a bake: the better of two alignments.

    Parameters
    ----------
    bake : Bake
        The bake.
    points : Receivers
        Where.
    references : dict of str to (2, n) ndarray
        Luminance of the path-traced values of each transport and "all".

    Returns
    -------
    dict
        For each kind of grid, as `measure` says.
    """
    raw = bake.bytes / bake.functions / dense_grid.PROBE_BYTES
    traced, samples = bake.traced, bake.settings.samples
    grid = dense_grid.build(traced.scene, raw)
    ratio = min(1.0, dense_grid.ratio(dense_grid.trace(traced, grid, dense_grid.planes(grid), samples)))
    found = []
    for inset in INSETS:
        grid = dense_grid.build(traced.scene, raw / ratio, inset)
        figures = {"spacing": grid.spacing, "probes": len(grid.valid), "ratio": ratio, "inset": inset}
        found.append(figures | _grid_errors(bake, grid, points, references))
    return min(found, key=lambda each: min(each[kind]["all"]["rmse"] for kind in GRIDS))


def _grid_errors(bake: Bake, grid: DenseGrid, points: Receivers, references: dict[str, np.ndarray]) -> dict:
    """Errors of one grid by kind and transport."""
    local = points.point - bake.traced.scene.origin
    rows = np.unique(grid.weigh(local, None)[0])
    values = dense_grid.trace(bake.traced, grid, rows, bake.settings.samples)
    found = {}
    for kind in GRIDS:
        look = (local, points.normal, kind != "grid")
        light = {name: dense_grid.irradiance(grid, rows, v, *look) @ LUMINANCE for name, v in values.items()}
        light["all"] = sum(light.values())
        found[kind] = {name: errors.compare(light[name], references[name]) for name in light}
    return found


def table(found: dict) -> str:
    """A measurement as text.

    Parameters
    ----------
    found : dict
        From `measure`.

    Returns
    -------
    str
        Relative errors in per cent.
    """
    keys = ("rmse", "rmse_error", "bias", "noise", "angular", "spatial", "ideal", "transport", "compression")
    keys += ("p50", "p90", "p99", "bright", "dark")
    lines = [f"{found['points']} points, {found['data_points']} data points, {found['bytes'] / 1e6:.2f} MB; per cent"]
    lines.append(f"{'':12s}" + "".join(f"{key[:10]:>11s}" for key in keys))
    for name, row in found["errors"].items():
        lines.append(f"{name:12s}" + "".join(f"{100 * row[key]:11.2f}" for key in keys if key in row))
    grid = found.get("grid")
    if grid:
        lines.append(f"dense grid of {grid['probes']} probes, {grid['spacing']:.3f} m, zstd x {grid['ratio']:.2f}")
        for kind in GRIDS:
            cells = (f"{name} {100 * row['rmse']:.2f}" for name, row in grid[kind].items() if row)
            lines.append(f"  {kind:14s} rmse: " + ", ".join(cells))
    lines.append(f"{'share of':28s}{'points':>8s}{'error2':>8s}{'spatial2':>9s}{'rmse':>8s}{'spatial':>9s}")
    for name, row in found["circumstances"].items():
        shares = f"{100 * row['points']:8.1f}{100 * row['error']:8.1f}{100 * row['spatial']:9.1f}"
        lines.append(f"{name:28s}{shares}{100 * row['rmse']:8.2f}{100 * row['spatial_rms']:9.2f}")
    return "\n".join(lines)


def record(name: str, found: dict) -> None:
    """Add rows to `benchmarks/results.csv`.

    Parameters
    ----------
    name : str
        Of the scene.
    found : dict
        From `measure`.
    """
    for transport, row in found["errors"].items():
        figures = dict(row)
        for kind in GRIDS if "grid" in found else ():
            figures[f"{kind.replace(', ', '_')}_rmse"] = found["grid"][kind][transport].get("rmse", np.nan)
        add_row("reconstruction", f"{name} {transport}", figures | {"bytes": found["bytes"]})


def main() -> None:
    """Measure bakes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bakes", type=Path, nargs="+")
    parser.add_argument("--points", type=int, default=Plan.points)
    parser.add_argument("--seed", type=int, default=Plan.seed)
    parser.add_argument("--near", type=float, help="only within this distance of where the triangles are [m]")
    parser.add_argument("--view", action="store_true", help="what the cameras see instead of all surfaces")
    parser.add_argument("--samples", type=int, default=Plan.samples)
    parser.add_argument("--data-samples", type=int, default=Plan.data_samples)
    parser.add_argument("--no-grid", action="store_true", help="leave the dense grid out")
    parser.add_argument("--cache", type=Path, help="folder for what was traced")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--record", action="store_true", help="add rows to results.csv")
    options = parser.parse_args()
    words = (options.points, options.seed, options.near, options.view, options.samples, options.data_samples)
    plan = Plan(*words, not options.no_grid)
    for path in options.bakes:
        found = measure(open_bake(path, options.cache, options.threads), plan)
        print(path.name, table(found), sep=": ", flush=True)
        if options.record:
            record(path.name, found)


if __name__ == "__main__":
    main()
