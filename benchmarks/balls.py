"""Chrome and satin balls in a scene: what probes show in them beside path tracing.

    python benchmarks/balls.py FOLDER PICTURE.png [--scene NAME] [--width 400] [--paths 64]

FOLDER holds a bake with probes; NAME, one of those below, says where balls hang: two rows, the upper one of chrome.
They are no part of the scene: they mirror it and not each other, all of its light and without a loss. What lies
behind them is path-traced in both pictures.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from gi_volumes.bake import compare, picture, viewpoint
from gi_volumes.benchmarks.mirrored import Baked, Mirrors, gathered

ROUGHNESS = (0.1, 0.35)
"""Of chrome, as sharp as probes are, and satin."""

COLUMNS = 4
SHAPE = 0.62
"""Height over width."""

BEHIND = 16
"""Paths of a pixel without a ball."""

SEED = 3


@dataclass(frozen=True)
class Shelf:
    """Where balls hang: middle of the grid, eye [m], distance between balls and their radius [m]."""

    middle: tuple[float, float, float]
    eye: tuple[float, float, float]
    spacing: float
    radius: float
    fov: float = 60.0


SHELVES = {
    "sponza": Shelf((-2.0, 0.0, 1.9), (-5.2, 0.0, 2.0), 0.85, 0.38),
    "small_house": Shelf((-5.4, 0.9, 1.35), (-2.9, -2.0, 1.5), 0.72, 0.3),
}


def balls(shelf: Shelf) -> tuple[np.ndarray, np.ndarray]:
    """Hang balls in a plane across the line of sight.

    Parameters
    ----------
    shelf : Shelf
        Where.

    Returns
    -------
    center : (n, 3) float64 ndarray
        World space [m].
    roughness : (n,) float64 ndarray
        Of each.
    """
    ahead = np.array(shelf.middle) - shelf.eye
    right = np.array([ahead[1], -ahead[0], 0.0]) / np.hypot(*ahead[:2])
    column = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * shelf.spacing
    rows = np.array([0.5, -0.5]) * shelf.spacing
    center = shelf.middle + column[None, :, None] * right + rows[:, None, None] * [0, 0, 1]
    return center.reshape(-1, 3), np.repeat(ROUGHNESS, COLUMNS)


def first_ball(start: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float):
    """Intersect rays with balls.

    Parameters
    ----------
    start, direction : (n, 3) float64 ndarray
        Rays, of unit length [m].
    center : (k, 3) float64 ndarray
        Middles [m].
    radius : float
        Of all balls [m].

    Returns
    -------
    distance : (n,) float64 ndarray
        Infinite where there is none [m].
    number : (n,) int64 ndarray
        Which ball.
    """
    way = center - start[:, None]
    along = np.einsum("nkc,nc->nk", way, direction)
    half = radius**2 - (np.einsum("nkc,nkc->nk", way, way) - along**2)
    distance = np.where((half > 0) & (along > 0), along - np.sqrt(np.maximum(half, 0)), np.inf)
    number = distance.argmin(axis=1)
    return np.take_along_axis(distance, number[:, None], 1)[:, 0], number


def pictures(baked: Baked, shelf: Shelf, width: int, paths: int) -> tuple[np.ndarray, np.ndarray]:
    """See balls.

    Parameters
    ----------
    baked : Baked
        The bake.
    shelf : Shelf
        Where they are.
    width : int
        Of a picture [px].
    paths : int
        Of a pixel with a ball.

    Returns
    -------
    ours, traced : (h, w, 3) float32 ndarray
        Radiance [W/(m2 sr)].
    """
    size = (width, int(width * SHAPE))
    camera = viewpoint.look(np.array(shelf.eye), np.array(shelf.middle), shelf.fov)
    start, direction = (rays.T.astype(np.float64) for rays in compare.camera_rays(camera, size, np.zeros(3)))
    (center, roughness), out = balls(shelf), np.zeros((2, len(start), 3), np.float32)
    distance, number = first_ball(start, direction, center, shelf.radius)
    behind = np.flatnonzero(~np.isfinite(distance))
    rays = Mirrors(start[behind], direction[behind].astype(np.float32), direction[behind].astype(np.float32))
    out[:, behind] = gathered(baked, rays, 0.0, BEHIND, SEED)
    for ball_roughness in ROUGHNESS:
        rows = np.flatnonzero(np.isfinite(distance) & (roughness[number] == ball_roughness))
        point = start[rows] + direction[rows] * distance[rows, None]
        normal = (point - center[number[rows]]) / shelf.radius
        mirrored = direction[rows] - 2 * np.einsum("nc,nc->n", direction[rows], normal)[:, None] * normal
        rays = Mirrors(point, normal.astype(np.float32), mirrored.astype(np.float32))
        out[0, rows] = baked.world.radiance(point, mirrored, ball_roughness, normals=normal)
        out[1, rows] = gathered(baked, rays, ball_roughness, paths, SEED)
    return tuple(out.reshape(2, size[1], size[0], 3))


def main() -> None:
    """Read the command line, write a picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--scene", choices=SHELVES, help="of the shelf; the folder's name when left out")
    parser.add_argument("--width", type=int, default=400)
    parser.add_argument("--paths", type=int, default=64)
    words = parser.parse_args()
    ours, traced = pictures(
        Baked.load(words.folder), SHELVES[words.scene or words.folder.name], words.width, words.paths
    )
    picture.write_pictures(words.picture, ours, traced, np.ones(ours.shape[:2], np.float32))
    print(f"{words.picture}: mean difference {np.abs(ours - traced).mean() / traced.mean():.4f}")


if __name__ == "__main__":
    main()
