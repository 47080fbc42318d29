"""Positions and velocities of chosen joints, differentiable: what the refiner and its critic see beside the state.

rnn paper, section 4.2.1: the density's features say little of where hands and feet end up, and that is where a viewer
looks. By the one forward kinematics of the project.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial


def compute_end_effectors(
    features: Float[Tensor, "batch frames size"], joints: Sequence[str]
) -> Float[Tensor, "batch later channels"]:
    """For each frame but the first: positions (m) seen from the hips' ground point and heading, then velocities (m/s)
    over the ground on the way to it, in the same heading frame, so that a foot that stands has none.
    """
    trial = Trial.of_features(features)
    world = trial.joints_world[..., [CANONICAL.index(name) for name in joints], :]
    velocity = torch.diff(world, dim=1) * PRIOR_FPS
    ground = trial.root_xz_world[:, 1:, None]
    place = torch.stack(
        [world[:, 1:, :, 0] - ground[..., 0], world[:, 1:, :, 1], world[:, 1:, :, 2] - ground[..., 1]], dim=-1
    )
    seen = torch.cat([place, velocity], dim=2)
    heading = trial.heading[:, 1:, None].expand(seen.shape[:-1])
    turned = rotations.rotate_ground(seen[..., ::2], -heading)
    return torch.stack([turned[..., 0], seen[..., 1], turned[..., 1]], dim=-1).flatten(2)


def count_channels(joints: Sequence[str]) -> int:
    """Width of `compute_end_effectors`."""
    return 6 * len(joints)
