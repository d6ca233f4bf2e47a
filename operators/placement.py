"""Where instances stand, in double precision.

Comes in: instances of a dependency graph, whose matrices Blender keeps in single precision. Goes out: float64
matrices. Far from the origin a child's own placement is finer than its world matrix can say: the chain of
parents is multiplied again in double precision, and used where it agrees with Blender's matrix to its rounding.
"""

from __future__ import annotations

import bpy
import numpy as np

# Rounding steps of float32 by which the two may differ: a few for each parent and each factor of a matrix.
STEPS = 32
MAX_PARENTS = 64


class Placements:
    """World matrices; those of objects are kept, since children ask for them again."""

    def __init__(self) -> None:
        self._objects: dict[int, np.ndarray] = {}

    def matrix(self, instance: bpy.types.DepsgraphObjectInstance) -> np.ndarray:
        """Return where an instance stands.

        Parameters
        ----------
        instance : bpy.types.DepsgraphObjectInstance
            Of an evaluated scene.

        Returns
        -------
        (4, 4) float64 [m]
            World from mesh; as precise as the scene's data where the object is placed by parents or by an
            instanced collection alone, else as Blender has it.
        """
        single = np.array(instance.matrix_world, np.float64)
        if not instance.is_instance:
            return _finer(self._chain(instance.object), single)
        parent, object = instance.parent, instance.object
        if parent is None or parent.instance_type != "COLLECTION" or parent.instance_collection is None:
            return single
        offset = np.eye(4)
        offset[:3, 3] = -np.array(parent.instance_collection.instance_offset, np.float64)
        return _finer(self._chain(parent) @ offset @ self._chain(object), single)

    def _chain(self, object: bpy.types.Object, depth: int = 0) -> np.ndarray:
        """World from object by its parents, each factor as Blender stores it."""
        key = object.as_pointer()
        if key not in self._objects:
            own = np.array(object.matrix_world, np.float64)
            if object.parent is None:
                self._objects[key] = own
            elif object.parent_type == "OBJECT" and depth < MAX_PARENTS:
                inverse, basis = (np.array(m, np.float64) for m in (object.matrix_parent_inverse, object.matrix_basis))
                self._objects[key] = _finer(self._chain(object.parent, depth + 1) @ inverse @ basis, own)
            else:
                self._objects[key] = own
        return self._objects[key]


def _finer(double: np.ndarray, single: np.ndarray) -> np.ndarray:
    """The first where it rounds to the second, else the second (constraints, delta transforms, other parents)."""
    if not (np.isfinite(double).all() and np.isfinite(single).all()):
        return single
    scale = np.abs(single[:3]).max(1)
    allowed = STEPS * np.spacing(np.maximum(scale, 1e-3).astype(np.float32)).astype(np.float64)
    return double if (np.abs(double - single)[:3] <= allowed[:, None]).all() else single
