"""Range-constrained forward kinematics: any numbers become a pose that bodies take (Zhou et al. 2020, section 3.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl import joint_ranges, kinematics, rotations
from mapctl.joint_ranges import JointRanges
from mapctl.skeleton import CANONICAL, Skeleton

_OTHERS = CANONICAL.num_joints - 1
ROOT_ROWS = 6
"""Numbers of the hips' rotation, which is free (Zhou et al. 2019)."""
POSE_ROWS = ROOT_ROWS + 3 * _OTHERS
"""Numbers of a pose: the hips' six, and three for each other joint."""


@dataclass(frozen=True, eq=False)
class ConstrainedPose:
    """Poses within the ranges of the joints."""

    local_matrix: Float[Tensor, "*batch joints 3 3"]
    """Local rotations; the hips' is that in whatever frame it was told."""
    places: Float[Tensor, "*batch joints 3"]
    """Joint positions from the hips, metres, in the same frame."""


class RangeConstrainedKinematics(nn.Module):
    """Numbers of any size in, rotations within their ranges and positions on rigid bones out. It has no weights."""

    axes: Tensor
    mid_matrix: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, ranges: JointRanges | None = None, skeleton: Skeleton = CANONICAL):
        """With the bundled ranges, if none are given, on the bones of a skeleton of canonical joints."""
        super().__init__()
        ranges = joint_ranges.load() if ranges is None else ranges
        self.skeleton = skeleton
        # They are the code's, not learnt: weights do not hold them, a card tells which they were.
        for name in ("axes", "mid_matrix", "low", "high"):
            values = getattr(ranges, name)
            values = values.float() if values.is_floating_point() else values
            self.register_buffer(name, values, persistent=False)

    def forward(self, rows: Float[Tensor, "*batch rows"]) -> ConstrainedPose:
        """Return the poses of rows of POSE_ROWS numbers: the hips' by Gram and Schmidt, angles by Eq. 3, matrices in
        each joint's order, and the forward kinematics that all use."""
        root, free = rows.split([ROOT_ROWS, 3 * _OTHERS], dim=-1)
        ranges = JointRanges(self.axes, self.mid_matrix, self.low, self.high)
        others = ranges.to_matrices(ranges.constrain(free.unflatten(-1, (_OTHERS, 3))))
        local = torch.cat([rotations.from_six(root)[..., None, :, :], others], dim=-3)
        return ConstrainedPose(local, kinematics.positions_from_matrices(self.skeleton, local))
