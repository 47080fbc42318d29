"""`mapctl infill`: missing frames and joints of a motion are filled in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from tyro.conf import UseAppendAction, arg

import priors
from controllers.inbetweening.infill import infill, retraced
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, FillOptions, InbetweenSolution
from controllers.inbetweening.proposers import build_inbetweener
from mapctl import curves
from mapctl.commands.shared import inputs, options, results
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.recording.inspection import find_gaps
from mapctl.recording.masks import ALL, ROOT, Mask
from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class Infill(ModelCommand, options.RigOptions, options.ProposalOptions):
    """Fill in missing frames or joints of a motion; all else stays as it was. On any known rig."""

    source: options.InFile
    """A motion file."""
    out: options.OutFile
    """Output file."""
    gap: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds as in 2s:4s; may be given several times. Their values are ignored.
    What is nan in IN is missing as well; where nothing is, and there are no gaps and joints, frozen and leaping frames
    are detected."""
    way: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="A:B")] = ()
    """Frames from A up to B (exclusive), or seconds, in which the position of the hips is lost and predicted from how
    the body moves: treadmills, drifting sensors, poses from video. May be given several times, alone or with gaps,
    whose poses are filled first; all frames may be lost so."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Only these joints are missing, canonical names or the rig's own: in the gaps, or throughout if there are none."""
    curve: options.MaybeCurve = None
    """Trajectory of the hips in the gaps: a CSV or SVG file, or a shape, that passes within 1 m of where each begins
    and ends."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier. It extrapolates a gap at the end (`auto` if none is
    named), where the frames before are likely under it."""
    report: options.MaybeFile = None
    """JSON with the gaps, contacts, ledger, measures and compute."""
    video: options.MaybeFile = None
    """Film of the given motion and the filled one side by side: .mp4, .gif, .webp or .png."""
    seed: options.Count = 0
    """Seed of what rollouts sample."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds."""
    quiet: options.Quiet = False


def run(command: Infill) -> int:
    options.check_seed(command.seed)
    if command.way and command.curve is not None:
        raise RequestError("--way and --curve both give the hips' trajectory; choose one")
    if command.curve is not None and command.method in ("slerp", "rollouts"):
        raise RequestError(f"--curve needs the steps that a network makes; leave --method {command.method} out")
    if command.curve is not None and command.dna is not None:
        raise RequestError("--dna gives a style and --curve a trajectory; leave one of them out")
    results.check_proposal(command, prior=command.prior, way=bool(command.way))
    results.check_destinations(command.out, command.video, command.report, given=(command.source,))
    rig = inputs.read_rig(command.rig, command)
    motion, marked, has_gaps = inputs.read_motion_with_gaps(command.source, rig, quiet=command.quiet)
    fps, frames = float(motion.fps), motion.num_frames
    ways = [Mask(ROOT, *way) for way in options.parse_ranges(command.way, fps=fps, frames=frames, what="way")]
    gaps, names = options.parse_ranges(command.gap, fps=fps, frames=frames), [ALL]
    if command.joints is not None:
        gaps, names = gaps or [(0, frames)], [name.strip() for name in command.joints.split(",")]
    masks = (*marked, *(Mask(name, *gap) for gap in gaps for name in names))
    if not (masks or has_gaps or ways):
        masks = find_gaps(motion)
    done = _run_infilling(command, motion, masks, ways, rig)
    results.write_result("infill", command, done, motion, rig=rig)
    if not command.quiet:
        filled = ", ".join(
            f"{gap['start']}:{gap['stop']} ({gap['joints']} joints)"
            if gap["joints"]
            else f"{gap['start']}:{gap['stop']} (the hips' position)"
            for gap in done.list_gaps()
        )
        print(
            f"{command.out}: {frames} frames at {fps:.6g} a second; filled {filled}; {done.frame_ms:.1f} ms a filled"
            " frame"
        )
        print("".join(f"{note}\n" for note in (*done.notes, *done.gap_notes)), end="")
    return conclude(done.status, strict=command.strict)


def _run_infilling(
    command: Infill, motion: Motion, masks: Sequence[Mask], ways: Sequence[Mask], rig: Rig | None
) -> InbetweenSolution:
    shared = FillOptions(
        refinement=None if command.no_refine else INFILL_REFINEMENT,
        densities=priors.load_choice(command.prior),
        rig=rig,
        generator=torch.Generator().manual_seed(command.seed),
    )
    inbetweener = None
    # Where no pose is missing the network that would propose them need not be there.
    if not ways or any(mask.joint != ROOT for mask in masks):
        inbetweener = build_inbetweener(command.method, results.load_models(command, prior=command.prior))
    if ways or inbetweener is None:
        path = priors.load_path(command.path or "path")
        return retraced(motion, path, (*masks, *ways), inbetweener=inbetweener, **shared)
    curve = None if command.curve is None else curves.read(command.curve)
    return infill(motion, inbetweener, masks, curve=curve, **shared)
