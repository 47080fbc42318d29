"""The four operators. In the interface they run beside it, until Esc; in the background they return when done."""

# pyright: reportInvalidTypeForm=false

import time
from collections.abc import Callable

import bpy

from . import jobs, process
from .problem import AddonError, Step
from .scene import actions
from .settings import BetweenProperties, CleanUpProperties, GapProperties, WalkProperties, read_command

_TICK = 0.1  # seconds between two looks at a job
_SLICE = 0.08  # seconds that a job may take of each
_VIEW_EVENTS = {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "MOUSEMOVE", "TRACKPADPAN", "TRACKPADZOOM"}
_SHOWN_LINES = 8


class Report:
    """What the panel tells: of a job that runs, or of the last one."""

    step: Step | None = None
    """How far the job that runs is; None while none runs."""
    lines: tuple[str, ...] = ()
    """What was told last."""
    failed: bool = False
    """Whether that is why nothing was done."""


class JobOperator:
    """Base of operators: runs a job to its end, and tells of it."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own way
    report: Callable[[set[str], str], None]
    """Blender's way to tell the user something."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return whether an armature is active and no job runs."""
        if context.object is None or context.object.type != "ARMATURE" or context.object.mode not in ("OBJECT", "POSE"):
            cls.poll_message_set("needs an active armature in Object or Pose Mode")  # pyright: ignore
            return False
        return Report.step is None

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Check what is asked for and begin the job; AddonError where it cannot be done."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run the job to its end."""
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
            self._tell(("cancelled: nothing was changed",), failed=True)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"} if event.type in _VIEW_EVENTS else {"RUNNING_MODAL"}
        try:
            step = self._advance_for(self._job, _SLICE)
        except BaseException:
            self._leave(context)
            raise
        if step is not None:
            Report.step = step
            _show(context, step)
            return {"RUNNING_MODAL"}
        self._leave(context)
        return self._conclude(context)

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
        """Begin the job; what is wrong comes out of its first step, so that it is told in one place."""
        self._outcome = jobs.Outcome(())
        self._problem = ""

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
            self._outcome = end.value
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
        told = (self._problem,) if self._problem else (*self._outcome.warnings, *self._outcome.lines)
        self._tell(told, failed=bool(self._problem))
        if self._problem:
            self.report({"ERROR"}, self._problem)
            return {"CANCELLED"}
        for line in self._outcome.warnings:
            self.report({"WARNING"}, line)
        self.report({"INFO"}, f"new action: {context.object.animation_data.action.name}")
        return {"FINISHED"}

    def _tell(self, lines: tuple[str, ...], *, failed: bool) -> None:
        Report.lines, Report.failed = lines[:_SHOWN_LINES], failed


class MAPCTL_OT_walk(JobOperator, WalkProperties, bpy.types.Operator):
    """Let the active armature walk along the selected curve, as a new action from the scene's first frame on"""

    bl_idname = "mapctl.walk"
    bl_label = "Walk along Curve"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Find the curve."""
        drawn = [each for each in context.selected_objects if each.type == "CURVE"]
        if len(drawn) != 1:
            raise AddonError(f"select the armature and one curve; {len(drawn)} curves are selected")
        options = jobs.WalkOptions(self.speed, self.seconds, self.gait.strip(), self.style.strip(), self.seed)
        return jobs.walk_along(at, drawn[0], options)


class MAPCTL_OT_clean_up(JobOperator, CleanUpProperties, bpy.types.Operator):
    """Denoise the armature's action, as a new action"""

    bl_idname = "mapctl.clean_up"
    bl_label = "Clean up"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Find the frames."""
        return jobs.clean_up(at, find_frames(at), anchor=self.anchor)


class MAPCTL_OT_fill_gap(JobOperator, GapProperties, bpy.types.Operator):
    """Fill frames of the armature's action with new motion, as a new action; all other frames stay"""

    bl_idname = "mapctl.fill_gap"
    bl_label = "Fill Gap"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Find the gap, and the joints if only some are asked for."""
        selected = [bone.name for bone in context.selected_pose_bones or ()] if self.selected else []
        joints = jobs.name_joints(at, selected) if self.selected else []
        return jobs.fill_gap(at, find_frames(at), range(self.first, self.last + 1), joints)


class MAPCTL_OT_in_between(JobOperator, BetweenProperties, bpy.types.Operator):
    """Make the motion between the keyed frames of the armature's action, as a new action; generated keys are no keys"""

    bl_idname = "mapctl.in_between"
    bl_label = "In-between Keys"

    def prepare(self, context: bpy.types.Context, at: jobs.Scene) -> jobs.Job:
        """Find the keyed frames."""
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


OPERATORS = (MAPCTL_OT_walk, MAPCTL_OT_clean_up, MAPCTL_OT_fill_gap, MAPCTL_OT_in_between)
