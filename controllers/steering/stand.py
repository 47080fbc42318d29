"""Stands of a steered body: the pose that it takes over its feet, and how it sways and breathes, without a search."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.pose import BodyPose
from mapctl.retarget.character import LEGS, limb_extension
from mapctl.retarget.legs import bend_legs, find_ankles, lower_hips
from mapctl.skeleton import CANONICAL, FEET, TOES, Skeleton


def find_pose(features: Float[Tensor, "size"], ground: GroundPose, skeleton: Skeleton) -> Motion:
    """Return the pose of a frame's features at a ground pose."""
    at = ground.position_xz[None].double(), ground.heading.reshape(1).double()
    return replace(BodyPose.of_features_at(features[None].double(), *at).motion(), skeleton=skeleton)


def find_stand(mean: Float[Tensor, "size"], ground: GroundPose, skeleton: Skeleton, toe_height: float) -> Motion:
    """Return a stand at a ground pose: a mean pose, as features, with both feet flat, side by side."""
    pose = find_pose(mean, ground, skeleton)
    heading = ground.heading.reshape(1).double()
    toes = rotations.rotate_about_y(pose.joint_positions()[:, CANONICAL.indices(TOES)] - pose.root_position, -heading)
    toes[..., 2] = toes[..., 2].mean()
    toes = rotations.rotate_about_y(toes, heading[:, None]) + pose.root_position
    toes[..., 1] = toe_height
    return _stand_on(pose, toes, rotations.about_y(heading)[:, None].expand(1, 2, 4))


_SETTLES, _SWAYS = 1.0, 2.0  # seconds until a body has come to its stand, and until it sways as far as it does
_SWAY = ((0.07, 5.0), (0.11, 4.0), (0.19, 2.5), (0.31, 1.5))  # Hz and mm: slower sway is wider, and never repeats
_BREATH_HZ, _BREATH = 0.24, math.radians(0.5)


@dataclass(frozen=True, eq=False)
class Stand:
    """A body that stands where it came to rest."""

    pose: Motion
    """Pose in which it came to rest, one frame."""
    stand: Motion
    """Pose that it takes there, one frame."""
    frames: int = 0
    """Frames since then."""

    def advance(self, frames: int) -> tuple["Stand", Float[Tensor, "frames size"]]:
        """Return the next frames, as features, and the stand after them."""
        clock = torch.arange(self.frames, self.frames + frames + 1, dtype=torch.float64) / PRIOR_FPS
        settled = smootherstep((clock / _SETTLES).clamp(max=1))[:, None]
        count, joints = len(clock), self.pose.local_quat_xyzw.shape[1]
        # Five seconds apart, so that the hips go round rather than to and fro on a line.
        phases = 2 * math.pi * (clock[:, None] + torch.tensor([0.0, 5.0], dtype=torch.float64))
        sway = sum((0.001 * size * torch.sin(hz * phases) for hz, size in _SWAY), torch.zeros(count, 2).double())
        sway = sway * smootherstep((clock / _SWAYS).clamp(max=1))[:, None]
        root = torch.lerp(self.pose.root_position, self.stand.root_position, settled) + rotations.lift_ground(sway)
        quats = rotations.slerp(
            self.pose.local_quat_xyzw.expand(count, -1, 4),
            self.stand.local_quat_xyzw.expand(count, -1, 4),
            settled.expand(count, joints),
        ).clone()
        breath = _BREATH * torch.sin(2 * math.pi * _BREATH_HZ * clock) * settled[:, 0]
        chest, tilt = CANONICAL.index("chest"), torch.stack([breath, 0 * breath, 0 * breath], dim=-1)
        quats[:, chest] = rotations.multiply(quats[:, chest], rotations.from_rotation_vector(-tilt))
        body = replace(self.pose, root_position=root, local_quat_xyzw=quats)
        toes, feet = (self.pose.joint_positions()[:, CANONICAL.indices(TOES)]).expand(count, -1, 3).clone(), []
        toes[..., 1] = torch.lerp(toes[..., 1], self.stand.joint_positions()[:, CANONICAL.indices(TOES), 1], settled)
        for first, last in zip(*(_feet(pose) for pose in (self.pose, self.stand)), strict=True):
            feet.append(rotations.slerp(first.expand(count, 4), last.expand(count, 4), settled[:, 0]))
        features = encode(_stand_on(body, toes, torch.stack(feet, dim=1)))[0][1:].float()
        features[:, LAYOUT.slices["contacts"]] = 1.0
        return replace(self, frames=self.frames + frames), features


def _feet(pose: Motion) -> Float[Tensor, "2 4"]:
    return pose.joint_rotations()[0, CANONICAL.indices(FEET)]


def _stand_on(body: Motion, toes: Float[Tensor, "frames 2 3"], feet: Float[Tensor, "frames 2 4"]) -> Motion:
    """Bring the feet of a body to positions of the toe joints and world rotations; hips are as low as legs need."""
    ankles = find_ankles(body.skeleton, toes, feet)
    return bend_legs(lower_hips(body, ankles, limb_extension(body, LEGS)), ankles, feet)
