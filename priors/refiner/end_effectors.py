"""Positions and velocities of chosen joints, differentiable: inputs of the refiner and its critic beside the state.

Wang et al. 2019, section 4.2.1: the density's features say little of where hands and feet end up, and that is where a
viewer looks. By the one forward kinematics of the project.
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
    """Compute for each frame but the first: positions (m) relative to the hips' ground point and heading, then
    velocities (m/s) over the ground from the frame before, in the same heading frame, so that a planted foot has none.
    """
    trial = Trial.of_features(features)
    world = trial.joints_world[..., [CANONICAL.index(name) for name in joints], :]
    velocity = torch.diff(world, dim=1) * PRIOR_FPS
    position = world[:, 1:] - rotations.lift_ground(trial.root_xz_world[:, 1:, None])
    vectors = torch.cat([position, velocity], dim=2)
    return rotations.rotate_about_y(vectors, -trial.heading[:, 1:, None]).flatten(2)


def count_channels(joints: Sequence[str]) -> int:
    """Count the width of `compute_end_effectors`."""
    return 6 * len(joints)
