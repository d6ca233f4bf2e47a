"""The repository as a real extension: built, validated, enabled, inspected and disabled by Blender itself."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="this Python has no bpy")

PREAMBLE = """
import sys, bpy, addon_utils
from pathlib import Path
repository, output = Path(sys.argv[1]), Path(sys.argv[2])
bpy.context.preferences.extensions.repos.new(
    name="dev", module="dev", custom_directory=str(repository), remote_url="")
NAME = "bl_ext.dev.gi_volumes"

def ours():
    types = [name for name in dir(bpy.types) if "GIVOLUMES" in name or "GI_VOLUMES" in name]
    places = [owner.__name__ for owner in (bpy.types.Scene, bpy.types.Object, bpy.types.Light)
              if hasattr(owner, "gi_volumes")]
    handlers = [f for name in dir(bpy.app.handlers) if isinstance(h := getattr(bpy.app.handlers, name), list)
                for f in h if f.__module__.startswith(NAME)]
    return types + places + handlers + list(dir(bpy.ops.gi_volumes))
"""


@pytest.fixture
def linked(repository, tmp_path):
    """An extension repository that holds this one by a link with the extension's name."""
    home = tmp_path / "linked"
    home.mkdir()
    (home / "gi_volumes").symlink_to(repository, target_is_directory=True)
    return home


@pytest.fixture
def blender(linked, run_python, tmp_path):
    """Run a program in Blender; returns what it printed."""

    def run(program: str, place=linked) -> str:
        done = run_python(PREAMBLE + program, str(place), str(tmp_path / "out"))
        assert done.returncode == 0, done.stderr + done.stdout
        assert "Traceback" not in done.stderr
        return done.stdout

    return run


SOURCES = ("LICENSE", "README.md", "__init__.py", "__main__.py", "bake", "blender_manifest.toml", "operators", "tree")
PACKAGED = (".py", ".md", ".toml", "LICENSE")


@pytest.fixture
def built(repository, tmp_path):
    """The zip that `make package` makes."""
    tool = [sys.executable, str(repository / "tools" / "package.py"), str(tmp_path)]
    done = subprocess.run(tool, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stderr + done.stdout
    (file,) = tmp_path.glob("*.zip")
    return file


def test_the_manifest_and_the_package_agree_on_name_and_version(repository, run_python):
    manifest = tomllib.loads((repository / "blender_manifest.toml").read_text())
    done = run_python("import gi_volumes; print(gi_volumes.__name__, gi_volumes.VERSION)")
    assert done.stdout.split() == [manifest["id"], manifest["version"]]


def test_blenders_tool_builds_and_validates_a_zip_of_the_package_and_nothing_else(built):
    names = zipfile.ZipFile(built).namelist()
    folders = {name.partition("/")[0] for name in names if "/" in name}
    assert folders <= {"bake", "operators", "preview", "shaders", "tree", "presets"}
    top = {name for name in names if "/" not in name}
    assert top == {"LICENSE", "README.md", "__init__.py", "__main__.py", "blender_manifest.toml"}


def test_what_a_user_leaves_in_the_repository_is_not_packaged(repository, tmp_path):
    for name in (*SOURCES, "tools"):
        source = repository / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / name)
    for name in ("lamp.blend", "bake/notes.txt", "hall/world.json", "hall/cell_0_0.tree"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    subprocess.run([sys.executable, str(tmp_path / "tools" / "package.py"), str(tmp_path)], check=True)
    (file,) = tmp_path.glob("*.zip")
    assert not [name for name in zipfile.ZipFile(file).namelist() if "hall" in name or not name.endswith(PACKAGED)]


def test_a_manifest_that_breaks_blenders_rules_is_refused(repository, tmp_path):
    for name in ("__init__.py", "blender_manifest.toml", "tools"):
        source = repository / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / name)
    manifest = tmp_path / "blender_manifest.toml"
    manifest.write_text(manifest.read_text().replace('volumes that light everything"', 'volumes."'))
    (tmp_path / "out").mkdir()
    tool = [sys.executable, str(tmp_path / "tools" / "package.py"), str(tmp_path / "out")]
    done = subprocess.run(tool, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode != 0
    assert not list((tmp_path / "out").glob("*.zip"))


def test_the_built_zip_installs_and_runs(built, blender, tmp_path):
    home = tmp_path / "installed"
    zipfile.ZipFile(built).extractall(home / "gi_volumes")
    said = blender(
        """
assert addon_utils.enable(NAME, default_set=True)
scene = bpy.context.scene
scene.gi_volumes.output_folder, scene.gi_volumes.quality = str(output), "draft"
print(bpy.ops.gi_volumes.bake(), (output / "world.json").is_file())
""",
        home,
    )
    assert "{'FINISHED'} True" in said


def test_enabling_twice_and_disabling_leaves_nothing_behind(blender):
    blender("""
before = ours()
for _ in range(2):
    assert addon_utils.enable(NAME, default_set=True).__name__ == NAME
    assert "GI_VOLUMES_OT_bake" in ours() and "GIVOLUMES_PT_render" in ours() and "Scene" in ours()
    assert bpy.context.scene.gi_volumes.schema_version == 2
    assert not bpy.data.lights[0].gi_volumes.reflector
    addon_utils.disable(NAME, default_set=True)
    assert ours() == before, ours()
""")


def test_settings_survive_saving_and_loading(blender):
    blender("""
addon_utils.enable(NAME, default_set=True)
bpy.context.scene.gi_volumes.quality = "final"
bpy.data.lights[0].gi_volumes.reflector = True
output.mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(output / "a.blend"))
bpy.ops.wm.read_homefile()
assert bpy.context.scene.gi_volumes.quality == "preview"
bpy.ops.wm.open_mainfile(filepath=str(output / "a.blend"))
assert bpy.context.scene.gi_volumes.quality == "final" and bpy.data.lights[0].gi_volumes.reflector
""")


def test_the_command_line_outside_of_blender_reads_the_settings_of_lamps_and_objects(blender, repository, tmp_path):
    blender("""
addon_utils.enable(NAME, default_set=True)
bpy.data.lights[0].gi_volumes.reflector = True
bpy.ops.gi_volumes.add_probe()
bpy.context.object.location = (1, 2, 3)
output.mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(output / "a.blend"))
""")
    words = ["snapshot", str(tmp_path / "out" / "a.blend"), "-o", str(tmp_path / "a.giv")]
    done = subprocess.run([sys.executable, str(repository / "__main__.py"), *words], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")
    from gi_volumes.bake import snapshot_file

    snapshot = snapshot_file.load(tmp_path / "a.giv")
    assert snapshot.lights.reflector.tolist() == [True]
    assert snapshot.probes.pinned.tolist() == [[1, 2, 3]]


def test_a_finest_voxel_saved_as_a_number_is_read_as_automatic(blender):
    blender("""
class Old(bpy.types.PropertyGroup):
    finest: bpy.props.FloatProperty()
    quality: bpy.props.StringProperty()
bpy.utils.register_class(Old)
bpy.types.Scene.gi_volumes = bpy.props.PointerProperty(type=Old)
bpy.context.scene.gi_volumes.finest = 0.3
output.mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(output / "old.blend"))
del bpy.types.Scene.gi_volumes
bpy.utils.unregister_class(Old)
addon_utils.enable(NAME, default_set=True)
bpy.ops.wm.open_mainfile(filepath=str(output / "old.blend"))
settings = bpy.context.scene.gi_volumes
assert settings.finest == "automatic", settings.finest
settings.finest = "0.25"
bpy.ops.wm.save_mainfile()
bpy.ops.wm.open_mainfile(filepath=str(output / "old.blend"))
assert bpy.context.scene.gi_volumes.finest == "0.25"
""")


def test_blender_sees_no_policy_violation_after_every_operator_and_the_command(blender):
    said = blender("""
addon_utils.enable(NAME, default_set=True)
scene = bpy.context.scene
scene.gi_volumes.output_folder, scene.gi_volumes.quality = str(output), "draft"
print(bpy.ops.gi_volumes.bake(), bpy.ops.gi_volumes.clear())
from bl_ext.dev.gi_volumes.operators import command
print("CODE", command.main(["bake"]), command.main(["info", str(output)]), command.main(["verify", str(output)]))
bpy.ops.gi_volumes.place_probes(), bpy.ops.gi_volumes.add_probe(), bpy.ops.gi_volumes.pin_probes()
operators = ["add_probe", "bake", "cancel", "clear", "forget_deleted_probes", "pin_probes", "place_probes"]
assert sorted(dir(bpy.ops.gi_volumes)) == operators
assert bpy.ops.gi_volumes.forget_deleted_probes() == {"CANCELLED"}
assert not bpy.ops.gi_volumes.cancel.poll()
print("VIOLATIONS", addon_utils._extensions_warnings_get())
""")
    assert "{'FINISHED'} {'FINISHED'}" in said
    assert "CODE 0 0 0" in said
    assert "VIOLATIONS {}" in said


def test_the_policy_check_sees_a_planted_violation(blender):
    said = blender("""
addon_utils.enable(NAME, default_set=True)
sys.path.append(str(repository / "gi_volumes" / "bake"))
print("VIOLATIONS", addon_utils._extensions_warnings_get())
""")
    assert "Policy violation" in said


def test_clear_removes_the_bake_and_leaves_other_files_alone(blender):
    blender("""
addon_utils.enable(NAME, default_set=True)
scene = bpy.context.scene
scene.gi_volumes.output_folder, scene.gi_volumes.quality = str(output), "draft"
bpy.ops.gi_volumes.bake()
for name in ("mine.txt", "mine.tree"):
    (output / name).write_text("not of the bake")
assert len(list(output.iterdir())) > 3
bpy.ops.gi_volumes.clear()
left = sorted(path.name for path in output.iterdir())
assert left == ["mine.tree", "mine.txt"], left
assert bpy.ops.gi_volumes.clear() == {"FINISHED"}
""")


def test_clear_refuses_a_folder_whose_world_file_is_another_programs(blender):
    said = blender("""
addon_utils.enable(NAME, default_set=True)
bpy.context.scene.gi_volumes.output_folder = str(output)
output.mkdir()
(output / "world.json").write_text('{"name": "a level of a game"}')
(output / "scene.giv").write_text("x")
try:
    bpy.ops.gi_volumes.clear()
except RuntimeError as error:
    print("REFUSED", " ".join(str(error).split()))
print(sorted(path.name for path in output.iterdir()))
""")
    assert "this is not the world.json of a bake" in said
    assert "['scene.giv', 'world.json']" in said
