"""Windows in poses that no clip shows: joints turned by constants that drift, bodies tilted up to lying and lowered.

A model that has seen the poses of one performer alone returns to them where it should not. Truth and input are changed
alike, so the task stays the same.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import ContactSettings
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_WIDE = {"UpperArm": 0.6, "LowerArm": 0.5, "UpperLeg": 0.5, "LowerLeg": 0.5}
_TURN_SIGMA = torch.tensor(
    [0.0] + [next((wide for part, wide in _WIDE.items() if part in name), 0.3) for name in CANONICAL.names[1:]]
)
"""Spread of a joint's rotation vector, radians; the hips are tilted instead."""


@dataclass(frozen=True)
class PoseVariation:
    """How far windows leave the poses of their clips."""

    share: float = 0.7
    """Share of windows whose joints are turned, each by normal rotation vectors times one uniform number a window."""
    drift: float = 0.3
    """Turn that is added over the window, as a share of the first."""
    tilted: float = 0.35
    """Share of windows whose hips are tilted about a horizontal axis, and lowered."""
    tilt: float = 1.6
    """Largest tilt, radians."""
    lowering: float = 0.6
    """Largest lowering, metres."""


def vary_poses(
    heading: Float[Tensor, "batch frames"],
    quats: Float[Tensor, "batch frames joints 4"],
    height: Float[Tensor, "batch frames"],
    variation: PoseVariation,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "batch frames"], Float[Tensor, "batch frames joints 4"], Float[Tensor, "batch frames"]]:
    """Return headings (radians), local rotations (the hips' without their heading) and hips heights (metres) of windows
    in other poses."""
    batch, frames, joints = quats.shape[:3]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator)

    def turn(size: float) -> Tensor:
        return size * _TURN_SIGMA[:, None] * torch.randn(batch, 1, joints, 3, generator=generator)

    amount = (uniform() < variation.share) * uniform()
    progress = torch.linspace(0, 1, frames)[:, None, None]
    vectors = amount[:, None, None, None] * (turn(1.0) + progress * turn(variation.drift))
    tilted, about = uniform() < variation.tilted, 2 * math.pi * uniform()
    axis = torch.stack([about.cos(), torch.zeros(batch), about.sin()], dim=-1)
    tilt = rotations.from_rotation_vector((tilted * variation.tilt * uniform())[:, None] * axis)
    lowered = height - (tilted * variation.lowering * uniform())[:, None]
    quats = rotations.multiply(quats, rotations.from_rotation_vector(vectors))
    hips = rotations.multiply(tilt[:, None].expand(-1, frames, -1), quats[..., 0, :])
    turned, upright = rotations.split_heading(hips)
    quats = torch.cat([upright[..., None, :], quats[..., 1:, :]], dim=-2)
    return heading + rotations.unwrap_angle(turned), quats, torch.where(tilted[:, None], lowered, height)


def vary_features(
    features: Float[Tensor, "batch frames size"], variation: PoseVariation, generator: torch.Generator
) -> Float[Tensor, "batch frames size"]:
    """Return the features of windows in other poses."""
    pose = BodyPose.of_features(features, GroundPose.origin())
    quats = rotations.from_rotation_vector(pose.rotation_vectors)
    heading, quats, height = vary_poses(pose.heading, quats, pose.root_position[..., 1], variation, generator)
    root = torch.stack([pose.root_position[..., 0], height, pose.root_position[..., 2]], dim=-1)
    vectors = rotations.to_rotation_vector(quats)
    varied = BodyPose(root, heading, vectors[..., 0, ::2], vectors[..., 1:, :])
    planted = keep_still(LAYOUT.pick(features, "contacts"), varied.joints_world())
    return varied.features(GroundPose.origin(), planted > 0)


def keep_still(
    contacts: Float[Tensor, "batch frames 2"], positions: Float[Tensor, "batch frames joints 3"]
) -> Float[Tensor, "batch frames 2"]:
    """Keep contacts of toes that still do not travel; world positions, metres."""
    toes = positions[..., list(TOE_JOINTS), ::2]
    speed = torch.diff(toes, dim=1, prepend=toes[:, :1]).norm(dim=-1) * PRIOR_FPS
    return contacts * (speed < ContactSettings.slow)
