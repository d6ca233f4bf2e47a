"""The command line: `bake`, `info`, `verify`, `query`, `reference`, `compare`.

Comes in: words. Goes out: files, one JSON object on standard output when asked, text on standard error, and an
exit code: 0 done, 1 failed with a one-line reason, 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..tree import container, verify, world
from ..tree.atomic import write_bytes_atomically
from . import job, reference, snapshot_file
from .progress import Progress
from .settings import QUALITIES, Settings, SettingsError, numbers
from .snapshot import Snapshot, SnapshotError

EXPECTED = (SnapshotError, SettingsError, container.FileError, OSError, ValueError, MemoryError)
"""Errors that are the input's fault: one line, no traceback."""

Extract = Callable[[Path, Path], None]


def main(argv: list[str], extract: Extract) -> int:
    """Run one command.

    Parameters
    ----------
    argv : list of str
        The arguments after the program's name.
    extract : callable
        `extract(scene, snapshot)` reads a scene file into a snapshot file.

    Returns
    -------
    int
        0 done, 1 failed with a one-line reason. Wrong usage exits with 2 by itself.

    Raises
    ------
    KeyboardInterrupt
        The user stopped it.
    """
    options = _parser().parse_args(argv)
    progress = Progress(getattr(options, "progress", "text") == "json")
    try:
        result = options.run(options, extract, progress)
    except EXPECTED as error:
        progress.fail(one_line(error))
        return 1
    progress.finish(result)
    if options.json:
        print(json.dumps(result))
    elif options.show is not None and getattr(options, "progress", "text") != "json":
        print(options.show(result))
    return 1 if result.get("defects") else 0


def one_line(error: BaseException) -> str:
    """Say an error in one line.

    Parameters
    ----------
    error : BaseException
        What was raised.

    Returns
    -------
    str
        Its message without line breaks.
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}"
    if isinstance(error, MemoryError):
        return "out of memory; use fewer samples or threads, or coarser voxels (--finest)"
    return " ".join(str(error).split()) or type(error).__name__


def _parser() -> argparse.ArgumentParser:
    """Every command with its options."""
    parser = argparse.ArgumentParser(prog="gi_volumes", description="Bakes global-illumination volumes.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_bake(commands)
    _add_folder_command(commands, "info", "what is in a bake", _run_info, _show_info)
    _add_folder_command(
        commands, "verify", "check every file, checksum and invariant of a bake", _run_verify, _show_verify
    )
    _add_query(commands)
    _add_reference(commands)
    _add_compare(commands)
    return parser


def _add_command(commands, name: str, text: str, run, show) -> argparse.ArgumentParser:
    """A command with what all commands share."""
    command = commands.add_parser(name, help=text, description=text)
    command.add_argument("--json", action="store_true", help="print one JSON object on standard output")
    command.set_defaults(run=run, show=show)
    return command


def _add_folder_command(commands, name: str, text: str, run, show) -> None:
    """A command that only looks at a bake."""
    _add_command(commands, name, text, run, show).add_argument("folder", type=Path, metavar="DIR")


def _add_light(command: argparse.ArgumentParser) -> None:
    """Options that say what light to model."""
    command.add_argument(
        "--sky", default="scene", help="scene, harmonics, or the radiance of a uniform sky: 1.0 or r,g,b"
    )
    command.add_argument("--sun", default="scene", help="scene, none, hemisphere, arc:FILE, or x,y,z towards the sun")
    command.add_argument("--bounces", type=_natural, help="reflections that light may undergo")
    command.add_argument("--threads", type=_natural, default=0, help="worker threads; 0, the default, uses every core")
    command.add_argument("--seed", type=_natural, default=0, help="another seed gives independent noise")
    command.add_argument(
        "--progress", choices=("text", "json"), default="text", help="json writes lines to standard output"
    )


def _add_bake(commands) -> None:
    command = _add_command(commands, "bake", "bake a scene into a folder", _run_bake, _show_bake)
    command.add_argument("scene", type=Path, metavar="SCENE", help=".blend, .glb, .gltf, or a snapshot (.giv)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    command.add_argument("--quality", choices=tuple(QUALITIES), default="preview")
    command.add_argument("--samples", type=_positive, help="paths per data point, instead of the quality's")
    command.add_argument("--finest", type=float, default=0.0, help="size of the finest voxels in metres")
    command.add_argument("--cells", type=_cells, help="only these world cells: 0,1/3,2")
    _add_light(command)


def _add_query(commands) -> None:
    command = _add_command(commands, "query", "irradiance from a bake", _run_query, None)
    command.add_argument("folder", type=Path, metavar="DIR")
    _add_points(command)
    command.add_argument("--sun", help="x,y,z towards the sun, instead of the scene's")


def _add_reference(commands) -> None:
    command = _add_command(commands, "reference", "path-traced irradiance at points", _run_reference, None)
    command.add_argument("scene", type=Path, metavar="SCENE")
    _add_points(command)
    command.add_argument("--samples", type=_positive, default=1024, help="paths per point")
    _add_light(command)


def _add_compare(commands) -> None:
    text = "a picture of the baked irradiance beside the path-traced one and their difference"
    command = _add_command(commands, "compare", text, _run_compare, _show_compare)
    command.add_argument("folder", type=Path, metavar="DIR")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="IMAGE", help=".png or .exr")
    command.add_argument("--camera", help="its name; the scene's active camera without it")
    command.add_argument("--size", type=_size, default=(480, 270), metavar="WxH", help="of each of the three pictures")
    command.add_argument("--samples", type=_positive, default=256, help="paths per pixel of the reference")
    command.add_argument("--transport", choices=("local", "sun", "sky", "all"), default="all")
    command.add_argument("--threads", type=_natural, default=0)
    command.add_argument("--progress", choices=("text", "json"), default="text")


def _add_points(command: argparse.ArgumentParser) -> None:
    """Where to measure, and where to write it."""
    command.add_argument("--points", type=Path, required=True, metavar="P.npy", help="(n, 3) points in metres")
    command.add_argument("--normals", type=Path, required=True, metavar="N.npy", help="(n, 3) unit normals")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="E.npy")
    command.add_argument("--transport", choices=("local", "sun", "sky", "all"), default="all")


def _run_bake(options, extract: Extract, progress: Progress) -> dict:
    samples, bounces = QUALITIES[options.quality]
    settings = _settings(options, options.samples or samples, bounces, options.finest)
    snapshot = _read_scene(options.scene, extract, progress)
    outcome = job.bake(snapshot, options.output, settings, options.cells, options.threads, progress)
    return dataclasses.asdict(outcome)


def _settings(options, samples: int, bounces: int, finest: float = 0.0) -> Settings:
    """Settings from the words of the command line."""
    bounces = bounces if options.bounces is None else options.bounces
    return Settings(samples, bounces, options.sky, options.sun, finest, options.seed)


def _read_scene(path: Path, extract: Extract, progress: Progress) -> Snapshot:
    """A snapshot from a snapshot file, or by way of one."""
    if not path.exists():
        raise SnapshotError(f"{path}: there is no such file")
    if path.suffix.lower() == ".giv":
        return snapshot_file.load(path)
    if path.suffix.lower() not in (".blend", ".glb", ".gltf"):
        raise SnapshotError(f"{path}: unknown kind of scene; use .blend, .glb, .gltf or a snapshot (.giv)")
    progress.stage("Reading the scene")
    with tempfile.TemporaryDirectory(prefix="gi_volumes_") as scratch:
        snapshot = Path(scratch) / job.SNAPSHOT_NAME
        extract(path, snapshot)
        return snapshot_file.load(snapshot)


def _run_info(options, extract: Extract, progress: Progress) -> dict:
    return world.load(options.folder).header


def _run_verify(options, extract: Extract, progress: Progress) -> dict:
    defects = verify.verify(options.folder)
    return {"defects": [dataclasses.asdict(defect) for defect in defects]}


def _run_query(options, extract: Extract, progress: Progress) -> dict:
    loaded = world.load(options.folder)
    points, normals = _read_points(options)
    sun = None
    if options.sun is not None:
        direction = numbers(options.sun, "--sun", (3,))
        sun = (direction / np.linalg.norm(direction), loaded.sun_irradiance)
    values = loaded.irradiance(points, normals, sun=sun, transport=options.transport)
    _write_array(options.output, values)
    return {"points": len(points), "output": str(options.output)}


def _run_reference(options, extract: Extract, progress: Progress) -> dict:
    points, normals = _read_points(options)
    settings = _settings(options, options.samples, QUALITIES["final"][1])
    snapshot = _read_scene(options.scene, extract, progress)
    values = reference.irradiance(
        snapshot,
        points,
        normals,
        options.transport,
        settings.samples,
        settings.bounces,
        settings.seed,
        settings,
        options.threads,
    )
    _write_array(options.output, values)
    return {"points": len(points), "output": str(options.output)}


def _run_compare(options, extract: Extract, progress: Progress) -> dict:
    from . import compare

    view = compare.View(options.camera, options.size, options.samples, options.transport, options.threads)
    return compare.compare(options.folder, options.output, view, progress)


def _read_points(options) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals of equal number."""
    points, normals = _read_array(options.points), _read_array(options.normals)
    if len(points) != len(normals):
        raise SettingsError(
            f"{options.points} has {len(points)} rows and {options.normals} {len(normals)}: want the same"
        )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if (length == 0).any():
        raise SettingsError(
            f"{options.normals}: row {int(np.argmin(length))} has no length; normals must be directions"
        )
    return points, normals / length


def _read_array(path: Path) -> np.ndarray:
    """(n, 3) finite float64 numbers of a .npy file; nothing in it is executed."""
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise SettingsError(f"{path}: not a .npy file of numbers ({one_line(error)})") from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise SettingsError(f"{path}: want numbers of shape (n, 3)")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise SettingsError(f"{path}: row {int(np.argmax(~np.isfinite(array).all(axis=1)))} holds NaN or infinity")
    return array


def _write_array(path: Path, array: np.ndarray) -> None:
    """A .npy file, whole or not at all."""
    import io

    buffer = io.BytesIO()
    np.save(buffer, array.astype(np.float32), allow_pickle=False)
    write_bytes_atomically(path, buffer.getvalue())


def _show_bake(result: dict) -> str:
    """A summary for people."""
    megabytes = sum(result["bytes"].values()) / 1e6
    lines = [
        f"{result['data_points']} data points in {result['cells']} cell(s) from {result['triangles']} triangles, "
        f"{megabytes:.2f} MB, {sum(result['seconds'].values()):.1f} s, {result['rays'] / 1e6:.0f} million rays",
        f"modelled: {', '.join(result['modelled']) or 'nothing'}",
    ]
    lines += [f"left out: {item['what']}: {item['why']}" for item in result["left_out"]]
    lines += [f"warning: {text}" for text in result["warnings"]]
    return "\n".join(lines)


def _show_info(result: dict) -> str:
    return json.dumps(result, indent=1)


def _show_verify(result: dict) -> str:
    lines = [f"{defect['file']}: {defect['what']}" for defect in result["defects"]]
    return "\n".join(lines) or "no defects"


def _show_compare(result: dict) -> str:
    return "\n".join(f"{name}: {value}" for name, value in result.items())


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return value


def _cells(text: str) -> list[tuple[int, int]]:
    try:
        pairs = [tuple(int(word) for word in pair.split(",")) for pair in text.split("/")]
    except ValueError:
        pairs = [()]
    if any(len(pair) != 2 for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text}: write cells as i,j/i,j")
    return pairs


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(word) for word in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: write a size as 480x270") from None
    if not 1 <= min(width, height) <= max(width, height) <= 8192:
        raise argparse.ArgumentTypeError(f"{text}: each side must be 1 to 8192 pixels")
    return width, height
