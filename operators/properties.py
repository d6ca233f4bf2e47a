"""Settings that live in the .blend file, and the command-line arguments that they stand for."""

from pathlib import Path

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .probe_properties import GIVOLUMES_PG_object, GIVOLUMES_PG_place

# In files of version 1 the finest voxels are a number, which Blender reads as the default, automatic.
SCHEMA_VERSION = 2
DEFAULT_FOLDER = "//gi_bake/"

QUALITIES = (
    ("draft", "Draft", "Seconds to minutes; grainy, for checking the set-up"),
    ("preview", "Preview", "For everyday work"),
    ("final", "Final", "For shipping; slow"),
)
SUNS = (
    ("scene", "Scene", "The sun lamps of the scene, as they stand"),
    ("hemisphere", "Any Direction", "The sun may stand anywhere at run time; larger files"),
    ("none", "None", "No sun"),
)
SKIES = (
    ("scene", "Scene", "The world of the scene, as it stands"),
    ("harmonics", "Any Sky", "The sky may change at run time; larger files"),
)
PROBES = (
    ("auto", "Automatic", "Reflection probes where surfaces are glossy, as many as the budget allows"),
    ("count", "Count", "So many reflection probes, whatever the materials"),
    ("none", "None", "No reflection probes"),
)
AUTOMATIC = "automatic"
# The grid's levels are powers of two; scenes of another scale than people's get theirs from the automatic choice.
FINEST = (
    (AUTOMATIC, "Automatic", "Fits the scene; 0.5 m where people walk"),
    *(
        (size, f"{size} m", f"Voxels of {size} m where surfaces are near")
        for size in ("4", "2", "1", "0.5", "0.25", "0.125")
    ),
)


class SettingsError(ValueError):
    """A setting that a bake cannot use; the message holds the remedy."""


class GIVOLUMES_PG_scene(bpy.types.PropertyGroup):
    """Settings of a bake."""

    schema_version: IntProperty(default=SCHEMA_VERSION, options={"HIDDEN"})
    output_folder: StringProperty(
        name="Output Folder",
        description="Folder that the bake is written to; // stands for the folder of the .blend file",
        default=DEFAULT_FOLDER,
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    quality: EnumProperty(
        name="Quality",
        description="How many light paths each data point gets, from few (Draft) to many (Final)",
        items=QUALITIES,
        default="preview",
    )
    sun: EnumProperty(
        name="Sun",
        description="Which sun directions the bake answers for",
        items=SUNS,
        default="scene",
    )
    sky: EnumProperty(
        name="Sky",
        description="Which skies the bake answers for",
        items=SKIES,
        default="scene",
    )
    finest: EnumProperty(
        name="Finest Voxel",
        description="Size of the smallest voxels; half the size takes more time, memory and disk space",
        items=FINEST,
        default=AUTOMATIC,
    )
    threads: IntProperty(
        name="Threads",
        description="Processor threads to use; 0 (the default) uses all of them. The result does not depend on it",
        default=0,
        min=0,
        soft_max=64,
    )
    seed: IntProperty(
        name="Seed",
        description="Number of the noise pattern (0 by default)",
        default=0,
        min=0,
    )
    probes: EnumProperty(
        name="Probes",
        description="Which reflection probes the bake makes; pinned ones are made unless there are to be none",
        items=PROBES,
        default="auto",
    )
    probe_count: IntProperty(
        name="Count",
        description="How many reflection probes, pinned ones among them (50 by default)",
        default=50,
        min=0,
        soft_max=1000,
    )
    probe_megabytes: FloatProperty(
        name="Budget (MB)",
        description="Most that reflection probes take as textures [MB]; 0 (the default) is 32 MB for automatic probes"
        " and no limit for a count. Pinned ones are made in any case",
        default=0.0,
        min=0.0,
        soft_max=1024.0,
    )
    placed_probes: CollectionProperty(type=GIVOLUMES_PG_place, options={"HIDDEN"})
    deleted_probes: CollectionProperty(type=GIVOLUMES_PG_place, options={"HIDDEN"})
    shown_probes: StringProperty(options={"HIDDEN"})


class GIVOLUMES_PG_light(bpy.types.PropertyGroup):
    """Settings of a lamp."""

    reflector: BoolProperty(
        name="Reflector",
        description="Bake this lamp's direct light too: a soft fill light, free at run time (off by default)",
        default=False,
    )


CLASSES = (GIVOLUMES_PG_place, GIVOLUMES_PG_object, GIVOLUMES_PG_scene, GIVOLUMES_PG_light)


def attach() -> None:
    """Give scenes, objects and lamps their settings."""
    bpy.types.Scene.gi_volumes = PointerProperty(type=GIVOLUMES_PG_scene)
    bpy.types.Object.gi_volumes = PointerProperty(type=GIVOLUMES_PG_object)
    bpy.types.Light.gi_volumes = PointerProperty(type=GIVOLUMES_PG_light)


def attach_alone() -> None:
    """Give them their settings where the extension is not enabled, so that a file's can be read."""
    if not hasattr(bpy.types.Scene, "gi_volumes"):
        for group in CLASSES:
            bpy.utils.register_class(group)
        attach()


def detach() -> None:
    """Take the settings away again."""
    del bpy.types.Light.gi_volumes
    del bpy.types.Object.gi_volumes
    del bpy.types.Scene.gi_volumes


def output_folder(scene: bpy.types.Scene) -> Path:
    """Return the folder that a scene is baked to.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.

    Returns
    -------
    Path
        An absolute path; the folder need not exist.

    Raises
    ------
    SettingsError
        No folder is set, or it is relative to a .blend file that has never been saved.
    """
    folder = scene.gi_volumes.output_folder.strip()
    if not folder:
        raise SettingsError("No output folder: set one in Render Properties > GI Volumes")
    if folder.startswith("//") and not bpy.data.filepath:
        raise SettingsError("Unsaved file: save the .blend first, or set an absolute output folder")
    path = Path(bpy.path.abspath(folder))
    if not path.is_absolute():
        raise SettingsError(f"Output folder {folder!r} is neither absolute nor relative to the .blend file (//)")
    return path


def arguments(scene: bpy.types.Scene) -> dict[str, str]:
    """Return the options of the command `bake` that a scene's settings stand for.

    Parameters
    ----------
    scene : bpy.types.Scene
        The scene.

    Returns
    -------
    dict of str to str
        Value of each option; options at their defaults are left out where the command knows the default.
    """
    settings = scene.gi_volumes
    options = {
        "--quality": settings.quality,
        "--sun": settings.sun,
        "--sky": settings.sky,
        "--seed": str(settings.seed),
    }
    if settings.finest != AUTOMATIC:
        options["--finest"] = settings.finest
    if settings.threads:
        options["--threads"] = str(settings.threads)
    return options | _probe_arguments(settings)


def _probe_arguments(settings: GIVOLUMES_PG_scene) -> dict[str, str]:
    """The options for reflection probes."""
    options = {}
    if settings.probes != "auto":
        options["--probes"] = str(settings.probe_count) if settings.probes == "count" else settings.probes
    if settings.probe_megabytes:
        options["--probe-megabytes"] = f"{settings.probe_megabytes:g}"
    return options
