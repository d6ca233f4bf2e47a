"""The same light, bit for bit, however the work is split; other noise for another seed."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import build_scenes
import numpy as np
import pytest
from command_line import cells_only
from gi_volumes.bake import gather as gathering
from gi_volumes.bake import job, parallel
from gi_volumes.bake.gather import Effort, gather
from gi_volumes.bake.parallel import CancelledError
from gi_volumes.bake.scene import Model, Scene, SunDirections, prepare
from gi_volumes.bake.sensors import HarmonicsSensor, SurfaceSensor
from gi_volumes.bake.settings import Settings
from gi_volumes.bake.snapshot import Channel, Image, LightKind, Material, Texture
from gi_volumes.tree import folder
from statistics_checks import standard_error

POINTS = 45
TRANSPORTS = ("local", "sun", "sky")


def lights():
    """More lamps than are all weighed, of every shape."""
    rng = np.random.default_rng(1)
    rows = []
    for k in range(11):
        kind = list(LightKind)[k % 4]
        size = (0.1, 0) if kind <= LightKind.SPOT else (0.5, 0.3)
        spot = (0.4, 0.5) if kind == LightKind.SPOT else (-1, 0)
        place = {"position": (*rng.uniform(-3, 3, 2), rng.uniform(2, 4)), "strength": rng.uniform(0.1, 3, 3)}
        rows.append({**place, "kind": kind, "size": size, "spot": spot, "reflector": k % 3 == 0, "shadow": k != 4})
    return build_scenes.lamps(*rows)


def courtyard(sky: str) -> Scene:
    """Everything that paths can meet."""
    rng = np.random.default_rng(2)
    uneven = rng.uniform(0.1, 0.5, (16, 32, 3)).astype(np.float32)
    uneven[12, 5] = 90
    image = Image("leaf", rng.integers(0, 256, (8, 8, 4), dtype=np.uint8))
    parts = [
        (build_scenes.plane(6.0), Material("ground", Channel((0.7, 0.6, 0.5), Texture(0)))),
        (build_scenes.box((1, -1, 0), (2, 2, 1.5)), Material("block", Channel((0.5, 0.6, 0.9)))),
        (build_scenes.plane(1.0, 2.0), Material("leaf", alpha=Channel((1.0,), Texture(0, "a")), alpha_mode="blend")),
        (build_scenes.plane(0.5, 3.0), Material("glass", Channel((0.9, 0.8, 0.7)), transmission=Channel((0.9,)))),
        (build_scenes.box((-3, -1, 1), (-2.9, 1, 2)), Material("panel", emission=Channel((2.0, 3.0, 1.0), Texture(0)))),
    ]
    uvs = rng.uniform(-1, 2, (sum(len(triangles) for triangles, _ in parts), 3, 2))
    snapshot = build_scenes.snapshot(parts, lights(), uneven, uvs=uvs, images=(image,))
    toward = np.array([[0.6, 0, 0.8], [0, 0, 1]], np.float32)
    return prepare(snapshot, Model(suns=SunDirections(toward, np.array([0.05, 0.0], np.float32)), sky=sky))


def points(sensor: str) -> tuple[np.ndarray, np.ndarray, object]:
    """(positions, keys, sensor)."""
    rng = np.random.default_rng(3)
    position = rng.uniform((-4, -4, 0.1), (4, 4, 3), (POINTS, 3)).T.astype(np.float32)
    normal = rng.normal(size=(3, POINTS)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=0)
    made = HarmonicsSensor() if sensor == "data points" else SurfaceSensor(normal)
    return np.ascontiguousarray(position), rng.integers(0, 1 << 32, POINTS, dtype=np.uint32), made


def some_of(sensor, rows: np.ndarray):
    return (
        sensor if isinstance(sensor, HarmonicsSensor) else SurfaceSensor(np.ascontiguousarray(sensor._normal[:, rows]))
    )


def equal(one, two, rows=slice(None)) -> bool:
    """Bit for bit."""
    return all(np.array_equal(getattr(one, name)[rows], getattr(two, name)) for name in TRANSPORTS)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {sky: courtyard(sky) for sky in ("fixed", "harmonics")}


CASES = list(itertools.product(("fixed", "harmonics"), ("data points", "surface points")))


@pytest.mark.parametrize(("sky", "sensor"), CASES)
def test_the_number_of_threads_changes_no_bit(sky, sensor, scenes, monkeypatch):
    monkeypatch.setattr(parallel, "LANES", 640)
    position, key, made = points(sensor)
    found = [gather(scenes[sky], made, position, key, Effort(80, 4, 5, threads)) for threads in (1, 2, 3)]
    assert equal(found[0], found[1])
    assert equal(found[0], found[2])
    for name in TRANSPORTS:
        assert getattr(found[0], name).any()


@pytest.mark.parametrize(("sky", "sensor"), CASES)
def test_the_size_of_tiles_changes_no_bit(sky, sensor, scenes, monkeypatch):
    position, key, made = points(sensor)
    whole = gather(scenes[sky], made, position, key, Effort(61, 4, 5, 1))
    for lanes in (1, 183, 500, 1000, 2700):
        monkeypatch.setattr(parallel, "LANES", lanes)
        assert equal(whole, gather(scenes[sky], made, position, key, Effort(61, 4, 5, 1))), lanes


@pytest.mark.parametrize(("sky", "sensor"), CASES)
def test_a_point_s_light_does_not_depend_on_the_other_points_or_their_order(sky, sensor, scenes):
    position, key, made = points(sensor)
    whole = gather(scenes[sky], made, position, key, Effort(64, 4, 5, 1))
    rng = np.random.default_rng(4)
    for rows in (rng.permutation(POINTS), rng.permutation(POINTS)[:7], np.array([13]), np.arange(1, POINTS)):
        part = gather(
            scenes[sky], some_of(made, rows), np.ascontiguousarray(position[:, rows]), key[rows], Effort(64, 4, 5, 1)
        )
        assert equal(whole, part, rows)


@pytest.mark.parametrize("samples", [1, 3, 1024, 1025, 2050])
def test_any_number_of_samples_gives_the_same_bits_alone_and_among_others(samples, scenes):
    position, key, made = points("data points")
    few = slice(0, 5)
    whole = gather(scenes["fixed"], made, np.ascontiguousarray(position[:, few]), key[few], Effort(samples, 3, 1, 2))
    one = gather(scenes["fixed"], made, np.ascontiguousarray(position[:, 2:3]), key[2:3], Effort(samples, 3, 1, 1))
    assert equal(whole, one, slice(2, 3))


def test_preparing_the_scene_again_changes_no_bit(scenes):
    position, key, made = points("data points")
    one = gather(scenes["fixed"], made, position, key, Effort(32, 3, 1, 1))
    assert equal(one, gather(courtyard("fixed"), made, position, key, Effort(32, 3, 1, 1)))


def test_other_seeds_and_other_keys_give_other_noise_about_the_same_mean_and_a_shift_is_caught(scenes):
    position, key, made = points("surface points")
    seeds = (0, 1, 2, -1, 7_000_000_000, 2**31, 99, 100)
    found = [gather(scenes["fixed"], made, position, key, Effort(256, 4, seed, 1)) for seed in seeds]
    for one, two in itertools.combinations(found, 2):
        for name in TRANSPORTS:
            a, b = getattr(one, name), getattr(two, name)
            assert (a != b)[b > 0].mean() > 0.9, name
    other_keys = gather(scenes["fixed"], made, position, key + np.uint32(1), Effort(256, 4, 0, 1))
    assert not np.array_equal(other_keys.local, found[0].local)
    for name in TRANSPORTS:
        pooled = np.stack([getattr(f, name).astype(float).mean() for f in found])
        error = 4 * standard_error(pooled)
        more = gather(scenes["fixed"], made, position, key, Effort(1024, 4, 1234, 1))
        mean = getattr(more, name).astype(float).mean()
        assert abs(pooled.mean() - mean) < 1.5 * error, name
        assert error < 0.05 * mean
        assert abs(1.1 * pooled.mean() - mean) > 1.5 * error, name


def test_progress_counts_every_point_once_and_saying_no_stops_the_work(scenes, monkeypatch):
    monkeypatch.setattr(parallel, "LANES", 320)
    position, key, made = points("data points")
    counts = []

    def listen(done: int) -> bool:
        counts.append(done)
        return True

    gather(scenes["fixed"], made, position, key, Effort(64, 1, 0, 2), listen)
    assert counts == sorted(counts)
    assert counts[-1] == POINTS
    with pytest.raises(CancelledError):
        gather(scenes["fixed"], made, position, key, Effort(64, 1, 0, 2), lambda done: False)


def test_an_error_in_a_thread_reaches_the_caller(scenes):
    class Broken(HarmonicsSensor):
        def response(self, rows, direction):
            raise RuntimeError("planted")

    position, key, _ = points("data points")
    with pytest.raises(RuntimeError, match="planted"):
        gather(scenes["fixed"], Broken(), position, key, Effort(8, 1, 0, 2))


def test_no_points_give_no_rows(scenes):
    found = gather(
        scenes["fixed"], HarmonicsSensor(), np.zeros((3, 0), np.float32), np.zeros(0, np.uint32), Effort(8, 1)
    )
    assert found.local.shape == (0, 9, 3)
    assert found.sun.shape == (0, 2, 9, 3)
    assert found.sky.shape == (0, 1, 9, 3)


MANY_CHANNELS = """
import hashlib
import numpy as np
from gi_volumes.bake import gather as gathering
from gi_volumes.bake import job
weights, values = np.random.default_rng(0).random((9, 4096), np.float32), None
for responses, channels in ((9, 78), (9, 9), (1, 78), (1, 222), (9, 222)):
    values = np.random.default_rng(1).random((channels, 4096), np.float32)
    sums, _ = gathering._project(weights[:responses], values, 4, gathering._ends(1024, False))
    print(hashlib.sha256(sums.tobytes()).hexdigest())
"""


def test_the_threads_of_the_matrix_library_change_no_bit_of_the_sums():
    outputs = []
    for threads in ("1", "2", "4"):
        names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads)}
        run = subprocess.run([sys.executable, "-c", MANY_CHANNELS], capture_output=True, text=True, env=environment)
        assert run.returncode == 0, run.stderr
        outputs.append(run.stdout)
    assert outputs[0] == outputs[1] == outputs[2]


@pytest.mark.parametrize("watched", [False, True])
def test_sums_over_samples_are_the_exact_sums_to_single_precision(watched):
    rng = np.random.default_rng(5)
    weights, values = rng.normal(size=(9, 3 * 700)), rng.normal(size=(6, 3 * 700))
    ends = gathering._ends(700, watched)
    found, parts = gathering._project(weights.astype(np.float32), values.astype(np.float32), 3, ends)
    assert ends[0] == 0
    assert ends[-1] == 700
    assert np.ptp(np.diff(ends)) <= 1
    assert np.allclose(parts.sum(axis=0), found[:, 0], atol=1e-9)
    truth = np.einsum("rps,cps->prc", weights.reshape(9, 3, 700), values.reshape(6, 3, 700))
    assert np.abs(found - truth).max() < 700 * 2.0**-23


HOUSE = Settings(samples=8, bounces=2, finest=0.5)
CELLS = [(-1, -1), (-1, 0), (0, -1), (0, 0)]


def house():
    """Two rooms, one of them lit, where four world cells meet."""
    parts = [
        (build_scenes.plane(7.0), Material("ground", Channel((0.5, 0.4, 0.3)))),
        (build_scenes.box((-3, -2.5, 0), (4, 3, 2.6)), Material("wall")),
        (build_scenes.box((-2.8, -2.3, 0.1), (0.7, 2.8, 2.5), inward=True), Material("room")),
        (build_scenes.box((0.9, -2.3, 0.1), (3.8, 2.8, 2.5), inward=True), Material("other room")),
    ]
    lamps = build_scenes.lamps(
        {"position": (-1, 0.5, 2.0), "strength": (30, 20, 10)},
        {"position": (0.6, 0.5, 2.45), "strength": (6, 6, 9)},  # in a corner, where it lights a spot
        {"kind": LightKind.SUN, "frame": build_scenes.sun_frame((0.3, 0.4, 0.8)), "strength": (3, 3, 3)},
    )
    return build_scenes.snapshot(parts, lamps, (0.5, 0.7, 1))


@pytest.fixture(scope="module")
def house_baked(tmp_path_factory):
    target = tmp_path_factory.mktemp("house")
    job.bake(house(), target, HOUSE, manner=job.Manner(1))
    return target


def test_a_lamp_of_the_house_lights_a_spot():
    assert prepare(house(), Model()).lit_spots.count == 1


def test_the_house_is_subdivided_fitted_and_has_planes_on_both_sides_of_its_borders(house_baked, tmp_path):
    found = [folder.read_cell(house_baked, cell) for cell in CELLS]
    assert len(folder.load_header(house_baked)["cells"]) == len(CELLS)
    for cell in found:
        level = cell.topology.voxels()[0]
        assert level.max() == 2
        assert (cell.planes.planes >= 0).any()
    job.bake(house(), tmp_path, Settings(**{**vars(HOUSE), "fit": False}), manner=job.Manner(1))
    other = folder.read_cell(tmp_path, (0, 0))
    assert np.array_equal(other.topology.nodes, found[-1].topology.nodes)
    for name in TRANSPORTS:
        assert not np.array_equal(other.payloads[name].values(), found[-1].payloads[name].values())


def test_threads_order_and_split_of_a_whole_bake_change_no_byte(house_baked, tmp_path):
    for part in ([CELLS[3]], CELLS[1:3], [CELLS[0]]):
        job.bake(house(), tmp_path, HOUSE, part, job.Manner(2))
    assert cells_only(tmp_path) == cells_only(house_baked)
