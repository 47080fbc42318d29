"""`mapctl chain`: one long motion through pieces of many clips."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tyro.conf import arg

from controllers.inbetweening.infill import chain
from controllers.inbetweening.pipeline import INFILL_REFINEMENT
from controllers.inbetweening.proposers import build_inbetweener
from mapctl.commands.shared import inputs, options, outputs, results
from mapctl.commands.shared.command import ModelCommand
from mapctl.errors import RequestError
from mapctl.retarget import to_canonical
from scenes.film import film


@dataclass(frozen=True)
class Chain(ModelCommand, options.RigOptions, options.ProposalOptions):
    """One long motion through short pieces of many clips, the gaps between them filled in; on the first clip's rig."""

    clips: tyro.conf.Positional[Annotated[tuple[Path, ...], arg(metavar="CLIP CLIP ...")]]
    """Motion files, of any known rigs."""
    out: options.OutFile
    """Output file, at 30 frames a second."""
    piece: options.Count = 40
    """Frames of a piece, from the middle of every clip."""
    gap: Annotated[str, arg(metavar="A:B")] = "50:100"
    """Frames between two pieces: sampled from A to B."""
    seed: options.Count = 0
    """Seed of the gaps' lengths and of what rollouts sample."""
    video: options.MaybeFile = None
    """Film of the motion: .mp4, .gif, .webp or .png."""
    quiet: options.Quiet = False


def run(command: Chain) -> int:
    options.check_seed(command.seed)
    results.check_proposal(command)
    results.check_destinations(command.out, command.video, given=command.clips)
    low, colon, high = command.gap.partition(":")
    if not (colon and low.isdecimal() and high.isdecimal()):
        raise RequestError(f"--gap is A:B, frames as in 50:100; got {command.gap!r}")
    rig = inputs.read_rig(command.rig, command)
    done = chain(
        [inputs.read_motion(path, rig, quiet=command.quiet) for path in command.clips],
        build_inbetweener(command.method, results.load_models(command)),
        piece=command.piece,
        gap=(int(low), int(high)),
        refinement=None if command.no_refine else INFILL_REFINEMENT,
        rig=rig,
        generator=torch.Generator().manual_seed(command.seed),
    )
    outputs.save_motion(done.motion, command.out)
    if command.video is not None:
        with outputs.show_progress("filming", quiet=command.quiet) as progress:
            film([(to_canonical(done.motion, rig)[0], None)], command.video, progress=progress)
    if not command.quiet:
        filled = int(done.missing.frames.sum())
        print(
            f"{command.out}: {done.motion.num_frames} frames, {filled} of them filled in between {len(command.clips)}"
            f" clips; {done.frame_ms:.1f} ms a filled frame"
        )
        for note in (*done.notes, *done.gap_notes):
            print(note)
    return 0
