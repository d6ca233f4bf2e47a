"""Runs inside a desktop Blender: installs the zip, bakes in the window, cancels, bakes to the end, quits.

`blender --python drive.py -- ZIP FOLDER`; writes FOLDER/seen.json and a picture of the window for each step.
"""

import json
import subprocess
import sys
import traceback
from pathlib import Path

import bpy

ARCHIVE, FOLDER = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
TICK_S = 0.1
REPOSITORY = "user_default"
NAME = f"bl_ext.{REPOSITORY}.gi_volumes"
seen = {"progress": [], "steps": []}


def view() -> dict:
    """The 3D view, for operators that want a window."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    return {"window": window, "screen": window.screen, "area": area, "region": region}


def picture(name: str) -> None:
    """What the window shows now."""
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
    subprocess.run(["import", "-window", "root", str(FOLDER / f"{name}.png")], check=False)


def start(quality: str, output: str):
    """Press *Bake GI*; returns the job."""
    settings = bpy.context.scene.gi_volumes
    settings.quality, settings.output_folder = quality, str(FOLDER / output)
    with bpy.context.temp_override(**view()):
        answer = bpy.ops.gi_volumes.bake("INVOKE_DEFAULT")
    assert answer == {"RUNNING_MODAL"}, answer
    return job().current


def open_panel(name: str) -> None:
    """Make a panel that is closed by default an open one, before it is drawn for the first time."""
    panel = getattr(bpy.types, name)
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


def add_slow_mesh() -> None:
    """Something that takes long enough to bake to be cancelled: curved, and larger than the finest voxels."""
    with bpy.context.temp_override(**view()):
        bpy.ops.mesh.primitive_torus_add(major_radius=30.0, minor_radius=12.0, major_segments=96, minor_segments=48)


def job():
    """The module that knows the current bake."""
    return sys.modules[f"{NAME}.operators.job"]


def until(condition, running=None):
    """Wait, one timer tick after the other; note every stage that the panel shows."""
    for _ in range(3000):
        if running is not None and running.progress.stage not in seen["progress"]:
            seen["progress"].append(running.progress.stage)
        if condition():
            return
        if running is not None and job().current is not running:
            break
        yield
    raise AssertionError(f"waited in vain; the last bake: {job().last}")


def probes(where: dict):
    """Show a room's probes, move one, bake again: the others follow by themselves, and that can be undone."""
    room = bpy.data.objects["Cube"]
    room.scale = (4.0, 4.0, 4.0)
    room.data.flip_normals()
    bpy.context.scene.gi_volumes.probes, bpy.context.scene.gi_volumes.probe_count = "count", 2
    running = start("draft", "finished")
    yield from until(lambda: job().current is None, running)
    with bpy.context.temp_override(**where):
        assert bpy.ops.gi_volumes.place_probes("INVOKE_DEFAULT") == {"FINISHED"}
    moved = bpy.data.collections["GI Probes"].objects[0]
    moved.select_set(True)
    bpy.context.view_layer.objects.active = moved
    moved.location = (3.0, 3.0, 3.0)
    yield
    picture("3_probes")
    running = start("draft", "finished")
    yield from until(lambda: job().current is None, running)
    shown = bpy.data.collections["GI Probes"].objects
    seen["probes"] = sorted(object.gi_volumes.pinned for object in shown)
    with bpy.context.temp_override(**where):
        bpy.ops.ed.undo()
    yield
    seen["steps"].append(["probes", job().last.kind])


def scenario():
    """Everything that an artist does, one `yield` per timer tick."""
    bpy.ops.extensions.package_install_files(filepath=str(ARCHIVE), repo=REPOSITORY, enable_on_install=True)
    open_panel("GIVOLUMES_PT_sidebar_probes")
    where = view()
    where["area"].spaces.active.show_region_ui = True
    yield
    sidebar = next(region for region in where["area"].regions if region.type == "UI")
    sidebar.active_panel_category = "GI Volumes"
    yield
    picture("1_panel")

    running = start("draft", "finished")
    yield from until(lambda: job().current is None, running)
    seen["steps"].append(["finish", job().last.kind])
    seen["message"] = job().last.message
    picture("2_finished")

    yield from probes(where)

    add_slow_mesh()
    running = start("final", "cancelled")
    yield from until(lambda: running.progress.stage == "Baking" and running.progress.fraction > 0, running)
    picture("4_progress")
    assert not bpy.ops.gi_volumes.bake.poll()
    where["window"].event_simulate(type="ESC", value="PRESS", x=300, y=300)
    yield from until(lambda: job().current is None, running)
    where["window"].event_simulate(type="ESC", value="RELEASE", x=300, y=300)
    seen["steps"].append(["escape", job().last.kind])

    running = start("final", "cancelled")
    yield from until(lambda: running.progress.stage == "Baking", running)
    bpy.ops.gi_volumes.cancel()
    yield from until(lambda: job().current is None, running)
    seen["steps"].append(["cancel", job().last.kind])
    picture("5_cancelled")

    running = start("final", "disabled")
    yield from until(lambda: running.progress.stage == "Baking", running)
    bpy.ops.preferences.addon_disable(module=NAME)
    yield
    yield
    bpy.ops.preferences.addon_enable(module=NAME)
    yield
    seen["steps"].append(["disable", "alive"])
    picture("6_enabled_again")

    running = start("final", "left")
    yield from until(lambda: running.progress.stage == "Baking", running)
    bpy.ops.wm.read_homefile(app_template="")
    yield
    seen["steps"].append(["another file", "forgotten" if job().last is None else job().last.kind])
    picture("7_another_file")


def tick():
    """One step of the scenario; the result is written whatever happens."""
    try:
        next(steps)
        return TICK_S
    except StopIteration:
        seen["done"] = True
    except BaseException:
        seen["error"] = traceback.format_exc()
    (FOLDER / "seen.json").write_text(json.dumps(seen))
    bpy.ops.wm.quit_blender()
    return None


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.use_preferences_save = False
steps = scenario()
bpy.app.timers.register(tick, first_interval=1.0, persistent=True)
