"""What objects that stand for reflection probes know of themselves, and what a scene remembers of those of its bake.

A probe's object has the place and the reach that the bake gave it: elsewhere it counts as moved, and without a reach it
is an artist's own. A scene has the places of all that were shown: one that no object stands for any more was deleted.
"""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty

PROBE = "PROBE"
ROLES = (
    ("NONE", "None", "An ordinary object"),
    (PROBE, "Reflection Probe", "Stands for a reflection probe; it is neither rendered nor baked"),
)


class GIVOLUMES_PG_place(bpy.types.PropertyGroup):
    """The place of a probe [m, world space], and half the distance to the nearest other one [m]."""

    place: FloatVectorProperty(size=3)
    reach: FloatProperty()


def _is_pinned(self) -> bool:
    from . import probe_marks

    return self.role == PROBE and probe_marks.is_pinned(self.id_data, probe_marks.place_of(self.id_data))


def _pin(self, value: bool) -> None:
    from . import probe_marks

    if value:
        self.kept = True
    else:
        probe_marks.release(self.id_data)


class GIVOLUMES_PG_object(bpy.types.PropertyGroup):
    """What an object is to the bake."""

    role: EnumProperty(
        name="Role",
        description="What the object is to the bake",
        items=ROLES,
        default="NONE",
    )
    pinned: BoolProperty(
        name="Pinned",
        description="The next bake makes a probe here in any case. Probes that were moved, added or duplicated are"
        " pinned; without this the probe goes back to where the bake had put it",
        options=set(),  # not to be animated
        get=_is_pinned,
        set=_pin,
    )
    kept: BoolProperty(default=False, options={"HIDDEN"})
    placed: FloatVectorProperty(size=3, options={"HIDDEN"})
    reach: FloatProperty(options={"HIDDEN"})
