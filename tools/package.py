"""Build and validate the extension's zip with Blender's own tool: `package.py FOLDER`."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def blenders_tool() -> Path:
    """Return the extension builder that comes with `bpy`; it runs without Blender."""
    spec = importlib.util.find_spec("bpy")
    if spec is None:
        raise SystemExit("error: this Python has no bpy: run 'make setup'")
    return next(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def build(folder: Path) -> Path:
    """Write the zip into a folder and return its path; raise CalledProcessError when Blender refuses it."""
    tool = [sys.executable, str(blenders_tool())]
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
    built = folder / f"{manifest['id']}-{manifest['version']}.zip"
    subprocess.run([*tool, "build", "--source-dir", str(ROOT), "--output-filepath", str(built)], check=True)
    subprocess.run([*tool, "validate", str(built)], check=True)
    return built


if __name__ == "__main__":
    try:
        print(build(Path(sys.argv[1]).resolve()))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
