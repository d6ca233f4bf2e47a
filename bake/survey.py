"""Surveys a cell: receivers all over its surfaces, the light that arrives there, and how wrong the data points are.

Comes in: a tree with measured data points. Goes out: receivers path-traced twice, independently; data points fitted
to them; and for each receiver an estimate of the squared error there that noise doesn't raise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..tree import harmonics, interpolate
from ..tree.blend import ENOUGH, blend, clamp
from ..tree.stencil import taps
from ..tree.topology import Topology
from . import fit, fit_error, receivers, reference
from .gather import Effort
from .lamps import LUMINANCE
from .measured import Measured, functions, split, stack
from .receivers import FIELDS, Receivers
from .scene import Scene

DARK = 0.1
"""Errors count relative to the light at the receiver, and to this part of the cell's mean where it is darker."""

INSIDE = 0.9
"""Part of a receiver's linear weights that must lie in the cell itself for the receiver to have a say in the fit."""

CLOSER, CLOSER_SEED = 4, 0xC105
"""Paths that receivers get besides their own where an error may be too large but is not clear of noise; their seed."""

HALVES = (0x51ED, 0xA11E)
"""Added to the seed for either half of the receivers' paths."""


@dataclass(frozen=True, eq=False)
class Judge:
    """What the error is measured in: mixtures of the modelled functions.

    views : (v, functions, 3) float64, each looked at by itself, their squared errors are added
    mean : (functions, 3) float64, the mixture that errors are relative to
    """

    views: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True, eq=False)
class Seen:
    """Receivers and the light that arrives at them.

    at : Receivers
    light : (2, n, functions, 3) float32, two independent halves
    """

    at: Receivers
    light: np.ndarray

    def take(self, rows: np.ndarray) -> Seen:
        """Some of them.

        Parameters
        ----------
        rows : (m,) int64 or (n,) bool ndarray
            Which.

        Returns
        -------
        Seen
            Copies.
        """
        return Seen(self.at.take(rows), self.light[:, rows])

    @classmethod
    def none(cls, functions: int) -> Seen:
        """See nothing.

        Parameters
        ----------
        functions : int
            Functions of light that would be seen.

        Returns
        -------
        Seen
            No receivers.
        """
        return cls(receivers.none(), np.zeros((len(HALVES), 0, functions, 3), np.float32))

    def plus(self, other: Seen) -> Seen:
        """These and others.

        Parameters
        ----------
        other : Seen
            More of them.

        Returns
        -------
        Seen
            These first.
        """
        at = Receivers(*(np.concatenate([getattr(part.at, name) for part in (self, other)]) for name in FIELDS))
        return Seen(at, np.concatenate([self.light, other.light], axis=1))


@dataclass(frozen=True, eq=False)
class State:
    """A cell's tree with its data.

    tree : Topology
    measured : Measured, its data points
    data : DataPoints, the same for look-up, with occluding planes
    seen : Seen, receivers all over it
    """

    tree: Topology
    measured: Measured
    data: interpolate.DataPoints
    seen: Seen


def trace(scene: Scene, at: Receivers, effort: Effort, progress: Callable[[float], bool] | None = None) -> Seen:
    """Path-trace receivers twice.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    at : Receivers
        Points on surfaces.
    effort : Effort
        Paths per receiver, shared by both halves.
    progress : callable, optional
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Seen
        Irradiance of every modelled function.

    Raises
    ------
    CancelledError
        `progress` returned False.
    """
    if not functions(scene):
        return Seen(at, np.zeros((len(HALVES), len(at.key), 0, 3), np.float32))
    halves = []
    for number, salt in enumerate(HALVES):
        half = dataclasses.replace(effort, samples=max(1, effort.samples // 2), seed=effort.seed ^ salt)
        show = progress and (lambda done, n=number: progress((n + done / len(at.key)) / len(HALVES)))
        found = reference.at(scene, at.position + scene.origin, at.normal, half, show, at.key)
        halves.append(stack(scene, found)[:, :, 0])
    return Seen(at, np.stack(halves))


def trace_closer(scene: Scene, seen: Seen, effort: Effort) -> np.ndarray:
    """Look at receivers once more, by more paths.

    Parameters
    ----------
    scene : Scene
        What light travels through.
    seen : Seen
        Receivers, as `trace` saw them.
    effort : Effort
        As they were traced.

    Returns
    -------
    (2, n, functions, 3) float32 ndarray
        Their light by all paths together.
    """
    more = dataclasses.replace(effort, samples=CLOSER * effort.samples, seed=effort.seed ^ CLOSER_SEED)
    return (seen.light + CLOSER * trace(scene, seen.at, more).light) / (1 + CLOSER)


def fitted(scene: Scene, state: State, judge: Judge, threads: int) -> np.ndarray:
    """Fit the data points of a cell to what its receivers see.

    Parameters
    ----------
    scene : Scene
        Says what is modelled; every transport has its own noise.
    state : State
        The cell.
    judge : Judge
        Errors count relative to the light of its mean view.
    threads : int
        As in `Effort`.

    Returns
    -------
    (points, functions, 9, 3) float32 ndarray
        Irradiance harmonics. Receivers whose neighbourhood reaches into other cells have no say: their data
        points are not known here.
    """
    use, system = _system(state, judge)
    if not len(use) or not state.measured.light.shape[1]:
        return state.measured.light
    light, parts = split(scene, state.measured.light), []
    for name, number in split(scene, np.arange(state.measured.light.shape[1])[None]).items():
        parts.append(_fit(system, light[name], state.seen.light[:, use][:, :, number[0]], threads))
    return np.concatenate(parts, axis=1)


def squared_errors(state: State, judge: Judge, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the squared error of what receivers see, relative to the light there.

    Parameters
    ----------
    state : State
        A cell.
    judge : Judge
        What is looked at.
    threads : int
        As in `Effort`.

    Returns
    -------
    squared : (n,) float32 ndarray
        Right on average, so that single ones may be negative.
    noise : (n,) float32 ndarray
        Squared noise of the light at the receiver, relative likewise: it says how far to trust `squared`.
    """
    use, system = _system(state, judge)
    stored = _views(np.moveaxis(state.measured.light, 1, 2), judge)
    stored, halves = np.ascontiguousarray(np.moveaxis(stored, 2, 1)), _views(state.seen.light, judge)
    if len(use):
        prior = fit.trust(system, stored, halves[:, use])
        stored = fit.fit(system, stored, halves[:, use].mean(axis=0), prior, threads)
    one, other = _received(state, stored) - halves
    squared = (one * other).sum(axis=(1, 2))
    if len(use):
        share = fit_error.leverage(system, prior)
        squared[use] = fit_error.squared_error(system, stored, halves[:, use], share).sum(axis=(1, 2))
    noise = ((halves[0] - halves[1]) ** 2).sum(axis=(1, 2)) / 4
    bright, typical = brightness(state.seen, judge)
    scale = np.maximum(bright**2 + (DARK * typical) ** 2, 1e-30)
    return squared / scale, noise / scale


def brightness(seen: Seen, judge: Judge) -> tuple[np.ndarray, float]:
    """Measure how much light there is.

    Parameters
    ----------
    seen : Seen
        Receivers.
    judge : Judge
        What is looked at.

    Returns
    -------
    bright : (n,) float32 ndarray
        Luminance of the mean view at each receiver.
    typical : float
        Its mean over the area.
    """
    bright = _looked_at(seen.light.mean(axis=0), judge.mean)
    return bright, float((bright * seen.at.area).sum() / max(float(seen.at.area.sum()), 1e-30))


def shade(state: State, light: np.ndarray, judge: Judge) -> float:
    """Fit how dark it is where receivers see none of the data points that could light them.

    Parameters
    ----------
    state : State
        A cell.
    light : (points, functions, 9, 3) float32 ndarray
        What is stored.
    judge : Judge
        Its mean view counts.

    Returns
    -------
    float
        Least-squares factor of the last resort's light, 0 to 1; 1 where no receiver needs it.
    """
    unlit = np.flatnonzero(confidence(state) < ENOUGH)
    state = dataclasses.replace(state, seen=state.seen.take(unlit))
    mixed = mean_view(light, judge)
    dark, full = (luminance(shaded(state, value), mixed) for value in (0.0, 1.0))
    wanted, given, area = brightness(state.seen, judge)[0] - dark, full - dark, state.seen.at.area
    spread = float((area * given * given).sum())
    return float(np.clip((area * wanted * given).sum() / spread, 0.0, 1.0)) if spread > 0 else 1.0


def mean_view(light: np.ndarray, judge: Judge) -> np.ndarray:
    """Mix the functions of stored values.

    Parameters
    ----------
    light : (points, functions, 9, 3) float32 ndarray
        What is stored.
    judge : Judge
        Its mean view counts.

    Returns
    -------
    (points, 1, 9, 3) float32 ndarray
        Harmonics of luminance, in the first channel.
    """
    mixed = _views(np.moveaxis(light, 1, 2), Judge(judge.mean[None], judge.mean))
    return np.ascontiguousarray(np.moveaxis(mixed, 2, 1))


def luminance(state: State, mixed: np.ndarray) -> np.ndarray:
    """Look up what receivers see.

    Parameters
    ----------
    state : State
        A cell.
    mixed : (points, 1, 9, 3) float32 ndarray
        From `mean_view`.

    Returns
    -------
    (n,) float32 ndarray
        Irradiance at each receiver.
    """
    return _received(state, mixed)[:, 0, 0]


def shaded(state: State, value: float) -> State:
    """Give a cell another shade.

    Parameters
    ----------
    state : State
        A cell.
    value : float
        Its shade, as `shade` finds it.

    Returns
    -------
    State
        The same data otherwise.
    """
    data = dataclasses.replace(state.data, shade=np.full_like(state.data.shade, value))
    return dataclasses.replace(state, data=data)


def confidence(state: State) -> np.ndarray:
    """Sum the weights of the data points that light each receiver.

    Parameters
    ----------
    state : State
        A cell.

    Returns
    -------
    (n,) float32 ndarray
        As `interpolate.weigh` gives them; below `blend.ENOUGH` coarser levels fill up.
    """
    return interpolate.weigh(state.data, state.seen.at.position, state.seen.at.normal)[1].sum(axis=1)


def _system(state: State, judge: Judge) -> tuple[np.ndarray, fit.System | None]:
    """Receivers with a say, and how they see the data points.

    They count by the inverse of the light that data points bring there: what a bright place is wrong by must not be
    made up for by a dark one beside it, nor the other way round (by its inverse square, spots beside lamps came out
    too dark). Their own light would do worse, as those that look dark by chance would count more.
    """
    at, data = state.seen.at, state.data
    row, weight = interpolate.weigh(data, at.position, at.normal)
    total, reached = weight.sum(axis=1), np.zeros(len(weight))
    for found in taps(data.grid, data.dual_cells, np.ascontiguousarray(at.position.T), data.grid.levels - 1):
        reached[found.point] += found.weight.sum(axis=0)
    use = np.flatnonzero((total > ENOUGH) & (reached > INSIDE))
    if not len(use):
        return use, None
    basis = harmonics.basis(at.normal[use].astype(np.float64))
    plain = fit.System(len(data.valid), row[use], weight[use] / total[use, None], basis, np.ones(len(use)))
    bright = fit.evaluate(plain, mean_view(state.measured.light, judge))[:, 0, 0].astype(np.float64)
    typical = float((bright * at.area[use]).sum() / at.area[use].sum())
    counts = 1 / np.maximum(np.hypot(bright, DARK * typical), 1e-30) if typical > 0 else plain.receiver
    return use, dataclasses.replace(plain, receiver=counts)


def _fit(system: fit.System, traced: np.ndarray, halves: np.ndarray, threads: int) -> np.ndarray:
    """Fit to the mean of the halves; what they differ by says how far to trust the traced values."""
    prior = fit.trust(system, traced, halves)
    return fit.fit(system, traced, halves.mean(axis=0), prior, threads)


def _received(state: State, values: np.ndarray) -> np.ndarray:
    """(n, functions, 3) what the run time shows at the receivers."""
    at, count = state.seen.at, values.shape[1]
    flat = np.ascontiguousarray(values.reshape(len(values), -1))
    mean = blend(state.data, flat, clamp(state.data, at.position), at.normal).reshape(len(at.key), count, 9, 3)
    basis = harmonics.basis(at.normal.astype(np.float64)).astype(np.float32)
    return np.maximum(np.einsum("nfkc,nk->nfc", mean, basis), 0.0)


def _views(light: np.ndarray, judge: Judge) -> np.ndarray:
    """(..., functions', 3) luminance of the views, three to a function, of (..., functions, 3) light."""
    count = -(-len(judge.views) // 3)
    out = np.zeros((*light.shape[:-2], 3 * count), np.float32)
    for number, view in enumerate(judge.views):
        out[..., number] = np.einsum("...fc,fc->...", light, (view * LUMINANCE).astype(np.float32))
    return out.reshape(*light.shape[:-2], count, 3)


def _looked_at(light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(n,) luminance of a mixture of functions, of (n, functions, 3) light."""
    return np.einsum("nfc,fc->n", light, (view * LUMINANCE).astype(np.float32))
