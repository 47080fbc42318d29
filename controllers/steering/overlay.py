"""Hands that reach and heads that look, live, on top of a steered walk: pose offsets with limited acceleration.

The density has no reaches, so they are no terms of its windows: arms, trunk and head are turned in the frames that it
delivers, and the next step continues from the walk alone. A hand moves toward its target while that can be reached
within half a second by the forecast, and lets it go behind the character. Both motions are of minimum jerk.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.kinematics import inverse
from mapctl.kinematics.inverse import bend_within, find_out, lead_about
from mapctl.kinematics.moving import turn_head
from mapctl.motion import Motion
from mapctl.numerics.easing import MinimumJerkTrack, smootherstep
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton

_RAISE_SECONDS = 0.7  # in which a hand goes to its position, and back
_TURN_SECONDS = 0.5  # in which a head turns there, and back
_MOVE_SECONDS, _MOVE_SPEED = (0.5, 1.2)  # least time in which a hand follows a moved target, and its mean speed, m/s
_AHEAD_FRAMES = 15  # of the forecast, after which a position must be in reach
_NEAR = 0.45  # metres beyond the arm at which a hand sets out, to reach with a lean or to point there
_LET_GO = 0.1  # metres farther than that, at which a hand lets go
_BEHIND = 0.45  # cosine below zero of the angle to a shoulder's front beyond which nothing is reached
_EASY_SHARE = 0.85  # of an arm's length, beyond which the trunk leans
_BENT_SHARE, _STRETCHED_SHARE = 0.95, 0.99  # of it, between which an arm gives up reaching exactly
_MOST_LEAN = 0.4  # radians that the trunk turns toward a position, twice
_LEAN_EASE = 0.03  # metres out of reach, up to which the trunk hardly moves
_BEGUN_SHARE = 0.15  # of the motion, in which an elbow comes to where inverse kinematics has it
_TRUNK = CANONICAL.indices(("spine", "chest"))
_HEAD = "head"


@dataclass(frozen=True, eq=False)
class PartTrack:
    """Progress of a hand or the head towards a position, and that position."""

    weight: MinimumJerkTrack
    """Share of the distance, 0 to 1."""
    position: MinimumJerkTrack
    """Position in the world, metres."""

    @staticmethod
    def begin(position: tuple[float, float, float]) -> "PartTrack":
        """Begin without a share."""
        zero = torch.zeros(1, dtype=torch.float64)
        return PartTrack(MinimumJerkTrack.rest_at(zero), MinimumJerkTrack.rest_at(zero.new_tensor(position)))

    @property
    def idle(self) -> bool:
        """Whether it has no share, and will have none."""
        return self.weight.resting and float(self.weight.value) == 0.0

    def aim(self, position: tuple[float, float, float] | None, wanted: bool, seconds: float) -> "PartTrack":
        """Go toward a position if it is wanted, and back if not."""
        found = self
        if position is not None:
            goal = self.position.goal.new_tensor(position)
            distance = float((goal - self.position.value).norm())
            moved = self.position.aim(goal, max(_MOVE_SECONDS, distance / _MOVE_SPEED))
            found = replace(self, position=MinimumJerkTrack.rest_at(goal) if self.idle else moved)
        return replace(found, weight=found.weight.aim(found.weight.goal.new_tensor([float(wanted)]), seconds))

    def move(self, frames: int) -> tuple["PartTrack", Float[Tensor, " frames"], Float[Tensor, "frames 3"]]:
        """Move on for so many frames; also return share and position in each."""
        track, weights, positions = self, [], []
        for _ in range(frames):
            track = PartTrack(track.weight.move(1 / PRIOR_FPS), track.position.move(1 / PRIOR_FPS))
            weights.append(track.weight.value)
            positions.append(track.position.value)
        return track, torch.cat(weights), torch.stack(positions)


@dataclass(frozen=True, eq=False)
class Overlay:
    """Motion of hands and head on top of the walk; `pose` returns the frames and the next overlay."""

    parts: Mapping[str, PartTrack] = field(default_factory=dict)
    """Tracks by `leftHand`, `rightHand` and `head`, of those that are not idle."""

    def pose(
        self, walk: Motion, command: Command, forecast: Float[Tensor, "ahead joints 3"]
    ) -> tuple["Overlay", Motion]:
        """Pose the frames of a step under a command; `forecast` holds the world joints of the frames after them.
        A walk with nothing to reach for and to look at comes back as it is."""
        if not (self.parts or command.reach or command.look_at):
            return self, walk
        parts = self._aim_parts(walk, command, forecast)
        moved = {name: part.move(walk.num_frames) for name, part in parts.items()}
        arms = {name: moved[name][1:] for name in moved if name != _HEAD}
        posed = _reach(_lean(_lean(walk, arms), arms), arms) if arms else walk
        if _HEAD in moved:
            posed = turn_head(posed, moved[_HEAD][2], moved[_HEAD][1])
        return Overlay({name: part for name, (part, *_) in moved.items() if not part.idle}), posed

    def _aim_parts(self, walk: Motion, command: Command, forecast: Tensor) -> dict[str, PartTrack]:
        parts = dict(self.parts)
        joints = torch.cat([walk.joint_positions(), forecast.to(walk.root_position)])
        soon = joints[min(walk.num_frames - 1 + _AHEAD_FRAMES, len(joints) - 1)]
        for name in {*parts, *command.reach} - {_HEAD}:
            position = command.reach.get(name)
            part = parts.get(name) or PartTrack.begin(position or (0.0, 0.0, 0.0))
            moving = bool(part.weight.goal > 0)
            wanted = position is not None and _is_in_reach(name, position, soon, walk.skeleton, keep=moving)
            if wanted or name in parts:
                parts[name] = part.aim(position, wanted, _RAISE_SECONDS)
        if command.look_at is not None or _HEAD in parts:
            part = parts.get(_HEAD) or PartTrack.begin(command.look_at or (0.0, 0.0, 0.0))
            parts[_HEAD] = part.aim(command.look_at, command.look_at is not None, _TURN_SECONDS)
        return parts


def _is_in_reach(
    name: str,
    position: tuple[float, float, float],
    joints: Float[Tensor, "joints 3"],
    skeleton: Skeleton,
    *,
    keep: bool,
) -> bool:
    """Return whether a hand gets to a position with a lean of the trunk; one that is to `keep`, a little farther."""
    limb = LIMBS[name]
    away = joints.new_tensor(position) - joints[limb.upper]
    near = float(away.norm()) < limb.length(skeleton) + _NEAR + _LET_GO * keep
    return near and float(away @ find_out(name, joints[None])[0]) > -_BEHIND * float(away.norm())


def _lean(walk: Motion, arms: Mapping[str, tuple[Tensor, Tensor]]) -> Motion:
    """Turn the trunk toward what arms alone do not reach, about as far as brings the shoulders there: they go there on
    a circle, so that a second lean is needed over long distances."""
    joints, turn = walk.joint_positions(), torch.zeros(walk.num_frames, 3, dtype=torch.float64)
    for name, (weight, position) in arms.items():
        limb = LIMBS[name]
        length = limb.length(walk.skeleton)
        shoulder, away = joints[:, limb.upper] - joints[:, _TRUNK[0]], position - joints[:, limb.upper]
        short = (away.norm(dim=-1) - _EASY_SHARE * length).clamp_min(0)
        angle = short**2 / (short + _LEAN_EASE) / shoulder.norm(dim=-1)
        angle = weight * _MOST_LEAN * torch.tanh(angle / _MOST_LEAN)
        axis = torch.nn.functional.normalize(torch.linalg.cross(shoulder.to(away), away), dim=-1)
        turn = turn + angle[:, None] * axis
    quats, half = walk.local_quat_xyzw.clone(), rotations.from_rotation_vector(turn / 2).to(walk.local_quat_xyzw)
    for joint in _TRUNK:
        above = replace(walk, local_quat_xyzw=quats).joint_rotations()[:, CANONICAL.parents[joint]]
        world = rotations.multiply(half, rotations.multiply(above, quats[:, joint]))
        quats[:, joint] = rotations.multiply(rotations.inverse(above), world)
    return replace(walk, local_quat_xyzw=quats)


def _reach(motion: Motion, arms: Mapping[str, tuple[Tensor, Tensor]]) -> Motion:
    """Bend arms of a motion so that hands go by their shares from where they are to the positions."""
    joints, world = motion.joint_positions(), motion.joint_rotations()
    quats = motion.local_quat_xyzw.clone()
    for name, (weight, position) in arms.items():
        limb, offsets = LIMBS[name], motion.skeleton.offsets.to(joints)
        length = limb.length(motion.skeleton)
        aim = position.to(joints) - joints[:, limb.upper]
        aim = bend_within(aim, length, easy=_BENT_SHARE, most=_STRETCHED_SHARE)
        own, out = joints[:, limb.end] - joints[:, limb.upper], find_out(name, joints)
        aim = lead_about(own, aim, weight.to(joints), out=out)
        turned, bent = inverse.reach(limb, world[:, limb.upper], quats[:, limb.lower], aim, offsets)
        above = world[:, CANONICAL.parents[limb.upper]]
        begun = smootherstep(weight / _BEGUN_SHARE).to(joints)
        for joint, local in ((limb.upper, rotations.multiply(rotations.inverse(above), turned)), (limb.lower, bent)):
            quats[:, joint] = rotations.slerp(quats[:, joint], local.to(quats), begun)
    return replace(motion, local_quat_xyzw=quats)
