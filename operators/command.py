"""The command line inside Blender: `blender -b level.blend --command gi_volumes COMMAND ...`.

The commands are those of `python -m gi_volumes`. SCENE may be left out: it is the loaded file then, and the
options of `bake` that are not given come from the scene's settings. Any scene is read here, where Blender is;
the command itself runs in a worker, like everywhere.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import bpy

from . import bake_operator, dependencies, job, properties, snapshot_command, worker
from .snapshot_command import one_line

NAME = "gi_volumes"
SCENE_COMMANDS = ("bake", "reference")
SCENE_SUFFIXES = (".blend", ".glb", ".gltf")
SNAPSHOT_SUFFIX = ".giv"


def main(argv: list[str]) -> int:
    """Run one command.

    Parameters
    ----------
    argv : list of str
        The arguments after `--command gi_volumes`.

    Returns
    -------
    int
        0 done, 1 failed with a one-line reason, 2 wrong usage, 130 interrupted.
    """
    complaint = dependencies.complaint()
    if complaint:
        return _fail(complaint)
    try:
        with tempfile.TemporaryDirectory(prefix="gi_volumes_", dir=bpy.app.tempdir) as scratch:
            return _run(_with_snapshot(list(argv), Path(scratch) / f"scene{SNAPSHOT_SUFFIX}"))
    except (OSError, ValueError) as error:
        return _fail(one_line(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return worker.INTERRUPTED


def _fail(reason: str) -> int:
    """The one line of a failure."""
    print(f"error: {reason}", file=sys.stderr)
    return 1


def _with_snapshot(argv: list[str], snapshot: Path) -> list[str]:
    """The arguments with the scene read and replaced by its snapshot."""
    if argv[:1] not in [[name] for name in SCENE_COMMANDS] or {"-h", "--help"} & set(argv):
        return argv
    scene = next((text for text in argv[1:] if Path(text).suffix.lower() in (*SCENE_SUFFIXES, SNAPSHOT_SUFFIX)), None)
    if scene is not None and Path(scene).suffix.lower() == SNAPSHOT_SUFFIX:
        return argv
    rest = [text for text in argv[1:] if text != scene]
    if scene is None:
        job.write_snapshot(snapshot)
    else:
        snapshot_command.write(Path(scene), snapshot)
    return [argv[0], str(snapshot), *(_defaults(rest) if argv[0] == "bake" else []), *rest]


def _defaults(given: list[str]) -> list[str]:
    """The scene's settings; they come before the given words, the last of which wins."""
    scene = bpy.context.scene
    options = properties.arguments(scene)
    # The scene's folder may be unusable, which matters only where no other is given.
    if not any(text.startswith(("-o", "--output")) for text in given):
        options["-o"] = str(properties.output_folder(scene))
    return [text for pair in options.items() for text in pair]


def _run(argv: list[str]) -> int:
    """Until the worker ends; its output is ours, and Ctrl-C reaches it."""
    with worker.start(argv) as process, bake_operator.interrupts(lambda: worker.interrupt(process)):
        code = process.wait()
    return worker.INTERRUPTED if code < 0 else code
