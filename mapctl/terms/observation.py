"""Near to what a capture shows: its root and its joint angles, each with its own sigma (rnn paper, Eq. 25)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Observation:
    """The root is where a capture saw it and joints are turned as it saw them, as far as it saw them.

    Errors are judged joint by joint: beyond `outlier` sigmas an energy grows no longer with the square of the error but
    with the error (Huber), so that a spike pulls no harder than a large error that noise explains.
    """

    root: Float[Tensor, "frames 3"]
    """Of the hips, world, metres."""
    heading: Float[Tensor, " frames"]
    """Of the hips about +Y, radians."""
    angles: Float[Tensor, "frames angles"]
    """The hips' tilt (2) and the rotation vectors of all other joints, as in the features, radians."""
    seen_root: Bool[Tensor, " frames"]
    """Whether the root's place was seen."""
    seen: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation was seen, the hips' first."""
    sigma_root: float
    """Of each coordinate, metres."""
    sigma_angle: Float[Tensor, " joints"]
    """Of each of a joint's three angles, radians."""
    outlier: float = 4.0
    """Sigmas."""
    name: str = "observation"
    unit: str = "rad"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats."""
        root, angles = self._squares(trial)
        root = _huber(root / self.sigma_root**2, self.outlier)
        angles = _huber(angles / self.sigma_angle.to(angles).square(), self.outlier)
        return 0.5 * (self.seen_root * root + (self.seen * angles).sum(-1))

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Root mean square over the seen joints of the angle between what is and what was seen, radians."""
        _, angles = self._squares(trial)
        return ((self.seen * angles).sum(-1) / self.seen.sum(-1).clamp_min(1)).sqrt()

    def _squares(self, trial: Trial) -> tuple[Float[Tensor, "batch frames"], Float[Tensor, "batch frames joints"]]:
        """Squared distance of the root (m^2) and of each joint's angles (rad^2)."""
        features = trial.features
        height = LAYOUT.pick(features, "root_height")
        ground = trial.root_xz_world - self.root[:, ::2].to(features)
        root = ground.square().sum(-1) + (height[..., 0] - self.root[:, 1].to(features)).square()
        turn = trial.heading - self.heading.to(features)
        turn = turn - 2 * math.pi * torch.round(turn.detach() / (2 * math.pi))
        apart = torch.cat([LAYOUT.pick(features, "root_tilt"), LAYOUT.pick(features, "joint_rotations")], dim=-1)
        apart = apart - self.angles.to(features)
        hips = turn.square() + apart[..., :2].square().sum(-1)
        joints = apart[..., 2:].unflatten(-1, (-1, 3)).square().sum(-1)
        return root, torch.cat([hips.unsqueeze(-1), joints], dim=-1)


def _huber(squares: Tensor, outlier: float) -> Tensor:
    """Of squared errors in sigmas: themselves up to outlier^2, beyond it as the error's first power."""
    beyond = 2 * outlier * torch.sqrt(squares.clamp_min(outlier**2)) - outlier**2
    return torch.where(squares <= outlier**2, squares, beyond)
