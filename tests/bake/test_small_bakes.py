"""Bakes with next to nothing in them, in every way of baking: sound files and finite light."""

from __future__ import annotations

import itertools

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import job
from gi_volumes.bake.settings import Settings
from gi_volumes.bake.snapshot import Channel, Material, Snapshot
from gi_volumes.tree import folder, verify, world

ROOM = build_scenes.box((0, 0, 0), (3, 2, 2.5), inward=True)
TRIANGLE = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
SLIVER = np.array([[[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]]])
LAMP = build_scenes.lamps({"position": (1, 1, 1.5), "strength": (10, 10, 10)})
CAP, BYTES = 200, 2800


def gray(albedo: float = 0.5, **rest) -> Material:
    return Material("gray", Channel((albedo,) * 3), specular_level=0.0, **rest)


GLASS = gray(1.0, transmission=Channel((0.97,)))
NOTHING = gray(alpha=Channel((0.0,)), alpha_mode="blend")
WHITE = (1, 1, 1)
SCENES: dict[str, Snapshot] = {
    "one triangle": build_scenes.snapshot([(TRIANGLE, gray())], sky=WHITE),
    "a speck": build_scenes.snapshot([(TRIANGLE * 1e-3, gray())], sky=WHITE),
    "no receivers": build_scenes.snapshot([(SLIVER, gray())], LAMP, WHITE),
    "nothing but glass": build_scenes.snapshot([(ROOM, GLASS)], LAMP, WHITE),
    "nothing to be seen": build_scenes.snapshot([(ROOM, NOTHING)], LAMP, WHITE),
    "no light": build_scenes.snapshot([(ROOM, gray())]),
    "a lamp in a wall": build_scenes.snapshot([(ROOM[:, ::-1], gray())], LAMP),
    "black walls": build_scenes.snapshot([(ROOM, gray(0.0))], LAMP),
    "a millimetre": build_scenes.snapshot([(ROOM * 3e-4, gray(1.0, emission=Channel(WHITE)))]),
    "hundred kilometres": build_scenes.snapshot([(build_scenes.plane(5e4), gray())], sky=WHITE),
}
WAYS = {
    "default": {},
    "by geometry": {"error": 0.0},
    "as traced": {"fit": False},
    "full dilation": {"dilation": "full"},
    "few points": {"max_points": CAP},
    "few bytes": {"max_bytes": BYTES},
}
FINEST = {"a speck": 2.0**-11, "a millimetre": 2.0**-12, "hundred kilometres": 8192.0}
DARK = ("no light", "a lamp in a wall", "black walls")
OPEN = ("one triangle", "a speck", "no receivers", "nothing to be seen", "hundred kilometres")


EVERY_WAY = ("one triangle", "nothing to be seen", "no light")
CASES = [(scene, way) for scene, way in itertools.product(SCENES, WAYS) if way == "default" or scene in EVERY_WAY]


@pytest.mark.parametrize(("scene", "way"), CASES)
def test_next_to_nothing_bakes_in_every_way(scene, way, tmp_path):
    settings = Settings(samples=4, bounces=2, finest=FINEST.get(scene, 1.0), **WAYS[way])
    outcome = job.bake(SCENES[scene], tmp_path, settings)
    assert verify.verify(tmp_path) == []
    assert bool(outcome.modelled) == (scene != "no light")
    baked = world.load(tmp_path)
    rng = np.random.default_rng(1)
    points, normals = rng.normal(size=(300, 3)) * 3, rng.normal(size=(300, 3))
    points[:, 2] = np.abs(points[:, 2])
    normals[:, 2] = np.abs(normals[:, 2])
    found = baked.irradiance(points, normals)
    assert np.isfinite(found).all()
    assert (not found.any()) == (scene in DARK)
    if scene in OPEN:
        assert found.mean() == pytest.approx(np.pi, rel=0.25)
    for cell in map(tuple, baked.cells):
        assert folder.read_cell(tmp_path, cell).topology.size <= settings.max_points
        size = sum(path.stat().st_size for path in tmp_path.glob(f"cell_{cell[0]}_{cell[1]}.*"))
        assert way != "few bytes" or size <= BYTES
