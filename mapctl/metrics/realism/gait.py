"""Range of gait in a set of clips: step length, speed and turning of pieces of one length."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts
from mapctl.errors import RequestError
from mapctl.joint_roles import find_feet, find_hips
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.numerics.gaussian import low_pass
from mapctl.rotations import unwrap_angle

PIECE_SECONDS = 3.0
"""Length of the pieces: long averages vary less than short ones, so sets are compared in pieces of one length."""
LONGEST_STEP = 1.0
"""Longest step, seconds; touch-downs further apart have a contact between them that was not detected."""
_MOVING = 0.2
"""Speed over the ground, m/s, below which the direction of travel is not measured."""


class GaitSpread(NamedTuple):
    """Statistics of one measure over the pieces of a set of clips; NaN where too few of them have it."""

    mean: float
    """Mean over pieces."""
    std: float
    """Standard deviation over pieces."""
    pieces: int
    """Number of pieces that have the measure."""


def measure_gait_spread(motions: Sequence[Motion], *, seconds: float = PIECE_SECONDS) -> dict[str, GaitSpread]:
    """Measure the spread of step_length_cm, speed_m_s and turning_deg_s over consecutive pieces of the clips (any rig).

    Step length is the mean of a piece's distances over the ground from one foot's touch-down to the next of the other
    foot; speed the hips' mean over the ground; turning the mean size of the turn rate of their travel, strides smoothed
    away. What is left of a clip after its last whole piece is not used, so clips shorter than `seconds` add nothing.
    RequestError for no clips, a length that is none, and rigs whose hips or feet are not found.
    """
    if not motions or not 0 < seconds < float("inf"):
        raise RequestError(f"a gait needs clips and a length in seconds, got {len(motions)} and {seconds:g} s")
    pieces = [_measure_clip_gait(motion, seconds) for motion in motions]
    return {name: _summarise_pieces(torch.cat([clip[name] for clip in pieces])) for name in pieces[0]}


def _summarise_pieces(values: Float[Tensor, "pieces"]) -> GaitSpread:
    known = values[~values.isnan()]
    if len(known) < 2:
        return GaitSpread(float(values.nanmean()), float("nan"), len(known))
    return GaitSpread(float(known.mean()), float(known.std()), len(known))


def _measure_clip_gait(motion: Motion, seconds: float) -> dict[str, Float[Tensor, "pieces"]]:
    """Measure a value for each whole piece of a clip, by measure. Contacts and smoothing know the whole clip."""
    positions, fps = motion.joint_positions(), float(motion.fps)
    hips = positions[:, find_hips(motion.skeleton)]
    toes = positions[:, list(find_feet(motion.skeleton))]
    frames = max(2, round(seconds * fps))
    count = len(positions) // frames
    by_frame = {
        "step_length_cm": 100 * step_lengths(toes[..., ::2], contacts.detect_contacts(toes, fps), fps),
        "turning_deg_s": torch.rad2deg(travel_turn_rate(hips[:, ::2], fps)),
    }
    speeds = [body.ground_speed(piece, fps) for piece in hips[: count * frames].split(frames)] if count else []
    means = {name: values[: count * frames].reshape(count, frames).nanmean(1) for name, values in by_frame.items()}
    return {
        "step_length_cm": means["step_length_cm"],
        "speed_m_s": hips.new_tensor(speeds),
        "turning_deg_s": means["turning_deg_s"],
    }


def step_lengths(
    toes_xz: Float[Tensor, "frames feet 2"], planted: Bool[Tensor, "frames feet"], fps: float
) -> Float[Tensor, "frames"]:
    """Return the length of the step that a touch-down ends in its frame, metres; NaN where none does.

    A touch-down is the first frame of a contact. Two in a row of one foot make no step, nor do two that are
    `LONGEST_STEP` apart.
    """
    lengths = torch.full((len(planted),), float("nan"), dtype=toes_xz.dtype)
    downs = ((planted[1:] & ~planted[:-1]).nonzero() + planted.new_tensor([1, 0], dtype=torch.long)).tolist()
    for (before, other), (frame, foot) in pairwise(downs):
        if foot != other and frame - before < LONGEST_STEP * fps:
            lengths[frame] = (toes_xz[frame, foot] - toes_xz[before, other]).norm()
    return lengths


def travel_turn_rate(hips_xz: Float[Tensor, "frames 2"], fps: float) -> Float[Tensor, "frames"]:
    """Return the size of the turn rate of the direction of travel, rad/s; NaN where the hips hardly move.

    Smoothed as `body.turn_rate`, so that the hips' swing with each stride does not count.
    """
    rate = torch.full((len(hips_xz),), float("nan"), dtype=hips_xz.dtype)
    if len(hips_xz) < 3:
        return rate
    velocity = hips_xz.diff(dim=0) * fps
    slow = torch.stack([low_pass(axis, seconds=body.TURN_SECONDS, fps=fps) for axis in velocity.T], dim=-1)
    moving = slow.norm(dim=-1) > _MOVING
    turn = unwrap_angle(torch.atan2(slow[:, 0], slow[:, 1])).diff().abs() * fps
    rate[2:] = torch.where(moving[1:] & moving[:-1], turn, float("nan"))
    return rate
