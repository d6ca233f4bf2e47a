"""Build and validate the extension's zip with Blender's own tool: `package.py FOLDER`."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

FILES = ("LICENSE", "README.md", "__init__.py", "__main__.py", "blender_manifest.toml")
FOLDERS = ("bake", "operators", "presets", "preview", "shaders", "tree")
KINDS = (".glsl", ".json", ".png", ".py")
"""What of the repository the extension is; whatever else lies there, bakes and scenes, is the user's."""


def blenders_tool() -> Path:
    """Return the extension builder that comes with `bpy`; it runs without Blender."""
    spec = importlib.util.find_spec("bpy")
    if spec is None:
        raise SystemExit("error: this Python has no bpy: run 'make setup'")
    return next(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def stage(folder: Path) -> None:
    """Copy what belongs to the extension."""
    inside = [path for name in FOLDERS for path in sorted((ROOT / name).rglob("*")) if path.suffix in KINDS]
    for path in [ROOT / name for name in FILES] + inside:
        if path.is_file():
            copy = folder / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)


def build(folder: Path) -> Path:
    """Write the zip into a folder and return its path; raise CalledProcessError when Blender refuses it."""
    tool = [sys.executable, str(blenders_tool())]
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
    built = folder / f"{manifest['id']}-{manifest['version']}.zip"
    with tempfile.TemporaryDirectory() as staged:
        stage(Path(staged))
        subprocess.run([*tool, "build", "--source-dir", staged, "--output-filepath", str(built)], check=True)
    subprocess.run([*tool, "validate", str(built)], check=True)
    return built


if __name__ == "__main__":
    try:
        print(build(Path(sys.argv[1]).resolve()))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
