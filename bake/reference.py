"""Ground truth: irradiance on surfaces by path tracing, with no voxels between.

Comes in: points and normals in world space. Goes out: the quantity that a bake stores, traced right there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .gather import Effort, Gathered, gather
from .scene import Model, Scene, prepare
from .sensors import SurfaceSensor
from .settings import Settings, model
from .snapshot import LightKind, Snapshot
from .sobol import scramble

START = 4
"""Surface points lie on triangles only to float32: rays start this many times the usual offset off them."""


def at(
    scene: Scene,
    points: np.ndarray,
    normals: np.ndarray,
    effort: Effort,
    progress: Callable[[int], bool] | None = None,
    keys: np.ndarray | None = None,
) -> Gathered:
    """Trace every modelled transport at surface points.

    Parameters
    ----------
    scene : Scene
        A prepared scene.
    points : (n, 3) float64 ndarray
        Points in world space [m].
    normals : (n, 3) ndarray
        Unit normals.
    effort : Effort
        Samples, bounces, seed.
    progress : callable, optional
        As in `gather.gather`.
    keys : (n,) uint32 ndarray, optional
        Random key of each point; by its number when left out.

    Returns
    -------
    Gathered
        With one response: irradiance [W/m2], or as the transport's unit says.
    """
    normal = np.ascontiguousarray(np.asarray(normals, np.float32).T)
    local = np.ascontiguousarray((np.asarray(points, np.float64) - scene.origin).T.astype(np.float32))
    position = local + normal * (START * scene.tracer.offset(local, np.zeros(local.shape[1], np.float32)))
    if keys is None:
        keys = scramble(np.arange(len(points), dtype=np.uint32), 0x5EED)
    return gather(scene, SurfaceSensor(normal), position, keys, effort, progress)


def irradiance(
    snapshot: Snapshot,
    points: np.ndarray,
    normals: np.ndarray,
    transport: str = "all",
    samples: int = 1024,
    bounces: int = 8,
    seed: int = 0,
    settings: Settings | None = None,
    threads: int = 0,
    progress: Callable[[int], bool] | None = None,
) -> np.ndarray:
    """Path-trace indirect irradiance at surface points.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    points : (n, 3) float64 ndarray
        Points in world space [m].
    normals : (n, 3) ndarray
        Unit normals.
    transport : str
        "local", "sky", "sun" (per W/m2 that all suns together bring on surfaces facing them), or "all", which is
        their sum with every sun at its own strength.
    samples, bounces, seed : int
        As in `Effort`.
    settings : Settings, optional
        Sky and sun other than the scene's.
    threads : int
        As in `Effort`.
    progress : callable, optional
        As in `gather.gather`.

    Returns
    -------
    (n, 3) float32 ndarray
        Irradiance [W/m2]; zeros for light that the scene does not have.

    Notes
    -----
    Error: noise that falls with the square root of `samples`, and the energy beyond the bounce limit.
    """
    snapshot, light = model(snapshot, settings or Settings())
    light = Model(
        local=light.local and transport in ("local", "all"),
        suns=light.suns if transport in ("sun", "all") else type(light.suns)(),
        sky=_folded(snapshot) if transport in ("sky", "all") else "none",
    )
    scene = prepare(snapshot, light)
    found = at(scene, points, normals, Effort(samples, bounces, seed, threads), progress)
    if not (scene.has_local or len(light.suns.toward) or light.sky_count):
        return np.zeros((len(points), 3), np.float32)
    return total(snapshot, scene, found, transport)


def total(snapshot: Snapshot, scene: Scene, found: Gathered, transport: str) -> np.ndarray:
    """Combine what was gathered into the irradiance that a transport's name stands for.

    Parameters
    ----------
    snapshot : Snapshot
        The scene, for the strength of its suns.
    scene : Scene
        Its sky weighs the responses to harmonics.
    found : Gathered
        With one response.
    transport : str
        As in `irradiance`.

    Returns
    -------
    (n, 3) float32 ndarray
        Irradiance [W/m2], or per W/m2 of sun irradiance for "sun".
    """
    count = max(len(found.local), len(found.sun), len(found.sky))
    out = np.zeros((count, 3), np.float32)
    if transport in ("local", "all") and len(found.local):
        out += found.local[:, 0]
    if transport in ("sun", "all") and len(found.sun):
        strength = sun_strength(snapshot, found.sun.shape[1])
        if transport == "sun":
            strength = strength / np.maximum(strength.sum(axis=0), 1e-30)
        out += np.einsum("nkc,kc->nc", found.sun[:, :, 0], strength).astype(np.float32)
    if transport in ("sky", "all") and len(found.sky):
        response = found.sky[:, :, 0]
        weights = scene.sky.harmonics() if scene.model.sky == "harmonics" else np.ones((1, 3))
        out += np.einsum("nkc,kc->nc", response, weights).astype(np.float32)
    return out


def _folded(snapshot: Snapshot) -> str:
    """The sky as one value: the truth needs no basis."""
    return "fixed" if (snapshot.sky > 0).any() else "none"


def sun_strength(snapshot: Snapshot, keys: int) -> np.ndarray:
    """Irradiance of the scene's own suns, for each sun key.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    keys : int
        Number of sun keys; where they are not the scene's suns, all take the first sun's strength, or 1 W/m2.

    Returns
    -------
    (keys, 3) float64 ndarray
        Irradiance on a surface that faces the sun [W/m2].
    """
    lights = snapshot.lights
    own = lights.strength[(lights.kind == LightKind.SUN) & (lights.strength > 0).any(axis=1)].astype(np.float64)
    return own if len(own) == keys else np.broadcast_to(own[:1] if len(own) else np.ones((1, 3)), (keys, 3))
