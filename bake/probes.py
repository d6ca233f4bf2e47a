"""Where probes stand: the places that together see best what reflections show.

Comes in: a scene, the trees of its cells, what is asked for. Goes out: positions in the order of their use, so that any
first part of the list is the best list of that length. Nothing needs to be set: candidates, patches and worths follow
the scale of the space around them (`candidates.py`, `patches.py`, `views.py`), and the choice ends by itself where a
further probe would add little (`greedy.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .candidates import Candidates, candidates
from .gather import Effort
from .greedy import Choice, choose
from .parallel import CancelledError
from .patches import Forest, Patches, patches
from .scene import Scene
from .views import affordable, views

__all__ = ["LEAST_GAIN", "Probes", "Request", "RequestError", "place"]

LEAST_GAIN = 1 / 1000
"""Part of the best single probe's gain that the last one still adds, where nothing is asked for."""

MEGABYTE = 1e6
"""Bytes of a megabyte."""


class RequestError(ValueError):
    """What is asked for cannot be done; the message says what to change."""


@dataclass(frozen=True, eq=False)
class Request:
    """What is asked of the choice.

    count : most probes, pinned ones among them
    megabytes : most that all probes may take [MB]; None for no limit
    probe_bytes : what one takes [bytes]; needed with `megabytes`
    least_gain : stop below this part of the gain of the best single probe, 0 to 1
    pinned : (m, 3) float64 [m], probes that are there anyway, relative to the scene's origin
    deleted : (b, 2, 3) float64 [m], lowest and highest corners of boxes that get no others
    counts : callable, says which patches count, (n,) bool of `Patches`; all that see others when left out
    """

    count: int = 1000
    megabytes: float | None = None
    probe_bytes: int = 0
    least_gain: float = LEAST_GAIN
    pinned: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    deleted: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    counts: Callable[[Patches], np.ndarray] | None = None

    def limit(self) -> int:
        """Count probes that count and budget allow.

        Returns
        -------
        int
            The smaller of both.

        Raises
        ------
        RequestError
            A number, a shape or a coordinate makes no sense.
        """
        if self.count < 0 or not 0 <= self.least_gain <= 1:
            raise RequestError(f"{self.count} probes, least gain {self.least_gain}; want 0 or more, and 0 to 1")
        for name, values, shape in (("pinned", self.pinned, (3,)), ("deleted", self.deleted, (2, 3))):
            if np.shape(values)[1:] != shape or not np.isfinite(values).all():
                raise RequestError(f"{name}: want finite numbers of shape (n, {', '.join(map(str, shape))})")
        if self.megabytes is None:
            return self.count
        if not (self.megabytes >= 0 and self.probe_bytes > 0):
            raise RequestError(f"a budget of {self.megabytes} MB with {self.probe_bytes} bytes a probe")
        return math.floor(min(self.megabytes * MEGABYTE / self.probe_bytes, self.count))


@dataclass(frozen=True, eq=False)
class Probes:
    """Probes in the order of their use: pinned ones, then the best.

    position : (k, 3) float64 [m], relative to the scene's origin
    pinned : (k,) bool
    gain : (k,) float64 [m2], what each added to the weighted surface that is seen
    total : that surface, all of it [m2]; `gain.sum() / total` is the part that is seen well, below 1
    candidates : places that there were to choose from
    reason : why there are no more, in words
    """

    position: np.ndarray
    pinned: np.ndarray
    gain: np.ndarray
    total: float
    candidates: int
    reason: str


def place(
    scene: Scene,
    forest: Forest,
    request: Request,
    effort: Effort,
    progress: Callable[[float], bool] | None = None,
) -> Probes:
    """Choose places for probes.

    Parameters
    ----------
    scene : Scene
        The surfaces.
    forest : Forest
        Cells where probes are wanted, by their trees.
    request : Request
        How many, which are given, where there are to be none.
    effort : Effort
        Seed, threads.
    progress : callable, optional
        Called with the part that is done, 0 to 1; returns False to stop.

    Returns
    -------
    Probes
        Pinned ones always; others as far as candidates are free and see anything. The same for any number of threads.

    Raises
    ------
    RequestError
        The request makes no sense.
    CancelledError
        `progress` returned False.

    Notes
    -----
    Source: row 5 of the talk, with a greedy choice instead of the best by themselves, which would crowd together.
    """
    limit = request.limit()
    _show(progress, 0.0)
    seen = patches(scene, forest, effort)
    if request.counts is not None:
        seen = seen.take(np.flatnonzero(request.counts(seen)))
    _show(progress, 0.2)
    found = candidates(scene, forest, np.asarray(request.deleted, np.float64), effort)
    found = found.thinned(affordable(scene, found.position, seen, effort.threads))
    _show(progress, 0.3)
    pinned = np.asarray(request.pinned, np.float64)
    position = np.concatenate([pinned, found.position])
    seeing = views(scene, position, seen, effort.threads)
    _show(progress, 0.9)
    chosen = choose(seeing, seen.weight, limit, request.least_gain, len(pinned))
    reason = _reason(len(seen.weight), found, request, chosen)
    of_pinned = chosen.place < len(pinned)
    total = float(seen.weight.sum(dtype=np.float64))
    _show(progress, 1.0)
    return Probes(position[chosen.place], of_pinned, chosen.gain, total, len(found.position), reason)


def _show(progress: Callable[[float], bool] | None, share: float) -> None:
    """Say how far it is."""
    if progress is not None and not progress(share):
        raise CancelledError


def _reason(patch_count: int, found: Candidates, request: Request, chosen: Choice) -> str:
    """Why the choice ended."""
    limit = request.limit()
    if len(chosen.place) >= limit:
        of = "were asked for" if limit == request.count else f"{request.megabytes:g} MB have room for"
        return f"{limit} probes are as many as {of}"
    inside = f"{found.inside} of {found.looked_at} candidates see the backs of surfaces, as those inside walls do"
    if not len(found.position):
        return f"no candidate is free: {inside}" if found.looked_at else "no candidate is left: all space is deleted"
    if not patch_count:
        return f"no surface sees another one, reflections show the sky alone; {inside}"
    return "a further probe would add too little"
