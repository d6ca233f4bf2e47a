"""What a bake says of itself: its summary, and the head of `world.json`.

Comes in: a scene, settings, what was found while baking. Goes out: the command line's JSON object, and a dictionary.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from ..tree.grid import Grid
from ..tree.suns import SunKeys
from . import snapshot_file
from .check import Check
from .reference import sun_strength
from .scene import Model, Scene, scene_suns
from .settings import Settings, has_free_sun
from .snapshot import Snapshot

UNKNOWN = 1e9
"""Stands for what is not a number, which JSON does not have."""


@dataclass
class Outcome:
    """What a bake did, as the command line's JSON object."""

    folder: str = ""
    triangles: int = 0
    cells: int = 0
    data_points: int = 0
    dilated: int = 0
    kept: int = 0
    bytes: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    rays: int = 0
    voxels: dict[str, float] = field(default_factory=dict)
    modelled: list[str] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    checked: list[dict] = field(default_factory=list)
    probes: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def header(snapshot: Snapshot, settings: Settings, scene: Scene, grid: Grid, identity: str) -> dict:
    """Write the head of `world.json`.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    settings : Settings
        How it is baked.
    scene : Scene
        The same scene, prepared.
    grid : Grid
        The lattice.
    identity : str
        Hash of the bake.

    Returns
    -------
    dict
        All but the cells, as `folder.assemble` takes it.
    """
    light, transports = scene.model, {}
    if scene.has_local:
        transports["local"] = {"unit": "W/m2"}
    if len(light.suns.toward):
        transports["sun"] = _sun_header(snapshot, settings, light)
    if light.sky != "none":
        transports["sky"] = {"kind": light.sky, "unit": "W/m2"}
    if light.sky == "harmonics":
        transports["sky"] |= {"unit": "sr", "radiance": scene.sky.harmonics().tolist()}
    return {
        "bake": identity,
        "snapshot": snapshot_file.digest(snapshot),
        "source": snapshot.source,
        "settings": dataclasses.asdict(settings),
        "grid": grid,
        "transports": transports,
    }


def _sun_header(snapshot: Snapshot, settings: Settings, light: Model) -> dict:
    """Key directions, and the suns that shine when nobody says otherwise: the scene's, or the one asked for."""
    shining = (scene_suns(snapshot) if has_free_sun(settings.sun) else light.suns).toward
    strength = sun_strength(snapshot, len(shining))
    free = has_free_sun(settings.sun)
    return {
        "unit": "1, irradiance per W/m2 of sun on a surface facing it",
        "directions": light.suns.toward.tolist(),
        "diameters": light.suns.diameter.tolist(),
        "free": free,
        "triangles": SunKeys(light.suns.toward).triangles.tolist() if free else [],
        "scene": [
            {"direction": direction.tolist(), "irradiance": irradiance.tolist()}
            for direction, irradiance in zip(shining, strength, strict=True)
        ],
    }


def describe(snapshot: Snapshot, settings: Settings, scene: Scene, trees: list, no_probes: str) -> Outcome:
    """Count, and say what was modelled and what was left out and why.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    settings : Settings
        How it was baked.
    scene : Scene
        The same scene, prepared.
    trees : list
        Of each cell `size`, `dilated` and `left_out`.
    no_probes : str
        Why there are no reflection probes; empty where there are.

    Returns
    -------
    Outcome
        Without what is known of files, times and light.
    """
    light = scene.model
    outcome = Outcome("", len(scene.soup.corners), len(trees), sum(tree.size for tree in trees))
    outcome.dilated = sum(tree.dilated for tree in trees)
    parts = {
        "local": (scene.has_local, "the scene has no lamps and no emissive surfaces"),
        "sun": (len(light.suns.toward) > 0, "there is no sun, or none was asked for"),
        "sky": (light.sky != "none", "the sky is black"),
        "probes": (not no_probes, no_probes),
    }
    for name, (present, why) in parts.items():
        if present:
            outcome.modelled.append(name)
        else:
            outcome.left_out.append({"what": name, "why": why})
    if not outcome.modelled:
        remedy = "--sky 1.0 gives it a sky, --sun x,y,z a sun"
        outcome.warnings.append(
            f"the scene has no light to bake: no lamps, no emissive surfaces, no sun, no sky; {remedy}"
        )
    skipped = sum(tree.left_out for tree in trees)
    if skipped:
        limit = f"{settings.max_points:,} data points" + f" and {settings.max_bytes:,} bytes" * bool(settings.max_bytes)
        why = f"a world cell may hold {limit}; the neediest voxels were refined"
        outcome.left_out.append({"what": f"{skipped} voxels", "why": why})
    outcome.left_out += [{"what": note.what, "why": note.why} for note in snapshot.notes]
    return outcome


def dark(transports: list[str], arriving: list[set[str]]) -> list[str]:
    """Warn of what is modelled, and yet arrives nowhere.

    Parameters
    ----------
    transports : list of str
        What is modelled.
    arriving : list of set of str
        Of each cell, the transports with any light at its data points.

    Returns
    -------
    list of str
        One sentence each.
    """
    hint = {"local": "; are all lamps inside closed meshes?"}
    missing = [name for name in transports if name not in set().union(*arriving)]
    return [f"{name}: no light arrives at any data point{hint.get(name, '')}" for name in missing]


def checked(made: Check, transports: list[str]) -> list[dict]:
    """Say what the caches of all cells were found to be off by, and the noise of data points.

    Parameters
    ----------
    made : Check
        Of all cells.
    transports : list of str
        Its views.

    Returns
    -------
    list of dict
        For each transport, ready for JSON; nothing where nothing was checked.
    """
    if len(made.paths) < 2:
        return []
    (bias, error), noise = made.bias(), made.noise()
    parts = {"bias": bias, "bias_error": error, "noise": noise}
    figures = (
        {key: round(float(np.nan_to_num(part[number], nan=UNKNOWN, posinf=UNKNOWN)), 5) for key, part in parts.items()}
        for number in range(len(bias))
    )
    return [{"what": name, "places": len(made.paths)} | row for name, row in zip(transports, figures, strict=True)]


def file_sizes(cells: list[dict]) -> dict[str, int]:
    """Sum bytes on disk.

    Parameters
    ----------
    cells : list of dict
        Entries of `world.json`.

    Returns
    -------
    dict of str to int
        Bytes by kind.
    """
    sizes = dict.fromkeys(("tree", "local", "sun", "sky", "points", "probes"), 0)
    for entry in cells:
        for name, file in entry["files"].items():
            sizes[name] += int(file["bytes"])
    return sizes
