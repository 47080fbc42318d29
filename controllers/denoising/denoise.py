"""Denoise a capture on any rig (Wang et al. 2019, section 5.4): inspection, a proposal, and the MAP stage about it.

A network that has seen all kinds of motion proposes; what it leaves out and noise does not explain goes back in, so
that out of its depth it is no worse than a low-pass filter; the MAP stage puts the feet down. The result is on the
capture's own rig, at its own rate, with all of its frames.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from controllers.denoising.lead_pose import has_lead_pose, restore_lead_pose
from controllers.denoising.lead_transition import find_lead_transition
from controllers.denoising.result import DenoiseSolution, join_segments
from controllers.denoising.segment import DenoiseSettings, SegmentDenoiser
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Status
from mapctl.protocols import Denoiser, Density
from mapctl.recording.inspection import inspect_recording
from mapctl.recording.masks import (
    Mask,
    expand_valid_masks,
    resolve_joint_names,
    slice_masks,
    trim_masks_before,
    write_back_masked,
)
from mapctl.retarget import as_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.terms import Term

__all__ = ["DenoiseSettings", "DenoiseSolution", "begins_with_tpose", "denoise"]

MIN_DENOISE_FRAMES = 8
"""Frames of a capture that noise can be told in."""
_RIG_FRAMES = 3000  # frames that show what rig a capture is on
_SEGMENT_SECONDS, _OVERLAP_SECONDS = (
    60.0,
    2.0,
)  # seconds of a long capture that are cleaned at once, and that two pieces share


def denoise(
    motion: Motion,
    denoiser: Denoiser,
    *,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenoiseSolution:
    """Denoise a motion on any rig that `mapctl.retarget.rigs` can tell, or on a given one; RequestError for others and
    for masks that do not fit.

    `denoiser` proposes (see priors.load_denoiser). Of `densities` the likeliest adds its likelihood to each window of
    the MAP stage; `terms` are the caller's own, which see the time since the capture's first frame. A T-pose in frame
    0, as many captures begin with, stays. A long capture is cleaned in pieces that fade into each other, so memory
    beyond the capture's own does not grow with it. `progress` is called with frames done and all frames.
    """
    settings = settings or DenoiseSettings()
    masks = resolve_joint_names(motion, masks, rig)
    expand_valid_masks(motion, masks)  # whole: of a piece they are cut to its frames
    # Told once: a piece may lack what shows the rig's T-pose.
    beginning, rigmap = to_canonical(_slice_beginning(motion), rig)
    rig = as_rig(rigmap)
    lead = 1 if has_lead_pose(_slice_beginning(motion), beginning, rigmap) else 0
    mixed = find_lead_transition(motion, rigmap) if lead else None
    wanted = (*masks, *(mixed.masks(motion.skeleton.names) if mixed else ()))
    frames, fps = motion.num_frames - lead, float(motion.fps)
    long, shared = (max(MIN_DENOISE_FRAMES, round(seconds * fps)) for seconds in (_SEGMENT_SECONDS, _OVERLAP_SECONDS))
    pieces: list[tuple[DenoiseSolution, int]] = []
    start = stop = 0
    while stop < frames:
        before, stop = stop, frames if frames - start <= long + shared else start + long
        part, hidden = motion.slice(lead + start, lead + stop), slice_masks(wanted, lead + start, lead + stop)
        if pieces:  # what the piece before made of lost joints is all that is known of them
            last, first = pieces[-1]
            part = write_back_masked(part, last.motion.slice(start - first, before - first), hidden)
            hidden = trim_masks_before(hidden, before - start)
        denoised = _denoise_segment(
            part, denoiser, hidden, settings, densities, terms, rig, seconds=(lead + start) / fps
        )
        pieces.append((denoised, start))
        start = stop - shared
        if progress is not None:
            progress(lead + stop, motion.num_frames)
    done = replace(join_segments(pieces), capture=motion.slice(lead, motion.num_frames), rig=rig)
    return (restore_lead_pose(motion, done, rigmap, mixed, masks) if mixed else done).assess()


def begins_with_tpose(motion: Motion, rig: Rig | None = None) -> bool:
    """Whether frame 0 is a T-pose, or the rig's rest pose, that the motion does not begin with."""
    beginning = _slice_beginning(motion)
    return has_lead_pose(beginning, *to_canonical(beginning, rig))


def _slice_beginning(motion: Motion) -> Motion:
    """As much as is looked at to tell a rig."""
    return motion.slice(0, min(motion.num_frames, _RIG_FRAMES))


def _denoise_segment(
    motion: Motion,
    denoiser: Denoiser,
    masks: Sequence[Mask],
    settings: DenoiseSettings,
    densities: Sequence[Density],
    terms: Sequence[Term],
    rig: Rig,
    *,
    seconds: float,
) -> DenoiseSolution:
    """Denoise a piece that begins so many seconds after the capture."""
    began = time.perf_counter()
    examined = inspect_recording(motion, masks)
    if motion.num_frames < MIN_DENOISE_FRAMES:
        note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
        return DenoiseSolution(
            motion,
            Status(Outcome.DONE, (note,)),
            Ledger(),
            capture=motion,
            noise=examined.noise,
            noise_root=examined.noise_root,
            faults=(),
            contacts=torch.zeros(motion.num_frames, 2, dtype=torch.bool),
            proposal_share=torch.zeros(motion.num_frames, CANONICAL.num_joints),
        )
    done = SegmentDenoiser(examined, denoiser, settings, rig).run(densities, terms, round(seconds * PRIOR_FPS))
    return replace(done, seconds=time.perf_counter() - began)
