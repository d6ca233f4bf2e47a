"""A bake, loaded: irradiance at any point for any normal, and radiance that rays meet: what the files mean.

    E(p, n) = E_local(p, n) + E_sun(p, n; sun direction) * sun irradiance + E_sky(p, n; sky radiance)   [W/m2]

Comes in: a folder, then points and normals. Goes out: irradiance, finite and not negative everywhere. Each of the
three terms is clamped at 0 by itself, so that they add up whether they are asked for together or one by one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from . import folder, harmonics, planes, probe_cells, probe_file
from .blend import blend, clamp
from .container import FileError
from .grid import Grid
from .interpolate import DataPoints, join
from .lookup import Atlas
from .probe_maps import ProbeMaps
from .probe_sets import ProbeSets
from .reflections import Rays, Reflections
from .sources import TRANSPORTS, Sources
from .values import Values

__all__ = ["TRANSPORTS", "World", "load"]

LARGEST = np.finfo(np.float32).max / 100
"""Limit of coefficients, so that no sum of them overflows."""
CHUNK = 1 << 16
"""Points handled at a time: few enough for some 50 MB, so many that calls cost little."""
RAYS = 1 << 14
"""Rays handled at a time, each with a dozen probes: some 100 MB."""
REMEMBERED = 4
"""Combinations of transports, sun and sky whose coefficients are kept for the next look-up."""


class World:
    """A baked folder.

    Parameters
    ----------
    header : dict
        Content of `world.json`.
    cells : list of Cell
        All cells of the bake.
    maps : ProbeMaps, optional
        What its reflection probes see.
    sets : sequence of ProbeSets
        Which of them count where, of each cell; there are none without probes.

    Attributes
    ----------
    header : dict
        Content of `world.json`.
    grid : Grid
        The lattice; `grid.origin` is where local metres start.
    cells : (n, 2) int64
        World cells (i, j) that are there.
    """

    def __init__(
        self,
        header: dict,
        cells: list[folder.Cell],
        maps: ProbeMaps | None = None,
        sets: Sequence[ProbeSets] = (),
    ):
        self.header, self.grid = header, folder.grid_of(header)
        self.cells = np.array([cell.topology.cell for cell in cells], np.int64).reshape(-1, 2)
        self._data = _data_points(self.grid, cells)
        names = [name for name in TRANSPORTS[1:] if any(name in cell.payloads for cell in cells)]
        self._values = {name: _join(name, cells, self._data.atlas) for name in names}
        functions = {name: values.functions for name, values in self._values.items()}
        self._sources = Sources(header.get("transports", {}), functions)
        self._remembered: dict[tuple, np.ndarray] = {}
        self._reflections = Reflections(self._data, maps, sets) if maps is not None and len(maps.position) else None

    @property
    def sun_irradiance(self) -> np.ndarray:
        """(3,) float64 irradiance of the scene's own suns together, on surfaces that face them [W/m2]."""
        return self._sources.sun_irradiance

    def irradiance(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        sun: tuple | None = None,
        sky: np.ndarray | float | None = None,
        transport: str = "all",
    ) -> np.ndarray:
        """Return irradiance.

        Parameters
        ----------
        points : (n, 3) float64
            World space [m]; anywhere, also outside the bake.
        normals : (n, 3) float
            Away from the surface, of any length; zero gives the mean over all directions.
        sun : (direction, irradiance), optional
            Direction to the sun, and its irradiance on a surface that faces it, a number or (3,) [W/m2]; the
            scene's own suns when None. A bake of fixed suns knows their directions only.
        sky : float, (3,) or (9, 3), optional
            Factor of the scene's own sky, or the harmonics of another sky's radiance [W/(m2 sr)], for a bake that
            holds the response to them; the scene's own sky when None.
        transport : str
            "all"; "local" or "sky" alone; or "sun" alone, per 1 W/m2 of sun irradiance.

        Returns
        -------
        (n, 3) float32
            Irradiance [W/m2], finite and not negative. A transport that the bake does not have is 0.

        Raises
        ------
        ValueError
            For wrong shapes, input that is not finite, an unknown transport, a sun or a sky that the bake cannot
            represent.

        Notes
        -----
        Error: bounded by what is stored; see `docs/accuracy.md`.
        Source: the talk's rows 9 and 10.
        """
        points, normals = _check_rows(points, "points"), _check_rows(normals, "normals")
        if len(points) != len(normals):
            raise ValueError(f"{len(points)} points and {len(normals)} normals; as many are needed")
        values = self._folded(self._sources.factors(sun, sky, transport))
        result = np.zeros((len(points), 3), np.float32)
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            result[part] = self._evaluate(points[part], normals[part], values)
        return result

    def radiance(
        self,
        points: np.ndarray,
        directions: np.ndarray,
        roughness: np.ndarray | float,
        sun: tuple | None = None,
        sky: np.ndarray | float | None = None,
        normals: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the radiance that rays meet, blurred by a lobe about them: what a surface there mirrors.

        Parameters
        ----------
        points : (n, 3) float64
            World space [m]; anywhere, also outside the bake.
        directions : (n, 3) float
            Away from the points, of any length but 0: the mirror directions.
        roughness : float or (n,) float
            0 to 1; the lobe is that of `ggx.density`.
        sun, sky
            As for `irradiance`.
        normals : (n, 3) float, optional
            Of the surfaces that the points lie on, of any length; without them, or where they are zero, a wall
            without thickness does not hide what lies behind it.

        Returns
        -------
        (n, 3) float32
            Radiance [W/(m2 sr)], finite and not negative. Where no probe sees what a ray meets it is the irradiance of
            a surface that faces along the ray, over pi: as of a lobe as wide as a cosine.

        Raises
        ------
        ValueError
            For wrong shapes, input that is not finite, roughness out of range, a direction of no length, a sun or a
            sky that the bake cannot represent.

        Notes
        -----
        Error: see `docs/accuracy.md`. Continuous along a moving point, in direction and in roughness.
        Source: the talk's rows 3 and 4.
        """
        normals = np.zeros_like(directions) if normals is None else normals
        points, directions, normals = (
            _check_rows(*pair) for pair in ((points, "points"), (directions, "directions"), (normals, "normals"))
        )
        roughness = _check_roughness(roughness, len(points))
        if not len(points) == len(directions) == len(normals) == len(roughness):
            counts = f"{len(directions)} directions, {len(normals)} normals, {len(roughness)} numbers of roughness"
            raise ValueError(f"{len(points)} points, {counts}; as many are needed")
        if not directions.any(axis=1).all():
            raise ValueError(f"directions: row {int(np.argmin(directions.any(axis=1)))} has no length")
        factors, result = self._sources.factors(sun, sky, "all"), np.zeros((len(points), 3), np.float32)
        points = clamp(self._data, self.grid.to_local(points))
        directions, normals = (_unit(rows).astype(np.float32) for rows in (directions, normals))
        for start in range(0, len(points), RAYS):
            part = slice(start, start + RAYS)
            rays = Rays(points[part], directions[part], roughness[part], normals[part])
            result[part] = self._reflect(rays, factors)
        return result

    def _reflect(self, rays: Rays, factors: dict[str, np.ndarray]) -> np.ndarray:
        """One chunk: what probes see, and what irradiance says where they see nothing."""
        light, seen = np.zeros((len(rays.point), 3), np.float32), np.zeros(len(rays.point), np.float32)
        if self._reflections is not None:
            light, seen = self._reflections.look(rays, self._reflections.mixed(factors))
        some = np.flatnonzero(seen < 1)
        facing = np.where(rays.normal[some].any(axis=1, keepdims=True), rays.normal[some], rays.direction[some])
        other = self._toward(rays.point[some], facing, rays.direction[some], self._folded(factors)) / np.float32(np.pi)
        light[some] = seen[some, None] * light[some] + (1 - seen[some, None]) * other
        return light

    def _evaluate(self, points: np.ndarray, normals: np.ndarray, values: np.ndarray) -> np.ndarray:
        """One chunk of points in world space."""
        normals = _unit(normals)
        return self._toward(clamp(self._data, self.grid.to_local(points)), normals, normals, values)

    def _toward(self, points: np.ndarray, normals: np.ndarray, facing: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The mean coefficients of all transports at once, by the surfaces' normals, then each along what they face."""
        functions = harmonics.basis(facing)
        functions[:, 6] *= np.any(facing.T, axis=0)  # of no direction; the others are 0 there, but the constant
        mean = blend(self._data, values, points, normals)
        total = np.zeros((len(points), 3), np.float32)
        for first in range(0, mean.shape[1], 27):
            part = np.matmul(functions[:, None], mean[:, first : first + 27].reshape(-1, 9, 3))[:, 0]
            total += np.maximum(part, 0.0, out=part)
        return np.minimum(total, np.finfo(np.float32).max)

    def _folded(self, factors: dict[str, np.ndarray]) -> np.ndarray:
        """(rows, 27 for each transport) float32 coefficients of all voxels, for these suns and this sky."""
        key = tuple((name, factor.tobytes()) for name, factor in factors.items())
        if key not in self._remembered:
            while len(self._remembered) >= REMEMBERED:
                self._remembered.pop(next(iter(self._remembered)))
            parts = [self._values[name].folded(factor) for name, factor in factors.items()]
            folded = np.concatenate([np.zeros((len(self._data.valid), 0), np.float32), *parts], axis=1)
            self._remembered[key] = np.clip(folded, -LARGEST, LARGEST, out=folded)
        return self._remembered[key]


def load(path: str | os.PathLike) -> World:
    """Load a bake.

    Parameters
    ----------
    path : str or Path
        The folder.

    Returns
    -------
    World
        The bake, with every cell in memory.

    Raises
    ------
    FileError
        For a file that is damaged or does not belong to the bake.
    OSError
        For a folder or file that is missing or cannot be read.
    """
    header = folder.load_header(path)
    cells = []
    for entry in header["cells"]:
        cell = folder.read_cell(path, tuple(entry["cell"]))
        if cell.meta["bake"] != header["bake"]:
            name = f"cell_{entry['cell'][0]}_{entry['cell'][1]}.tree"
            raise FileError(os.path.join(path, name), 0, "this cell is of another bake than world.json")
        cells.append(cell)
    return World(header, cells, probe_file.load(path, header), probe_cells.load(path, header, cells))


def _data_points(grid: Grid, cells: list[folder.Cell]) -> DataPoints:
    """Join the data points of all cells."""
    offset = np.concatenate([np.zeros((0, 3), np.int8), *(cell.offset for cell in cells)])
    valid = np.concatenate([np.zeros(0, bool), *(cell.valid for cell in cells)])
    corners = np.array([[*cell.topology.cell, 0] for cell in cells], np.float64).reshape(-1, 3) * grid.cell_size
    occluders = planes.join([cell.planes for cell in cells], corners)
    shade = np.array([cell.planes.shade for cell in cells])
    fill = np.concatenate([np.zeros(0, np.float32), *(_fill(cell) for cell in cells)])
    return join(grid, [cell.topology for cell in cells], offset, valid, *occluders, shade, fill)


def _fill(cell: folder.Cell) -> np.ndarray:
    """(size,) float32 what a cell's voxels leave of light that fills up."""
    stored = cell.planes.fill
    return np.ones(len(cell.valid), np.float32) if stored is None else stored / np.float32(255)


def _join(name: str, cells: list[folder.Cell], atlas: Atlas) -> Values:
    """One payload over all cells."""
    return Values(name, [cell.payloads.get(name) for cell in cells], atlas.first)


def _check_rows(values: np.ndarray, what: str) -> np.ndarray:
    """(n, 3) finite float64."""
    values = np.asarray(values, np.float64)
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"{what} have shape {values.shape}; (n, 3) is needed")
    finite = np.isfinite(values)
    if not finite.all():
        raise ValueError(f"{what}: row {int(np.argmin(finite.all(axis=1)))} is not finite")
    return values


def _check_roughness(values: np.ndarray | float, count: int) -> np.ndarray:
    """(n,) float64 from 0 to 1."""
    values = np.asarray(values, np.float64)
    values = np.full(count, values) if values.ndim == 0 else values
    if values.ndim != 1 or not ((values >= 0) & (values <= 1)).all():
        raise ValueError("roughness is a number from 0 to 1, or one for each point")
    return values


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors; zero stays zero, and no length overflows."""
    x, y, z = np.abs(vectors.T)
    largest = np.maximum(np.maximum(x, y), z)
    x, y, z = vectors = vectors.T / np.where(largest > 0, largest, 1.0)
    length = np.sqrt(x * x + y * y + z * z)
    return (vectors / np.where(length > 0, length, 1.0)).T
