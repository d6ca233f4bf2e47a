"""What to bake and how well: parsed from the command line's words, said in the bake's own terms.

Comes in: words such as `preview`, `hemisphere`, `0.5`. Goes out: numbers, sun keys, a sky. Wrong words are
refused with what would be right.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..tree import grid as lattice
from ..tree.grid import Grid
from ..tree.suns import MAX_KEYS
from ..tree.topology import MAX_POINTS
from .scene import Model, SunDirections, scene_suns
from .snapshot import Snapshot, SnapshotError

QUALITIES = {"draft": (64, 6), "preview": (256, 8), "final": (1024, 12)}
"""(paths per data point, bounces) by name; doubling the paths takes about a third off the noise."""

CACHED_BOUNCES = 64
"""Bounces with a surface cache, where they cost hardly any time; light that is left is less than rounding by then."""

ERRORS = {"draft": 0.2, "preview": 0.1, "final": 0.05}
"""Relative error of surface irradiance above which a voxel is subdivided, by name of the quality."""

RECEIVER_SHARE, RECEIVER_SAMPLES = 8, 32
"""A receiver has an eighth of a data point's paths, but at least these: there are more of them, and more receivers
beat more paths per receiver (`benchmarks/fit.py`)."""

HEMISPHERE_KEYS = 16
"""Directions of a free sun."""

LEVELS = 4
"""Levels of voxels that light may ask for: 8, 2, 0.5 and 0.125 m at human scale."""

MOST_LEVELS = 5
"""Levels of voxels that --finest may ask for: 256 voxels along the edge of a first-level one."""

COARSEST = 64
"""Finest voxels may be this many times larger than the first level that suits the scene."""


class SettingsError(ValueError):
    """A setting that cannot be used; the message names it and says what can."""


@dataclass(frozen=True)
class Settings:
    """Everything besides the scene that a bake's result depends on.

    samples, bounces : paths per data point, and reflections that light may undergo
    sky : "scene", "harmonics", or three numbers with commas: the radiance of a uniform sky
    sun : "scene", "none", "hemisphere", "arc:FILE", or a direction to the sun as x,y,z
    finest : size of the finest voxels [m]; 0 chooses it for the scene
    dilation : "partial", or "full": surfaces have data of the finest level alone, for two to eight times the size
    seed : another seed gives independent noise
    error : relative error of surface irradiance above which a voxel is subdivided; 0: wherever geometry is not flat
    max_points, max_bytes : most data points and bytes of a world cell; 0 bytes for no limit
    fit : whether data points are fitted to what surfaces see of them
    method : "paths" follows every path to its end, "cache" ends most on surfels, whose light is known
    """

    samples: int = QUALITIES["preview"][0]
    bounces: int = QUALITIES["preview"][1]
    sky: str = "scene"
    sun: str = "scene"
    finest: float = 0.0
    seed: int = 0
    dilation: str = "partial"
    error: float = ERRORS["preview"]
    max_points: int = MAX_POINTS
    max_bytes: int = 0
    fit: bool = True
    method: str = "paths"

    @classmethod
    def of(cls, quality: str, method: str = "cache") -> Settings:
        """Choose what a quality stands for.

        Parameters
        ----------
        quality : str
            One of `QUALITIES`.
        method : str
            As above.

        Returns
        -------
        Settings
            The rest as it is.
        """
        samples, bounces = QUALITIES[quality]
        bounces = CACHED_BOUNCES if method == "cache" else bounces
        return cls(samples, bounces, error=ERRORS[quality], method=method)

    @property
    def receiver_samples(self) -> int:
        """Paths per receiver: an even number, as errors are measured by two independent halves."""
        return max(RECEIVER_SAMPLES, self.samples // RECEIVER_SHARE // 2 * 2)


def with_sky(snapshot: Snapshot, sky: str) -> tuple[Snapshot, str]:
    """Give the scene the sky that was asked for.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    sky : str
        As in `Settings`.

    Returns
    -------
    snapshot : Snapshot
        With that sky.
    kind : str
        "none", "fixed" or "harmonics", as in `Model`.

    Raises
    ------
    SettingsError
        The word is not understood.
    """
    if sky == "harmonics":
        return snapshot, "harmonics"
    if sky != "scene":
        uniform = np.broadcast_to(_radiance(sky), (1, 1, 3)).astype(np.float32)
        snapshot = dataclasses.replace(snapshot, sky=uniform)
    return snapshot, "fixed" if (snapshot.sky > 0).any() else "none"


def _radiance(sky: str) -> np.ndarray:
    """(1,) or (3,) radiance of a uniform sky."""
    radiance = numbers(sky, "--sky", (1, 3), "scene, harmonics")
    if (radiance < 0).any():
        raise SettingsError(f"--sky {sky}: radiance cannot be negative")
    if (radiance > np.finfo(np.float32).max).any():
        raise SettingsError(f"--sky {sky}: radiance must be a number of single precision")
    return radiance


def sun_keys(snapshot: Snapshot, sun: str) -> SunDirections:
    """The sun directions that were asked for.

    Parameters
    ----------
    snapshot : Snapshot
        The scene; its first sun lends its angular diameter to other directions.
    sun : str
        As in `Settings`.

    Returns
    -------
    SunDirections
        Possibly none.

    Raises
    ------
    SettingsError
        The word is not understood, or the file cannot be read.
    """
    own = scene_suns(snapshot)
    if sun == "scene":
        _check_count(len(own.toward), sun)
        return own
    if sun == "none":
        return SunDirections()
    diameter, toward = own.diameter[0] if len(own.diameter) else 0.0, _toward(sun)
    return SunDirections(toward, np.full(len(toward), diameter, np.float32))


def _toward(sun: str) -> np.ndarray:
    """(n, 3) float32 unit vectors to suns that are not the scene's own."""
    if sun == "hemisphere":
        toward = hemisphere(HEMISPHERE_KEYS)
    elif sun.startswith("arc:"):
        toward = _read_arc(Path(sun.removeprefix("arc:")))
    else:
        toward = numbers(sun, "--sun", (3,), "scene, none, hemisphere, arc:FILE")[None]
    _check_count(len(toward), sun)
    return unit(toward, f"--sun {sun}").astype(np.float32)


def check_words(settings: Settings) -> None:
    """Refuse what no scene makes right, before one is read.

    Parameters
    ----------
    settings : Settings
        What was asked for.

    Raises
    ------
    SettingsError
        A word for the sky or the sun is not understood, a file of suns cannot be read, or a size is not a power of two.
    """
    if settings.sky not in ("scene", "harmonics"):
        _radiance(settings.sky)
    if settings.sun not in ("scene", "none"):
        _toward(settings.sun)
    _check_finest(settings.finest)


def _check_finest(finest: float) -> None:
    """Refuse sizes that are no power of two; 0 is none."""
    if finest and not (math.isfinite(finest) and finest > 0 and math.frexp(finest)[0] == 0.5):
        raise SettingsError(f"--finest {finest}: use a power of two, such as 0.25, 0.5 or 1")


def _check_count(count: int, sun: str) -> None:
    """Refuse more sun directions than a reader takes."""
    if count > MAX_KEYS:
        raise SettingsError(f"--sun {sun}: {count} directions; a bake holds at most {MAX_KEYS}")


def has_free_sun(sun: str) -> bool:
    """Say whether the sun's directions are keys to interpolate between, not suns that shine together.

    Parameters
    ----------
    sun : str
        As in `Settings`.

    Returns
    -------
    bool
        True for a hemisphere and an arc.
    """
    return sun == "hemisphere" or sun.startswith("arc:")


def from_header(stored: dict) -> Settings:
    """Settings of a bake.

    Parameters
    ----------
    stored : dict
        What its `world.json` holds under "settings".

    Returns
    -------
    Settings
        The same.

    Raises
    ------
    SettingsError
        A newer program wrote them.
    """
    known = {field.name for field in dataclasses.fields(Settings)}
    if not isinstance(stored, dict) or not set(stored) <= known:
        raise SettingsError(f"the bake has settings that this version does not know: {sorted(set(stored) - known)}")
    return Settings(**stored)


def of_reference(settings: Settings) -> Settings:
    """Settings of the light that a bake has when nobody says otherwise.

    Parameters
    ----------
    settings : Settings
        What a bake was asked for.

    Returns
    -------
    Settings
        With the scene's own sun instead of a free one, and its own sky instead of a changing one: what a
        bake holds for other light, its reference has no need of.
    """
    sun = "scene" if has_free_sun(settings.sun) else settings.sun
    return dataclasses.replace(settings, sun=sun, sky="scene" if settings.sky == "harmonics" else settings.sky)


def model(snapshot: Snapshot, settings: Settings) -> tuple[Snapshot, Model]:
    """The scene and the light to bake in it.

    Parameters
    ----------
    snapshot : Snapshot
        The scene as it was read.
    settings : Settings
        What was asked for.

    Returns
    -------
    snapshot : Snapshot
        With the sky that was asked for.
    model : Model
        Which transports to compute.
    """
    snapshot, sky = with_sky(snapshot, settings.sky)
    return snapshot, Model(local=True, suns=sun_keys(snapshot, settings.sun), sky=sky)


def hemisphere(count: int) -> np.ndarray:
    """Directions spread evenly over the upper half of the sphere, the lowest near the horizon.

    Parameters
    ----------
    count : int
        How many.

    Returns
    -------
    (count, 3) float64 ndarray
        Unit vectors, from low to high.

    Notes
    -----
    Source: Swinbank and Purser 2006, Fibonacci grid, one half of it.
    """
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * (math.pi * (3 - math.sqrt(5)))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def choose_grid(corners: np.ndarray, origin: np.ndarray, finest: float, levels: int = LEVELS) -> Grid:
    """Sizes of the voxels.

    Parameters
    ----------
    corners : (n, 3, 3) float32 ndarray
        Triangles relative to the origin [m].
    origin : (3,) float64 ndarray
        The snapshot's origin [m].
    finest : float
        Size of the finest voxels [m]; 0 chooses it for the scene.
    levels : int
        Levels of a lattice that is chosen for the scene.

    Returns
    -------
    Grid
        The lattice; its first level is near the size that suits the scene.

    Raises
    ------
    SettingsError
        The size is not a power of two, or far from the scene's own scale.
    """
    grid = lattice.choose(corners, levels, tuple(origin))
    _check_finest(finest)
    if not finest:
        return grid
    levels = 1 + math.ceil(math.log(grid.first_size / 2 / finest, lattice.BRANCH)) if finest < grid.first_size else 1
    levels = max(levels, 1)
    if levels > MOST_LEVELS or finest > COARSEST * grid.first_size:
        wrong = "fine" if levels > MOST_LEVELS else "coarse"
        raise SettingsError(f"--finest {finest}: too {wrong} for a scene whose first level is {grid.first_size} m")
    return Grid(finest * lattice.BRANCH ** (levels - 1), levels, tuple(origin))


def numbers(text: str, option: str, counts: tuple[int, ...], others: str = "") -> np.ndarray:
    """Numbers separated by commas.

    Parameters
    ----------
    text : str
        The words after an option.
    option : str
        Its name, for the message.
    counts : tuple of int
        How many numbers there may be.
    others : str
        What may be written instead, for the message.

    Returns
    -------
    (n,) float64 ndarray
        Finite numbers.

    Raises
    ------
    SettingsError
        They are not numbers, not finite, or too many or too few.
    """
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) not in counts or not np.isfinite(values).all():
        wanted = " or ".join(str(count) for count in counts)
        words = f"{others}, or " if others else ""
        raise SettingsError(f"{option} {text}: use {words}{wanted} numbers with commas between them")
    return values


def unit(vectors: np.ndarray, what: str) -> np.ndarray:
    """Directions of length 1.

    Parameters
    ----------
    vectors : (n, 3) float64 ndarray
        Finite, of any length but 0.
    what : str
        What they are, for the message.

    Returns
    -------
    (n, 3) float64 ndarray
        Unit vectors, exact for tiny and for huge lengths too.

    Raises
    ------
    SettingsError
        One has no length.
    """
    largest = np.abs(vectors).max(axis=1, keepdims=True, initial=0.0)
    if (largest == 0).any():
        which = f"direction {int(np.argmin(largest)) + 1} is" if len(vectors) > 1 else "that is"
        raise SettingsError(f"{what}: {which} 0,0,0, which points nowhere; give another direction")
    vectors = vectors / largest
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _read_arc(path: Path) -> np.ndarray:
    """(n, 3) directions, one line each."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise SettingsError(f"--sun arc:{path}: cannot be read ({reason})") from error
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").split()
        try:
            found += [numbers(",".join(words), "", (3,))] if words else []
        except SettingsError:
            place = f"--sun arc:{path}: line {number} ({line.strip()})"
            raise SettingsError(f"{place}: write three numbers, as in 0 0.5 1") from None
    if not found:
        raise SettingsError(f"--sun arc:{path}: holds no directions; write one per line, as in 0 0.5 1")
    return np.stack(found)


def check_scene(snapshot: Snapshot) -> None:
    """Refuse a scene with nothing to light.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.

    Raises
    ------
    SnapshotError
        It has no triangles.
    """
    if not len(snapshot.geometry.triangles) or not len(snapshot.geometry.instance_mesh):
        raise SnapshotError("the scene has no triangles to bake; add a mesh that is visible in renders")


def check_triangles(corners: np.ndarray) -> None:
    """Refuse a scene with no surface.

    Parameters
    ----------
    corners : (n, 3, 3) float32 ndarray
        Triangles relative to the origin [m].

    Raises
    ------
    SnapshotError
        A corner lies beyond single precision, or no triangle has an area.
    """
    if not np.isfinite(corners).all():
        raise SnapshotError("a vertex is too far away for single precision; check the scale of the objects")
    edges = corners[:, 1:].astype(np.float64) - corners[:, :1]
    if not np.cross(edges[:, 0], edges[:, 1]).any():
        raise SnapshotError("every triangle of the scene has zero area; check the scale of the objects")
