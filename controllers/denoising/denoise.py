"""Denoise a capture on any rig (Wang et al. 2019, section 5.4): inspection, a proposal, and the MAP stage about it.

A network trained on all kinds of motion proposes; its proposal is fused with the capture by the noise that the capture
itself shows, so that on unfamiliar motion the result is a filter of the capture; the MAP stage plants the feet. The
result is on the capture's own rig, at its own rate, with all of its frames.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from controllers.denoising.lead_pose import has_lead_pose, restore_lead_pose
from controllers.denoising.lead_transition import find_lead_transition
from controllers.denoising.lost_parts import LostPartFiller
from controllers.denoising.result import DenoiseSolution, join_segments
from controllers.denoising.rigid_bones import hold_rigid_bones
from controllers.denoising.segment import DenoiseSettings, SegmentDenoiser
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Status
from mapctl.protocols import Denoiser, Density, Inbetweener
from mapctl.recording.inspection import inspect_recording
from mapctl.recording.masks import (
    Mask,
    expand_valid_masks,
    resolve_joint_names,
    slice_masks,
    trim_masks_before,
    write_back_masked,
)
from mapctl.recording.swap_detection import exchange_swapped_limbs
from mapctl.retarget import as_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.terms import Term

__all__ = ["DenoiseSettings", "DenoiseSolution", "begins_with_tpose", "denoise"]

MIN_DENOISE_FRAMES = 8
"""Fewest frames of a capture whose noise can be estimated."""
_RIG_FRAMES = 3000  # frames from which the rig is identified
_SEGMENT_SECONDS = 60.0  # seconds of a long capture that are cleaned at once
_OVERLAP_SECONDS = 2.0  # seconds that two segments share


def denoise(
    motion: Motion,
    denoiser: Denoiser,
    *,
    inbetweener: Inbetweener | None = None,
    masks: Sequence[Mask] = (),
    settings: DenoiseSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenoiseSolution:
    """Denoise a motion on any rig that `mapctl.retarget.rigs` identifies, or on a given one; RequestError for others
    and for masks that do not fit.

    `denoiser` proposes (see priors.load_denoiser), and `inbetweener`, if there is one, what is lost for longer (see
    LostPartFiller). Of `densities` the likeliest adds its likelihood to each window of the MAP stage; `terms` are the
    caller's own, which see the time since the capture's first frame. A T-pose in frame 0, as many captures begin with,
    stays. Offsets of bones that vary only by noise are held at their medians. A long capture is cleaned in segments
    that crossfade, so memory beyond the capture's own does not grow with it. `progress` is called with frames done and
    all frames.
    """
    settings, capture = settings or DenoiseSettings(), motion
    stretched = ()
    if capture.num_frames >= MIN_DENOISE_FRAMES:
        motion, stretched = hold_rigid_bones(capture)
    denoiser = denoiser if inbetweener is None else LostPartFiller(denoiser, inbetweener)
    masks = resolve_joint_names(motion, masks, rig)
    hidden, _ = expand_valid_masks(motion, masks)  # checked whole: for a segment they are cut to its frames
    # Identified once: a segment may lack the frames that show the rig's T-pose.
    beginning, rigmap = to_canonical(_slice_beginning(motion), rig)
    rig = as_rig(rigmap)
    motion, swapped = exchange_swapped_limbs(motion, rigmap, hidden)
    lead = 1 if has_lead_pose(_slice_beginning(motion), beginning, rigmap) else 0
    transition = find_lead_transition(motion, rigmap) if lead else None
    all_masks = (*masks, *(transition.masks(motion.skeleton.names) if transition else ()))
    frames, fps = motion.num_frames - lead, float(motion.fps)
    long, shared = (max(MIN_DENOISE_FRAMES, round(seconds * fps)) for seconds in (_SEGMENT_SECONDS, _OVERLAP_SECONDS))
    pieces: list[tuple[DenoiseSolution, int]] = []
    start = stop = 0
    while stop < frames:
        before, stop = stop, frames if frames - start <= long + shared else start + long
        part, part_masks = motion.slice(lead + start, lead + stop), slice_masks(all_masks, lead + start, lead + stop)
        if pieces:  # missing joints are known only from the segment before
            last, first = pieces[-1]
            part = write_back_masked(part, last.motion.slice(start - first, before - first), part_masks)
            part_masks = trim_masks_before(part_masks, before - start)
        denoised = _denoise_segment(
            part, denoiser, part_masks, settings, densities, terms, rig, seconds=(lead + start) / fps
        )
        pieces.append((denoised, start))
        start = stop - shared
        if progress is not None:
            progress(lead + stop, motion.num_frames)
    done = replace(join_segments(pieces), capture=motion.slice(lead, motion.num_frames), rig=rig)
    done = restore_lead_pose(motion, done, rigmap, transition, masks) if transition else done
    if stretched or swapped:
        held = f"offsets of {len(stretched)} bones vary only by noise: they are held at their medians"
        exchanged = f"left and right limbs are swapped {len(swapped)} times: they are exchanged back"
        notes = (*[held] * bool(stretched), *[exchanged] * bool(swapped), *done.notes)
        cut = motion.num_frames - done.motion.num_frames
        swapped = tuple(replace(fault, start=fault.start - cut, stop=fault.stop - cut) for fault in swapped)
        status = replace(done.status, notes=notes)
        capture = capture.slice(cut, motion.num_frames)
        done = replace(done, capture=capture, faults=(*stretched, *swapped, *done.faults), status=status)
    return done.assess()


def begins_with_tpose(motion: Motion, rig: Rig | None = None) -> bool:
    """Return whether frame 0 is a T-pose, or the rig's rest pose, that does not belong to the motion."""
    beginning = _slice_beginning(motion)
    return has_lead_pose(beginning, *to_canonical(beginning, rig))


def _slice_beginning(motion: Motion) -> Motion:
    """Slice the frames from which the rig is identified."""
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
    """Denoise a segment that begins so many seconds after the capture."""
    began = time.perf_counter()
    inspection = inspect_recording(motion, masks)
    if motion.num_frames < MIN_DENOISE_FRAMES:
        note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
        return DenoiseSolution(
            motion,
            Status(Outcome.DONE, (note,)),
            Ledger(),
            capture=motion,
            noise=inspection.noise,
            noise_root=inspection.noise_root,
            faults=(),
            contacts=torch.zeros(motion.num_frames, 2, dtype=torch.bool),
            proposal_share=torch.zeros(motion.num_frames, CANONICAL.num_joints),
            error=torch.zeros(motion.num_frames, CANONICAL.num_joints),
        )
    done = SegmentDenoiser(inspection, denoiser, settings, rig).run(densities, terms, round(seconds * PRIOR_FPS))
    whole = bool(inspection.known.all() and inspection.seen_root.all()) and not terms
    if whole and _measure_roughness(done.motion) > _measure_roughness(motion):
        note = f"frames from {seconds:.1f} s on would become rougher than they are: they were not changed"
        done = replace(done, motion=motion, status=replace(done.status, notes=(*done.status.notes, note)))
    return replace(done, seconds=time.perf_counter() - began)


def _measure_roughness(motion: Motion) -> float:
    """Measure the mean third difference of joints' positions, metres: what noise adds most to."""
    return float(motion.joint_positions().diff(n=3, dim=0).norm(dim=-1).mean()) if motion.num_frames > 3 else 0.0
