"""`mapctl convert`: any format to any format, other bones, another frame rate."""

from fractions import Fraction

from mapctl import formats, retarget
from mapctl.commands.convert import Convert
from mapctl.commands.shared import inputs, outputs
from mapctl.commands.shared.frame_syntax import parse_range
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.retarget.carry import RetargetedMotion, RiggedCharacter, retarget_motion
from mapctl.retarget.recognition.doubts import assess_fit
from mapctl.retarget.rigs import Rig


def run(command: Convert) -> int:
    """Read, convert, write."""
    formats.check_ending(command.out)
    outputs.check_files([command.out])
    fps = None if command.fps is None else parse_fps(command.fps)
    source_rig = inputs.read_rig(command.source_rig)
    fps_in = None if command.fps_in is None else parse_fps(command.fps_in)
    motion, notes = inputs.read_motion(command.source, source_rig, fps=fps_in), []
    if command.frames is not None:
        start, stop = parse_range(
            command.frames, fps=float(motion.fps), frames=motion.num_frames, what="range of frames"
        )
        motion = motion.slice(start, stop)
    if command.rig is not None:
        doubts = describe_doubts(motion, source_rig)
        retargeted = transfer_to_rig(motion, command.rig, source_rig)
        motion, notes = retargeted.motion, [*doubts, *retargeted.notes]
    if fps is not None:
        motion = motion.resample(fps)
    formats.save(motion, command.out)
    rate = f"{float(motion.fps):.6g} frames a second"
    print(f"{command.out}: {motion.num_frames} frames, {motion.num_joints} joints, {rate}")
    for note in notes:
        print(f"note: {note}")
    return 0


def parse_fps(text: str) -> Fraction:
    """Parse a frame rate as a number or a fraction; RequestError for what is none or beyond 1000."""
    try:
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"a frame rate is a number, as 30, 29.97 or 30000/1001, got {text!r}") from None
    if not Fraction(1, 100) <= fps <= 1000:
        raise RequestError(f"the frame rate must be 0.01 to 1000, got {text}")
    return fps


def describe_doubts(motion: Motion, rig: Rig | None) -> list[str]:
    """Describe in one note what is doubtful about how a motion's rig is understood; empty where nothing is."""
    doubts = assess_fit(retarget.identify_rig(motion.skeleton, rig, motion=motion), motion).doubts
    more = f", and {len(doubts) - 1} more" if len(doubts) > 1 else ""
    return [f"the rig of IN is doubtful: {doubt.reason}{more}; see mapctl info IN" for doubt in doubts[:1]]


def transfer_to_rig(motion: Motion, rig: str, source_rig: Rig | None = None) -> RetargetedMotion:
    """Retarget a motion to the canonical joints, to a clip's skeleton in that clip's layout, or to a named rig; and
    note what could not be kept.

    RequestError for rigs that are not known. A clip of the same skeleton stays as it is; others get their floor
    (see mapctl.retarget.carry).
    """
    if rig == "canonical":
        return RetargetedMotion(retarget.to_canonical(motion, source_rig)[0])
    body = RiggedCharacter.of(*inputs.read_rig_clip(rig))[1]
    retargeted = retarget_motion(motion, body, source_rig)
    return RetargetedMotion(body.on_rig(retargeted.motion), retargeted.notes)
