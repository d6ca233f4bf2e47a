"""What the compression of payloads costs in irradiance on surfaces, against the bytes it takes.

    python benchmarks/compression.py SNAPSHOT.giv [--samples 1024] [--points 3000] [--tolerances 0.02,0.05] [--record]

Bakes the scene with a free sun and a changing sky, keeps the values as they were traced, and compresses them with
several tolerances and with the goals that bakes use. Errors are of irradiance on surfaces, root mean square relative to
the irradiance: of each transport alone (the sun: median over its keys), and of all together on a clear day, a
sun of 20 W/m2 in each key in turn and a white sky of radiance 1. A second bake with another seed tells the noise of
the values themselves, and by how much the error against noiseless values grows. `--record` adds rows to
`benchmarks/results.csv`.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import job, snapshot_file
from gi_volumes.bake.scene import prepare
from gi_volumes.bake.settings import Settings, model
from gi_volumes.benchmarks.receivers import spread
from gi_volumes.benchmarks.results import add_row
from gi_volumes.tree import folder, payload, world
from gi_volumes.tree.payload import GOALS
from gi_volumes.tree.transform import Goal

LIFT = 1e-3
"""Distance of the points from their surface [m]."""

SUN = 20.0
"""Irradiance of a clear day's sun, six times that of its sky [W/m2 for a sky of radiance 1]."""

SKY = np.array([[np.sqrt(4 * np.pi)] * 3] + [[0.0] * 3] * 8)
"""A white sky of radiance 1 W/(m2 sr)."""


@dataclass
class Exact:
    """Values of a cell as they were traced, in the place of a payload."""

    values: np.ndarray
    valid: np.ndarray

    @property
    def functions(self) -> int:
        """Number of functions."""
        return self.values.shape[1]

    @property
    def index(self) -> np.ndarray:
        """One entry for each data point."""
        return np.where(self.valid, np.arange(len(self.valid)), payload.NO_DATA)

    @property
    def table(self) -> Exact:
        """The entries."""
        return self

    def fold(self, factors: np.ndarray) -> np.ndarray:
        """Sum the functions of each entry."""
        return np.einsum("nkhc,kc->nhc", self.values.astype(np.float64), factors).reshape(-1, 27).astype(np.float32)


@dataclass
class Baked:
    """A bake in memory: `world.json`, its cells, and their values as they were traced."""

    header: dict
    cells: list[folder.Cell]
    exact: list[dict[str, Exact]]


def bake(snapshot_path: Path, samples: int, seed: int = 0) -> Baked:
    """Bake a scene and keep its exact values.

    Parameters
    ----------
    snapshot_path : Path
        The snapshot.
    samples : int
        Paths for each data point.
    seed : int
        Another one gives independent noise.

    Returns
    -------
    Baked
        What was baked.
    """
    kept, write = {}, folder.write_cell

    def keep(path, topology, payloads, valid, *rest):
        kept[topology.cell] = {name: Exact(values.copy(), valid.copy()) for name, values in payloads.items()}
        return write(path, topology, payloads, valid, *rest)

    settings = Settings(samples, 6, sky="harmonics", sun="hemisphere", seed=seed)
    with tempfile.TemporaryDirectory() as place, mock.patch.object(folder, "write_cell", keep):
        job.bake(snapshot_file.load(snapshot_path), Path(place), settings, manner=job.Manner(1))
        header = folder.load_header(place)
        cells = [folder.read_cell(place, tuple(entry["cell"])) for entry in header["cells"]]
    return Baked(header, cells, [kept[cell.topology.cell] for cell in cells])


def irradiance(baked: Baked, payloads: list[dict], points: np.ndarray, normals: np.ndarray) -> dict[str, list]:
    """Look irradiance up in other payloads than the bake's own.

    Parameters
    ----------
    baked : Baked
        The bake.
    payloads : list of dict
        Of each cell.
    points, normals : (n, 3) float64 ndarray
        Where.

    Returns
    -------
    dict of str to list of (n, 3) ndarray
        By transport; the sun's for each key.
    """
    cells = [folder.Cell(**(vars(cell) | {"payloads": own})) for cell, own in zip(baked.cells, payloads, strict=True)]
    look = world.World(baked.header, cells)
    keys = baked.header["transports"]["sun"]["directions"]
    found = {"sun": [look.irradiance(points, normals, (key, SUN), transport="all", sky=0.0) for key in keys]}
    local = look.irradiance(points, normals, transport="local")
    found["sun"] = [value - local for value in found["sun"]]
    found["sky"] = [look.irradiance(points, normals, sky=SKY, transport="sky")]
    return found | ({"local": [local]} if local.any() else {})


def compress(baked: Baked, goals: dict[str, Goal]) -> tuple[list[dict], dict[str, float]]:
    """Compress the exact values.

    Parameters
    ----------
    baked : Baked
        The bake.
    goals : dict of str to Goal
        For each payload.

    Returns
    -------
    payloads : list of dict
        Of each cell.
    sizes : dict of str to float
        Bytes on disk for each data point.
    """
    points, sizes, payloads = sum(int(cell.valid.sum()) for cell in baked.cells), dict.fromkeys(goals, 0.0), []
    with tempfile.TemporaryDirectory() as place, mock.patch.dict(payload.GOALS, goals):
        for own in baked.exact:
            payloads.append({})
            for name, exact in own.items():
                path = Path(place) / name
                sizes[name] += payload.write_payload(path, name, exact.values, exact.valid, {}) / points
                payloads[-1][name] = payload.read_payload(path)[0]
    return payloads, {name: size for name, size in sizes.items() if size}


def figures(exact: dict[str, list], stored: dict[str, list], other: dict[str, list]) -> dict[str, float]:
    """Errors of irradiance.

    Parameters
    ----------
    exact, stored, other : dict of str to list of (n, 3) ndarray
        From `irradiance`: as traced, compressed, and as traced with another seed.

    Returns
    -------
    dict of str to float
        Relative root mean square errors, of each transport and of all.
    """
    found = {}
    for name, values in exact.items():
        pairs = zip(values, stored[name], strict=True)
        found[name] = float(np.median([_rms(b - a) / _rms(a) for a, b in pairs if a.any()]))
    a, b, c = (_days(side) for side in (exact, stored, other))
    level = np.array([_rms(x) for x in a])
    added = np.array([_rms(y - x) for x, y in zip(a, b, strict=True)]) / level
    noise = np.array([_rms(z - x) for x, z in zip(a, c, strict=True)]) / level / np.sqrt(2)
    whole = np.array([_rms(z - y) for y, z in zip(b, c, strict=True)]) / level
    growth = np.sqrt(np.maximum(np.square(whole).mean() - np.square(noise).mean(), 0)) - _rms(noise)
    return found | {"clear day": _rms(added), "worst key": added.max(), "noise": _rms(noise), "growth": growth}


def _days(found: dict[str, list]) -> list[np.ndarray]:
    """Irradiance of clear days, the sun in each key in turn."""
    steady = sum(values[0] for name, values in found.items() if name != "sun")
    return [sun + steady for sun in found["sun"]]


def _rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(values.astype(np.float64)).mean()))


def main() -> None:
    """Measure one scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshot", type=Path)
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--tolerances", default="0.02,0.05")
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    baked = bake(options.snapshot, options.samples)
    scene = prepare(*model(snapshot_file.load(options.snapshot), Settings(sky="harmonics", sun="hemisphere")))
    on = spread(scene, options.points)
    points, normals = on.point + LIFT * on.normal, on.normal
    exact = irradiance(baked, baked.exact, points, normals)
    another = bake(options.snapshot, options.samples, seed=1)
    other = irradiance(another, another.exact, points, normals)
    goals = {f"{t:g}": dict.fromkeys(GOALS, Goal(t)) for t in map(float, options.tolerances.split(","))}
    for name, chosen in (goals | {"stored": GOALS}).items():
        payloads, sizes = compress(baked, chosen)
        errors = figures(exact, irradiance(baked, payloads, points, normals), other)
        rows = {f"{name}: {part} bytes": size for part, size in sizes.items()} | {f"{name}: bytes": sum(sizes.values())}
        rows |= {f"{name}: {part} error": error for part, error in errors.items()}
        print(
            f"{options.snapshot.stem} {options.samples} {name}:", _line(sizes), "=", f"{sum(sizes.values()):.1f} bytes;"
        )
        print("    errors", _line({part: 100 * error for part, error in errors.items()}), "%", flush=True)
        if options.record:
            add_row("compression", f"{options.snapshot.stem}, {options.samples} paths", rows)


def _line(numbers: dict[str, float]) -> str:
    """Numbers with their names."""
    return ", ".join(f"{name} {value:.2f}" for name, value in numbers.items())


if __name__ == "__main__":
    main()
