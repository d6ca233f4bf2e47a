"""A bake seen by a camera: its irradiance beside the path-traced one, and their difference.

Comes in: a bake's folder and a camera. Goes out: a picture and figures. Surfaces are shown by
the irradiance they receive, not by their colours, so that nothing hides an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..tree import world
from . import reference, snapshot_file
from .gather import Effort
from .lamps import LUMINANCE
from .picture import check_path, write_pictures
from .place import SNAPSHOT_NAME, scene_defects
from .progress import Progress
from .rays import MISS
from .scene import Scene, prepare
from .settings import Settings, SettingsError, from_header, model, of_reference
from .snapshot import Camera, Snapshot

LAYERS = 16
"""Transparent surfaces that the camera looks through."""


@dataclass(frozen=True)
class View:
    """What to look at and how well.

    camera : a camera, the name of one of the scene's, or None for the scene's first
    size : (width, height) [px]
    samples : paths per pixel
    transport : "local", "sun", "sky" or "all"
    threads : 0 for every core
    """

    camera: Camera | str | None = None
    size: tuple[int, int] = (480, 270)
    samples: int = 256
    transport: str = "all"
    threads: int = 0


def compare(folder: Path, image: Path, view: View, progress: Progress) -> dict:
    """Render the comparison.

    Parameters
    ----------
    folder : Path
        A finished bake.
    image : Path
        The picture to write, .png or .exr.
    view : View
        What to look at.
    progress : Progress
        Where to say how far it is.

    Returns
    -------
    dict
        `pixels`, `mean_baked` and `mean_reference` [W/m2], `relative_rmse` of luminance over its mean.

    Raises
    ------
    SettingsError
        There is no such camera, no kind of picture by that name, or another scene in the folder.
    """
    check_path(image)
    baked = world.load(folder)
    for defect in scene_defects(folder):
        raise SettingsError(f"{folder / defect.file}: {defect.what}")
    snapshot = snapshot_file.load(folder / SNAPSHOT_NAME)
    camera = _camera(snapshot, view.camera)
    settings = of_reference(from_header(baked.header["settings"]))
    snapshot, light = model(snapshot, settings)
    progress.stage("Preparing")
    scene = prepare(snapshot, light)
    points, normals, pixels = surface_points(scene, camera, view.size)
    progress.stage("Path tracing", len(points))
    found = _traced(scene, snapshot, points, normals, view, settings, progress)
    progress.stage("Looking up")
    values = baked.irradiance(points, normals, transport=view.transport)
    pictures = [_fill(view.size, pixels, v) for v in (values, found)]
    write_pictures(image, *pictures, covered=_fill(view.size, pixels, np.ones((len(points), 1), np.float32))[..., 0])
    return _figures(values, found)


def surface_points(scene: Scene, camera: Camera, size: tuple[int, int]):
    """What a camera sees: first surfaces that are more there than not.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    camera : Camera
        Where to look from.
    size : (width, height)
        Pixels.

    Returns
    -------
    points : (n, 3) float64 ndarray
        World space [m].
    normals : (n, 3) float32 ndarray
        Unit geometric normals that face the camera.
    pixels : (n,) int64 ndarray
        Which pixel, counted by rows from the top left.
    """
    origin, direction = camera_rays(camera, size, scene.origin)
    hits = scene.tracer.intersect(origin, direction)
    for _ in range(LAYERS):
        seen = np.flatnonzero(hits.triangle != MISS)
        rows = seen[scene.surfaces.transparent[hits.triangle[seen]]]
        passed = scene.surfaces.through(hits.triangle[rows], hits.u[rows], hits.v[rows])[0].mean(axis=0)
        rows = rows[passed > 0.5]
        if not len(rows):
            break
        reached = origin[:, rows] + direction[:, rows] * hits.distance[rows]
        origin[:, rows] = reached + direction[:, rows] * scene.tracer.offset(reached, hits.distance[rows])
        hits = scene.tracer.intersect(origin, direction)
    pixels = np.flatnonzero(hits.triangle != MISS)
    normal = hits.facing(direction)[:, pixels]
    points = (origin[:, pixels] + direction[:, pixels] * hits.distance[pixels]).T.astype(np.float64) + scene.origin
    return points, np.ascontiguousarray(normal.T), pixels


def camera_rays(camera: Camera, size: tuple[int, int], scene_origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays through pixel centres.

    Parameters
    ----------
    camera : Camera
        Pinhole or orthographic.
    size : (width, height)
        Pixels; the camera's horizontal field of view is kept.
    scene_origin : (3,) float64 ndarray
        Where the scene's coordinates start [m].

    Returns
    -------
    origin, direction : (3, width * height) float32 ndarray
        By rows from the top left [m]; directions have unit length.
    """
    width, height = size
    matrix = np.array(camera.world_from_camera).reshape(3, 4)
    x = ((np.arange(width) + 0.5) / width * 2 - 1 + 2 * camera.shift[0]) * camera.half_width
    y = ((1 - (np.arange(height) + 0.5) / height * 2) * height / width + 2 * camera.shift[1]) * camera.half_width
    plane_x, plane_y = (values.ravel() for values in np.meshgrid(x, y))
    along = np.zeros_like(plane_x) if camera.orthographic else plane_x
    up = np.zeros_like(plane_y) if camera.orthographic else plane_y
    direction = matrix[:, :3] @ np.stack([along, up, -np.ones_like(plane_x)])
    direction /= np.linalg.norm(direction, axis=0)
    start = np.repeat(matrix[:, 3:] - scene_origin[:, None], plane_x.size, axis=1)
    if camera.orthographic:
        start = start + matrix[:, :3] @ np.stack([plane_x, plane_y, np.zeros_like(plane_x)])
    return start.astype(np.float32), direction.astype(np.float32)


def _camera(snapshot: Snapshot, name: Camera | str | None) -> Camera:
    """The camera itself, that by its name, or the first."""
    if isinstance(name, Camera):
        return name
    for camera in snapshot.cameras:
        if name is None or camera.name == name:
            return camera
    if name is None:
        raise SettingsError("the scene has no camera to look through; say where from with --eye and --target")
    known = ", ".join(repr(camera.name) for camera in snapshot.cameras) or "none"
    raise SettingsError(f"--camera {name}: the scene has no such camera; cameras: {known}")


def _traced(scene: Scene, snapshot: Snapshot, points, normals, view: View, settings: Settings, progress: Progress):
    """(n, 3) path-traced irradiance of the transport that is looked at."""
    effort = Effort(view.samples, settings.bounces, settings.seed + 1, view.threads)
    found = reference.at(scene, points, normals, effort, progress.show)
    values = reference.total(snapshot, scene, found, view.transport)
    return values if len(values) else np.zeros((len(points), 3), np.float32)


def _fill(size: tuple[int, int], pixels: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(height, width, channels) picture, zero where nothing was hit."""
    out = np.zeros((size[1] * size[0], values.shape[1]), np.float32)
    out[pixels] = values
    return out.reshape(size[1], size[0], -1)


def _figures(values: np.ndarray, found: np.ndarray) -> dict:
    """Means and the relative error of luminance, noise of the reference included."""
    baked, traced = values @ LUMINANCE, found @ LUMINANCE
    mean = float(traced.mean()) if len(traced) else 0.0
    rmse = float(np.sqrt(np.mean((baked - traced) ** 2))) if len(traced) else 0.0
    return {
        "pixels": len(values),
        "mean_baked": round(float(baked.mean()) if len(baked) else 0.0, 5),
        "mean_reference": round(mean, 5),
        "relative_rmse": round(rmse / mean, 4) if mean > 0 else None,
    }
