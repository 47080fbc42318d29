"""`mapctl infill`: missing frames and joints of a motion are filled in."""

from collections.abc import Sequence

import torch

import priors
from controllers.inbetweening.infill import InbetweenSolution, InfillSettings, infill, retraced
from controllers.inbetweening.proposers import build_inbetweener
from mapctl import report
from mapctl.commands.infill import Infill
from mapctl.commands.shared import inputs, licensing, options, results
from mapctl.commands.shared.exit_status import conclude
from mapctl.commands.shared.frame_syntax import parse_ranges
from mapctl.commands.shared.style import read_dna
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.gap_detection import find_gaps
from mapctl.recording.masks import ALL, ROOT, Mask
from mapctl.retarget.rigs import Rig


def run(command: Infill) -> int:
    """Check everything, fill, write, report."""
    _check(command)
    rig = inputs.read_rig(command.rig, command)
    motion, marked, has_gaps = inputs.read_motion_with_gaps(command.source, rig, quiet=command.quiet)
    ways = _parse_ways(command, motion)
    masks = (*marked, *_parse_masks(command, motion)) or (() if has_gaps or ways else find_gaps(motion))
    done = _run_infilling(command, motion, masks, ways, rig)
    licensing.save_motion(done.motion, command.out)
    if command.report is not None:
        report.write_report(results.build_report("infill", command, done), command.report)
    results.film_comparison(motion, done.motion, command.video, rig=rig, quiet=command.quiet)
    if not command.quiet:
        _tell(command, done)
    return conclude(done.status, strict=command.strict)


def _check(command: Infill) -> None:
    options.check_seed(command.seed)
    if command.way and command.curve is not None:
        raise RequestError("--way and --curve both say where the hips go; choose one")
    if command.path is not None and not command.way and not results.takes_path(command.method, command.inbetweener):
        raise RequestError("--path predicts the hips' place for --way and for --method tweener; leave it out")
    if command.curve is not None and command.method in ("slerp", "rollouts"):
        raise RequestError(f"--curve needs the steps that a network makes; leave --method {command.method} out")
    if command.curve is not None and command.dna is not None:
        raise RequestError("--dna says how to move and --curve where; only one of them can be had, leave the other out")
    finish, prior = not command.no_finish, command.prior
    results.check_method(
        command.method, finish=finish, prior=prior, inbetweener=command.inbetweener, stitcher=command.stitcher
    )
    results.check_destinations(command.out, command.video, command.report, given=(command.source,))


def _parse_masks(command: Infill, motion: Motion) -> Sequence[Mask]:
    """Parse the masks of the options; RequestError for impossible ones."""
    if not command.gap and command.joints is None:
        return ()
    gaps = parse_ranges(command.gap, fps=float(motion.fps), frames=motion.num_frames) or [(0, motion.num_frames)]
    names = [ALL] if command.joints is None else [name.strip() for name in command.joints.split(",")]
    return [Mask(name, start, stop) for start, stop in gaps for name in names]


def _parse_ways(command: Infill, motion: Motion) -> Sequence[Mask]:
    """Parse the frames in which the hips' place is lost; RequestError for impossible ones."""
    ways = parse_ranges(command.way, fps=float(motion.fps), frames=motion.num_frames, what="way")
    return [Mask(ROOT, start, stop) for start, stop in ways]


def _run_infilling(
    command: Infill, motion: Motion, masks: Sequence[Mask], ways: Sequence[Mask], rig: Rig | None
) -> InbetweenSolution:
    settings, densities = InfillSettings(finish=not command.no_finish), priors.load_choice(command.prior)
    generator = torch.Generator().manual_seed(command.seed)
    if ways:
        return retraced(
            motion,
            priors.load_path(command.path or "path"),
            (*masks, *ways),
            # Where no pose is missing the network that would propose them need not be there.
            inbetweener=_build_inbetweener(command) if any(mask.joint != ROOT for mask in masks) else None,
            settings=settings,
            densities=densities,
            rig=rig,
            generator=generator,
        )
    return infill(
        motion,
        _build_inbetweener(command),
        masks,
        settings=settings,
        densities=densities,
        rig=rig,
        curve=None if command.curve is None else inputs.read_curve(command.curve, None),
        generator=generator,
    )


def _build_inbetweener(command: Infill) -> Inbetweener:
    dna = read_dna(command.dna, command.method)
    return build_inbetweener(
        command.method, results.load_models(command.inbetweener, command.prior, command.path, dna, command.stitcher)
    )


def _tell(command: Infill, done: InbetweenSolution) -> None:
    gaps = ", ".join(
        f"{gap['start']}:{gap['stop']} ({gap['joints']} joints)"
        if gap["joints"]
        else f"{gap['start']}:{gap['stop']} (the hips' place)"
        for gap in done.list_gaps()
    )
    print(
        f"{command.out}: {done.motion.num_frames} frames at {float(done.motion.fps):.6g} a second; filled {gaps};"
        f" {done.frame_ms:.1f} ms a filled frame"
    )
    for note in (*done.notes, *done.gap_notes):
        print(note)
