"""Footholds: planted toes are held at one position during each contact, by inverse kinematics of the legs."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.inbetweening.whole_body import bend_limbs
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_TOES = list(TOE_JOINTS)
_STANCE_FADE_SECONDS = 0.12  # over which a swinging foot's correction fades away from its contacts


def hold_planted(
    motion: Motion,
    planted: Bool[Tensor, "frames 2"],
    *,
    free: Bool[Tensor, " frames"],
    rest_height: Float[Tensor, "frames 2"],
) -> Motion:
    """Hold the toes (left, right) of a canonical motion at one position during each contact, in frames that are free.

    A contact that begins or ends in frames that are not free keeps its position there; others are held at the mean of
    their positions, at `rest_height` (metres). Between contacts the correction fades. Hips and the feet's orientations
    stay.
    """
    positions, goals = motion.joint_positions(), motion.joint_positions().clone()
    for foot, toe in enumerate(_TOES):
        offset = torch.zeros_like(positions[:, toe])
        for _, start, stop in true_intervals(planted[:, foot, None]):
            part = slice(start, stop)
            offset[part] = _compute_stance_offset(positions[part, toe], ~free[part], rest_height[part, foot])
        firm = ~free | planted[:, foot]
        goals[:, CANONICAL.parents[toe]] += interpolate_offsets(
            offset, firm, seconds=_STANCE_FADE_SECONDS, fps=float(motion.fps)
        )
    turning = free[:, None].expand(-1, CANONICAL.num_joints)
    return bend_limbs(motion, motion, goals, torch.zeros_like(turning), turning)


def _compute_stance_offset(
    positions: Float[Tensor, "contact 3"], anchored: Bool[Tensor, " contact"], rest_height: Float[Tensor, " contact"]
) -> Float[Tensor, "contact 3"]:
    """Compute the offsets from a contact's positions to the anchored ones, interpolated linearly, or to their mean."""
    if bool(anchored.any()):
        return fill_missing(positions[None], anchored[None])[0] - positions
    middle = positions.mean(dim=0)
    middle[1] = rest_height.mean()
    return middle - positions
