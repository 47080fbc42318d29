"""Bones whose offsets are animated and vary only by noise, as in files with six channels on every joint, held still."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.recording.artefacts import NOISE_CM, Artefact
from mapctl.recording.noise_estimation import estimate_position_noise

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
