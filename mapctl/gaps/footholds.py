"""Planted feet that stay where they are: toes are held at one place as long as they stand, and legs bend to that."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.capture.faults import runs
from mapctl.gaps.reaching import bend_limbs
from mapctl.gaps.second_differences import spread
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL
from mapctl.terms.footing import TOES

_TOES = [CANONICAL.index(name) for name in TOES]
_SECONDS = 0.12  # over which a foot that swings leaves the correction of where it stood


def hold_planted(
    motion: Motion, stands: Bool[Tensor, "frames 2"], *, free: Bool[Tensor, " frames"], rest_height: float
) -> Motion:
    """A canonical motion whose toes (left, right) stay at one place while they stand, in frames that are free.

    A stand that begins or ends in frames that are not free goes on in the place it has there; others are in the middle
    of where they slid along, at `rest_height` (metres). Between stands the correction fades. Hips stay; feet keep how
    they lie.
    """
    places, ends = motion.joint_positions(), motion.joint_positions().clone()
    for foot, toe in enumerate(_TOES):
        moved, firm = torch.zeros_like(places[:, toe]), ~free
        for _, start, stop in runs(stands[:, foot, None]):
            held = ~free[start:stop]
            track = places[start:stop, toe]
            anchor = track[held].mean(dim=0) if bool(held.any()) else track.mean(dim=0)
            anchor = torch.where(held.any() & torch.tensor([True] * 3), anchor, anchor.index_fill(0, torch.tensor(1), rest_height))
            moved[start:stop] = torch.where(held[:, None], 0.0, anchor - track)
            firm = firm | (stands[:, foot] & (torch.arange(len(free)) >= start) & (torch.arange(len(free)) < stop))
        ankle = CANONICAL.parents[toe]
        ends[:, ankle] += spread(moved, firm, seconds=_SECONDS, fps=float(motion.fps))
    turning = free[:, None].expand(-1, CANONICAL.num_joints)
    return bend_limbs(motion, motion, ends, torch.zeros_like(turning), turning)
