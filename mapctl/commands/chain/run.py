"""`mapctl chain`: one long motion through pieces of many clips."""

import torch

from controllers.inbetweening.chain import ChainSettings, chain
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import build_inbetweener
from mapctl.commands.chain import Chain
from mapctl.commands.shared import inputs, licensing, options, results
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.shared.style import read_dna
from mapctl.errors import RequestError
from mapctl.retarget import to_canonical
from scenes.film import film


def run(command: Chain) -> int:
    """Check everything, chain, write, report."""
    options.check_seed(command.seed)
    results.check_method(
        command.method, finish=not command.no_finish, inbetweener=command.inbetweener, stitcher=command.stitcher
    )
    results.check_destinations(command.out, command.video, given=command.clips)
    if command.path is not None and not results.takes_path(command.method, command.inbetweener):
        raise RequestError("--path predicts where the hips go for --method tweener; leave it out")
    dna = read_dna(command.dna, command.method)
    settings = ChainSettings(piece=command.piece, gap=_parse_gap(command))
    rig = inputs.read_rig(command.rig, command)
    done = chain(
        [inputs.read_motion(path, rig, quiet=command.quiet) for path in command.clips],
        build_inbetweener(
            command.method, results.load_models(command.inbetweener, None, command.path, dna, command.stitcher)
        ),
        settings=settings,
        filling=InfillSettings(finish=not command.no_finish),
        rig=rig,
        generator=torch.Generator().manual_seed(command.seed),
    )
    licensing.save_motion(done.motion, command.out)
    if command.video is not None:
        with show_progress("filming", quiet=command.quiet) as progress:
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


def _parse_gap(command: Chain) -> tuple[int, int]:
    low, colon, high = command.gap.partition(":")
    if not (colon and low.isdecimal() and high.isdecimal()):
        raise RequestError(f"--gap is A:B, frames as in 50:100; got {command.gap!r}")
    return int(low), int(high)
