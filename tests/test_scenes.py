"""Real scenes by others, from the file to irradiance, through the command line.

They lie beside the repository, in `../shared/scenes`; without them these tests are skipped.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
SCENES = REPOSITORY.parent / "shared" / "scenes"
QUICK = ("living_room", "sponza")
LONG = ("small_house", "bookstore", "modern_hall", "truck_town")
POINTS = 100_000
TOPOLOGY_BYTES = 300_000
MEMORY_KB = 2_000_000
DRAFT = ("--quality", "draft", "--sky", "1.0", "--probes", "none")
"""Reflection probes would take longer than all the rest; small scenes of the other tests have them."""

pytestmark = pytest.mark.skipif(not SCENES.is_dir(), reason=f"the public scenes are not in {SCENES}")


def command(*words: str) -> dict:
    """The JSON object of a command that has to succeed."""
    run = [sys.executable, "-m", "gi_volumes", *words, "--json"]
    done = subprocess.run(run, capture_output=True, text=True, stdin=subprocess.DEVNULL, cwd=REPOSITORY, timeout=900)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def surface_points(snapshot_path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points spread over all surfaces by area, and their normals."""
    from gi_volumes.bake import snapshot_file
    from gi_volumes.bake.soup import flatten

    snapshot = snapshot_file.load(snapshot_path)
    corners = flatten(snapshot).corners.astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    rng = np.random.default_rng(0)
    row = rng.choice(len(corners), POINTS, p=area / area.sum())
    weight = rng.dirichlet((1, 1, 1), POINTS)
    return np.einsum("nc,nci->ni", weight, corners[row]) + snapshot.origin, cross[row] / area[row, None]


def bake_and_query(name: str, folder: Path) -> dict:
    """Bake a scene under a white sky, verify it, and ask it everywhere."""
    baked = folder / "bake"
    result = command("bake", str(SCENES / f"{name}.glb"), "-o", str(baked), *DRAFT)
    assert command("verify", str(baked)) == {"defects": []}
    points, normals = surface_points(baked / "scene.giv")
    for file, values in (("p.npy", points), ("n.npy", normals)):
        np.save(folder / file, values)
    where = ("--points", str(folder / "p.npy"), "--normals", str(folder / "n.npy"))
    command("query", str(baked), *where, "-o", str(folder / "e.npy"))
    found = np.load(folder / "e.npy")
    assert found.shape == (POINTS, 3)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert found.mean() > 0.01
    return result


@pytest.mark.parametrize("name", QUICK)
def test_a_public_scene_bakes_verifies_and_answers_everywhere(name, tmp_path):
    result = bake_and_query(name, tmp_path)
    assert "sky" in result["modelled"]
    assert result["bytes"]["tree"] < TOPOLOGY_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_the_other_public_scenes_do_so_too(name, tmp_path):
    assert bake_and_query(name, tmp_path)["data_points"] > 0


@pytest.mark.slow
def test_sponza_in_preview_quality_stays_under_two_gigabytes(tmp_path):
    resource = pytest.importorskip("resource", reason="memory of child processes is told on Unix only")
    command("bake", str(SCENES / "sponza.glb"), "-o", str(tmp_path / "bake"), "--sky", "1.0", "--sun", "0.2,0.3,1")
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < MEMORY_KB
