"""Least squares between data points and receivers, for many columns at once, without a sparse matrix.

Comes in: taps and weights of receivers, their normals' basis functions. Goes out: what receivers see, the transpose,
and the solution of the normal equations. Taps lie sorted by data point, so that a product with a data point's values
is a small dense matrix product:

    apply      values (9, columns) of a data point  ->  its taps (16 at a time, columns)  ->  receivers
    transpose  receivers' columns  ->  taps (16 at a time, columns)  ->  (9, columns)  ->  data points
"""

from __future__ import annotations

import numpy as np

from ..tree import harmonics

__all__ = ["Operator", "Solver"]

SUMMED = 16
"""Taps of a data point in one matrix product; larger ones start threads of BLAS, which change the last bits."""

SWEPT = 512
"""Matrices that are inverted at a time: they stay in the cache."""

ITERATIONS = 50
TOLERANCE = 1e-2
"""Relative residual, in the preconditioner's norm, at which a column is solved; 1e-5 changes errors by under 0.1 %."""


class Operator:
    """The map from values (points, 9, columns) to irradiance (receivers, columns), and its transpose.

    Taps lie sorted by data point, padded to whole products of `SUMMED`; receivers lie sorted by number of taps, so
    that the j-th taps of all receivers that have so many are one gather.

    Parameters
    ----------
    points : int
        Number of data points.
    row : (n, t) int64
        Data points of each receiver's taps.
    weight : (n, t) float
        Weights of the taps.
    basis : (n, 9) float
        Basis functions at the receivers' normals.
    receiver : (n,) float
        How much each receiver counts, 1 on average.
    """

    def __init__(self, points: int, row, weight, basis, receiver: np.ndarray) -> None:
        used = (weight != 0) & (receiver > 0)[:, None]
        seer, slot = np.nonzero(used)
        order = np.argsort(row[seer, slot], kind="stable")
        seer, slot = seer[order], slot[order]
        place, self._group_point = _places(row[seer, slot], points)
        self.taps = len(self._group_point) * SUMMED
        self.shape = (points, harmonics.COUNT)
        self.order = np.argsort(-used.sum(axis=1), kind="stable")
        self._seen_by = np.zeros(self.taps, np.int64)
        self._seen_by[place] = np.argsort(self.order)[seer]
        self._slots = _slots(used, seer, slot, place, self.order)
        factors = np.zeros((self.taps, harmonics.COUNT), np.float32)
        factors[place] = weight[seer, slot, None] * basis[seer]
        self._factors = factors.reshape(-1, SUMMED, harmonics.COUNT)
        self._rounds = _rounds(self._group_point, points)
        self.weight = receiver[self.order].astype(np.float32)[:, None]

    def apply(self, values: np.ndarray) -> np.ndarray:
        """What receivers see.

        Parameters
        ----------
        values : (points, 9, columns) float32 ndarray
            Irradiance harmonics.

        Returns
        -------
        (receivers, columns) float32 ndarray
            In the operator's `order`.
        """
        parts = (self._factors @ values[self._group_point]).reshape(self.taps, values.shape[2])
        out = np.zeros((len(self.order), values.shape[2]), np.float32)
        for place in self._slots:
            out[: len(place)] += parts[place]
        return out

    def transpose(self, seen: np.ndarray) -> np.ndarray:
        """What data points are told.

        Parameters
        ----------
        seen : (receivers, columns) float32 ndarray
            In the operator's `order`.

        Returns
        -------
        (points, 9, columns) float32 ndarray
            Sums over receivers.
        """
        groups = seen[self._seen_by].reshape(-1, SUMMED, seen.shape[1])
        return self._sum(self._factors.transpose(0, 2, 1) @ groups)

    def blocks(self) -> np.ndarray:
        """Diagonal blocks of transpose * weight * apply.

        Returns
        -------
        (points, 9, 9) float32 ndarray
            Symmetric, not negative.
        """
        weight = self.weight[self._seen_by].reshape(-1, SUMMED, 1)
        return self._sum(self._factors.transpose(0, 2, 1) @ (self._factors * weight))

    def _sum(self, groups: np.ndarray) -> np.ndarray:
        """Sum the groups of each data point: the first of all, the second of those that have two, and so on."""
        out = np.zeros((*self.shape, groups.shape[2]), np.float32)
        for point, group in self._rounds:
            out[point] += groups[group]
        return out


class Solver:
    """Conjugate gradients on the normal equations, preconditioned by each data point's own 9 x 9 block.

    Parameters
    ----------
    operator : Operator
        What receivers see.
    prior : (points,) float64 ndarray
        Trust in what the values are now, above 0.

    Attributes
    ----------
    inverse : (points, 9, 9) float32
        Of the blocks.
    """

    def __init__(self, operator: Operator, prior: np.ndarray) -> None:
        self._operator = operator
        penalty = prior[:, None] * (harmonics.COSINE[0] / harmonics.COSINE) ** 2
        blocks = operator.blocks().astype(np.float64) + penalty[:, :, None] * np.eye(harmonics.COUNT)
        self.inverse = _inverse(blocks).astype(np.float32)
        self._penalty = penalty[:, :, None].astype(np.float32)

    def solve(self, traced: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Fit every column, in its own unit.

        Parameters
        ----------
        traced : (points, 9, columns) float32 ndarray
            Values to stay close to.
        seen : (receivers, columns) float32 ndarray
            Irradiance to follow.

        Returns
        -------
        (points, 9, columns) float32 ndarray
            Fitted values.
        """
        unit = _unit(traced, seen)
        traced = traced / unit
        residual = seen[self._operator.order] / unit - self._operator.apply(traced)
        change = self._conjugate_gradients(self._operator.transpose(residual * self._operator.weight))
        largest = np.finfo(np.float32).max / np.maximum(unit, 1.0)
        return np.clip(traced + change, -largest, largest) * unit

    def _conjugate_gradients(self, residual: np.ndarray) -> np.ndarray:
        """Solve normal(x) = residual for every column."""
        x = np.zeros_like(residual)
        step = self.inverse @ residual
        direction = step.copy()
        energy = first = _dot(residual, step)
        for _ in range(ITERATIONS):
            image = self._normal(direction)
            length = _ratio(energy, _dot(direction, image))
            x += length * direction
            residual = residual - length * image
            step = self.inverse @ residual
            before, energy = energy, _dot(residual, step)
            if (energy <= first * TOLERANCE**2).all():
                break
            direction = step + _ratio(energy, before) * direction
        return x

    def _normal(self, values: np.ndarray) -> np.ndarray:
        """The matrix of the normal equations."""
        seen = self._operator.apply(values) * self._operator.weight
        return self._operator.transpose(seen) + self._penalty * values


def _inverse(blocks: np.ndarray) -> np.ndarray:
    """Inverses of symmetric positive matrices, by sweeping one pivot after the other through all of them.

    LAPACK takes 1.7 us for one of 9 x 9 on one thread, but 40 to 180 us where OpenBLAS wakes its threads for it.
    Source: Goodnight 1979, "A Tutorial on the SWEEP Operator".
    """
    out = np.empty_like(blocks)
    for first in range(0, len(blocks), SWEPT):
        part = np.ascontiguousarray(np.moveaxis(blocks[first : first + SWEPT], 0, 2))
        for pivot in range(len(part)):
            row, scale = part[pivot].copy(), 1 / part[pivot, pivot]
            part -= row[:, None] * (row * scale)
            part[pivot] = part[:, pivot] = row * scale
            part[pivot, pivot] = -scale
        out[first : first + SWEPT] = -np.moveaxis(part, 2, 0)
    return out


def _places(point: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Padded place of each tap, taps sorted by data point, and the data point of each group of `SUMMED` places."""
    count = np.bincount(point, minlength=points)
    groups = -(-count // SUMMED)
    start = (np.cumsum(groups) - groups) * SUMMED - (np.cumsum(count) - count)
    return np.arange(len(point)) + start[point], np.repeat(np.arange(points), groups)


def _rounds(group_point: np.ndarray, points: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Data points that have a first group, and those groups; the same for a second group, and so on."""
    count = np.bincount(group_point, minlength=points)
    first, order = np.cumsum(count) - count, np.argsort(-count, kind="stable")
    sizes = np.searchsorted(-count[order], -np.arange(count.max(initial=0)), side="left")
    return [(order[:size], first[order[:size]] + number) for number, size in enumerate(sizes)]


def _slots(used, receiver, slot, place, order: np.ndarray) -> list[np.ndarray]:
    """Places of the first taps of all receivers, of the second taps of those that have two, and so on."""
    table = np.full(used.shape, -1)
    table[receiver, slot] = place
    table = np.take_along_axis(table, np.argsort(table < 0, axis=1, kind="stable"), axis=1)[order]
    return [column[: (column >= 0).sum()] for column in np.ascontiguousarray(table.T) if (column >= 0).any()]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner product of each column."""
    return np.einsum("kjf,kjf->f", a, b, dtype=np.float64, casting="same_kind")


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quotients, 0 where a column has nothing left to solve."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0).astype(np.float32)


def _unit(traced: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Power of two at most the largest value of each column, so that squares stay in range."""
    largest = np.abs(traced).max(axis=(0, 1), initial=0.0)
    largest = np.maximum(largest, np.abs(seen).max(axis=0, initial=0.0))
    exponent = np.frexp(np.where(largest > 0, largest, 1.0))[1] - 1
    return np.ldexp(np.float32(1), np.maximum(exponent, -126)).astype(np.float32)
