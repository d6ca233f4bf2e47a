"""Bakes as one sees them: pictures from chosen places, their errors, and the sheet of the documents.

    python benchmarks/pictures.py FOLDER [SCENE...] [--keep FOLDER] [--sheet docs/images/scenes.png] [--record]

FOLDER holds a bake for each scene of the list below, by its name, as `docs/accuracy.md` says how to make it. Errors
are over pixels, which show contacts and far edges more often than an even spread over surfaces does; the
reference's noise is taken out by two halves of it (`errors.py`).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gi_volumes.bake import compare, picture, snapshot_file, viewpoint
from gi_volumes.bake.lamps import LUMINANCE
from gi_volumes.bake.place import SNAPSHOT_NAME
from gi_volumes.bake.settings import from_header
from gi_volumes.benchmarks import errors
from gi_volumes.benchmarks.results import add_row
from gi_volumes.benchmarks.traced import Traced
from gi_volumes.tree import world

SIZE = (320, 240)
PATHS = 64
"""Per pixel and half of the reference."""

SHEET_WIDTH = 190
"""Of one picture in the sheet [px], so that all of them stay below 400 kB."""

HARDLY = 1e-3
"""Share of all light below which a transport is nobody's concern in a picture."""

COLOURS = 256
"""In the sheet's palette; dithered, as bands would look like faults of a bake."""


@dataclass(frozen=True)
class Place:
    """Where to look from: name, eye and target [m], horizontal field of view [degrees], whether the sheet has it."""

    name: str
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = viewpoint.FIELD_OF_VIEW
    shown: bool = False


PLACES = {
    "courtyard": (
        Place("gallery", (6.35, -3.2, 1.8), (7.0, 6.5, 1.75), 81, shown=True),
        Place("blue room", (-9.9, 8.0, 1.9), (0.0, 8.2, 1.7), 84),
    ),
    "living_room": (
        Place("table", (3.2, 1.4, 1.7), (-3.3, -1.2, 0.6), shown=True),
        Place("terrace", (-3.3, -6.1, 1.6), (3.1, -1.1, 1.2)),
        Place("far corner", (-3.7, 1.2, 2.1), (3.9, -1.1, 1.2)),
    ),
    "modern_hall": (
        Place("stairs", (3.3, -2.1, 4.6), (-3, 1.2, 1.2), shown=True),
        Place("landing", (-10.3, -2.2, 1.6), (-2, 1.7, 2.5)),
    ),
    "small_house": (
        Place("doors", (2.3, 3.2, 1.3), (-2.4, 0.6, 0.5)),
        Place("bedroom", (-2.3, -2.2, 1.6), (-8.2, 4.1, 0.6), shown=True),
    ),
    "sponza": (
        Place("nave", (-9.3, 0.6, 1.5), (5, -0.5, 2.5)),
        Place("aisle", (-4, 3.6, 1.7), (9, 4.4, 1.2), shown=True),
        Place("curtain", (2.9, 0.8, 1.4), (1.2, -3.6, 2.6)),
        Place("upper gallery", (-6, 4.3, 6), (9, 4.6, 5)),
    ),
    "bookstore": (
        Place("table", (4.1, -3.1, 1.6), (5.6, -2.3, 0.8), shown=True),
        Place("shop", (-6.7, -6.1, 1.6), (2, 0, 1)),
    ),
    "truck_town": (
        Place("street", (12.3, 0.6, 10.9), (22.5, 12.3, 11.8)),
        Place("tree", (28.3, 4.2, 13.2), (20.1, 11.6, 11.6), shown=True),
    ),
}


@dataclass(frozen=True)
class Seen:
    """A bake from one place.

    covered : (h, w) bool, where there is a surface
    points, normals : (n, 3), what the covered pixels show, by rows
    baked, halves : by transport, (n, 3) and (2, n, 3) float32 [W/m2]
    """

    covered: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    baked: dict[str, np.ndarray]
    halves: dict[str, np.ndarray]


class Eyes:
    """One bake and the reference of its scene.

    Parameters
    ----------
    folder : Path
        The bake.
    cache : Path, optional
        Where traced light is kept.
    """

    def __init__(self, folder: Path, cache: Path | None = None):
        self._baked = world.load(folder)
        snapshot = snapshot_file.load(folder / SNAPSHOT_NAME)
        self._traced = Traced(snapshot, from_header(self._baked.header["settings"]), cache)

    def look(self, place: Place, size: tuple[int, int] = SIZE) -> Seen:
        """See one place.

        Parameters
        ----------
        place : Place
            Where from.
        size : (width, height)
            Pixels.

        Returns
        -------
        Seen
            Every transport, and "all" of them.
        """
        camera = viewpoint.look(np.array(place.eye), np.array(place.target), place.fov)
        points, normals, pixels = compare.surface_points(self._traced.scene, camera, size)
        covered = np.zeros(size[0] * size[1], bool)
        covered[pixels] = True
        halves = [self._traced.surface(points, normals, PATHS, seed) for seed in (1, 2)]
        halves = {name: np.stack([half[name] for half in halves]) for name in self._traced.transports}
        baked = {name: self._light(points, normals, name) for name in halves}
        halves["all"], baked["all"] = sum(halves.values()), sum(baked.values())
        return Seen(covered.reshape(size[::-1]), points, normals, baked, halves)

    def _light(self, points: np.ndarray, normals: np.ndarray, transport: str) -> np.ndarray:
        """(n, 3) of the bake, suns at the strength that they have."""
        values = self._baked.irradiance(points, normals, transport=transport)
        return values * self._baked.sun_irradiance if transport == "sun" else values


def figures(seen: Seen) -> dict[str, float]:
    """Errors of luminance over the covered pixels.

    Parameters
    ----------
    seen : Seen
        A bake from one place.

    Returns
    -------
    dict of str to float
        By transport: share of the mean of all light, relative error, and by how much the mean is off.
    """
    found, whole = {}, float((seen.halves["all"] @ LUMINANCE).mean())
    for name, halves in seen.halves.items():
        reference, values = halves @ LUMINANCE, seen.baked[name] @ LUMINANCE
        told = errors.compare(values, reference)
        mean = float(reference.mean())
        if not told or mean < HARDLY * whole:
            continue
        found |= {f"{name} share": mean / whole, f"{name} error": told["rmse"], f"{name} mean off": told["bias"]}
    return found


def strip(seen: Seen, transport: str = "all") -> np.ndarray:
    """Baked, path traced and their difference beside each other.

    Parameters
    ----------
    seen : Seen
        A bake from one place.
    transport : str
        Which light.

    Returns
    -------
    (h, 3 w, 3) uint8 ndarray
        As `compare` shows them, without captions.
    """
    full = np.zeros((2, *seen.covered.shape, 3), np.float32)
    full[:, seen.covered] = seen.baked[transport], seen.halves[transport].mean(axis=0)
    return picture.panels(*full, seen.covered)


def write_sheet(path: Path, strips: list[np.ndarray]) -> None:
    """Write the strips below each other, small and with a palette.

    Parameters
    ----------
    path : Path
        A .png file.
    strips : list of (h, 3 w, 3) uint8 ndarray
        Pictures.
    """
    from PIL import Image

    height = SHEET_WIDTH * SIZE[1] // SIZE[0]
    small = [Image.fromarray(one).resize((3 * SHEET_WIDTH, height), Image.Resampling.BOX) for one in strips]
    sheet = Image.fromarray(np.concatenate([np.asarray(one) for one in small]))
    palette = sheet.quantize(COLOURS)
    sheet.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)


def main() -> None:
    """Look at every bake that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(PLACES)}; all when left out")
    parser.add_argument("--keep", type=Path, help="folder for every picture and for traced light")
    parser.add_argument("--sheet", type=Path, help="one picture of all scenes")
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    strips = []
    for scene in options.scenes or PLACES:
        eyes = Eyes(options.folder / scene, options.keep)
        for place in PLACES[scene]:
            if options.sheet and not place.shown and not options.keep:
                continue
            seen = eyes.look(place)
            _tell(f"{scene}, {place.name}", figures(seen), options.record)
            if options.keep:
                _keep(options.keep / f"{scene} {place.name}", seen)
            strips += [strip(seen)] if place.shown else []
    if options.sheet:
        write_sheet(options.sheet, strips)


def _tell(what: str, found: dict[str, float], record: bool) -> None:
    """Print figures, or print and keep them."""
    if record:
        add_row("pictures", what, found)
    else:
        print(what, "  ".join(f"{name} {value:.4g}" for name, value in found.items()), flush=True)


def _keep(stem: Path, seen: Seen) -> None:
    """Each transport's picture."""
    from PIL import Image

    for name in seen.halves:
        Image.fromarray(strip(seen, name)).save(f"{stem} {name}.png")


if __name__ == "__main__":
    main()
