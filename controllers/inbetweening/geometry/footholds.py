"""Planted feet that stay where they are: toes are held at one place as long as they stand, and legs bend to that."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.inbetweening.whole_body import bend_limbs
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_TOES = list(TOE_JOINTS)
_STANCE_FADE_SECONDS = 0.12  # over which a foot that swings leaves the correction of where it stood


def hold_planted(
    motion: Motion, stands: Bool[Tensor, "frames 2"], *, free: Bool[Tensor, " frames"], rest_height: float
) -> Motion:
    """A canonical motion whose toes (left, right) stay at one place while they stand, in frames that are free.

    A stand that begins or ends in frames that are not free goes on in the place it has there; others are in the middle
    of where they slid along, at `estimate_rest_height` (metres). Between stands the correction fades. Hips stay; feet
    keep how they lie.
    """
    places, ends = motion.joint_positions(), motion.joint_positions().clone()
    for foot, toe in enumerate(_TOES):
        moved = torch.zeros_like(places[:, toe])
        for _, start, stop in true_intervals(stands[:, foot, None]):
            part = slice(start, stop)
            moved[part] = _compute_stance_offset(places[part, toe], ~free[part], rest_height)
        firm = ~free | stands[:, foot]
        ends[:, CANONICAL.parents[toe]] += interpolate_offsets(
            moved, firm, seconds=_STANCE_FADE_SECONDS, fps=float(motion.fps)
        )
    turning = free[:, None].expand(-1, CANONICAL.num_joints)
    return bend_limbs(motion, motion, ends, torch.zeros_like(turning), turning)


def _compute_stance_offset(
    track: Float[Tensor, "stand 3"], held: Bool[Tensor, " stand"], rest_height: float
) -> Float[Tensor, "stand 3"]:
    """What brings a stand's frames to the place of those that are held, straight between such, or to its own middle."""
    if bool(held.any()):
        return fill_missing(track[None], held[None])[0] - track
    middle = track.mean(dim=0)
    middle[1] = rest_height
    return middle - track
