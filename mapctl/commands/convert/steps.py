"""The steps of a conversion, in their order: read, frames, rig, frame rate, mirror, loop, feet, travel.

The frame rate comes before edits, so that a loop is a whole number of frames and planted feet are still in the frames
that are written; feet come after the loop, which moves them, and travel last, since both need it.
"""

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from mapctl import editing, retarget
from mapctl.commands.convert import Convert
from mapctl.commands.shared import inputs
from mapctl.commands.shared.frame_syntax import parse_range
from mapctl.editing import GroundTransform, Loop
from mapctl.editing.looping import Peaks
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.errors import RequestError
from mapctl.metrics import feet
from mapctl.motion import Motion
from mapctl.retarget import as_rig, identify_rig
from mapctl.retarget.carry import Changes, GroundMode, RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig


@dataclass(frozen=True, eq=False)
class Converted:
    """A converted motion."""

    motion: Motion
    """The motion, on its rig and in its layout."""
    rig: Rig | None = None
    """Its rig, as it was identified; None where nobody asked."""
    lines: tuple[str, ...] = ()
    """What was done to it, for the user."""
    cycle: GroundTransform | None = None
    """Travel by cycle, of a loop."""
    changes: Changes | None = None
    """What was changed on the way to another rig."""
    notes: tuple[str, ...] = ()
    """The same in sentences, as far as it is worth one."""


@dataclass(frozen=True)
class Conversion:
    """Parsed options, cheap to send to a process."""

    command: Convert
    """The command."""
    fps: Fraction | None
    """Frames per second of the result."""
    fps_in: Fraction | None
    """Frames per second of an .amc."""
    source_rig: Rig | None
    """Rig of what is read."""
    body: RiggedCharacter | None = None
    """Body that gets the motion; None for the canonical joints, or for the motion's own."""

    @staticmethod
    def of(command: Convert) -> "Conversion":
        """Parse the options; RequestError for those that are none or do not go together."""
        if command.in_place and command.root_motion:
            raise RequestError("--in-place takes the travel out and --root-motion puts it on the root; choose one")
        fps, fps_in = (None if text is None else parse_fps(text) for text in (command.fps, command.fps_in))
        return Conversion(command, fps, fps_in, inputs.read_rig(command.source_rig, command), read_body(command.rig))

    def convert(self, source: Path) -> Converted:
        """Read a file and convert it."""
        command = self.command
        done = self._cut(inputs.read_motion(source, self.source_rig, fps=self.fps_in, quiet=command.quiet))
        if command.rig is not None:
            done = transfer_to_rig(done.motion, self.body, self.source_rig, ground=command.ground)
            done = replace(done, lines=tuple(f"note: {note}" for note in done.notes))
        if self.fps is not None:
            done = replace(done, motion=done.motion.resample(self.fps))
        if command.mirror:
            done = replace(done, motion=editing.mirror(done.motion, done.rig))
        if command.loop:
            done = _loop(done)
        if command.plant_feet:
            done = _plant_feet(done)
        if command.in_place:
            done = replace(done, motion=editing.remove_travel(done.motion, done.rig, done.cycle))
        if command.root_motion:
            done = replace(done, motion=editing.move_travel_to_root(done.motion, done.rig, done.cycle))
        ending = (command.to or command.out.suffix).lstrip(".").lower()
        if ending == "vrma" and not getattr(done.motion.source, "humanoid", None):  # no other rig is one that it names
            done = replace(done, motion=retarget.to_canonical(done.motion, done.rig or self.source_rig)[0])
        return done

    def _cut(self, motion: Motion) -> Converted:
        """Cut the frames that are asked for, of a rig that the whole clip shows."""
        command = self.command
        edited = any((command.mirror, command.loop, command.plant_feet, command.in_place, command.root_motion))
        rig = self.source_rig
        if edited and command.rig is None:
            rig = as_rig(identify_rig(motion.skeleton, rig, motion=motion))
        if command.frames is None:
            return Converted(motion, rig)
        fps, frames = float(motion.fps), motion.num_frames
        start, stop = parse_range(command.frames, fps=fps, frames=frames, what="range of frames")
        return Converted(motion.slice(start, stop), rig)


def parse_fps(text: str) -> Fraction:
    """Parse a frame rate as a number or a fraction; RequestError for what is none or beyond 1000."""
    try:
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"a frame rate is a number, as 30, 29.97 or 30000/1001, got {text!r}") from None
    if not Fraction(1, 100) <= fps <= 1000:
        raise RequestError(f"the frame rate must be 0.01 to 1000, got {text}")
    return fps


def read_body(rig: str | None) -> RiggedCharacter | None:
    """Read the body that a --rig option names: of a clip, or a rig by name; None for `canonical` and without one.
    RequestError for rigs that are not known."""
    return None if rig in (None, "canonical") else RiggedCharacter.of(*inputs.read_rig_clip(rig))[1]


def transfer_to_rig(
    motion: Motion, body: RiggedCharacter | None, source_rig: Rig | None = None, *, ground: GroundMode = "fit"
) -> Converted:
    """Retarget a motion to a body in the layout of its file, or without one to the canonical joints; and note what
    could not be kept.

    A clip of the same skeleton stays as it is; others get their floor (see mapctl.retarget.carry), with stairs and
    platforms as `ground` says.
    """
    if body is None:
        return Converted(retarget.to_canonical(motion, source_rig)[0], retarget.load_rig("canonical"))
    found = retarget_motion(motion, body, source_rig, ground=ground)
    original = motion if motion.skeleton.matches(body.rigmap.rig_skeleton) else None
    on_rig = body.on_rig(found.motion, original=original, fingers=found.fingers)
    return Converted(on_rig, as_rig(body.rigmap), changes=found.changes, notes=found.notes)


def _loop(done: Converted) -> Converted:
    loop = editing.close_loop(done.motion, done.rig)
    return replace(done, motion=loop.motion, cycle=loop.travel, lines=(*done.lines, _describe_loop(loop)))


def _describe_loop(loop: Loop) -> str:
    cycle, motion = loop.cycle, loop.motion
    return (
        f"loop: frames {cycle.start}:{cycle.stop}, {motion.seconds:.2f} s, travel {loop.travel.distance:.2f} m; at the"
        f" seam the largest step is {100 * loop.seam.step:.1f} cm and the largest acceleration"
        f" {loop.seam.acceleration:.0f} m/s^2, {100 * loop.clip.step:.1f} cm and {loop.clip.acceleration:.0f} m/s^2"
        " in these frames of the clip"
    )


def _plant_feet(done: Converted) -> Converted:
    planted = editing.plant_feet(done.motion, done.rig, cycle=done.cycle)
    before, after = (_describe_feet(motion, done.rig) for motion in (done.motion, planted))
    return replace(done, motion=planted, lines=(*done.lines, f"feet: {before} before, {after} after"))


def _describe_feet(motion: Motion, rig: Rig | None) -> str:
    toes = feet.ToeMeasurements.of(RiggedMotion.of(motion, rig).positions("Toes"), float(motion.fps))
    peaks = Peaks.of(motion.joint_positions(), float(motion.fps))
    return (
        f"planted toes {100 * feet.contact_speed(toes):.1f} cm/s, skate {100 * feet.skate(toes):.1f} cm/s, largest step"
        f" {100 * peaks.step:.1f} cm and acceleration {peaks.acceleration:.0f} m/s^2"
    )
