"""A snapshot made ready for light: triangles, materials, lamps, emitters, sky and suns.

Comes in: a snapshot, and what of its light to model. Goes out: one record that the path loop reads.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .emitters import Emitters
from .lamps import Lamps
from .lit_spots import LitSpots
from .rays import Tracer
from .sky import Sky
from .snapshot import LightKind, Snapshot, SnapshotError
from .soup import Soup, flatten
from .surfaces import Surfaces


@dataclass(frozen=True)
class SunDirections:
    """Sun directions to transport.

    toward : (k, 3) float32, unit vectors to the sun
    diameter : (k,) float32 [rad], angular diameter of the disk
    """

    toward: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    diameter: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))


@dataclass(frozen=True)
class Model:
    """Which light to transport; a scene needs no more than it has.

    `sky` is "none", "fixed" (the scene's sky, folded into one value) or "harmonics" (a response to each of the
    nine real spherical harmonics of order 2).
    """

    local: bool = True
    suns: SunDirections = field(default_factory=SunDirections)
    sky: str = "none"

    @property
    def sky_count(self) -> int:
        """Functions that describe the sky."""
        return {"none": 0, "fixed": 1, "harmonics": 9}[self.sky]


@dataclass(frozen=True)
class Scene:
    """Everything that a path needs; read-only, shared by threads."""

    soup: Soup
    tracer: Tracer
    surfaces: Surfaces
    lamps: Lamps
    reflectors: Lamps
    lit_spots: LitSpots
    emitters: Emitters
    sky: Sky
    model: Model
    origin: np.ndarray
    cache: object | None = None

    @property
    def has_local(self) -> bool:
        """Whether any local light is modelled."""
        return self.model.local and (self.lamps.count > 0 or self.emitters.count > 0)


def prepare(snapshot: Snapshot, model: Model) -> Scene:
    """Build the structures that tracing needs.

    Parameters
    ----------
    snapshot : Snapshot
        A checked scene.
    model : Model
        Which light to transport.

    Returns
    -------
    Scene
        Ready for paths.

    Raises
    ------
    SnapshotError
        There is no triangle to light.
    """
    soup = flatten(snapshot)
    if not len(soup.corners):
        raise SnapshotError("the scene has no triangles to bake; add a mesh that is visible in renders")
    surfaces = Surfaces(snapshot, soup)
    lamp_rows = np.flatnonzero((snapshot.lights.kind != LightKind.SUN) & (snapshot.lights.strength > 0).any(axis=1))
    reflector_rows = lamp_rows[snapshot.lights.reflector[lamp_rows]]
    tracer = Tracer(soup.corners, surfaces.transparent)
    lamps = Lamps(snapshot.lights, lamp_rows, snapshot.origin, tracer.size)
    lit_spots = LitSpots(lamps, tracer, surfaces, model.local)
    tracer.forget()  # looking around from the lamps is no transport
    return Scene(
        soup=soup,
        tracer=tracer,
        surfaces=surfaces,
        lamps=lamps,
        reflectors=Lamps(snapshot.lights, reflector_rows, snapshot.origin, tracer.size),
        lit_spots=lit_spots,
        emitters=Emitters(soup, surfaces),
        sky=Sky(snapshot.sky),
        model=model,
        origin=snapshot.origin,
    )


def scene_suns(snapshot: Snapshot) -> SunDirections:
    """The suns that the scene itself has.

    Parameters
    ----------
    snapshot : Snapshot
        A checked scene.

    Returns
    -------
    SunDirections
        One key for each sun lamp that shines.
    """
    lights = snapshot.lights
    rows = np.flatnonzero((lights.kind == LightKind.SUN) & (lights.strength > 0).any(axis=1))
    return SunDirections(np.ascontiguousarray(lights.frame[rows, :, 2]), np.ascontiguousarray(lights.size[rows, 0]))
