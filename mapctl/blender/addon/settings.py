"""The user's choices: the add-on's preferences, and the options of each operator as the panel keeps them."""

# Blender reads properties from annotations, which are calls.
# pyright: reportInvalidTypeForm=false

import bpy
from bpy.props import BoolProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from . import process
from .problem import AddonError


class WalkProperties:
    """Options of the walk along a curve."""

    speed: FloatProperty(name="Speed", description="Metres a second; 0 for the usual speed", min=0, soft_max=4)
    seconds: FloatProperty(name="Seconds", description="Duration; 0 for once along the curve", min=0, soft_max=120)
    gait: StringProperty(name="Gait", description="Gait that mapctl knows, as walk or run; empty for any")
    style: StringProperty(name="Style", description="Style that mapctl knows; empty for any")
    seed: IntProperty(name="Seed", description="Another seed is another walk", min=0)


class CleanUpProperties:
    """Options of the clean-up."""

    anchor: BoolProperty(
        name="Stop Sliding", description="Correct the trajectory so that planted feet do not travel", default=False
    )


class GapProperties:
    """Options of the filling of gaps."""

    first: IntProperty(name="First", description="First frame of the gap", default=1)
    last: IntProperty(name="Last", description="Last frame of the gap", default=24)
    selected: BoolProperty(
        name="Selected Bones Only", description="Only the bones selected in Pose Mode are filled", default=False
    )


class BetweenProperties:
    """Options of in-betweening: none yet."""


class MAPCTL_PG_walk(WalkProperties, bpy.types.PropertyGroup):
    """Options of the walk along a curve, of a scene."""


class MAPCTL_PG_clean_up(CleanUpProperties, bpy.types.PropertyGroup):
    """Options of the clean-up, of a scene."""


class MAPCTL_PG_gap(GapProperties, bpy.types.PropertyGroup):
    """Options of the filling of gaps, of a scene."""


class MAPCTL_PG_settings(bpy.types.PropertyGroup):
    """Options of all operators, of a scene."""

    walk: PointerProperty(type=MAPCTL_PG_walk)
    clean_up: PointerProperty(type=MAPCTL_PG_clean_up)
    gap: PointerProperty(type=MAPCTL_PG_gap)


class MAPCTL_OT_find(bpy.types.Operator):
    """Look for mapctl and tell its version"""

    bl_idname = "mapctl.find"
    bl_label = "Look for mapctl"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Look, and tell."""
        try:
            words = process.find_command(read_command(context))
        except AddonError as problem:
            self.report({"ERROR"}, str(problem))
            return {"CANCELLED"}
        version = ".".join(map(str, process.read_version(words) or ()))
        self.report({"INFO"}, f"mapctl {version}: {' '.join(words)}")
        return {"FINISHED"}


class MAPCTL_OT_preview_gap(bpy.types.Operator):
    """Take the preview range as the gap"""

    bl_idname = "mapctl.preview_gap"
    bl_label = "Gap from Preview Range"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own way

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return whether there is a preview range."""
        return context.scene.use_preview_range

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Take it."""
        gap = context.scene.mapctl.gap
        gap.first, gap.last = context.scene.frame_preview_start, context.scene.frame_preview_end
        return {"FINISHED"}


class MAPCTL_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of the add-on."""

    bl_idname = __package__ or ""

    command: StringProperty(
        name="mapctl",
        description="Program, or command as in: /path/to/python -m mapctl. Empty to look for it on the PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        """Draw them."""
        self.layout.prop(self, "command")
        self.layout.operator(MAPCTL_OT_find.bl_idname)
        self.layout.label(text="mapctl runs as a program of its own: pip install mapctl")


def read_command(context: bpy.types.Context) -> str:
    """Read the command of the preferences."""
    return context.preferences.addons[__package__ or ""].preferences.command


CLASSES = (
    MAPCTL_PG_walk,
    MAPCTL_PG_clean_up,
    MAPCTL_PG_gap,
    MAPCTL_PG_settings,
    MAPCTL_OT_find,
    MAPCTL_OT_preview_gap,
    MAPCTL_AP_preferences,
)
