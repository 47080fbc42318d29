"""Denoise a capture on any rig (rnn paper, section 5.4): what is to be believed, a proposal, and the MAP about it.

A network that has seen all kinds of motion proposes; what it leaves out and noise does not explain goes back in, so
that out of its depth it is no worse than a low-pass filter; the MAP stage puts the feet down. The result is on the
capture's own rig, at its own rate, with all of its frames.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from controllers.denoising.lead_pose import leads, led_by
from controllers.denoising.lead_transition import passage
from controllers.denoising.result import Denoised, joined
from controllers.denoising.segment import DenoiseSettings, Piece
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Denoiser
from mapctl.recording.inspection import examine
from mapctl.recording.masks import Mask, after, by_own_names, masked, part_of, written_back
from mapctl.retarget import settled, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

__all__ = ["DenoiseSettings", "Denoised", "begins_with_tpose", "denoise"]

SHORTEST = 8
"""Frames of a capture that noise can be told in."""
_TELLING = 3000  # frames that show what rig a capture is on
_PIECE, _SHARED = 60.0, 2.0  # seconds of a long capture that are cleaned at once, and that two pieces share


def denoise(
    motion: Motion,
    denoiser: Denoiser,
    *,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Denoised:
    """Denoise a motion on any rig that `mapctl.retarget.rigs` can tell, or on a given one; RequestError for others and
    for masks that do not fit.

    `denoiser` proposes (see priors.load_denoiser). Of `densities` the likeliest adds its likelihood to each window of
    the MAP stage. A T-pose in frame 0, as many captures begin with, stays. A long capture is cleaned in pieces that
    fade into each other, so memory beyond the capture's own does not grow with it. `progress` is called with frames
    done and all frames.
    """
    settings = settings or DenoiseSettings()
    masks = by_own_names(motion, masks, rig)
    masked(motion, masks)  # whole: of a piece they are cut to its frames
    # Told once: a piece may lack what shows the rig's T-pose.
    beginning, rigmap = to_canonical(_beginning(motion), rig)
    rig = settled(rigmap)
    lead = 1 if leads(_beginning(motion), beginning, rigmap) else 0
    mixed = passage(motion, rigmap) if lead else None
    wanted = (*masks, *(mixed.masks(motion.skeleton.names) if mixed else ()))
    frames = motion.num_frames - lead
    long, shared = (max(SHORTEST, round(seconds * float(motion.fps))) for seconds in (_PIECE, _SHARED))
    pieces: list[tuple[Denoised, int]] = []
    start = stop = 0
    while stop < frames:
        before, stop = stop, frames if frames - start <= long + shared else start + long
        part, hidden = motion.slice(lead + start, lead + stop), part_of(wanted, lead + start, lead + stop)
        if pieces:  # what the piece before made of lost joints is all that is known of them
            last, first = pieces[-1]
            part = written_back(part, last.motion.slice(start - first, before - first), hidden)
            hidden = after(hidden, before - start)
        pieces.append((_cleaned(part, denoiser, hidden, settings, densities, rig), start))
        start = stop - shared
        if progress is not None:
            progress(lead + stop, motion.num_frames)
    done = replace(joined(pieces), capture=motion.slice(lead, motion.num_frames), rig=rig)
    return led_by(motion, done, rigmap, mixed, masks) if mixed else done


def begins_with_tpose(motion: Motion, rig: Rig | None = None) -> bool:
    """Whether frame 0 is a T-pose, or the rig's rest pose, that the motion does not begin with."""
    beginning = _beginning(motion)
    return leads(beginning, *to_canonical(beginning, rig))


def _beginning(motion: Motion) -> Motion:
    """As much as is looked at to tell a rig."""
    return motion.slice(0, min(motion.num_frames, _TELLING))


def _cleaned(
    motion: Motion,
    denoiser: Denoiser,
    masks: Sequence[Mask],
    settings: DenoiseSettings,
    densities: Sequence[Any],
    rig: Rig,
) -> Denoised:
    began = time.perf_counter()
    examined = examine(motion, masks)
    if motion.num_frames < SHORTEST:
        nothing = torch.zeros(motion.num_frames, 2, dtype=torch.bool)
        believed = torch.zeros(motion.num_frames, CANONICAL.num_joints)
        note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
        return Denoised(
            motion, motion, examined.noise, examined.noise_root, (), nothing, believed, Ledger(), notes=(note,)
        )
    done = Piece(examined, denoiser, settings, rig).run(densities)
    return replace(done, seconds=time.perf_counter() - began)
