"""Cycles agrees with our reference, transport by transport, on the demo and on scenes of other people."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Cycles comes with the bpy wheel")

from gi_volumes.benchmarks.cycles_agreement import Plan, agreement, compare, open_scene  # noqa: E402
from gi_volumes.demo import courtyard  # noqa: E402

pytestmark = pytest.mark.slow

MOST = 0.01
"""Relative difference of the means that is allowed beyond noise."""

SIGMAS = 3.0
NOISE = 0.006
"""Most standard error of a comparison that can tell `MOST` from nothing."""

UNIFORM = Plan(points=400, samples=256, paths=512)
BRIGHT = Plan(points=600, samples=512, paths=1024, bright=True)
"""Local light is in few places, and noisy."""

SCENES = {
    "courtyard": {"sky": UNIFORM, "sun": UNIFORM, "local": BRIGHT},
    "living_room": {"sky": UNIFORM, "sun": UNIFORM, "local": dataclasses.replace(BRIGHT, paths=2048)},
    "modern_hall": {"sky": UNIFORM, "sun": BRIGHT, "local": UNIFORM},
    "sponza": {"sky": UNIFORM, "sun": BRIGHT},
}
CASES = [(scene, transport) for scene, plans in SCENES.items() for transport in plans]


def open_or_skip(name: str, repository) -> None:
    """Open a scene, built or read."""
    if name == "courtyard":
        courtyard.build()
        return
    path = repository.parent / "shared" / "scenes" / f"{name}.glb"
    if not path.is_file():
        pytest.skip(f"SKIPPED: the scene {path.name} is not on this machine, so Cycles judges nothing there")
    open_scene(path)


@pytest.mark.parametrize(("scene", "transport"), CASES)
def test_cycles_and_the_reference_agree_and_a_planted_three_percent_is_noticed(scene, transport, repository):
    open_or_skip(scene, repository)
    (found,) = compare(SCENES[scene][transport], [transport])
    result = agreement(found.ours, found.judge)
    assert result.mean > 0
    assert result.error < NOISE, result
    assert abs(result.difference) < SIGMAS * result.error, result
    assert abs(result.channel_z) < SIGMAS + 1, result
    assert result.correlation > 0.98, result
    # Where the means agree by luck the points still scatter by no more than noise.
    assert result.rmse < 1.25 * result.noise + MOST, result
    planted = agreement(1.03 * found.ours, found.judge)
    assert abs(planted.difference) > SIGMAS * planted.error, planted


def test_red_taken_for_every_channel_is_noticed_where_surfaces_have_colours(repository):
    open_or_skip("courtyard", repository)
    (found,) = compare(UNIFORM, ["sky"])
    grey = np.repeat(found.ours[..., :1], 3, axis=2)
    assert abs(agreement(grey, found.judge).channel_z) > SIGMAS + 1
