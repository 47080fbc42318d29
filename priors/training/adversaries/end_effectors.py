"""The refiner's critic, a bidirectional LSTM on end effectors (Wang et al. 2019, Eq. 12)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.features import LAYOUT
from priors.refiner.end_effectors import compute_end_effectors, count_channels

_FOOT_JOINTS = ("leftFoot", "leftToes", "rightFoot", "rightToes")


class Critic(nn.Module):
    """Tells captured windows from refined ones by end effectors and contact bits."""

    reach_mean: Tensor
    reach_std: Tensor

    def __init__(
        self, joints: Sequence[str], *, width: int, around: int, slow: float, reach_mean: Tensor, reach_std: Tensor
    ):
        """`width` units in the first layer and in each direction of the LSTM; the first layer sees `around` frames on
        either side of its own, and feet's ground speeds under `slow` (m/s) magnified, unless that is 0.
        """
        super().__init__()
        self.joints = tuple(joints)
        self.register_buffer("reach_mean", reach_mean.clone())
        self.register_buffer("reach_std", reach_std.clone())
        self.slow = slow
        self.magnified_columns = [
            len(joints) + number for number, name in enumerate(joints) if slow > 0 and name in _FOOT_JOINTS
        ]
        seen = count_channels(joints) + 2 * len(self.magnified_columns) + 2
        self.first = nn.Conv1d(seen, width, 2 * around + 1)
        self.lstm = nn.LSTM(width, width, batch_first=True, bidirectional=True)
        self.last = nn.Linear(2 * width, 1)

    def forward(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch judged"]:
        """Logits, frame by frame, that a window was captured; for the frames that have enough on either side."""
        ends = compute_end_effectors(features, self.joints)
        seen = [(ends - self.reach_mean) / self.reach_std, 2 * LAYOUT.pick(features, "contacts")[:, 1:] - 1]
        if self.magnified_columns:
            # A foot that slides by 10 cm/s is a twentieth of the spread of feet's speeds, and what every viewer sees.
            ground = ends.unflatten(-1, (-1, 3))[:, :, self.magnified_columns, ::2]
            seen.append(0.5 * torch.asinh(ground / self.slow).flatten(2))
        seen = torch.cat(seen, dim=-1).transpose(1, 2)
        hidden, _ = self.lstm(torch.nn.functional.leaky_relu(self.first(seen), 0.2).transpose(1, 2))
        return self.last(hidden)[..., 0]
