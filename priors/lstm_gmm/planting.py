"""Frames given that toes stand where the contact bits say so: each Gaussian conditioned on its planted toes' steps.

A Gaussian whose correlations are the same in every pose cannot know how the legs make up for the hips in this one, so
its samples slide. Given a toe's step over the floor and up, observed as zero with an error, it stays a Gaussian:
Matheron's rule (Doucet 2010, "A note on efficient conditional simulation of Gaussian distributions", Eq. 3) turns one
of its samples into one of the conditional. Steps are taken linearly about the mean; the mixture's component is the one
that was drawn without them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.kinematics.joint_places import place_joints
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_CHANGE = 2e-3  # of a feature, by which steps are differentiated
_JOINTS = LAYOUT.slices["joint_rotations"].start
_LEGS = [CANONICAL.index(side + part) for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot")]
_MOVING = [*range(_JOINTS), *(_JOINTS + 3 * (joint - 1) + axis for joint in _LEGS for axis in range(3))]
"""Features that move a toe: the root's, and the rotations of the legs."""
_CHANGES = torch.zeros(1 + len(_MOVING), LAYOUT.size)
_CHANGES[torch.arange(1, 1 + len(_MOVING)), _MOVING] = _CHANGE


@dataclass(frozen=True)
class Planting:
    """How firmly toes stand that are planted in a frame and in the one before it."""

    sigma_speed: float
    """Standard deviation of each coordinate of a toe's speed, m/s."""

    def condition(
        self,
        before: Float[Tensor, "batch size"],
        sample: Float[Tensor, "batch size"],
        mean: Float[Tensor, "batch continuous"],
        factor: Float[Tensor, "batch continuous continuous"],
        generator: torch.Generator,
    ) -> Float[Tensor, "batch size"]:
        """Turn a sample of Gaussians with a mean and a factor of the covariance (physical units) into one of them given
        the steps of toes that are planted in it and in the frame `before`."""
        planted = (LAYOUT.pick(before, "contacts") > 0.5) & (LAYOUT.pick(sample, "contacts") > 0.5)
        sigma = self.sigma_speed / PRIOR_FPS
        error = sigma * torch.randn(len(sample), 2, 3, generator=generator).to(sample)  # drawn whoever stands
        if not bool(planted.any()):
            return sample
        size = LAYOUT.continuous
        base = torch.cat([mean, sample[:, size:]], dim=-1)
        still = torch.cat([torch.zeros_like(before[:, :3]), before[:, 3:]], dim=-1)  # where the frame comes from
        places = _place_toes(torch.cat([base[:, None] + _CHANGES.to(base), still[:, None]], dim=1))
        places, stood = places[:, :-1], places[:, -1]
        told = planted[..., None].expand(-1, -1, 3).flatten(1)
        jacobian = factor.new_zeros(len(sample), 6, size)
        jacobian[..., _MOVING] = ((places[:, 1:] - places[:, :1]) / _CHANGE).transpose(1, 2)
        jacobian = torch.where(told[..., None], jacobian, 0.0)
        step = places[:, 0] - stood + torch.einsum("bij,bj->bi", jacobian, sample[:, :size] - mean)
        spread = jacobian @ factor  # of the steps, along the Gaussian's own axes
        covariance = spread @ spread.mT + sigma**2 * torch.eye(6).to(spread)
        miss = torch.where(told, error.flatten(1) - step, 0.0)
        change = factor @ (spread.mT @ torch.linalg.solve(covariance, miss[..., None]))
        return torch.cat([sample[:, :size] + change[..., 0], sample[:, size:]], dim=-1)


def _place_toes(features: Float[Tensor, "batch variants size"]) -> Float[Tensor, "batch variants 6"]:
    """Places of both toes after one frame from the origin, metres."""
    ground, heading = LAYOUT.pick(features, "root_displacement_heading"), LAYOUT.pick(features, "heading_change")
    places = place_joints(features, ground.contiguous(), heading[..., 0].contiguous(), CANONICAL)
    return places[:, :, list(TOE_JOINTS)].flatten(2)
