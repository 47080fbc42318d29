"""Planned steps and stands of a steered body.

No walk leads a standing body backward, to a side or round on the spot, and a search that begins at rest finds both feet
planted. Footsteps are planned for it (`controllers.shots.footsteps`), and the search starts from them, contacts
included. A body that has come to rest over its feet stands: frames sway about one pose, without a search.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.footsteps import (
    Displacement,
    bend_legs,
    find_ankles,
    find_lowering,
    lower_hips,
    plan_footsteps,
    take_steps,
)
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.intent.steering import Command, SteeringTarget
from mapctl.kinematics.moving import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, FEET, TOES, Skeleton

PLANNED_FRAMES = 150
"""Frames of travel that are planned at once, at PRIOR_FPS."""
_STEP_FRAMES = 11  # of a step of a turn on the spot, or into a stand
_OFF_FACING = math.radians(35)  # between travel and facing, from which on travel is no walk
_TURNED = math.radians(8)  # from which on a standing body turns
_SAME_SPEED, _SAME_ANGLE = 0.25, math.radians(20)  # m/s and radians by which a command may change while steps obey it
_ROOT = slice(0, LAYOUT.slices["root_height"].start)  # what travels


def needs_steps(command: Command, heading: float) -> bool:
    """Return whether a standing body with a heading, radians, obeys a command by planned steps."""
    if command.turning is not None:
        return False
    if command.speed == 0:
        return abs(_wrap(command.hips_heading - heading)) > _TURNED
    return abs(_wrap(command.heading - command.hips_heading)) > _OFF_FACING


@dataclass(frozen=True, eq=False)
class PlannedSteps:
    """Steps that are taken from a stand."""

    command: Command
    """Command that they obey."""
    features: Float[Tensor, "frames size"]
    """Frames that are left."""

    def obey(self, command: Command) -> bool:
        """Return whether they are under way and obey a command."""
        turned = command.heading - self.command.heading, command.hips_heading - self.command.hips_heading
        near = abs(command.speed - self.command.speed) < _SAME_SPEED and (command.speed > 0) == (self.command.speed > 0)
        return len(self.features) > 0 and near and all(abs(_wrap(angle)) < _SAME_ANGLE for angle in turned)

    def window(self, frames: int) -> Float[Tensor, "frames size"]:
        """Return the next frames; after the last of them the body stands."""
        still = self.features[-1:].clone()
        still[:, _ROOT] = 0.0
        return torch.cat([self.features[:frames], still.expand(max(0, frames - len(self.features)), -1)])

    def after(self, frames: int) -> "PlannedSteps":
        """Return what is left after so many frames."""
        return replace(self, features=self.features[frames:])


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


def plan_steps(pose: Motion, stand: Motion, command: Command, targets: Sequence[SteeringTarget]) -> PlannedSteps | None:
    """Plan the steps from a pose toward steering targets; at their end the body is in the stand, which is given at the
    pose's ground position and heading. None where no foot has to move."""
    path = torch.tensor([target.velocity for target in targets], dtype=torch.float64).cumsum(dim=0) / PRIOR_FPS
    heading = float(BodyPose.of_motion(pose).heading[0])
    turns = torch.tensor([[_wrap(target.facing - heading)] for target in targets], dtype=torch.float64)
    turns[:, 0] = rotations.unwrap_angle(torch.cat([turns.new_zeros(1), turns[:, 0]]))[1:]
    here = torch.tensor([*pose.root_position[0, ::2].tolist(), heading], dtype=torch.float64)
    track = here + torch.cat([path.new_zeros(1, 3), torch.cat([path, turns], dim=1)])
    stop = move_to(rotate_about_vertical(stand, float(turns[-1])), track[-1, :2])
    move = Displacement.between(pose, stop, track)
    frames = len(targets) if command.speed > 0 else _STEP_FRAMES * move.count_steps() + 3
    least = 2 if move.moves_feet else 0
    steps = plan_footsteps(move, frames, least=least)
    if command.speed > 0 and not move.leads_aside and len(steps) > 1:
        # The first and the last step are half ones: hips would go faster between them.
        frames = round(frames * len(steps) / (len(steps) - 1))
        steps = plan_footsteps(move, frames, least=least)
    return PlannedSteps(command, encode(take_steps(move, steps, frames))[0][1:].float()) if steps else None


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
    return bend_legs(lower_hips(body, find_lowering(body, ankles)), ankles, feet)


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
