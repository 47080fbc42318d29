"""Preferences, options, operators and the panel in the sidebar of the 3D view.

In the interface operators run beside it, until Esc; in the background they return when done.
"""

# Blender reads properties from annotations, which are calls.
# pyright: reportInvalidTypeForm=false

import textwrap
import time
from collections.abc import Callable
from contextlib import ExitStack

import bpy
from bpy.props import BoolProperty, FloatProperty, IntProperty, StringProperty

from . import actions, jobs, process
from .process import AddonError, Step


class WalkProperties:
    """Options of the walk along a curve."""

    speed: FloatProperty(name="Speed", description="Metres a second; 0 for the usual speed", min=0, soft_max=4)
    seconds: FloatProperty(name="Seconds", description="Duration; 0 for once along the curve", min=0, soft_max=120)
    gait: StringProperty(name="Gait", description="Gait of the prior, as walk or run; empty for any")
    style: StringProperty(name="Style", description="Style of the prior; empty for any")
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


class MAPCTL_PG_settings(WalkProperties, CleanUpProperties, GapProperties, bpy.types.PropertyGroup):
    """Options of all operators, of a scene."""


class MAPCTL_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of the add-on."""

    bl_idname = __package__ or ""

    command: StringProperty(
        name="mapctl",
        description="Program, or command as in: /path/to/python -m mapctl. Empty to look for it on the PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "command")
        self.layout.label(text="mapctl runs as a program of its own: pip install mapctl")


def read_command(context: bpy.types.Context) -> str:
    return context.preferences.addons[__package__ or ""].preferences.command


_TICK = 0.1  # seconds between two looks at a job
_SLICE = 0.08  # seconds that a job may take of each
_VIEW_EVENTS = {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "MOUSEMOVE", "TRACKPADPAN", "TRACKPADZOOM"}
_SHOWN_LINES = 8


class Report:
    """State of the running job, or of the last one, as the panel shows it."""

    step: Step | None = None
    """How far the job that runs is; None while none runs."""
    lines: tuple[str, ...] = ()
    failed: bool = False
    """Whether they are why nothing was done."""


class JobOperator:
    """Base of operators: runs a job to its end, and reports it."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own way
    report: Callable[[set[str], str], None]
    """Blender's message to the user."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return whether an armature is active and no job runs."""
        if context.object is None or context.object.type != "ARMATURE" or context.object.mode not in ("OBJECT", "POSE"):
            cls.poll_message_set("needs an active armature in Object or Pose Mode")  # pyright: ignore
            return False
        return Report.step is None

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Check what is requested and begin the job; AddonError where it cannot be done."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        wm = context.window_manager
        wm.progress_begin(0, 100)
        try:
            job = self._begin(context)
            while (step := self._advance(job)) is not None:
                _show(context, step)
                if step.idle:
                    time.sleep(_TICK / 2)
        finally:
            wm.progress_end()
            Report.step = None
        return self._conclude(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Run the job beside the interface."""
        return self.execute(context) if bpy.app.background else self.start(context)

    def start(self, context: bpy.types.Context) -> set[str]:
        """Begin the job, with a timer that takes it on. What is selected counts now."""
        self._job = self._begin(context)
        step = self._advance(self._job)
        if step is None:
            return self._conclude(context)
        Report.step = step
        context.window_manager.progress_begin(0, 100)
        self._timer = context.window_manager.event_timer_add(_TICK, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Go on with the job; nothing but the view can be changed meanwhile, so that all is undone in one step."""
        if event.type == "ESC":
            self.cancel(context)
            self._report(("cancelled: nothing was changed",), failed=True)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"} if event.type in _VIEW_EVENTS else {"RUNNING_MODAL"}
        with ExitStack() as ending:
            ending.callback(self._leave, context)
            step = self._advance_for(self._job, _SLICE)
            if step is not None:
                ending.pop_all()
        if step is None:
            return self._conclude(context)
        Report.step = step
        _show(context, step)
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the job and its process: on Esc, and where Blender closes the file."""
        self._job.close()
        self._leave(context)

    def _leave(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)
        Report.step = None
        _redraw(context)

    def _begin(self, context: bpy.types.Context) -> jobs.Job:
        """Begin the job; what is wrong comes out of its first step, so that it is reported in one place."""
        self._lines, self._warnings, self._problem = (), (), ""

        def run() -> jobs.Job:
            command = process.find_command(read_command(context))
            at = jobs.Scene(context.scene, context.object, command)
            return (yield from self.prepare(context, at))

        return run()

    def _advance(self, job: jobs.Job) -> Step | None:
        """Take the next step; None at the end."""
        try:
            return next(job)
        except StopIteration as end:
            self._lines, self._warnings = end.value
        except AddonError as problem:
            self._problem = str(problem)
        return None

    def _advance_for(self, job: jobs.Job, seconds: float) -> Step | None:
        """Take steps for a while, but no more once the job waits; None at the end."""
        until = time.monotonic() + seconds
        step = self._advance(job)
        while step is not None and not step.idle and time.monotonic() < until:
            step = self._advance(job)
        return step

    def _conclude(self, context: bpy.types.Context) -> set[str]:
        lines = (self._problem,) if self._problem else (*self._warnings, *self._lines)
        self._report(lines, failed=bool(self._problem))
        if self._problem:
            self.report({"ERROR"}, self._problem)
            return {"CANCELLED"}
        for line in self._warnings:
            self.report({"WARNING"}, line)
        self.report({"INFO"}, f"new action: {context.object.animation_data.action.name}")
        return {"FINISHED"}

    def _report(self, lines: tuple[str, ...], *, failed: bool) -> None:
        Report.lines, Report.failed = lines[:_SHOWN_LINES], failed


class MAPCTL_OT_walk(JobOperator, WalkProperties, bpy.types.Operator):
    """Let the active armature walk along the selected curve, as a new action from the scene's first frame on"""

    bl_idname = "mapctl.walk"
    bl_label = "Walk along Curve"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        drawn = [each for each in context.selected_objects if each.type == "CURVE"]
        if len(drawn) != 1:
            raise AddonError(f"select the armature and one curve; {len(drawn)} curves are selected")
        words = ["--seed", str(self.seed)]
        for name, value in (("--speed", self.speed), ("--seconds", self.seconds)):
            words += [name, f"{value:.6g}"] if value > 0 else []
        named = [(name, value.strip()) for name, value in (("--gait", self.gait), ("--style", self.style))]
        words += [word for name, value in named if value for word in (name, value)]
        return jobs.walk_along(at, drawn[0], words)


class MAPCTL_OT_clean_up(JobOperator, CleanUpProperties, bpy.types.Operator):
    """Denoise the armature's action, as a new action"""

    bl_idname = "mapctl.clean_up"
    bl_label = "Clean up"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        return jobs.clean_up(at, find_frames(at), anchor=self.anchor)


class MAPCTL_OT_fill_gap(JobOperator, GapProperties, bpy.types.Operator):
    """Fill frames of the armature's action with new motion, as a new action; all other frames stay"""

    bl_idname = "mapctl.fill_gap"
    bl_label = "Fill Gap"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Find the gap, and the joints if only some are requested."""
        selected = [bone.name for bone in context.selected_pose_bones or ()] if self.selected else []
        joints = jobs.name_joints(at, selected) if self.selected else []
        return jobs.fill_gap(at, find_frames(at), range(self.first, self.last + 1), joints)


class MAPCTL_OT_in_between(JobOperator, bpy.types.Operator):
    """Make the motion between the keyed frames of the armature's action, as a new action; generated keys are no keys"""

    bl_idname = "mapctl.in_between"
    bl_label = "In-between Keys"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        keyed = [frame for frame, own in actions.list_keys(at.armature).items() if own]
        return jobs.fill_between_keys(at, keyed)


def find_frames(at: jobs.Scene) -> range:
    """Find the frames from the first to the last key of the action's bones; AddonError for fewer than two."""
    keyed = list(actions.list_keys(at.armature))
    if len(keyed) < 2:
        name = actions.find_action(at.armature).name
        raise AddonError(f"{name} has keys of bones in {len(keyed)} frames: a motion has two or more")
    return range(keyed[0], keyed[-1] + 1)


def _show(context: bpy.types.Context, step: Step) -> None:
    if step.total:
        context.window_manager.progress_update(100 * step.done // step.total)
    if not bpy.app.background and context.workspace:
        context.workspace.status_text_set(f"mapctl: {step.describe()} (Esc to cancel)")
        _redraw(context)


def _redraw(context: bpy.types.Context) -> None:
    for area in context.screen.areas if context.screen else ():
        if area.type == "VIEW_3D":
            area.tag_redraw()


_WIDTH = 44  # characters of a line of the panel, about


class MAPCTL_PT_sidebar(bpy.types.Panel):
    """All operators with their options, and what happened last."""

    bl_label = "mapctl"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "mapctl"

    def draw(self, context: bpy.types.Context) -> None:
        for operator, options in (
            (MAPCTL_OT_walk, WalkProperties),
            (MAPCTL_OT_clean_up, CleanUpProperties),
            (MAPCTL_OT_fill_gap, GapProperties),
            (MAPCTL_OT_in_between, object),
        ):
            column, settings = self.layout.box().column(align=True), context.scene.mapctl
            names = tuple(getattr(options, "__annotations__", ()))
            for name in names:
                column.prop(settings, name)
            button = column.operator(operator.bl_idname)
            for name in names:
                setattr(button, name, getattr(settings, name))
        self._draw_report()

    def _draw_report(self) -> None:
        column = self.layout.column(align=True)
        if Report.step is not None:
            column.label(text=Report.step.describe(), icon="TIME")
            column.label(text="Esc to cancel")
            return
        icon = "ERROR" if Report.failed else "INFO"
        for line in Report.lines:
            for number, part in enumerate(textwrap.wrap(line, _WIDTH)):
                column.label(text=part, icon="BLANK1" if number else icon)


CLASSES = (
    MAPCTL_PG_settings,
    MAPCTL_AP_preferences,
    MAPCTL_OT_walk,
    MAPCTL_OT_clean_up,
    MAPCTL_OT_fill_gap,
    MAPCTL_OT_in_between,
    MAPCTL_PT_sidebar,
)
