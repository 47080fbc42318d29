"""The way to a place, worked out a frame at a time between deadlines, while frames that are known before it play."""

import math
from collections.abc import Generator
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.steering.steer import KEPT_FRAMES, SteerState, condition_prior
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root, reversed_features
from mapctl.intent.steering import Arrival, Command
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.problem.receding_horizon import CommittedFrames, replay
from mapctl.runtime.stepwise import StepwiseWork

LEAST_FRAMES = 4
"""Frames of the shortest way."""
_FAR = 0.3  # metres from which on the way to a place says where to face there
_CANDIDATES = 4  # moments of the prior that are tried at the place
_AFTER = 10  # frames of the prior's own continuation that say how motion goes on from there
_PAST_FRAMES = 60  # that are kept for terms that look back


@runtime_checkable
class TransitionMaker(Protocol):
    """Who makes the frames between two poses."""

    @property
    def longest(self) -> int:
        """Most frames between two poses."""
        ...

    def connect(
        self,
        before: Float[Tensor, "before size"],
        after: Float[Tensor, "batch after size"],
        place: Float[Tensor, "batch 2"],
        turn: Float[Tensor, " batch"],
        frames: int,
    ) -> Generator[None, None, Float[Tensor, "batch frames size"]]:
        """Make, a frame at a time, features from the frame after the last of `before` to the last of `after`, which is
        run backwards and `frames` later: there, seen from the last of `before`, is `place`, metres, and the heading
        another by `turn`."""
        ...


def begin_way(
    transitions: TransitionMaker,
    state: SteerState,
    command: Command,
    order: Arrival,
    frames: int,
    *,
    planned: Float[Tensor, "ahead size"],
) -> tuple[Float[Tensor, "held size"], StepwiseWork[Float[Tensor, "rest size"]]]:
    """Begin the way to a place, so many frames away: return features of the first frames, which play meanwhile, and
    the work that makes the others.

    The first are those of the next step as they were `planned` before; there are none where no time is left for the
    rest of the way after them.
    """
    held = planned[: state.settings.commit]
    if frames - len(held) < LEAST_FRAMES:
        held = held[:0]
    there = replace(state, committed=commit_frames(state, held)) if len(held) else state
    if len(held) and needed_speed(there, order, frames - len(held)) > state.prior.limits.max_steering_speed:
        there, held = state, held[:0]
    return held, StepwiseWork(plan_way(transitions, there, command, order, frames - len(held)))


def commit_frames(state: SteerState, new: Float[Tensor, "frames size"]) -> CommittedFrames:
    """Return what is committed after frames that nobody has solved: the density's state is advanced over them."""
    committed = state.committed
    start = GroundPose(committed.place.position_xz.double(), committed.place.heading.double())
    ground, facing = integrate_root(new.double(), start)  # in single precision a long way would not end on the place
    unit = decode(new, committed.place, skeleton=state.character.unit_skeleton)
    joints = torch.cat([committed.joints_world, unit.joint_positions().to(committed.joints_world)])
    return replace(
        committed,
        state=replay(state.prior, new, committed.state),  # pyright: ignore[reportArgumentType]
        place=GroundPose(ground[-1].float(), facing[-1].float()),
        features=torch.cat([committed.features, new]),
        joints_world=joints[-_PAST_FRAMES:],
        warm_start=committed.warm_start[:0],
        forecast=None,
    ).discard_history(KEPT_FRAMES)


def needed_speed(state: SteerState, order: Arrival, frames: int) -> float:
    """Return the mean speed that a place needs, m/s of a body of unit size."""
    here = state.committed.place.position_xz * state.character.scale
    return math.dist(order.place, here.tolist()) / state.character.scale * PRIOR_FPS / frames


def plan_way(
    transitions: TransitionMaker, state: SteerState, command: Command, order: Arrival, frames: int
) -> Generator[None, None, Float[Tensor, "frames size"]]:
    """Plan the frames to a place, a frame at a time, in the pose there to which the way is smoothest."""
    character = state.character
    after = _pose_candidates(state, command, order)
    here = state.committed.place
    place = torch.tensor(order.place, dtype=torch.float32) / character.scale
    facing = order.facing
    if facing is None:
        away = place - here.position_xz
        facing = float(here.heading) if float(away.norm()) < _FAR else math.atan2(*away.tolist())
    seen = rotations.rotate_ground(place - here.position_xz, -here.heading)
    turn = rotations.wrap_angle(torch.tensor(facing, dtype=torch.float32) - here.heading)
    count = len(after)
    ways = yield from transitions.connect(
        state.committed.features, after, seen.expand(count, -1), turn.expand(count), frames
    )
    return ways[int(_measure_roughness(state, ways).argmin())]


def _pose_candidates(state: SteerState, command: Command, order: Arrival) -> Float[Tensor, "batch after size"]:
    """Frames at the place run backwards, the pose there last: the given pose alone, or moments of the prior and how
    motion goes on from them."""
    if order.pose is not None:
        pose = order.pose
        still = Motion(
            pose.skeleton, pose.fps, pose.root_position.expand(2, -1), pose.local_quat_xyzw.expand(2, -1, -1)
        )
        return encode(still)[0][:1].float()[None]
    prior = condition_prior(state.prior, command.labels) if command.labels else state.prior
    starts = prior.initial_states
    speed = command.speed / state.character.scale
    near = (starts.speed - speed).abs().argsort()[:_CANDIDATES]
    begun = starts.state.pick(near)
    noise = torch.zeros(len(near), _AFTER, LAYOUT.continuous)
    with torch.no_grad():
        on, _ = prior.rollout(begun, noise, prior.plan(begun, noise))
    return reversed_features(torch.cat([begun.last_frame[:, None], on], dim=1))


def _measure_roughness(state: SteerState, ways: Float[Tensor, "batch frames size"]) -> Float[Tensor, " batch"]:
    """Measure the root mean square acceleration of the joints on ways from where the character is."""
    rough = []
    for way in ways:
        joints = decode(way, state.committed.place, skeleton=state.character.unit_skeleton).joint_positions()
        whole = torch.cat([state.committed.joints_world[-2:].to(joints), joints])
        rough.append(torch.diff(whole, n=2, dim=0).square().sum(dim=-1).mean().sqrt())
    return torch.stack(rough)
