"""The world as a panorama of radiance."""

from __future__ import annotations

import bpy
import numpy as np

from .evaluate import Evaluator


def read(world: bpy.types.World | None, evaluator: Evaluator) -> np.ndarray:
    """stub"""
    return np.zeros((1, 1, 3), np.float32)
