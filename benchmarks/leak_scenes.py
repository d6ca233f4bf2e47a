"""Scenes with a side that must stay dark, or nearly so, and where to look for light that leaks there.

Comes in: how thick a wall is, where the scene lies. Goes out: a snapshot, patches of its lit side, patches of its dark
side. Rooms are the insides of solid shells; a wall of no thickness is one sheet with two sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gi_volumes.bake.snapshot import Channel, LightKind, Material, Snapshot
from gi_volumes.tests.build_scenes import BOX_FACES, box, lamps, plane, quad, snapshot, sun_frame

NEAREST = 5e-4
"""Least distance of points from the edges of their patch [m]."""

WHITE = Material("white", Channel((0.7,) * 3), specular_level=0.0)
PANEL = Material("panel", Channel((0.0,) * 3), Channel((20.0,) * 3), specular_level=0.0)

WALL = 0.3
"""Thickness of outer walls, floors and ceilings [m]."""

ROOM = np.array([8.0, 5.0, 3.0])
CLEAR = 0.2
"""Between the outside of a scene and the ground around it, so that no faces coincide [m]."""


@dataclass(frozen=True, eq=False)
class Case:
    """A scene and where it is judged.

    name : str
    scene : Snapshot
    lit, dark : (k, 4, 3) float64, patches as corner, two edges and normal; `dark` must not be lit by what lights `lit`
    sealed : bool, whether no light at all reaches `dark`; else the reference says how much does
    """

    name: str
    scene: Snapshot
    lit: np.ndarray
    dark: np.ndarray
    sealed: bool = True


@dataclass(frozen=True)
class Pose:
    """Where a scene lies: first turned about z, then moved.

    shift : offset of all axes [m]
    turn : angle [degrees]
    """

    shift: float = 0.0
    turn: float = 0.0

    def rotation(self) -> np.ndarray:
        """Rows of the turned axes.

        Returns
        -------
        (3, 3) float64 ndarray
            Multiplied from the right.
        """
        sine, cosine = np.sin(np.radians(self.turn)), np.cos(np.radians(self.turn))
        return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])

    def __call__(self, corners: np.ndarray) -> np.ndarray:
        """Place points."""
        return corners @ self.rotation() + self.shift

    def patches(self, found: np.ndarray) -> np.ndarray:
        """Place patches.

        Parameters
        ----------
        found : (k, 4, 3) float64 ndarray
            Patches.

        Returns
        -------
        (k, 4, 3) float64 ndarray
            Their corners are moved, the rest is only turned.
        """
        out = found @ self.rotation()
        out[:, 0] += self.shift
        return out


def inside(low, high, floor_only: bool = False) -> np.ndarray:
    """Patches of the inside of a box.

    Parameters
    ----------
    low, high : (3,) float
        Corners [m].
    floor_only : bool
        Only that which looks up.

    Returns
    -------
    (k, 4, 3) float64 ndarray
        One for each face.
    """
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) * (np.array(high, float) - low) + low
    out = []
    for a, b, _, d in BOX_FACES[:1] if floor_only else BOX_FACES:
        u, v = corners[b] - corners[a], corners[d] - corners[a]
        normal = -np.cross(u, v)
        out.append([corners[a], u, v, normal / np.linalg.norm(normal)])
    return np.array(out)


def sample(patches: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose points on patches: half of them anywhere, half at all scales of distance from the edges.

    Parameters
    ----------
    patches : (k, 4, 3) float64 ndarray
        Patches.
    count : int
        Points.
    seed : int
        Which ones.

    Returns
    -------
    point : (n, 3) float64 ndarray
        On the patches [m].
    normal : (n, 3) float64 ndarray
        Of their patch.
    """
    rng = np.random.default_rng(seed)
    area = np.linalg.norm(np.cross(patches[:, 1], patches[:, 2]), axis=1)
    of = patches[rng.choice(len(patches), count, p=area / area.sum())]
    place = of[:, 0].copy()
    for axis in (1, 2):
        length = np.linalg.norm(of[:, axis], axis=1)
        near = NEAREST * (length / 2 / NEAREST) ** rng.uniform(0, 1, count) / length
        near = np.where(rng.random(count) < 0.5, near, 1 - near)
        place += np.where(rng.random(count) < 0.5, near, rng.uniform(0, 1, count))[:, None] * of[:, axis]
    return place, of[:, 3]


def two_rooms(thickness: float, pose: Pose | None = None) -> Case:
    """Two sealed rooms side by side, a panel in one of them.

    Parameters
    ----------
    thickness : float
        Of the wall between them [m]; 0 for a sheet.
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The second room is dark.
    """
    pose = pose or Pose()
    second = np.array([ROOM[0] + thickness, 0, 0])
    parts = [box(np.full(3, -WALL), second + ROOM + WALL), box((3, 2, 2.9), (4, 3, 2.95))]
    parts += (
        [box((0, 0, 0), ROOM, inward=True), box(second, second + ROOM, inward=True)]
        if thickness
        else [
            box((0, 0, 0), ROOM * (2, 1, 1), inward=True),
            quad((8, 0, 0), (8, 5, 0), (8, 5, 3), (8, 0, 3)),
        ]
    )
    name = f"two rooms, wall {thickness:g} m, shift {pose.shift:g}, turn {pose.turn:g}"
    return _case(name, pose, parts, inside((0, 0, 0), ROOM), inside(second, second + ROOM))


def storeys(thickness: float, pose: Pose | None = None) -> Case:
    """A house of two storeys, a panel upstairs.

    Parameters
    ----------
    thickness : float
        Of the floor between them [m].
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        Downstairs is dark.
    """
    pose = pose or Pose()
    second = np.array([0, 0, ROOM[2] + thickness])
    parts = [
        box(np.full(3, -WALL), second + ROOM + WALL),
        box(np.add(second, (3, 2, 2.9)), np.add(second, (4, 3, 2.95))),
    ]
    parts += [box((0, 0, 0), ROOM, inward=True), box(second, second + ROOM, inward=True)]
    lit, dark = inside(second, second + ROOM), inside((0, 0, 0), ROOM)
    return _case(f"two storeys, floor {thickness:g} m", pose, parts, lit, dark)


def under_sky(height: float, pose: Pose | None = None) -> Case:
    """A sealed room on the ground, in the sun.

    Parameters
    ----------
    height : float
        Of its floor; that of the ground is 0 [m].
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The room is dark, its roof is lit.
    """
    pose = pose or Pose()
    low, high = np.array([0, 0, height]), np.add(ROOM, (0, 0, height))
    parts = [plane(40.0, min(height, 0.0) - CLEAR / 4), box(low - WALL, high + WALL)]
    parts += [box((0, 0, height), high, inward=True)]
    roof = inside(low - WALL, high + WALL, True)
    roof[:, 0, 2] = high[2] + WALL
    return _case(f"under the sky, floor {height:g} m", pose, parts, roof, inside(low, high), sky=10.0, sun=True)


def cellar(pose: Pose | None = None) -> Case:
    """A cellar below a street in the sun.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The cellar is dark.
    """
    pose = pose or Pose()
    low, high = np.array([-4, -2.5, -3.3]), np.array([4, 2.5, -0.3])
    parts = [box((-20, -20, -6), (20, 20, 0)), box(low, high, inward=True), box((-4, 4, -0.1), (4, 12, 9))]
    street = inside((-10, -3, 0), (10, 3, 1), True)
    return _case("cellar", pose, parts, street, inside(low, high), sky=1.0, sun=True)


def closet(pose: Pose | None = None, thickness: float = 0.02) -> Case:
    """A small closed box in a lit room.

    Parameters
    ----------
    pose : Pose, optional
        Where.
    thickness : float
        Of its walls [m].

    Returns
    -------
    Case
        The closet's inside is dark.
    """
    pose = pose or Pose()
    low, high = np.array([5.0, 2.0, 0.1]), np.array([5.6, 2.6, 0.7])
    parts = [*_room(), box(low, high), box(low + thickness, high - thickness, inward=True)]
    return _case(
        f"closet, wall {thickness:g} m", pose, parts, inside((0, 0, 0), ROOM), inside(low + thickness, high - thickness)
    )


def door(pose: Pose | None = None) -> Case:
    """Two rooms with an open door between them, 1 m by 2 m, in a wall of 0.3 m.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The second room gets what falls through the door.
    """
    pose = pose or Pose()
    x, far = ROOM[0], 2 * ROOM[0] + WALL
    parts = [box((-WALL,) * 3, (far + WALL, ROOM[1] + WALL, ROOM[2] + WALL)), box((3, 2, 2.9), (4, 3, 2.95))]
    parts += [box((0, 0, 0), (far, ROOM[1], ROOM[2]), inward=True)]
    sides = [((x, 0, 0), (x + WALL, 3, 3)), ((x, 4, 0), (x + WALL, 5, 3)), ((x, 3, 2), (x + WALL, 4, 3))]
    parts += [box(*side) for side in sides]
    dark = inside((x + WALL, 0, 0), (far, ROOM[1], ROOM[2]))
    return _case("open door", pose, parts, inside((0, 0, 0), ROOM), dark, sealed=False)


def corner(pose: Pose | None = None) -> Case:
    """A bent corridor; the panel is at one end.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The other end gets what goes round the corner.
    """
    pose = pose or Pose()
    parts = [*_room(), box((2.5, 2, -0.1), (8.1, 5.1, 3.1))]
    parts[1] = box((6, 0.7, 2.9), (7, 1.3, 2.95))
    lit, dark = inside((3, 0, 0), (8, 2, 3), True), inside((0, 3, 0), (2.5, 5, 3))
    return _case("corner", pose, parts, lit, np.delete(dark, 2, axis=0), sealed=False)


def column(pose: Pose | None = None) -> Case:
    """A column of 0.5 m between a panel and the floor behind it.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The floor behind the column lies in its shadow.
    """
    pose = pose or Pose()
    parts = [*_room(), box((4, 2.25, -0.1), (4.5, 2.75, 3.1))]
    parts[1] = box((0.5, 2.2, 1), (0.55, 2.8, 1.6))
    lit = inside((1, 0, 0), (4, 5, 1), True)
    return _case("column", pose, parts, lit, inside((4.5, 2.25, 0), (6, 2.75, 1), True), sealed=False)


def table(pose: Pose | None = None) -> Case:
    """A table on the floor of a lit room.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        The floor below the table is darker.
    """
    pose = pose or Pose()
    parts = [*_room(), box((5, 2, 0.7), (6.6, 2.8, 0.74))]
    parts += [box((x, y, 0), (x + 0.06, y + 0.06, 0.7)) for x in (5.0, 6.54) for y in (2.0, 2.74)]
    dark = inside((5.1, 2.1, 0), (6.5, 2.7, 1), True)
    return _case("table", pose, parts, inside((0, 0, 0), (4, 5, 3), True), dark, sealed=False)


def curtain(pose: Pose | None = None) -> Case:
    """A curtain across a room, a sheet that ends 0.4 m below the ceiling.

    Parameters
    ----------
    pose : Pose, optional
        Where.

    Returns
    -------
    Case
        Behind it is what goes over it.
    """
    pose = pose or Pose()
    parts = [*_room(), quad((5, 0, 0), (5, 5, 0), (5, 5, 2.6), (5, 0, 2.6))]
    lit, dark = inside((0, 0, 0), (5, 5, 2.6), True), inside((5, 0, 0), (8, 5, 2.6))
    return _case("curtain", pose, parts, lit, dark[[0, 2, 3, 4, 5]], sealed=False)


def cases() -> dict[str, Callable[[], Case]]:
    """List all scenes that the benchmark bakes.

    Returns
    -------
    dict of str to callable
        By name; each call builds one.
    """
    rooms = {f"wall {t:g}": lambda t=t: two_rooms(t) for t in (0.3, 0.1, 0.02, 0.0)}
    moved = {
        f"wall {t:g} shift {s:g} turn {a:g}": lambda t=t, s=s, a=a: two_rooms(t, Pose(s, a))
        for t in (0.3, 0.02)
        for s, a in ((0.065, 0), (0.155, 17), (0.25, 45), (0.0, 17))
    }
    skies = {f"sky {h:g}": lambda h=h: under_sky(h) for h in (-0.02, 0.0, 0.1)}
    floors = {f"storeys {t:g}": lambda t=t: storeys(t) for t in (0.3, 0.1, 0.02)}
    others = {f.__name__: f for f in (cellar, closet, door, corner, column, table, curtain)}
    return rooms | moved | skies | floors | others


def _room() -> list[np.ndarray]:
    """A room with a panel under its ceiling."""
    return [
        np.concatenate([box(np.full(3, -WALL), ROOM + WALL), box((0, 0, 0), ROOM, inward=True)]),
        box((2, 2, 2.9), (3, 3, 2.95)),
    ]


def _case(name, pose, parts, lit, dark, sealed=True, sky=0.0, sun=False) -> Case:
    """Place everything; without a sky the second part shines."""
    lights = lamps()
    if sun:
        frame = pose.rotation().T @ sun_frame((0.5, -0.6, 0.8))
        lights = lamps({"kind": LightKind.SUN, "strength": (20,) * 3, "frame": frame, "size": (0.01, 0)})
    materials = [PANEL if number == 1 and not sky else WHITE for number in range(len(parts))]
    placed = [(pose(part), material) for part, material in zip(parts, materials, strict=True)]
    scene = snapshot(placed, lights, sky=(sky,) * 3)
    return Case(name, scene, pose.patches(lit), pose.patches(dark), sealed)
