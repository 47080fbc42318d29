"""`mapctl blend`: a hand or foot of one clip moves as in another for some frames."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import priors
from controllers.inbetweening.blend import LimbTransfer, blend
from controllers.inbetweening.pipeline import INFILL_REFINEMENT
from mapctl.commands.shared import inputs, options, results
from mapctl.commands.shared.command import ModelCommand, conclude


@dataclass(frozen=True)
class Blend(ModelCommand, options.RigOptions):
    """Hands or feet of a clip move as in another one for some frames: a walk that reaches or waves."""

    source: options.InFile
    """A motion file."""
    other: Annotated[Path, arg(name="from", metavar="CLIP")]
    """The other clip, of any known rig; resampled to IN's frame rate."""
    joints: Annotated[str, arg(metavar="NAME,NAME")]
    """Hands and feet, by the names of IN's rig or the canonical ones."""
    frames: Annotated[str, arg(metavar="A:B")]
    """Frames of the other clip, at its own rate, or seconds as in 2s:2.5s."""
    at: Annotated[str, arg(metavar="FRAME")]
    """First frame in IN, or seconds as in 1.5s."""
    out: options.OutFile
    """Output file."""
    margin: options.MaybeNumber = None
    """Seconds before and after in which the limb goes there and back; by its distance if not given."""
    no_refine: bool = False
    """Leave the proposal as it is, on rigid bones: no MAP stage plants the feet."""
    inbetweener: options.Name = "transformer"
    """A bundled in-betweener, or the file or run folder of a trained one."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif, .webp or .png."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: a margin too short for the limb."""
    quiet: options.Quiet = False


def run(command: Blend) -> int:
    results.check_destinations(command.out, command.video, given=(command.source, command.other))
    rig = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(command.source, rig, quiet=command.quiet)
    other = inputs.read_motion(command.other, None, quiet=command.quiet)
    fps, count = float(other.fps), other.num_frames
    start, stop = options.parse_range(command.frames, fps=fps, frames=count, what="range of --frames")
    names = tuple(name.strip() for name in command.joints.split(","))
    at = options.parse_frame(command.at, fps=float(motion.fps))
    transfer = LimbTransfer(names, start, stop, at, margin=command.margin)
    refinement = None if command.no_refine else INFILL_REFINEMENT
    done = blend(motion, other, transfer, priors.load_inbetweener(command.inbetweener), refinement=refinement, rig=rig)
    results.write_result("blend", command, done, motion, rig=rig)
    if not command.quiet:
        print("\n".join((f"{command.out}: {done.motion.num_frames} frames", *done.notes)))
    return conclude(done.status, strict=command.strict)
