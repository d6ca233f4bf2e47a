"""What an artist says about reflection probes by the objects that stand for them.

Comes in: a scene's objects. Goes out: which places are pinned, and boxes around those that are deleted. A probe is
pinned where its object says so or is not where the bake had put it, or was made by somebody else; it is deleted where
the bake had put one and no object stands for it any more. Hidden ones count like others.
"""

from __future__ import annotations

import math

import bpy
import numpy as np

from ..bake.snapshot import ProbeEdits, SnapshotError
from .probe_properties import PROBE

# Part of a probe's reach that it may be off before it counts as moved: rounding, when it gets a parent, is less.
STILL = 1 / 1000
MAX_PARENTS = 64
# Half the distance to the nearest other probe [m] where no bake has said it.
USUAL_REACH = 1.0


class Marks:
    """Probes' places that were met so far; `add` one after the other, then `record`."""

    def __init__(self) -> None:
        self._pinned: list[np.ndarray] = []
        self._met: set[int] = set()

    def add(self, object: bpy.types.Object, place: np.ndarray, name: str) -> None:
        """Add a probe, or an instance of one.

        Parameters
        ----------
        object : bpy.types.Object
            Stands for a probe.
        place : (3,) float64 [m]
            World space.
        name : str
            Its name, for messages.

        Raises
        ------
        SnapshotError
            The place is not finite.
        """
        self._met.add(object.original.as_pointer())
        if not np.isfinite(place).all():
            raise SnapshotError(f"reflection probe '{name}' has an invalid transform: reset its location")
        if is_pinned(object, place):
            self._pinned.append(place)

    def record(self, scene: bpy.types.Scene) -> ProbeEdits:
        """Return what is said about a scene's probes.

        Parameters
        ----------
        scene : bpy.types.Scene
            The scene, not evaluated; its probes that have not been added, as they don't render, are added.

        Returns
        -------
        ProbeEdits
            Each place once, sorted.
        """
        found = probes_of(scene)
        for object in found:
            if object.as_pointer() not in self._met:
                self.add(object, place_of(object), object.name)
        pinned = np.unique(np.array(self._pinned, np.float64).reshape(-1, 3), axis=0)
        return ProbeEdits(pinned, boxes(deleted(scene, found)))


def is_probe(object: bpy.types.Object) -> bool:
    """Say whether an object stands for a reflection probe.

    Parameters
    ----------
    object : bpy.types.Object
        Evaluated or not.

    Returns
    -------
    bool
        By its role.
    """
    settings = getattr(object.original, "gi_volumes", None)
    return settings is not None and settings.role == PROBE


def probes_of(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """List the objects of a scene that stand for reflection probes.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene, not evaluated.

    Returns
    -------
    list of bpy.types.Object
        Hidden ones too.
    """
    return [object for object in scene.objects if is_probe(object)]


def is_pinned(object: bpy.types.Object, place: np.ndarray) -> bool:
    """Say whether a probe has to be where it is.

    Parameters
    ----------
    object : bpy.types.Object
        Stands for a probe.
    place : (3,) float64 [m]
        Where it, or its instance, is in world space.

    Returns
    -------
    bool
        Whether it was pinned, is not where the bake had put it, or nobody knows: the bake never had it, or Blender has
        not evaluated its constraints.
    """
    settings = object.original.gi_volumes
    if settings.kept or not settings.reach or _is_lost(object.original):
        return True
    return math.dist(place, settings.placed) > STILL * settings.reach


def place_of(object: bpy.types.Object) -> np.ndarray:
    """Return where an object is, also when it has not been evaluated, as in a collection that is excluded.

    Parameters
    ----------
    object : bpy.types.Object
        Not evaluated.

    Returns
    -------
    (3,) float64 ndarray [m]
        World space; as Blender has evaluated it where constraints have a say.
    """
    if _is_driven(object) and not _is_lost(object):
        return np.array(object.matrix_world, np.float64)[:3, 3]
    return _resting(object)[:3, 3]


def release(object: bpy.types.Object) -> None:
    """Leave a probe to the bake again: it goes back to where the bake had put it.

    Parameters
    ----------
    object : bpy.types.Object
        Stands for a probe.
    """
    settings = object.gi_volumes
    settings.kept = False
    if not settings.reach:
        adopt(object)
    elif is_pinned(object, place_of(object)):
        matrix = object.matrix_world.copy()
        matrix.translation = settings.placed
        object.matrix_world = matrix


def adopt(object: bpy.types.Object) -> None:
    """Take the place of a probe for the one that the bake gave it.

    Parameters
    ----------
    object : bpy.types.Object
        Stands for a probe.
    """
    settings = object.gi_volumes
    settings.placed, settings.reach = place_of(object), settings.reach or USUAL_REACH


def deleted(scene: bpy.types.Scene, found: list[bpy.types.Object]) -> list[tuple[tuple[float, ...], float]]:
    """List places where an artist wants no probe.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.
    found : list of bpy.types.Object
        Its probes, as from `probes_of`.

    Returns
    -------
    list of (place, reach)
        Those that are remembered, then those that are missing since probes were shown: place and half the distance to
        the nearest other one [m].
    """
    settings = getattr(scene, "gi_volumes", None)
    if settings is None:
        return []
    return [(tuple(item.place), item.reach) for item in (*settings.deleted_probes, *missing(scene, found))]


def missing(scene: bpy.types.Scene, found: list[bpy.types.Object]) -> list[bpy.types.PropertyGroup]:
    """List places of probes that were shown and that no object stands for any more.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.
    found : list of bpy.types.Object
        Its probes, as from `probes_of`.

    Returns
    -------
    list of GIVOLUMES_PG_place
        None where no probe is left at all: somebody has put the whole collection away.
    """
    homes = {tuple(object.gi_volumes.placed) for object in found}
    return [item for item in scene.gi_volumes.placed_probes if found and tuple(item.place) not in homes]


def boxes(places: list[tuple[tuple[float, ...], float]]) -> np.ndarray:
    """Return boxes around deleted places.

    Parameters
    ----------
    places : list of (place, reach)
        As from `deleted`.

    Returns
    -------
    (b, 2, 3) float64 ndarray [m]
        Lowest and highest corners; they reach half of the way to the nearest other probe.
    """
    middle = np.array([place for place, _ in places], np.float64).reshape(-1, 1, 3)
    reach = np.array([reach for _, reach in places], np.float64).reshape(-1, 1, 1)
    return middle + reach * np.array([[[-1.0], [1.0]]])


def _is_driven(object: bpy.types.Object) -> bool:
    """Whether constraints, bones or vertices have a say in where an object is."""
    at, parents = object, 0
    while at is not None and parents < MAX_PARENTS:
        if at.constraints or at.parent_type != "OBJECT":
            return True
        at, parents = at.parent, parents + 1
    return False


def _is_lost(object: bpy.types.Object) -> bool:
    """Whether only Blender can say where an object is, and has not: matrices are not stored in files."""
    return object.matrix_world.is_identity and _is_driven(object)


def _resting(object: bpy.types.Object) -> np.ndarray:
    """(4, 4) world from object by its own and its parents' settings, without constraints."""
    matrix, parents = np.array(object.matrix_basis, np.float64), 0
    while object.parent is not None and parents < MAX_PARENTS:
        inverse, parent = (np.array(m, np.float64) for m in (object.matrix_parent_inverse, object.parent.matrix_basis))
        matrix, object, parents = parent @ inverse @ matrix, object.parent, parents + 1
    return matrix
