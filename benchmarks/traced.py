"""Path-traced light at points, kept on disk so that it is traced once.

Comes in: points, paths, a seed. Goes out: irradiance or its nine harmonics for each transport in W/m2, the suns and
the sky at the strength that the scene gives them.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from pathlib import Path

import numpy as np
from gi_volumes.bake import datapoints, reference, snapshot_file
from gi_volumes.bake.gather import Effort, Gathered, gather
from gi_volumes.bake.scene import Scene, prepare
from gi_volumes.bake.sensors import HarmonicsSensor
from gi_volumes.bake.settings import Settings, model, of_reference
from gi_volumes.bake.snapshot import Snapshot

VERSION = "1"
"""Of what is cached; raised when the same words would mean other numbers."""


class Traced:
    """A scene whose light is traced on demand.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    settings : Settings
        Of its bake: sky, sun, bounces.
    cache : Path, optional
        Folder for what was traced before; nothing is kept without it.
    threads : int
        As in `Effort`.

    Attributes
    ----------
    scene : Scene
        The scene, prepared.
    snapshot : Snapshot
        With the sky of the bake.
    transports : list of str
        Those that the scene has.
    """

    def __init__(self, snapshot: Snapshot, settings: Settings, cache: Path | None = None, threads: int = 0):
        self._settings, self._cache, self._threads = of_reference(settings), cache, threads
        self._digest = snapshot_file.digest(snapshot)
        self.snapshot, light = model(snapshot, self._settings)
        self.scene: Scene = prepare(self.snapshot, light)
        present = {"local": self.scene.has_local, "sun": len(light.suns.toward), "sky": light.sky_count}
        self.transports = [name for name, found in present.items() if found]

    def surface(self, points: np.ndarray, normals: np.ndarray, samples: int, seed: int) -> dict[str, np.ndarray]:
        """Irradiance on surfaces.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            World space [m].
        normals : (n, 3) float64 ndarray
            Unit vectors.
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        dict of str to (n, 3) float32 ndarray
            For each transport [W/m2].
        """
        found = self._kept(
            ("surface", samples, seed),
            (points, normals),
            lambda: self._fold(reference.at(self.scene, points, normals, self._effort(samples, seed))),
        )
        return {name: values[:, 0] for name, values in found.items()}

    def harmonics(self, position: np.ndarray, key: np.ndarray, samples: int, seed: int) -> dict[str, np.ndarray]:
        """Nine harmonics of irradiance in space.

        Parameters
        ----------
        position : (3, n) float32 ndarray
            Relative to the scene's origin [m].
        key : (n,) uint32 ndarray
            Random keys.
        samples, seed : int
            As in `Effort`.

        Returns
        -------
        dict of str to (n, 9, 3) float32 ndarray
            For each transport [W/m2].
        """

        def trace() -> dict[str, np.ndarray]:
            order = datapoints.morton_order(position)
            back = np.argsort(order)
            effort = self._effort(samples, seed)
            sorted_position = np.ascontiguousarray(position[:, order])
            found = gather(self.scene, HarmonicsSensor(), sorted_position, key[order], effort)
            return {name: values[back] for name, values in self._fold(found).items()}

        return self._kept(("harmonics", samples, seed), (position, key), trace)

    def _effort(self, samples: int, seed: int) -> Effort:
        return Effort(samples, self._settings.bounces, seed, self._threads)

    def _fold(self, found: Gathered) -> dict[str, np.ndarray]:
        """(n, responses, 3) of each transport; the suns together, at their strength."""
        out = {}
        if len(found.local):
            out["local"] = found.local
        if len(found.sun):
            strength = reference.sun_strength(self.snapshot, found.sun.shape[1])
            out["sun"] = np.einsum("nkrc,kc->nrc", found.sun, strength).astype(np.float32)
        if len(found.sky):
            out["sky"] = found.sky[:, 0]
        return out

    def _kept(self, what: tuple, arrays: tuple, trace) -> dict[str, np.ndarray]:
        """From the cache, or traced and put there."""
        if self._cache is None:
            return trace()
        settings = self._settings
        words = (VERSION, self._digest, settings.bounces, settings.sky, settings.sun, *what)
        digest = hashlib.blake2b(repr(words).encode(), digest_size=16)
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        path = self._cache / f"{self._digest[:8]}_{what[0]}_{digest.hexdigest()}.npz"
        try:
            with np.load(path) as file:
                return dict(file)
        except (OSError, ValueError, zipfile.BadZipFile):
            found = trace()
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as file:
            np.savez(file, **found)
        part.replace(path)
        return found
