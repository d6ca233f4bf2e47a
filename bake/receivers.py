"""Receivers: points spread over all surfaces that light can reach, where the bake's error is measured.

Comes in: a scene, a box, a spacing. Goes out: about one point per spacing^2 of each side of each face. Triangles are
cut in halves until a piece holds few points; a piece's points are a low-discrepancy sequence, shifted by the piece's
key. All of it depends on the triangle and the spacing alone, so two boxes hold what one box around them holds.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree.dualcells import CORNERS
from ..tree.region import finder
from . import warp
from .datapoints import BACKFACE_LIMIT
from .parallel import run_tiles, tile_size
from .rays import MISS
from .reference import START
from .scene import Scene
from .sobol import Sampler, scramble

SPACING = (0.25, 0.25, 0.4, 0.5)
"""Distance between receivers, in voxels of the level that they judge, the first level first; the last for all others:
four to sixteen on a voxel's face, fewer where there are more voxels."""

FEELERS = 16
"""Rays that judge a side: a share of a quarter is known to within 0.11 (one standard deviation)."""

FIRST_FEELERS = 6
"""Of them that go first: inside a wall five that meet backs settle it, a third of all sides."""

CRACK = 1 / 32
"""A side is squeezed when most of its rays end within this distance [spacings]: nobody sees what light is there."""

COARSER = 10
"""Doublings of a voxel's size at which boxes are looked up; larger boxes count as touching."""

PIECE = 128
"""Most points that one side of a piece holds: small against a tile, large against the rounding of their number."""

SLIVER = 2.0**-21
"""Triangles no higher than this, in their largest coordinate, have no normal: four float32 steps."""

DUPLICATE = 1 / 256
"""Two triangles are the same when their corners fall into the same voxels of this size [spacings]."""

LARGE = 8
"""Triangles below this many of those voxels are never duplicates: their corners fall together by chance."""

TINY = 1e-3
"""What a piece adds to a tile besides its points, so that tiles of tiny triangles stay small."""

DOWN = -0.5
"""Normals below this vertical component face down: those of slopes up to 60 degrees."""

GROUNDED = 1 / 8
"""Part of the feelers of a back that faces down that must meet something: cellars stick out below a ground, too. With
one feeler sealed rooms on a ground leaked 0.2 % of the light, with this 0.0005 %; floors of open storeys have more."""

WITNESSES = 4
"""Feelers of a back side whose ends are judged in their turn."""

FIELDS = ("position", "normal", "area", "key", "front")
KINDS = (np.float64, np.float32, np.float32, np.uint32, bool)

STEP = np.round(2.0**32 / 1.32471795724474602596 ** np.array([[1.0], [2.0]])).astype(np.uint32) | np.uint32(1)
"""Steps of the additive sequence R2 in both coordinates, times 2**32 (Roberts 2018, from the plastic number)."""


@dataclass(frozen=True)
class Receivers:
    """Points on surfaces, each with the side that is meant.

    position : (n, 3) float64 [m], relative to the scene's origin
    normal : (n, 3) float32, unit length, towards free space
    area : (n,) float32 [m2] that the point stands for
    key : (n,) uint32, random
    front : (n,) bool, whether that side is the front of its triangle
    """

    position: np.ndarray
    normal: np.ndarray
    area: np.ndarray
    key: np.ndarray
    front: np.ndarray

    def take(self, rows: np.ndarray) -> Receivers:
        """Some of the points.

        Parameters
        ----------
        rows : (m,) int64 or (n,) bool ndarray
            Which.

        Returns
        -------
        Receivers
            Copies.
        """
        return Receivers(*(getattr(self, name)[rows] for name in FIELDS))


@dataclass(frozen=True)
class _Pieces:
    """Parts of triangles: corners (n, 3, 3) float64 [m], keys (n,) uint32."""

    corners: np.ndarray
    key: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> _Pieces:
        return _Pieces(self.corners[rows], self.key[rows])


def spread(
    scene: Scene,
    low: np.ndarray,
    high: np.ndarray,
    spacing: float,
    wanted: Callable[[np.ndarray], np.ndarray] | None = None,
    threads: int = 0,
    progress: Callable[[int], bool] | None = None,
    touches: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Receivers:
    """Spread receivers over the surfaces in a box.

    Parameters
    ----------
    scene : Scene
        The surfaces; transparent ones have receivers too, but hide nothing.
    low, high : (3,) float64 ndarray
        The box [low, high), relative to the scene's origin [m].
    spacing : float
        One receiver stands for about this length squared [m].
    wanted : callable, optional
        Takes (n, 3) float64 positions and says which to keep, (n,) bool, before any ray is traced; called from
        several threads.
    threads : int
        Worker threads; 0 uses every core.
    progress : callable, optional
        As in `parallel.run_tiles`, counting pieces of triangles.
    touches : callable, optional
        Takes lowest and highest corners of boxes, and says which may hold a position that is wanted: `touching`.

    Returns
    -------
    Receivers
        Free of order, box and threads: those of a smaller box are a subsequence of those of a larger one.

    Raises
    ------
    CancelledError
        `progress` returned False.
    ValueError
        The spacing is not positive.

    Notes
    -----
    Error: areas sum to the area of the sides that see free space in the mean over keys; pieces that deserve one
    point or more have their exact area, smaller ones are drawn at random. 16 rays judge a side, so those close to
    the limit may go either way.
    """
    if not spacing > 0:
        raise ValueError(f"the spacing is {spacing} m; give a positive one")
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    pieces = _split(_triangles(scene.soup.corners, low, high, spacing), low, high, spacing, touches)
    found: dict[int, Receivers] = {}

    def work(rows: np.ndarray) -> int:
        points = _points(pieces[rows], spacing)
        inside = ((points.position >= low) & (points.position < high)).all(axis=1)
        points = points.take(inside)
        points = points if wanted is None else points.take(wanted(points.position))
        found[int(rows[0])] = points.take(_is_free(scene, points, CRACK * spacing))
        return len(rows)

    run_tiles(work, _tiles(pieces, spacing), threads, progress)
    return join([found[first] for first in sorted(found)])


def spacing(level: int, size: float) -> float:
    """Choose the distance between the receivers that judge a level.

    Parameters
    ----------
    level : int
        The level.
    size : float
        Size of its voxels [m].

    Returns
    -------
    float
        About the side of the area that a receiver stands for [m].
    """
    return SPACING[min(level, len(SPACING) - 1)] * size


def touching(coords: np.ndarray, size: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Make a test whether boxes touch some voxels.

    Parameters
    ----------
    coords : (n, 3) int64 ndarray
        Voxels of one level.
    size : float
        Their size [m].

    Returns
    -------
    callable
        Takes (m, 3) float64 lowest and highest corners; (m,) bool, True for every box that touches a voxel and for
        some that only come close: a box is looked up among voxels at least as large as itself.
    """
    levels = [(size * 2.0**step, among(coords >> step)) for step in range(COARSER)]

    def touch(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        extent, found = (high - low).max(axis=1, initial=0.0), np.ones(len(low), bool)
        for step, (width, has) in enumerate(levels):
            rows = np.flatnonzero((extent <= width) & ((step == 0) | (extent > width / 2)))
            base = np.floor(low[rows] / width).astype(np.int64)
            found[rows] = has((base[:, None] + CORNERS).reshape(-1, 3)).reshape(-1, 8).any(axis=1)
        return found

    return touch


def among(cells: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Make a test which voxels are among some.

    Parameters
    ----------
    cells : (n, 3) int64 ndarray
        Voxels, also more than once.

    Returns
    -------
    callable
        Takes (m, 3) int64 voxels; (m,) bool.
    """
    row = finder(np.unique(cells, axis=0))
    return lambda asked: row(asked) >= 0


def lifted(scene: Scene, receivers: Receivers) -> np.ndarray:
    """Starts of rays from receivers.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    receivers : Receivers
        Points on them.

    Returns
    -------
    (3, n) float32 ndarray
        Just off their surface, as in `reference.at` [m].
    """
    position = np.ascontiguousarray(receivers.position.T.astype(np.float32))
    normal = np.ascontiguousarray(receivers.normal.T)
    return position + normal * (START * scene.tracer.offset(position, np.zeros(position.shape[1], np.float32)))


def none() -> Receivers:
    """Make no receivers.

    Returns
    -------
    Receivers
        Empty.
    """
    return Receivers(*(np.zeros(shape, kind) for shape, kind in zip(((0, 3), (0, 3), 0, 0, 0), KINDS, strict=True)))


def join(parts: list[Receivers]) -> Receivers:
    """Put receivers together.

    Parameters
    ----------
    parts : list of Receivers
        Some, or none.

    Returns
    -------
    Receivers
        All of them.
    """
    return Receivers(*(np.concatenate([getattr(part, name) for part in (none(), *parts)]) for name in FIELDS))


def _triangles(corners: np.ndarray, low: np.ndarray, high: np.ndarray, spacing: float) -> _Pieces:
    """Triangles that reach into the box, without slivers and without copies, with a key each."""
    grain = spacing * DUPLICATE
    near = ((corners.min(axis=1) <= high + 2 * grain) & (corners.max(axis=1) >= low - 2 * grain)).all(axis=1)
    rows = np.flatnonzero(near)
    triangles = corners[rows].astype(np.float64)
    kept = ~_are_slivers(triangles)
    kept[kept] = _are_first(triangles[kept], grain)
    return _Pieces(triangles[kept], scramble(rows[kept].astype(np.uint32), 0x7EC))


def _are_slivers(triangles: np.ndarray) -> np.ndarray:
    """Triangles without a trustworthy normal, those without area among them."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    longest = np.sqrt((edges**2).sum(axis=2)).max(axis=1)
    coordinate = np.abs(triangles).max(axis=(1, 2))
    return 2 * _areas(triangles) <= SLIVER * coordinate * longest


def _are_first(triangles: np.ndarray, grain: float) -> np.ndarray:
    """Triangles that no earlier one coincides with, whatever its winding and first corner."""
    voxel = np.floor(triangles / grain).astype(np.int64).astype(np.uint32)
    corner = scramble(scramble(scramble(voxel[:, :, 0], 1) ^ voxel[:, :, 1], 2) ^ voxel[:, :, 2], 3)
    low, middle, high = np.sort(corner, axis=1).T
    code = scramble(low ^ scramble(middle, 4), 5).astype(np.int64) << 31 ^ scramble(middle ^ scramble(high, 4), 6)
    first = np.zeros(len(code), bool)
    first[np.unique(code, return_index=True)[1]] = True
    return first | (np.ptp(triangles, axis=1).max(axis=1) < LARGE * grain)


def _areas(triangles: np.ndarray) -> np.ndarray:
    """(n,) areas [m2]."""
    return np.sqrt((_crosses(triangles) ** 2).sum(axis=1)) / 2


def _crosses(triangles: np.ndarray) -> np.ndarray:
    """(n, 3) normals of the fronts, twice the area long."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _split(pieces: _Pieces, low: np.ndarray, high: np.ndarray, spacing: float, touches) -> _Pieces:
    """Halve triangles across their longest edge until none holds too many points; drop what is outside the box."""
    done = []
    while len(pieces.key):
        lowest, highest = pieces.corners.min(axis=1), pieces.corners.max(axis=1)
        near = ((lowest <= high) & (highest >= low)).all(axis=1)
        if touches is not None:
            near[near] = touches(lowest[near], highest[near])
        pieces = pieces[near]
        small = _areas(pieces.corners) <= PIECE * spacing**2
        done.append(pieces[small])
        pieces = _halves(pieces[~small])
    corners = [np.zeros((0, 3, 3)), *(part.corners for part in done)]
    return _Pieces(np.concatenate(corners), np.concatenate([np.zeros(0, np.uint32), *(part.key for part in done)]))


def _halves(pieces: _Pieces) -> _Pieces:
    """Both halves of each piece: all first ones, then all second ones."""
    corners = pieces.corners
    longest = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=2).argmax(axis=1)
    turned = np.take_along_axis(corners, ((longest[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)
    a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
    middle = (a + b) / 2
    halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return _Pieces(halves, np.concatenate([scramble(pieces.key, 1), scramble(pieces.key, 2)]))


def _tiles(pieces: _Pieces, spacing: float) -> list[np.ndarray]:
    """Rows of pieces that together hold about as many points as a tile has rays for."""
    expected = np.cumsum(2 * _areas(pieces.corners) / spacing**2 + TINY)
    number = (expected / (tile_size() // FEELERS)).astype(np.int64)
    return np.split(np.arange(len(expected)), np.flatnonzero(np.diff(number)) + 1) if len(expected) else []


def _points(pieces: _Pieces, spacing: float) -> Receivers:
    """The points of both sides of some pieces; a point's coordinates, area and key depend on its piece alone."""
    sides = np.repeat(np.arange(len(pieces.key)), 2)
    front = np.tile([True, False], len(pieces.key))
    key = scramble(pieces.key[sides] ^ front, 3)
    expected = (_areas(pieces.corners) / spacing**2)[sides]
    count = np.floor(expected + scramble(key, 4) * 2.0**-32).astype(np.int64)
    row = np.repeat(np.arange(len(sides)), count)
    number = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)).astype(np.uint32)
    shift = np.stack([scramble(key, 5), scramble(key, 6)])[:, row]
    position = _on_triangle(pieces.corners[sides[row]], number * STEP + shift)
    cross = _crosses(pieces.corners)
    normal = (cross / np.sqrt((cross**2).sum(axis=1, keepdims=True)))[sides] * np.where(front, 1, -1)[:, None]
    area = spacing**2 * np.maximum(expected, 1) / np.maximum(count, 1)
    area = np.where(expected < 1, spacing**2, area)
    normal, area = normal.astype(np.float32)[row], area.astype(np.float32)[row]
    return Receivers(position, normal, area, scramble(key[row] ^ number, 7), front[row])


def _on_triangle(corners: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """(n, 3) positions strictly inside triangles; the far half of the unit square is folded onto the near one."""
    u, v = (bits + 0.5) * 2.0**-32
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u)[:, None], np.where(fold, 1 - v, v)[:, None]
    return corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])


def _is_free(scene: Scene, receivers: Receivers, crack: float) -> np.ndarray:
    """(n,) whether a side sees free space: few backs of opaque faces, and not only what lies against it.

    The underside of a ground is not free: it is a back that faces down, with hardly anything below. A back side among
    fronts is free only where most of these are: nobody is inside a closed wall that furniture sticks into.
    """
    start = lifted(scene, receivers)
    free, met = _has_space(scene, start, receivers.normal.T, receivers.key, crack)
    free &= (met >= GROUNDED * FEELERS) | ~_face_down(receivers)
    back = np.flatnonzero(free & ~receivers.front)
    lane, position, normal = _witnesses(scene, start[:, back], receivers.take(back))
    good, _ = _has_space(scene, position, normal, scramble(receivers.key[back[lane]], 8), crack)
    free[back] &= np.bincount(lane, np.where(good, 1, -1), len(back)) >= 0
    return free


def _face_down(receivers: Receivers) -> np.ndarray:
    """(n,) backs that face down."""
    return ~receivers.front & (receivers.normal[:, 2] < DOWN)


def _has_space(scene: Scene, position, normal, key: np.ndarray, crack: float) -> tuple[np.ndarray, np.ndarray]:
    """(n,) whether few feelers meet backs, and most go farther than a crack is wide; (n,) how many meet anything.

    Those that the first feelers decide against need no others, and their count is not known.
    """
    counts, rows = np.zeros((3, len(key)), np.int64), np.arange(len(key))
    for first, last in itertools.pairwise((0, FIRST_FEELERS, FEELERS)):
        _, hits, opaque, back = _feel(scene, position[:, rows], normal[:, rows], key[rows], np.arange(first, last))
        close = opaque & (hits.distance < crack)
        for count, found in zip(counts, (back, close, hits.triangle != MISS), strict=True):
            count[rows] += found.reshape(len(rows), last - first).sum(axis=1)
        fit = (counts[0] <= BACKFACE_LIMIT * FEELERS) & (counts[1] <= FEELERS / 2)
        rows = np.flatnonzero(fit)
    return fit, counts[2]


def _witnesses(scene: Scene, start: np.ndarray, receivers: Receivers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(k,) rows of receivers, and (3, k) places with normals on fronts that some of their feelers meet."""
    normal, number = receivers.normal.T, np.arange(0, FEELERS, FEELERS // WITNESSES)
    direction, hits, opaque, back = _feel(scene, start, normal, receivers.key, number)
    lane = np.flatnonzero(opaque & ~back & (warp.dot(hits.normal, direction) < 0))
    normal = hits.normal[:, lane] / np.sqrt(warp.dot(hits.normal[:, lane], hits.normal[:, lane]))
    position = start[:, lane // WITNESSES] + direction[:, lane] * hits.distance[lane]
    position += normal * (START * scene.tracer.offset(position, hits.distance[lane]))
    return lane // WITNESSES, position, normal


def _feel(scene: Scene, position: np.ndarray, normal: np.ndarray, key: np.ndarray, numbers: np.ndarray):
    """(3, n * k) directions by the cosine, what they meet, and whether that is opaque, and the back of it."""
    point, sample = np.repeat(np.arange(len(key)), len(numbers)), np.tile(numbers, len(key))
    sampler = Sampler(scramble(key, 0), 0, FEELERS)
    normal = np.ascontiguousarray(normal)[:, point]
    direction = warp.cosine(*(sampler.uniform(point, sample, dimension) for dimension in (0, 1)), normal)
    hits = scene.tracer.intersect(np.ascontiguousarray(position[:, point]), direction)
    opaque = (hits.triangle != MISS) & ~scene.surfaces.transparent[hits.triangle]
    return direction, hits, opaque, opaque & (warp.dot(hits.normal, direction) > 0)
