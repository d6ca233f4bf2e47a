"""The command line: `bake`, `info`, `verify`, `query`, `reference`, `compare`.

Comes in: words. Goes out: files, one JSON object on standard output when asked, text on standard error, and an
exit code: 0 done, 1 failed with a one-line reason, 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import numpy as np

from ..tree import container, verify, world
from ..tree.topology import MAX_POINTS
from . import job, probe_job, reference, snapshot_file, viewpoint
from .arrays import check_output, one_line, read_array, read_points, read_roughness, write_array
from .capture import Spending
from .place import SNAPSHOT_NAME, check_target, scene_defects
from .probe_job import Wish
from .progress import Progress
from .settings import (
    QUALITIES,
    Settings,
    SettingsError,
    check_words,
    has_free_sun,
    numbers,
    of_reference,
    unit,
)
from .snapshot import ProbeEdits, Snapshot, SnapshotError

EXPECTED = (SnapshotError, SettingsError, container.FileError, OSError, ValueError, MemoryError)
"""Errors that are the input's fault: one line, no traceback."""

MAY_BE_NEGATIVE = ("--sun", "--sky", "--cells", "--finest", "--eye", "--target")
"""Options whose value may begin with a minus, which would otherwise pass for an option."""

MOST_SAMPLES = 1 << 20
"""Paths of a point beyond which noise is less than rounding."""

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
    options = _parser().parse_args(_joined(argv))
    misuse = options.misuse(options)
    if misuse:
        options.refuse(misuse)
    try:
        return _run(options, extract)
    except BrokenPipeError:
        _drop(sys.stdout)
        _drop(sys.stderr)
        return 1
    finally:
        _flush_or_drop(sys.stdout)


def _run(options, extract: Extract) -> int:
    """Run a command and say how it ended."""
    progress = Progress(getattr(options, "progress", "text") == "json")
    try:
        result = options.run(options, extract, progress)
        progress.finish(result)
        _print_result(options, result)
    except BrokenPipeError:
        raise
    except EXPECTED as error:
        progress.fail(one_line(error))
        return 1
    except KeyboardInterrupt:
        progress.interrupt()
        raise
    return 1 if result.get("defects") else 0


def _print_result(options, result: dict) -> None:
    """The result as an object or for people; with `--progress json` it was the last line already."""
    if getattr(options, "progress", "text") == "json":
        return
    text = json.dumps(result) if options.json else options.show(result) if options.show else ""
    if text:
        encoding = sys.stdout.encoding or "utf-8"
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)


def _drop(stream: TextIO) -> None:
    """Write to nowhere from now on, so that Python can end without complaining about what nobody took."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _flush_or_drop(stream: TextIO) -> None:
    """A failure to write has been reported; it must not be met again when Python ends."""
    try:
        stream.flush()
    except OSError:
        _drop(stream)


def _joined(argv: list[str]) -> list[str]:
    """The arguments, with values that begin with a minus tied to their options: --sun=-1,0,2."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] in MAY_BE_NEGATIVE and re.match(r"-[\d.]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _parser() -> argparse.ArgumentParser:
    """Every command with its options; an option's name has to be whole, so that new ones can be added."""
    parser = argparse.ArgumentParser(
        prog="gi_volumes", description="Bakes global-illumination volumes.", allow_abbrev=False
    )
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
    command = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
    command.add_argument(
        "--json", action="store_true", help="print one JSON object on standard output, and nothing else"
    )
    command.set_defaults(run=run, show=show, refuse=command.error, misuse=lambda options: "")
    return command


def _add_folder_command(commands, name: str, text: str, run, show) -> None:
    """A command that only looks at a bake."""
    _add_command(commands, name, text, run, show).add_argument("folder", type=_path, metavar="DIR")


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
    text = ".blend, .glb, .gltf, or a snapshot (.giv); inside Blender the open file where it is left out"
    command.add_argument("scene", type=_path, metavar="SCENE", help=text)
    text = "folder of the bake; inside Blender that of the scene's settings where it is left out"
    command.add_argument("-o", "--output", type=_path, required=True, metavar="DIR", help=text)
    command.add_argument("--quality", choices=tuple(QUALITIES), default="preview")
    command.add_argument("--samples", type=_samples, help="paths per data point, instead of the quality's")
    text = "cache ends paths on surfaces whose light is known; paths follows each to its end"
    command.add_argument("--method", choices=("cache", "paths"), default="cache", help=text)
    command.add_argument("--finest", type=float, default=0.0, help="size of the finest voxels in metres")
    text = "subdivide where the relative error of surface irradiance is above this; 0: wherever geometry is not flat"
    command.add_argument("--error", type=_error, help=text)
    text = "most data points of a world cell"
    command.add_argument("--max-points", type=_points, default=MAX_POINTS, help=text)
    text = "most bytes of a world cell, such as 500k or 2M: what buys least is left coarse"
    command.add_argument("--max-bytes", type=_bytes, default=0, help=text)
    command.add_argument("--no-fit", action="store_true", help="keep data points as traced, not fitted to surfaces")
    text = "full gives surfaces data of the finest voxels alone: two to eight times the data"
    command.add_argument("--dilation", choices=("partial", "full"), default="partial", help=text)
    command.add_argument("--cells", type=_cells, help="only these world cells: 0,1/3,2")
    text = "write a coarse look at every cell first, within seconds, for those who watch the folder"
    command.add_argument("--early", action="store_true", help=text)
    text = "keep what is measured in DIR/memory, and measure again only what has changed since"
    command.add_argument("--incremental", action="store_true", help=text)
    text = "refine cells, those near the camera first, for about this long; each has a coarse look at least"
    command.add_argument("--minutes", type=_minutes, default=0.0, help=text)
    text = "reflection probes: auto where surfaces are glossy, N of them, or none"
    command.add_argument("--probes", type=_probes, default="auto", metavar="auto|N|none", help=text)
    text = f"most that they take as textures, in millions of bytes; auto takes {probe_job.AUTOMATIC:g}"
    command.add_argument("--probe-megabytes", type=_megabytes, metavar="MB", help=text)
    _add_light(command)


def _add_query(commands) -> None:
    command = _add_command(commands, "query", "irradiance from a bake, or radiance that rays meet", _run_query, None)
    command.add_argument("folder", type=_path, metavar="DIR")
    _add_points(command, needs_normals=False)
    text = (
        "(n, 3) mirror directions: radiance from there, [W/(m2 sr)], instead of irradiance; --normals may be left out"
    )
    command.add_argument("--directions", type=_path, metavar="D.npy", help=text)
    command.add_argument("--roughness", type=_path, metavar="R.npy", help="(n,) roughness, with --directions")
    command.set_defaults(misuse=_misuse_of_query)
    command.add_argument("--sun", help="x,y,z towards the sun, instead of the scene's")


def _add_reference(commands) -> None:
    command = _add_command(commands, "reference", "path-traced irradiance at points", _run_reference, None)
    command.add_argument("scene", type=_path, metavar="SCENE")
    _add_points(command)
    command.add_argument("--samples", type=_samples, default=1024, help="paths per point (1024)")
    _add_light(command)


def _add_compare(commands) -> None:
    text = "a picture of the baked irradiance beside the path-traced one and their difference"
    command = _add_command(commands, "compare", text, _run_compare, _show_compare)
    command.add_argument("folder", type=_path, metavar="DIR")
    command.add_argument("-o", "--output", type=_path, required=True, metavar="IMAGE", help=".png or .exr")
    command.add_argument("--camera", help="its name; the scene's active camera without it")
    text = "stand here instead, in metres of the scene's world, z up; together with --target"
    command.add_argument("--eye", type=_place, metavar="x,y,z", help=text)
    command.add_argument("--target", type=_place, metavar="x,y,z", help="what is in the middle of the picture then")
    text = f"horizontal field of view from --eye ({viewpoint.FIELD_OF_VIEW:g})"
    command.add_argument("--fov", type=_field_of_view, metavar="DEGREES", help=text)
    command.add_argument("--size", type=_size, default=(480, 270), metavar="WxH", help="of each of the three pictures")
    command.add_argument("--samples", type=_samples, default=256, help="paths per pixel of the reference (256)")
    command.add_argument("--transport", choices=("local", "sun", "sky", "all"), default="all")
    command.add_argument("--threads", type=_natural, default=0)
    command.add_argument("--progress", choices=("text", "json"), default="text")
    command.set_defaults(refuse=command.error)


def _add_points(command: argparse.ArgumentParser, needs_normals: bool = True) -> None:
    """Where to measure, and where to write it."""
    command.add_argument("--points", type=_path, required=True, metavar="P.npy", help="(n, 3) points in metres")
    command.add_argument("--normals", type=_path, required=needs_normals, metavar="N.npy", help="(n, 3) unit normals")
    command.add_argument("-o", "--output", type=_path, required=True, metavar="E.npy")
    command.add_argument("--transport", choices=("local", "sun", "sky", "all"), default="all")


def _run_bake(options, extract: Extract, progress: Progress) -> dict:
    preset = Settings.of(options.quality, options.method)
    settings = _settings(options, options.samples or preset.samples, preset.bounces, options.finest)
    error = preset.error if options.error is None else options.error
    own = {"error": error, "fit": not options.no_fit, "dilation": options.dilation, "method": options.method}
    own |= {"max_points": options.max_points, "max_bytes": options.max_bytes}
    settings = dataclasses.replace(settings, **own)
    if options.minutes and options.incremental:
        raise SettingsError("--minutes and --incremental: one or the other, as only whole cells can be remembered")
    check_target(options.output)
    snapshot = _read_scene(options.scene, extract, progress)
    wish = _wish(options.probes, options.probe_megabytes, probe_job.spending_of(settings), snapshot.probes)
    manner = job.Manner(options.threads, options.early, options.incremental, 60 * options.minutes, wish)
    outcome = job.bake(snapshot, options.output, settings, options.cells, manner, progress)
    return dataclasses.asdict(outcome)


def _wish(probes: str | int, megabytes: float | None, spending: Spending, edits: ProbeEdits) -> Wish | None:
    """Which reflection probes were asked for."""
    if probes == "none":
        return None
    given = {"spending": spending, "pinned": edits.pinned, "deleted": edits.deleted}
    if probes == "auto":
        return Wish(megabytes=megabytes or probe_job.AUTOMATIC, only_if_glossy=True, **given)
    return Wish(probes, megabytes, least_gain=0.0, **given)


def _settings(options, samples: int, bounces: int, finest: float = 0.0) -> Settings:
    """Settings from the words of the command line."""
    bounces = bounces if options.bounces is None else options.bounces
    settings = Settings(samples, bounces, options.sky, options.sun, finest, options.seed)
    check_words(settings)
    return settings


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
        snapshot = Path(scratch) / SNAPSHOT_NAME
        extract(path, snapshot)
        return snapshot_file.load(snapshot)


def _run_info(options, extract: Extract, progress: Progress) -> dict:
    return world.load(options.folder).header


def _run_verify(options, extract: Extract, progress: Progress) -> dict:
    defects = verify.verify(options.folder) + scene_defects(options.folder)
    return {"defects": [dataclasses.asdict(defect) for defect in defects]}


def _run_query(options, extract: Extract, progress: Progress) -> dict:
    check_output(options.output)
    points = read_array(options.points)
    normals = None if options.normals is None else read_points(options.points, options.normals)[1]
    direction = None
    if options.sun is not None:
        direction = unit(numbers(options.sun, "--sun", (3,))[None], f"--sun {options.sun}")[0]
    loaded = world.load(options.folder)
    expected = len(loaded.header.get("expected_cells", loaded.cells))
    if len(loaded.cells) < expected:
        print(f"warning: {expected - len(loaded.cells)} of {expected} cells are not baked yet", file=sys.stderr)
    early = sum(bool(entry.get("early")) for entry in loaded.header["cells"])
    if early:
        print(f"warning: {early} of {expected} cells are an early look, not baked to their end", file=sys.stderr)
    sun = None if direction is None else (direction, loaded.sun_irradiance)
    if options.directions is None:
        values = loaded.irradiance(points, normals, sun=sun, transport=options.transport)
    else:
        directions = read_points(options.points, options.directions)[1]
        values = loaded.radiance(points, directions, read_roughness(options.roughness), sun, normals=normals)
    write_array(options.output, values)
    return {"points": len(points), "output": str(options.output)}


def _misuse_of_query(options) -> str:
    """Say why words do not tell what is asked for; nothing where they do."""
    if (options.directions is None) != (options.roughness is None):
        return "--directions and --roughness: give both, or neither"
    if options.directions is None and options.normals is None:
        return "--normals: give them for irradiance, or --directions and --roughness for radiance"
    if options.directions is not None and options.transport != "all":
        return f"--transport {options.transport}: not with --directions, which see all of them"
    return ""


def _run_reference(options, extract: Extract, progress: Progress) -> dict:
    check_output(options.output)
    points, normals = read_points(options.points, options.normals)
    settings = _settings(options, options.samples, QUALITIES["final"][1])
    if has_free_sun(settings.sun):
        raise SettingsError(f"--sun {settings.sun}: the reference needs one sun; name its direction as x,y,z")
    snapshot = _read_scene(options.scene, extract, progress)
    progress.stage("Path tracing", len(points))
    values = reference.irradiance(
        snapshot,
        points,
        normals,
        options.transport,
        settings.samples,
        settings.bounces,
        settings.seed,
        of_reference(settings),
        options.threads,
        progress.show,
    )
    write_array(options.output, values)
    return {"points": len(points), "output": str(options.output)}


def _run_compare(options, extract: Extract, progress: Progress) -> dict:
    from . import compare

    try:
        camera = viewpoint.choose(options.camera, options.eye, options.target, options.fov)
    except SettingsError as wrong:
        options.refuse(str(wrong))
    check_output(options.output)
    view = compare.View(camera, options.size, options.samples, options.transport, options.threads)
    return compare.compare(options.folder, options.output, view, progress)


def _show_bake(result: dict) -> str:
    """A summary for people."""
    megabytes = sum(result["bytes"].values()) / 1e6
    lines = [
        f"{result['data_points']} data points in {result['cells']} cell(s) from {result['triangles']} triangles, "
        f"{megabytes:.2f} MB, {sum(result['seconds'].values()):.1f} s, {result['rays'] / 1e6:.0f} million rays",
        f"voxels from {result['voxels']['first']:g} m to {result['voxels']['finest']:g} m",
        f"modelled: {', '.join(result['modelled']) or 'nothing'}",
    ]
    for item in result["checked"]:
        bias = f"{100 * item['bias']:+.1f} +- {100 * item['bias_error']:.1f} %"
        lines.append(
            f"{item['what']}: the surface cache is {bias} off on average, as paths show at {item['places']} places; a "
            f"data point's noise is {100 * item['noise']:.1f} %, before the fit to surfaces averages it out"
        )
    if result["probes"]:
        lines.append(_say_probes(result["probes"], result["bytes"]["probes"]))
    if result["kept"]:
        lines.append(f"kept as they were measured before: {result['kept']} data points")
    lines += [f"left out: {item['what']}: {item['why']}" for item in result["left_out"]]
    lines += [f"warning: {text}" for text in result["warnings"]]
    lines.append(f"written to {result['folder']}")
    return "\n".join(lines)


def _say_probes(probes: dict, size: int) -> str:
    """How many, how large, how good."""
    good = f", {probes['rays']:.0f} rays a texel, noise {100 * probes['noise']:.1f} %" if probes["rays"] else ""
    return f"{probes['count']} reflection probes, {size / 1e6:.2f} MB{good}"


def _show_info(result: dict) -> str:
    return json.dumps(result, indent=1)


def _show_verify(result: dict) -> str:
    lines = [f"{defect['file']}: {defect['what']}" for defect in result["defects"]]
    return "\n".join(lines) or "no defects"


def _show_compare(result: dict) -> str:
    return "\n".join(f"{name}: {value}" for name, value in result.items())


def _natural(text: str) -> int:
    return _whole(text, 0)


def _positive(text: str) -> int:
    return _whole(text, 1)


def _samples(text: str) -> int:
    """Paths that end within a lifetime."""
    value = _whole(text, 1)
    if value > MOST_SAMPLES:
        raise argparse.ArgumentTypeError(f"{text!r}: at most {MOST_SAMPLES} paths")
    return value


def _points(text: str) -> int:
    """A cap that a cell's index can number."""
    value = _whole(text, 1)
    if value > MAX_POINTS:
        raise argparse.ArgumentTypeError(f"{text!r}: a world cell holds at most {MAX_POINTS} data points")
    return value


def _bytes(text: str) -> int:
    """A size in bytes, or thousands or millions of them."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([kKmM]?)", text)
    value = float(found[1]) * {"": 1, "k": 1e3, "m": 1e6}[found[2].lower()] if found else 0
    if not 1 <= value < 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size in bytes, such as 500k or 2M")
    return int(value)


def _probes(text: str) -> str | int:
    """How many reflection probes."""
    return text if text in ("auto", "none") else _whole(text, 0)


def _megabytes(text: str) -> float:
    """A size, more than none."""
    return _above_none(text, "of megabytes")


def _error(text: str) -> float:
    """A relative error, 0 to 1."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 to 1")
    return value


def _minutes(text: str) -> float:
    """A time, more than none."""
    return _above_none(text, "of minutes")


def _above_none(text: str, of_what: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number {of_what} above 0")
    return value


def _whole(text: str, least: int) -> int:
    """A whole number of at least so much."""
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
    return value


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("an empty path")
    return Path(text)


def _cells(text: str) -> list[tuple[int, int]]:
    try:
        pairs = [tuple(int(word) for word in pair.split(",")) for pair in text.split("/")]
    except ValueError:
        pairs = [()]
    if any(len(pair) != 2 for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text}: write cells as i,j/i,j")
    return pairs


def _place(text: str) -> np.ndarray:
    try:
        return numbers(text, "a place", (3,))
    except SettingsError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a place: write three numbers as x,y,z") from None


def _field_of_view(text: str) -> float:
    """Degrees that a flat picture can hold."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 180:
        raise argparse.ArgumentTypeError(f"{text!r} is not an angle above 0 and below 180 degrees")
    return value


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(word) for word in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: write a size as 480x270") from None
    if not 1 <= min(width, height) <= max(width, height) <= 8192:
        raise argparse.ArgumentTypeError(f"{text}: each side must be 1 to 8192 pixels")
    return width, height
