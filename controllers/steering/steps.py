"""Planned steps of a steered body.

No walk leads a body backward, to a side or round on the spot, and a search that begins at rest finds both feet planted.
Footsteps are planned for it, and the search starts from them, contacts included.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.footsteps import (
    AIRBORNE,
    BOTH,
    STEP,
    SWING,
    Displacement,
    Footstep,
    Swing,
    measure_strain,
    plan_footsteps,
    pose_hips,
    stand_on,
    sway_from,
    swing_foot,
    take_steps,
)
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, encode
from mapctl.intent.steering import Command, SteeringLimits, SteeringTarget
from mapctl.kinematics.moving import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, FEET, TOES, leg_length

_STEP_FRAMES = 11  # of a step of a turn on the spot, or into a stand
_OFF_FACING = math.radians(35)  # between travel and facing, from which on travel is no walk
_TURNED = math.radians(8)  # from which on a standing body turns
_SAME_SPEED, _SAME_ANGLE = 0.1, math.radians(10)  # m/s and radians by which a command may change while steps obey it
_ROOT = slice(0, LAYOUT.slices["root_height"].start)  # what travels


def needs_steps(command: Command, heading: float) -> bool:
    """Return whether a body with a heading, radians, obeys a command by planned steps; at rest, if it is to stand."""
    if command.turning is not None:
        return False
    if command.speed == 0:
        return abs(_wrap(command.hips_heading - heading)) > _TURNED
    return abs(_wrap(command.heading - command.hips_heading)) > _OFF_FACING


@dataclass(frozen=True, eq=False)
class PlannedSteps:
    """Steps that a command is obeyed by."""

    command: Command
    """Command that they obey."""
    features: Float[Tensor, "frames size"]
    """Frames of the plan."""
    targets: Sequence[SteeringTarget]
    """Steering targets of the first of them; the last one holds for the others."""
    cycle: int = 0
    """Number of last frames that repeat; 0 if it ends in a stand."""
    taken: int = 0
    """Frames that are delivered."""

    @property
    def ended(self) -> bool:
        """Whether its last frame, a stand, is delivered."""
        return not self.cycle and self.taken >= len(self.features)

    def obey(self, command: Command) -> bool:
        """Return whether they are under way and obey a command."""
        turned = command.heading - self.command.heading, command.hips_heading - self.command.hips_heading
        near = abs(command.speed - self.command.speed) < _SAME_SPEED and (command.speed > 0) == (self.command.speed > 0)
        return not self.ended and near and all(abs(_wrap(angle)) < _SAME_ANGLE for angle in turned)

    def window(self, frames: int) -> Float[Tensor, "frames size"]:
        """Return the next frames."""
        at, last = torch.arange(self.taken, self.taken + frames), len(self.features) - 1
        if self.cycle:
            first = len(self.features) - self.cycle
            return self.features[torch.where(at < first, at, first + (at - first) % self.cycle)]
        features = self.features[at.clamp(max=last)]
        features[at > last, _ROOT] = 0.0
        return features

    def targets_of(self, frames: int) -> list[SteeringTarget]:
        """Return the steering targets of the next frames."""
        return [self.targets[min(self.taken + ahead, len(self.targets) - 1)] for ahead in range(frames)]

    def after(self, frames: int) -> "PlannedSteps":
        """Return the plan after so many frames of it."""
        return replace(self, taken=self.taken + frames)


def plan_turn(pose: Motion, stand: Motion, facing: float, limits: SteeringLimits) -> PlannedSteps | None:
    """Plan the steps of a body at rest into a stand that faces elsewhere, radians; the stand is given at the pose's
    ground position and heading. None where no foot has to move."""
    heading = float(BodyPose.of_motion(pose).heading[0])
    turn = _wrap(facing - heading)
    here = torch.tensor([*pose.root_position[0, ::2].tolist(), heading], dtype=torch.float64)
    track = torch.stack([here, here + here.new_tensor([0.0, 0.0, turn])])
    move = Displacement.between(pose, move_to(rotate_about_vertical(stand, turn), here[:2]), track)
    frames = _STEP_FRAMES * move.count_steps() + 3
    steps = plan_footsteps(move, frames, least=2 if move.moves_feet else 0)
    if not steps:
        return None
    command, start = Command(0.0, facing), SteeringTarget(0.0, facing, heading)
    targets = start.ahead(command, limits, frames=frames, fps=PRIOR_FPS)
    return PlannedSteps(command, encode(take_steps(move, steps, frames))[0][1:].float(), targets)


_POSED = 30  # frames within which trunk and arms come to the pose of the travel
_LANDING = 9  # frames that a swing under way still takes
_ARM_SWING = 0.7  # radians of an upper arm, for each metre that the foot of its side is ahead of the other one


def plan_travel(
    pose: Motion, joints: Float[Tensor, "past joints 3"], stand: Motion, command: Command, limits: SteeringLimits
) -> PlannedSteps:
    """Plan steps by which a body travels as commanded, from its pose, at rest or under way; `joints` are the world
    positions of its last frames, metres.

    Hips travel and turn as the limits allow. Feet alternate beneath them, each put where the hips are in the middle of
    its stance; to a side, both where the hips are between their stances, so that they do not cross. Steps take as long
    as people's who walk backward and to a side (17 frames: the median of the clips of `bandai-namco-1`), or less where
    feet would be too far apart. What repeats is planned once.
    """
    heading = float(BodyPose.of_motion(pose).heading[0])
    relative, turn = command.heading - command.hips_heading, _wrap(command.hips_heading - heading)
    aside, lead = math.sin(relative) ** 2, 0 if math.sin(relative) > 0 else 1
    longest = STEP * leg_length(stand.skeleton) / (1 + aside)
    period = min(SWING + BOTH, math.floor(longest / command.speed * PRIOR_FPS))
    speeds = torch.diff(joints[-4:].double(), dim=0) * PRIOR_FPS
    velocity, toe_velocity = speeds[:, 0, ::2].mean(dim=0), speeds[-1, CANONICAL.indices(TOES)]
    wanted = command.speed * velocity.new_tensor([math.sin(command.heading), math.cos(command.heading)])
    change = math.ceil(float((wanted - velocity).norm()) / limits.acceleration * PRIOR_FPS)
    change, turned = max(1, change), max(1, math.ceil(abs(turn) / limits.turn_rate * PRIOR_FPS))
    begin = max(change, turned, _POSED) + 2 * period  # of the cycle
    clock = torch.arange(begin + 6 * period, dtype=torch.float64)
    velocities = torch.lerp(velocity, wanted, smootherstep((clock / change).clamp(max=1))[:, None])
    path = pose.root_position[0, ::2] + (velocities.cumsum(dim=0) - velocities[0]) / PRIOR_FPS
    facing = heading + turn * smootherstep((clock / turned).clamp(max=1))
    move = Displacement(stand, stand, torch.cat([path, facing[:, None]], dim=1))
    swinging = int(toe_velocity.norm(dim=-1).argmax())
    airborne = float(toe_velocity[swinging].norm()) > AIRBORNE
    swing = round(SWING / (SWING + BOTH) * period)
    plans = list[list[Footstep]]()
    for first in [swinging] if airborne else [0, 1]:
        plan, land = list[Footstep](), _LANDING if airborne else BOTH + swing
        while land - swing < len(clock):
            foot = (first + len(plan)) % 2
            middle = land + period - 0.5 * swing + (0.5 if foot == lead else -0.5) * aside * period
            plan.append(Footstep(foot, max(0, land - swing), land, min(1.0, middle / (len(clock) - 1))))
            land += period
        plans.append(plan)
    plan = min(plans, key=lambda plan: measure_strain(move, plan))
    toes, turns, rotation = [], [], pose.joint_rotations()[0]
    for foot in range(2):
        steps = [step for step in plan if step.foot == foot]
        stands = zip(steps, *move.toes_at(foot, clock.new_tensor([step.share for step in steps])), strict=True)
        swings = [Swing(*each) for each in stands]
        if airborne and foot == swinging:
            swings[0] = replace(swings[0], velocity=toe_velocity[foot])
        toe, turn = swing_foot(
            clock, pose.joint_positions()[0, CANONICAL.index(TOES[foot])], rotation[CANONICAL.index(FEET[foot])], swings
        )
        toes.append(toe)
        turns.append(turn)
    sways = sum((sway_from(step, clock) for step in plan), torch.zeros_like(clock))
    weight = smootherstep((clock / _POSED).clamp(max=1))
    body = pose_hips(pose, stand, move.track, sways, weight)
    apart = rotations.rotate_about_y(toes[0] - toes[1], -facing)[:, 2]
    for name, side in (("leftUpperArm", 1), ("rightUpperArm", -1)):
        arm, angle = CANONICAL.index(name), side * _ARM_SWING * weight * apart
        swung = rotations.from_rotation_vector(torch.stack([angle, 0 * angle, 0 * angle], dim=-1))
        body.local_quat_xyzw[:, arm] = rotations.multiply(swung, body.local_quat_xyzw[:, arm])
    motion = stand_on(body, torch.stack(toes, dim=1), torch.stack(turns, dim=1))
    speed, direction = velocities.norm(dim=-1), torch.atan2(velocities[:, 0], velocities[:, 1])
    targets = [SteeringTarget(*each) for each in torch.stack([speed, direction, facing], dim=1)[1 : begin + 1].tolist()]
    features = encode(motion)[0][1 : begin + 2 * period + 1].float()
    return PlannedSteps(command, features, targets, cycle=2 * period)


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
