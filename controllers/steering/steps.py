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
    pose_hips,
    stand_on,
    sway_from,
    swing_foot,
)
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, encode
from mapctl.intent.steering import Command, SteeringLimits, SteeringTarget
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, FEET, TOES, leg_length

_OFF_FACING = math.radians(35)  # between travel and facing, from which on travel is no walk
_TURNED = math.radians(8)  # from which on a standing body turns
_SAME_SPEED, _SAME_ANGLE = 0.1, math.radians(10)  # m/s and radians by which a command may change while steps obey it
_ROOT = slice(0, LAYOUT.slices["root_height"].start)  # what travels


def needs_steps(command: Command, heading: float, *, starts: bool = False) -> bool:
    """Return whether a body with a heading, radians, obeys a command by planned steps: where it is to turn on the spot,
    to travel off its facing, or to start to walk off its heading."""
    if command.turning is not None:
        return False
    if command.speed == 0:
        return abs(_wrap(command.hips_heading - heading)) > _TURNED
    return not _is_walk(command) or (starts and abs(_wrap(command.heading - heading)) > _OFF_FACING)


def _is_walk(command: Command) -> bool:
    return command.speed > 0 and abs(_wrap(command.heading - command.hips_heading)) <= _OFF_FACING


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

    def obey(self, command: Command, heading: float) -> bool:
        """Return whether they are under way and obey a command; a walk, until the body's heading, radians, is its."""
        if _is_walk(command) and abs(_wrap(command.heading - heading)) < _SAME_ANGLE:
            return False
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


_QUICK = 12  # frames from one step to the next into a stand
_FASTEST = 6  # frames from one step to the next at least: faster travel is as fast as that
_LANDING = 9  # frames that a swing under way still takes
_POSED = 30  # frames within which trunk and arms come to the pose of the stand
_THERE, _FACED = 0.05, math.radians(8)  # metres and radians from where hips come to rest: feet are put there at once
_MOVED = 0.03  # metres from which on a foot is lifted
_ARM_SWING = 0.7  # radians of an upper arm, for each metre that the foot of its side is ahead of the other one
_EASE = 8  # frames in which a turn comes to its rate


def plan_steps(
    pose: Motion, joints: Float[Tensor, "past joints 3"], stand: Motion, command: Command, limits: SteeringLimits
) -> PlannedSteps | None:
    """Plan steps by which a body travels as commanded, or comes to a stand, from its pose, at rest or under way;
    `joints` are the world positions of its last frames, metres. None where it is to stand and no foot has to move.

    Hips travel and turn as the limits allow. Feet alternate beneath them, each put where the hips are in the middle of
    its stance; to a side, both where the hips are between their stances, so that they do not cross. Steps follow each
    other as in any displacement, or sooner where feet would be too far apart, but no sooner than they can: faster
    travel is not planned. What repeats is planned once.
    """
    relative = command.heading - command.hips_heading if command.speed > 0 else 0.0
    aside, lead = math.sin(relative) ** 2, 0 if math.sin(relative) > 0 else 1
    longest, period = STEP * leg_length(stand.skeleton) / (1 + aside), _QUICK
    speed = min(command.speed, longest / _FASTEST * PRIOR_FPS)
    if speed > 0:
        period = min(SWING + BOTH, math.floor(longest / speed * PRIOR_FPS + 1e-6))
    move, targets, settled = _lay_track(pose, joints, stand, replace(command, speed=speed), limits)
    clock = torch.arange(len(move.track), dtype=torch.float64)
    swing = round(SWING / (SWING + BOTH) * period)
    velocities = torch.diff(joints[-2:, CANONICAL.indices(TOES)].double(), dim=0).reshape(-1, 3) * PRIOR_FPS
    airborne = [foot for foot, velocity in enumerate(velocities) if float(velocity.norm()) > AIRBORNE]
    airborne = sorted(airborne, key=lambda foot: -float(velocities[foot].norm()))[:1]

    def lay(first: int) -> list[Footstep]:
        plan, land, frames = list[Footstep](), _LANDING if airborne else BOTH + swing, len(move.track)
        while land < frames - 2 * period and (command.speed > 0 or [step.share for step in plan[-2:]] != [1.0, 1.0]):
            foot = (first + len(plan)) % 2
            middle = land + period - 0.5 * swing + (0.5 if foot == lead else -0.5) * aside * period
            share = min(1.0, middle / (frames - 1))
            left = (move.track[-1] - move.hips_at(clock.new_tensor([share]))[0]).abs()
            if command.speed == 0 and float(left[:2].norm()) < _THERE and float(left[2]) < _FACED:
                share = 1.0
            plan.append(Footstep(foot, max(0, land - swing), land, share))
            land += period
        return plan

    plan = min(map(lay, airborne or [0, 1]), key=lambda plan: measure_strain(move, plan))
    toes, turns, taken = [], [], list[Footstep]()
    for foot in range(2):
        steps, swings = [step for step in plan if step.foot == foot], list[Swing]()
        toe = begin = pose.joint_positions()[0, CANONICAL.index(TOES[foot])]
        turn = pose.joint_rotations()[0, CANONICAL.index(FEET[foot])]
        footholds = move.toes_at(foot, clock.new_tensor([step.share for step in steps]))
        for step, position, rotation in zip(steps, *footholds, strict=True):
            last = swings[-1].turn if swings else turn
            turned = float(rotations.to_rotation_vector(rotations.multiply(rotations.inverse(last), rotation)).norm())
            in_air = step.lift == 0 and foot in airborne
            if in_air or float((position - toe).norm()) > _MOVED or turned > _TURNED:
                swings.append(Swing(step, position, rotation, velocities[foot] if in_air else None))
                toe = position
        path, rotation = swing_foot(clock, begin, turn, swings)
        toes.append(path)
        turns.append(rotation)
        taken += [swing.step for swing in swings]
    if not taken:
        return None
    weight = smootherstep((clock / _POSED).clamp(max=1))
    sways = sum((sway_from(step, clock) for step in taken), torch.zeros_like(clock))
    body = pose_hips(pose, stand, move.track, sways, weight)
    apart = rotations.rotate_about_y(toes[0] - toes[1], -move.track[:, 2])[:, 2]
    for name, side in (("leftUpperArm", 1), ("rightUpperArm", -1)):
        arm, angle = CANONICAL.index(name), side * _ARM_SWING * weight * apart
        swung = rotations.from_rotation_vector(torch.stack([angle, 0 * angle, 0 * angle], dim=-1))
        body.local_quat_xyzw[:, arm] = rotations.multiply(swung, body.local_quat_xyzw[:, arm])
    features = encode(stand_on(body, torch.stack(toes, dim=1), torch.stack(turns, dim=1)))[0][1:].float()
    cycle = 2 * period if command.speed > 0 else 0
    frames = max(settled, _POSED) + 3 * period if cycle else max(step.land for step in taken) + 2
    return PlannedSteps(command, features[:frames].clone(), targets, cycle)


def _lay_track(
    pose: Motion, joints: Float[Tensor, "past joints 3"], stand: Motion, command: Command, limits: SteeringLimits
) -> tuple[Displacement, list[SteeringTarget], int]:
    """Lay where hips are frame by frame from now on, as fast as the limits allow; with their steering targets, and the
    frame from which on nothing changes."""
    heading = float(BodyPose.of_motion(pose).heading[0])
    velocity = torch.diff(joints[-4:, 0, ::2].double(), dim=0).sum(dim=0) * PRIOR_FPS / max(1, len(joints[-4:]) - 1)
    wanted = command.speed * velocity.new_tensor([math.sin(command.heading), math.cos(command.heading)])
    turn, rate = _wrap(command.hips_heading - heading), limits.acceleration if command.speed > 0 else limits.braking
    change = max(1, math.ceil(float((wanted - velocity).norm()) / rate * PRIOR_FPS))
    turned = _EASE + math.ceil(abs(turn) / limits.turn_rate * PRIOR_FPS)
    settled = max(change, turned)
    clock = torch.arange(max(settled, _POSED) + 6 * (SWING + BOTH), dtype=torch.float64)
    travel = torch.lerp(velocity, wanted, (clock / change).clamp(max=1)[:, None])
    path = pose.root_position[0, ::2] + (travel.cumsum(dim=0) - travel[0]) / PRIOR_FPS
    rates = torch.minimum(clock, turned - clock).clamp(0, _EASE)
    facing = heading + turn * rates.cumsum(dim=0) / rates.sum()
    direction = torch.where(travel.norm(dim=-1) > 0, torch.atan2(travel[:, 0], travel[:, 1]), facing)
    rows = torch.stack([travel.norm(dim=-1), direction, facing], dim=1)[1:].tolist()
    move = Displacement(stand, stand, torch.cat([path, facing[:, None]], dim=1))
    return move, [SteeringTarget(*row) for row in rows[:settled]], settled


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
