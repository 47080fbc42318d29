"""`mapctl blend`: a hand or foot of one clip moves as in another for some frames."""

import priors
from controllers.inbetweening.blend import LimbTransfer, blend
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.commands.blend import Blend
from mapctl.commands.shared import inputs, licensing, results
from mapctl.commands.shared.exit_status import conclude
from mapctl.commands.shared.frame_syntax import parse_frame, parse_range


def run(command: Blend) -> int:
    """Check everything, blend, write, report."""
    results.check_destinations(command.out, command.video, given=(command.source, command.other))
    rig = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(command.source, rig, quiet=command.quiet)
    other = inputs.read_motion(command.other, None, quiet=command.quiet)
    start, stop = parse_range(command.frames, fps=float(other.fps), frames=other.num_frames, what="range of --frames")
    names = tuple(name.strip() for name in command.joints.split(","))
    transfer = LimbTransfer(names, start, stop, parse_frame(command.at, fps=float(motion.fps)), margin=command.margin)
    settings = InfillSettings(finish=not command.no_finish)
    done = blend(motion, other, transfer, priors.load_inbetweener(command.inbetweener), settings=settings, rig=rig)
    licensing.save_motion(done.motion, command.out)
    results.film_comparison(motion, done.motion, command.video, rig=rig, quiet=command.quiet)
    if not command.quiet:
        print("\n".join((f"{command.out}: {done.motion.num_frames} frames", *done.notes)))
    return conclude(done.status, strict=command.strict)
