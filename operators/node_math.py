"""Arithmetic of shader nodes on numpy arrays: one function for each operation, as Cycles defines it.

Comes in: arrays whose last axis holds the components. Goes out: the same shape. Source: Blender's
`intern/cycles/kernel/svm/math_util.h`, `color_util.h` and `kernel/svm/map_range.h`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray
TINY = 1e-5
BLACKBODY_LOW_K = 800.0


def _divide(a: Array, b: Array) -> Array:
    """Division that yields 0 for a divisor of 0."""
    return np.where(b != 0, a / np.where(b != 0, b, 1), 0)


def _power(a: Array, b: Array) -> Array:
    """Power that yields 0 where it is not real."""
    return np.nan_to_num(np.where((a < 0) & (b != np.floor(b)), 0, np.power(a, b)))


def _smooth(a: Array, b: Array, k: Array, sign: float) -> Array:
    """Smooth minimum (sign 1) or maximum (sign -1)."""
    h = np.maximum(k - np.abs(a - b), 0) / np.where(k != 0, k, 1)
    smooth = sign * (np.minimum(sign * a, sign * b) - h**3 * k / 6)
    return np.where(k != 0, smooth, sign * np.minimum(sign * a, sign * b))


def _wrap(a: Array, high: Array, low: Array) -> Array:
    """Wrap into [low, high)."""
    span = high - low
    return np.where(span != 0, a - span * np.floor(_divide(a - low, span)), low)


def _pingpong(a: Array, scale: Array) -> Array:
    """Back and forth between 0 and the scale."""
    return np.where(scale != 0, np.abs(np.mod(_divide(a - scale, scale * 2), 1) * scale * 2 - scale), 0)


MATH: dict[str, Callable[..., Array]] = {
    "ADD": lambda a, b, c: a + b,
    "SUBTRACT": lambda a, b, c: a - b,
    "MULTIPLY": lambda a, b, c: a * b,
    "DIVIDE": lambda a, b, c: _divide(a, b),
    "MULTIPLY_ADD": lambda a, b, c: a * b + c,
    "POWER": lambda a, b, c: _power(a, b),
    "LOGARITHM": lambda a, b, c: np.nan_to_num(_divide(np.log(np.maximum(a, 1e-30)), np.log(np.maximum(b, 1e-30)))),
    "SQRT": lambda a, b, c: np.sqrt(np.maximum(a, 0)),
    "INVERSE_SQRT": lambda a, b, c: np.where(a > 0, 1 / np.sqrt(np.maximum(a, 1e-30)), 0),
    "ABSOLUTE": lambda a, b, c: np.abs(a),
    "EXPONENT": lambda a, b, c: np.exp(np.minimum(a, 80)),
    "MINIMUM": lambda a, b, c: np.minimum(a, b),
    "MAXIMUM": lambda a, b, c: np.maximum(a, b),
    "LESS_THAN": lambda a, b, c: (a < b) * 1.0,
    "GREATER_THAN": lambda a, b, c: (a > b) * 1.0,
    "SIGN": lambda a, b, c: np.sign(a),
    "COMPARE": lambda a, b, c: (np.abs(a - b) <= np.maximum(c, TINY)) * 1.0,
    "SMOOTH_MIN": lambda a, b, c: _smooth(a, b, c, 1.0),
    "SMOOTH_MAX": lambda a, b, c: _smooth(a, b, c, -1.0),
    "ROUND": lambda a, b, c: np.floor(a + 0.5),
    "FLOOR": lambda a, b, c: np.floor(a),
    "CEIL": lambda a, b, c: np.ceil(a),
    "TRUNC": lambda a, b, c: np.trunc(a),
    "FRACT": lambda a, b, c: a - np.floor(a),
    "MODULO": lambda a, b, c: np.where(b != 0, np.fmod(a, np.where(b != 0, b, 1)), 0),
    "FLOORED_MODULO": lambda a, b, c: np.where(b != 0, np.mod(a, np.where(b != 0, b, 1)), 0),
    "WRAP": _wrap,
    "SNAP": lambda a, b, c: np.floor(_divide(a, b)) * b,
    "PINGPONG": lambda a, b, c: _pingpong(a, b),
    "SINE": lambda a, b, c: np.sin(a),
    "COSINE": lambda a, b, c: np.cos(a),
    "TANGENT": lambda a, b, c: np.tan(a),
    "ARCSINE": lambda a, b, c: np.arcsin(np.clip(a, -1, 1)),
    "ARCCOSINE": lambda a, b, c: np.arccos(np.clip(a, -1, 1)),
    "ARCTANGENT": lambda a, b, c: np.arctan(a),
    "ARCTAN2": lambda a, b, c: np.arctan2(a, b),
    "SINH": lambda a, b, c: np.sinh(np.clip(a, -80, 80)),
    "COSH": lambda a, b, c: np.cosh(np.clip(a, -80, 80)),
    "TANH": lambda a, b, c: np.tanh(a),
    "RADIANS": lambda a, b, c: np.deg2rad(a),
    "DEGREES": lambda a, b, c: np.rad2deg(a),
}

# Vector operations that act on each component alone, or reduce to a length; others are not represented.
VECTOR: dict[str, Callable[..., Array]] = {
    "ADD": lambda a, b, c, s: a + b,
    "SUBTRACT": lambda a, b, c, s: a - b,
    "MULTIPLY": lambda a, b, c, s: a * b,
    "DIVIDE": lambda a, b, c, s: _divide(a, b),
    "MULTIPLY_ADD": lambda a, b, c, s: a * b + c,
    "SCALE": lambda a, b, c, s: a * s,
    "MINIMUM": lambda a, b, c, s: np.minimum(a, b),
    "MAXIMUM": lambda a, b, c, s: np.maximum(a, b),
    "ABSOLUTE": lambda a, b, c, s: np.abs(a),
    "FLOOR": lambda a, b, c, s: np.floor(a),
    "CEIL": lambda a, b, c, s: np.ceil(a),
    "FRACTION": lambda a, b, c, s: a - np.floor(a),
    "DOT_PRODUCT": lambda a, b, c, s: np.sum(a * b, -1, keepdims=True),
    "LENGTH": lambda a, b, c, s: np.linalg.norm(a, axis=-1, keepdims=True),
    "DISTANCE": lambda a, b, c, s: np.linalg.norm(a - b, axis=-1, keepdims=True),
    "NORMALIZE": lambda a, b, c, s: _divide(a, np.linalg.norm(a, axis=-1, keepdims=True)),
}


def _overlay(a: Array, b: Array) -> Array:
    return np.where(a < 0.5, 2 * a * b, 1 - 2 * (1 - a) * (1 - b))


def _soft_light(a: Array, b: Array) -> Array:
    return (1 - a) * b * a + a * (1 - (1 - b) * (1 - a))


def _hsv_blend(a: Array, b: Array, planes: tuple[int, ...], needs_color: bool) -> Array:
    """Replace some of a's hue, saturation, value with b's."""
    a, b = np.broadcast_arrays(a, b)
    first, second = hsv_from_rgb(a), hsv_from_rgb(b)
    mixed = first.copy()
    mixed[..., planes] = second[..., planes]
    grey = (second[..., 1:2] == 0) if needs_color else np.zeros_like(second[..., 1:2], bool)
    return np.where(grey, a, rgb_from_hsv(mixed))


# Blend modes that lerp towards blend(a, b) by the factor.
BLEND: dict[str, Callable[[Array, Array], Array]] = {
    "MIX": lambda a, b: b,
    "ADD": lambda a, b: a + b,
    "MULTIPLY": lambda a, b: a * b,
    "SUBTRACT": lambda a, b: a - b,
    "DIVIDE": lambda a, b: np.where(b != 0, a / np.where(b != 0, b, 1), a),
    "DIFFERENCE": lambda a, b: np.abs(a - b),
    "EXCLUSION": lambda a, b: np.maximum(a + b - 2 * a * b, 0),
    "DARKEN": np.minimum,
    "LIGHTEN": np.maximum,
    "SCREEN": lambda a, b: 1 - (1 - a) * (1 - b),
    "OVERLAY": _overlay,
    "SOFT_LIGHT": _soft_light,
    "LINEAR_LIGHT": lambda a, b: a + 2 * b - 1,
    "HUE": lambda a, b: _hsv_blend(a, b, (0,), True),
    "SATURATION": lambda a, b: _hsv_blend(a, b, (1,), False),
    "VALUE": lambda a, b: _hsv_blend(a, b, (2,), False),
    "COLOR": lambda a, b: _hsv_blend(a, b, (0, 1), True),
}


def _dodge(a: Array, b: Array, factor: Array) -> Array:
    rest = 1 - factor * b
    return np.where(a == 0, 0, np.where(rest <= 0, 1, np.minimum(_divide(a, rest), 1)))


def _burn(a: Array, b: Array, factor: Array) -> Array:
    rest = 1 - factor + factor * b
    return np.where(rest <= 0, 0, np.clip(1 - _divide(1 - a, rest), 0, 1))


# Blend modes that take the factor into their formula.
FACTOR_BLEND: dict[str, Callable[[Array, Array, Array], Array]] = {"DODGE": _dodge, "BURN": _burn}


def hsv_from_rgb(rgb: Array) -> Array:
    """Return hue, saturation and value.

    Parameters
    ----------
    rgb : (..., 3) float
        Linear colours.

    Returns
    -------
    (..., 3) float
        Hue in 0..1 (red at 0), saturation, value.
    """
    r, g, b = np.moveaxis(np.asarray(rgb, np.float64), -1, 0)
    high, low = np.maximum(np.maximum(r, g), b), np.minimum(np.minimum(r, g), b)
    span = high - low
    safe = np.where(span > 0, span, 1)
    hue = np.where(high == r, (g - b) / safe, np.where(high == g, 2 + (b - r) / safe, 4 + (r - g) / safe))
    hue = np.where(span > 0, np.mod(hue / 6, 1), 0)
    return np.stack([hue, np.where(high > 0, span / np.where(high > 0, high, 1), 0), high], -1)


def rgb_from_hsv(hsv: Array) -> Array:
    """Return linear colours.

    Parameters
    ----------
    hsv : (..., 3) float
        Hue in 0..1, saturation, value.

    Returns
    -------
    (..., 3) float
        Linear colours.
    """
    hue, saturation, value = (plane[..., None] for plane in np.moveaxis(np.asarray(hsv, np.float64), -1, 0))
    wheel = np.abs(np.mod(hue * 6 + np.array([0.0, 4.0, 2.0]), 6) - 3) - 1
    return value * (1 + saturation * (np.clip(wheel, 0, 1) - 1))


def map_range(value: Array, low: Array, high: Array, to_low: Array, to_high: Array, mode: str, steps: Array) -> Array:
    """Return a value moved from one range to another.

    Parameters
    ----------
    value, low, high, to_low, to_high : (..., c) float
        The value, its range and the new range.
    mode : str
        LINEAR, STEPPED, SMOOTHSTEP or SMOOTHERSTEP.
    steps : (..., 1) float
        Number of steps of STEPPED.

    Returns
    -------
    (..., c) float
        Not clamped, except by the smooth modes.
    """
    t = _divide(value - low, high - low)
    if mode == "STEPPED":
        t = np.where(steps > 0, np.floor(t * (steps + 1)) / np.where(steps > 0, steps, 1), 0)
    if mode in ("SMOOTHSTEP", "SMOOTHERSTEP"):
        t = np.clip(t, 0, 1)
        t = t * t * (3 - 2 * t) if mode == "SMOOTHSTEP" else t**3 * (t * (t * 6 - 15) + 10)
    return to_low + t * (to_high - to_low)
