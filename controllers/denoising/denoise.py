"""Denoise a capture on any rig (Wang et al. 2019, section 5.4): inspection, a proposal, and the MAP stage about it.

A network trained on all kinds of motion proposes; its proposal is fused with the capture by the noise that the capture
itself shows, so that on unfamiliar motion the result is a filter of the capture; the MAP stage plants the feet. The
result is on the capture's own rig, at its own rate, with all of its frames.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.denoising.lead_pose import find_lead_transition, has_lead_pose, restore_lead_pose
from controllers.denoising.segment import DenoiseSettings, DenoiseSolution, SegmentDenoiser, join_segments
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.problem.solution import Ledger, Outcome, Status
from mapctl.protocols import Denoiser, Density, Inbetweener
from mapctl.recording import Capture, CaptureProposal
from mapctl.recording.inspection import NOISE_CM, Artefact, exchange_swapped_limbs, inspect_recording
from mapctl.recording.masks import (
    Mask,
    expand_valid_masks,
    resolve_joint_names,
    slice_masks,
    trim_masks_before,
    write_back_masked,
)
from mapctl.recording.noise_estimation import estimate_position_noise
from mapctl.retarget import as_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.terms import Term

_LOST_FRAMES = 8
"""Fewest consecutive frames without a joint that an in-betweener fills; shorter ones are the denoiser's own."""


@dataclass(frozen=True, eq=False)
class LostPartFiller(Denoiser):
    """A denoiser that leaves what is lost for longer to an in-betweener, which is shown all else denoised."""

    denoiser: Denoiser
    """Proposes what was observed, or lost for a moment."""
    inbetweener: Inbetweener
    """Proposes what was lost for longer."""

    def clean(self, capture: Capture) -> CaptureProposal:
        """Propose a motion of the capture's frames, on canonical bones at PRIOR_FPS.

        The denoiser's own answer stands for a batch of several captures, and where everything is lost throughout.
        """
        found = self.denoiser.clean(capture)
        lost = MissingMask(_find_lost(~capture.seen[0]), _find_lost(~capture.seen_root[0][:, None])[:, 0])
        if len(capture.root) != 1 or not (lost.joints.any() or lost.root.any()) or lost.joints.all():
            return found
        motion = BodyPose(**{name: values[0] for name, values in vars(found.pose).items()}).motion()
        seconds = torch.arange(motion.num_frames, dtype=torch.float64) / PRIOR_FPS
        proposed = self.inbetweener.propose(GapQuery(motion, lost, seconds)).motion
        root = torch.where(lost.root[:, None], proposed.root_position, motion.root_position)
        quats = torch.where(lost.joints[..., None], proposed.local_quat_xyzw, motion.local_quat_xyzw)
        pose = BodyPose.of_motion(replace(motion, root_position=root, local_quat_xyzw=quats))
        return replace(found, pose=BodyPose(**{name: values[None] for name, values in vars(pose).items()}))


def _find_lost(unseen: Bool[Tensor, "frames columns"]) -> Bool[Tensor, "frames columns"]:
    lost = torch.zeros_like(unseen)
    for column, start, stop in true_intervals(unseen):
        lost[start:stop, column] = stop - start >= _LOST_FRAMES
    return lost


_NO_TRAVEL = 1e-3  # metres by which a rigid bone may vary where no noise is measured
_SPIKE_SIGMAS, _DRIFT_SIGMAS = 5.0, 5.0  # noise of one frame, and of a block's median, that a rigid bone may show
_SPIKE_SECONDS, _BLOCK_SECONDS = 1 / 30, 0.5
_MEDIAN_NOISE = 1.2533  # standard deviation of a median by that of a mean


def hold_rigid_bones(motion: Motion) -> tuple[Motion, tuple[Artefact, ...]]:
    """Return the motion with the median offset of every joint whose offset varies only by noise, and these as faults.

    The joint that travels stays, and so does one whose offset drifts or differs for more than a frame, as in rigs that
    stretch. An offset of zero counts as lost.
    """
    moving, faults = dict(motion.moving_offsets), []
    for joint, track in motion.moving_offsets.items():
        held = None if joint == motion.travelling_joint else _find_rigid_offset(track, float(motion.fps))
        if held is None:
            continue
        moving[joint] = held.expand_as(track)
        amount = 100 * float((track - held).norm(dim=-1).max())
        if amount >= NOISE_CM:
            faults.append(Artefact(motion.skeleton.names[joint], 0, motion.num_frames, "stretch", amount, "cm"))
    return replace(motion, moving_offsets=moving), tuple(faults)


def _find_rigid_offset(track: Float[Tensor, "frames 3"], fps: float) -> Float[Tensor, "3"] | None:
    """Return the median of an offset that varies only by noise, of frames in which it is not zero; None for others."""
    known = track.any(dim=-1)
    if not known.any():
        return None
    median = track[known].median(dim=0).values
    away = torch.where(known[:, None], track - median, 0.0)
    noise = torch.tensor([estimate_position_noise(track[:, [axis] * 3], known) for axis in range(3)]).to(track)
    apart = (away.abs() > (_SPIKE_SIGMAS * noise).clamp_min(_NO_TRAVEL)).any(dim=-1, keepdim=True)
    if any(stop - start > max(1, round(_SPIKE_SECONDS * fps)) for _, start, stop in true_intervals(apart)):
        return None
    size = max(1, min(len(track), round(_BLOCK_SECONDS * fps)))
    drift = away.unfold(0, size, size).median(dim=-1).values.abs()
    allowed = _DRIFT_SIGMAS * _MEDIAN_NOISE * noise / size**0.5
    return None if (drift > allowed.clamp_min(_NO_TRAVEL)).any() else median


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
