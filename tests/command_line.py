"""The command line, called in this process, and small scenes to call it on."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import build_scenes
import numpy as np
from gi_volumes.bake import cli, snapshot_file
from gi_volumes.bake.snapshot import Camera, LightKind, Material, Snapshot
from gi_volumes.tree import container

QUICK = ("--samples", "2", "--finest", "2", "--threads", "1")
"""Options of a bake that is looked at, not measured."""

SUN = (0.3, 0.4, 0.8)


@dataclass(frozen=True)
class Said:
    """What a command said, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def object(self) -> dict:
        """The one JSON object on standard output."""
        assert self.out.count("\n") == 1
        return json.loads(self.out)

    @property
    def reason(self) -> str:
        """The one line that says why the command failed."""
        lines = [line for line in self.err.splitlines() if line.startswith("error: ")]
        assert self.code == 1, self
        assert len(lines) == 1
        assert self.err.endswith(lines[0] + "\n")
        return lines[0].removeprefix("error: ")


def refuse(scene: Path, snapshot: Path) -> None:
    """Stand in for the reader of Blender files where none may be needed."""
    raise AssertionError(f"{scene} was given to Blender")


def call(*words: object, extract=refuse) -> Said:
    """Run a command; a warning counts as a crash."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            code = cli.main([str(word) for word in words], extract)
        except SystemExit as end:
            code = end.code
    return Said(code, out.getvalue(), err.getvalue())


def succeed(*words: object) -> dict:
    """Run a command that has to work, for its JSON object."""
    said = call(*words, "--json")
    assert said.code == 0, said.err
    return said.object


def yard(cells: int = 1, lamp: bool = True, sun: bool = True, sky=(0.2, 0.3, 0.5), place=(0.0, 0.0, 0.0)) -> Snapshot:
    """A square of ground with a block on it, once in each of a row of world cells, 6 m from their borders: too
    far to need the next cells."""
    white = Material("white")
    parts = []
    for number in range(cells):
        corner = np.array([128.0 * number + 4, 4, 0])
        parts.append((build_scenes.plane(6.0) + corner + (8, 8, 0), white))
        parts.append((build_scenes.box((6, 6, 0), (8, 8, 2)) + corner, white))
    rows = []
    if lamp:
        rows.append({"position": np.array([13, 13, 3.0]) + place, "strength": (10, 9, 8), "size": (0.1, 0)})
    if sun:
        frame = build_scenes.sun_frame(SUN)
        rows.append({"kind": LightKind.SUN, "frame": frame, "strength": (5, 5, 4), "size": (0.01, 0)})
    made = build_scenes.snapshot(parts, build_scenes.lamps(*rows), sky, place)
    eye = np.concatenate([np.eye(3), np.array([[12.0], [12.0], [20.0]]) + np.reshape(place, (3, 1))], axis=1)
    return dataclasses.replace(made, cameras=(Camera("above", tuple(eye.ravel().tolist()), 0.5),))


def stored(folder: Path, snapshot: Snapshot, name: str = "level.giv") -> Path:
    """A snapshot as a file."""
    snapshot_file.save(snapshot, folder / name)
    return folder / name


def stored_unchecked(folder: Path, snapshot: Snapshot, name: str = "level.giv") -> Path:
    """A snapshot as a file that `save` would have refused."""
    arrays, meta = snapshot_file._to_container(snapshot)
    container.write(folder / name, snapshot_file.KIND, arrays, meta)
    return folder / name


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, and of the folders in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def cells_only(folder: Path) -> dict[str, bytes]:
    """The files of the cells."""
    return {name: data for name, data in content(folder).items() if name.startswith("cell_")}


def ground_points(count: int = 40, place=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Points on the yard's ground that are not under its block, and their normals."""
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(7, 17, (4 * count, 2)), np.zeros((4 * count, 1))], axis=1)
    outside = (np.abs(points[:, :2] - 11) > 1.2).any(axis=1)
    points = points[outside][:count]
    return points + place, np.tile([0.0, 0.0, 1.0], (len(points), 1))


class Points:
    """Point files in a folder, and what a command finds at them."""

    def __init__(self, folder: Path, points: np.ndarray, normals: np.ndarray) -> None:
        self.folder = folder
        np.save(folder / "points.npy", points)
        np.save(folder / "normals.npy", normals)

    @property
    def words(self) -> tuple[object, ...]:
        """The options that name the files."""
        place = self.folder
        return "--points", place / "points.npy", "--normals", place / "normals.npy", "-o", place / "found.npy"

    def ask(self, command: str, source: Path, *words: object) -> np.ndarray:
        """Irradiance from `query` or `reference`."""
        assert succeed(command, source, *self.words, *words)["output"] == str(self.folder / "found.npy")
        return np.load(self.folder / "found.npy")
