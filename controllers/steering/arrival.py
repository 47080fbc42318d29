"""Arrivals: be at a ground position, facing so, at a time. A walk is steered toward a far target, its end is stitched.

Ren et al. 2024 generate what lies between two poses; here the first is the last that was delivered, with those before
it, and the second is the target: a given pose, or one of the initial states of the prior, walking on or standing. A
step that is steered toward the target plays while this is computed. The density's state is then advanced over what was
shown, and steering goes on.
"""

import math
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.steering.steer import (
    Approach,
    Refusal,
    SteerFrames,
    SteerState,
    commit_frames,
    condition_prior,
    deliver,
    step,
)
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, reversed_features
from mapctl.intent.steering import Arrival, Command, SteeringTarget
from mapctl.pose import decode
from mapctl.runtime.stepwise import StepwiseWork

if TYPE_CHECKING:
    from priors.stitcher import Stitcher

LEAST_FRAMES = 4
"""Frames of the shortest stitched trajectory."""
_FAR = 0.3  # metres beyond which the direction to a target is the facing there
_CANDIDATES = 4  # moments of the prior that are tried at the position
_AFTER = 10  # frames of the prior's own continuation, as context of how motion continues from there


def needed_speed(state: SteerState, order: Arrival, frames: int) -> float:
    """Return the mean speed that a target needs, m/s of a body of unit size."""
    here = state.committed.ground_pose.position_xz * state.character.scale
    return math.dist(order.position, here.tolist()) / state.character.scale * PRIOR_FPS / frames


def plan_stitch(
    transitions: "Stitcher", state: SteerState, command: Command, order: Arrival, frames: int
) -> Generator[None, None, Float[Tensor, "frames size"]]:
    """Plan the frames to a target, a frame at a time, in the pose there to which the motion is smoothest."""
    character = state.character
    after = _pose_candidates(state, command, order)
    here = state.committed.ground_pose
    position = torch.tensor(order.position, dtype=torch.float32) / character.scale
    facing = order.facing
    if facing is None:
        away = position - here.position_xz
        facing = float(here.heading) if float(away.norm()) < _FAR else math.atan2(*away.tolist())
    seen = rotations.rotate_ground(position - here.position_xz, -here.heading)
    turn = rotations.wrap_angle(torch.tensor(facing, dtype=torch.float32) - here.heading)
    count = len(after)
    found = yield from transitions.connect(
        state.committed.features, after, seen.expand(count, -1), turn.expand(count), frames
    )
    return found[int(_measure_roughness(state, found).argmin())].clone()  # a view would keep, and pickle, all of them


def _pose_candidates(state: SteerState, command: Command, order: Arrival) -> Float[Tensor, "batch after size"]:
    """Frames at the position run backwards, the pose there last: the given pose alone, or moments of the prior and how
    motion continues from them."""
    if order.pose is not None:
        return encode(order.pose.pick(torch.zeros(2, dtype=torch.long)))[0][:1].float()[None]
    prior = condition_prior(state.prior, command.labels)
    starts = prior.initial_states
    speed = command.speed / state.character.scale
    near = (starts.speed - speed).abs().argsort()[:_CANDIDATES]
    begun = starts.state.pick(near)
    noise = torch.zeros(len(near), _AFTER, LAYOUT.continuous)
    with torch.no_grad():
        on, _ = prior.rollout(begun, noise, prior.plan(begun, noise))
    return reversed_features(torch.cat([begun.last_frame[:, None], on], dim=1))


def _measure_roughness(state: SteerState, motions: Float[Tensor, "batch frames size"]) -> Float[Tensor, " batch"]:
    """Measure the root mean square acceleration of the joints of motions from where the character is."""
    rough = []
    for features in motions:
        joints = decode(features, state.committed.ground_pose, skeleton=state.character.unit_skeleton).joint_positions()
        whole = torch.cat([state.committed.joints_world[-2:].to(joints), joints])
        rough.append(torch.diff(whole, n=2, dim=0).square().sum(dim=-1).mean().sqrt())
    return torch.stack(rough)


_STITCHED_FRAMES = 45  # at the end of a motion that is walked first
_LEAST_SPEED = 0.3  # m/s below which the character does not set out: there is time to stand first


@dataclass(frozen=True, eq=False)
class Arriver:
    """A step of steering that obeys orders to be somewhere."""

    transitions: "Stitcher"
    """Model of the frames between two poses."""

    def __call__(
        self, state: SteerState, command: Command, *, seconds: float | None = None
    ) -> tuple[SteerState, SteerFrames]:
        """Solve or deliver the next frames, as `controllers.steering.steer.step`. A command whose order cannot be met
        is not obeyed: the one before it holds, and the frames' `refusal` has the reason."""
        began = time.perf_counter()
        order, plain, refusal = command.arrival, replace(command, arrival=None), None
        approach = state.approach
        if order is None:
            return step(replace(state, approach=Approach(None, plain)), plain, seconds=seconds)
        left = round(order.by * PRIOR_FPS) - state.frames + 1
        condition_prior(state.prior, command.labels)  # unknown labels are refused now, not where they first matter
        old, new = approach, approach is None or approach.order != order
        if approach is None or new:
            refusal = _refuse(state, order, left)
            before = approach.held if approach and refusal else plain
            approach = Approach(order, before, refused=refusal is not None)
        # What is too far is walked first until little is left; what can be stitched as a whole is.
        most = self.transitions.longest + 1 if new else _STITCHED_FRAMES
        if approach.planned is None and not approach.refused and left <= most:
            ahead = None if old is None else old.ahead()
            planned = state.committed.features[:0] if ahead is None else ahead
            if not len(planned) and (found := self._set_out(state, approach, command, left)) is not None:
                after, frames, work = found
                _proceed(work, began, seconds)
                return after, frames
            approach = self._begin_stitch(state, approach, command, order, left, planned)
        if approach.rest is not None and approach.planned is not None and not len(approach.planned):
            approach = replace(approach, planned=approach.rest.finish(), rest=None)
        if approach.planned is not None and len(approach.planned):
            delivered = _deliver(state, approach, plain)
            if approach.rest is not None:
                _proceed(approach.rest, began, seconds)
            return delivered
        there = approach.refused or approach.planned is not None
        led = approach.held if there else _lead_to(state, plain, order, left)
        state, frames = step(replace(state, approach=approach), led, seconds=seconds)
        return state, replace(frames, refusal=refusal)

    def _begin_stitch(
        self, state: SteerState, approach: Approach, command: Command, order: Arrival, left: int, planned: Tensor
    ) -> Approach:
        """Begin the stitch to a target, so many frames away. Frames of the next step as they were `planned` before play
        meanwhile; none where no time is left for the rest after them."""
        held = planned[: state.settings.commit]
        if left - len(held) < LEAST_FRAMES:
            held = held[:0]
        there = replace(state, committed=commit_frames(state, held)) if len(held) else state
        if len(held) and needed_speed(there, order, left - len(held)) > state.prior.limits.max_steering_speed:
            there, held = state, held[:0]
        rest = plan_stitch(self.transitions, there, command, order, left - len(held))
        return replace(approach, planned=held, rest=StepwiseWork(rest))

    def _set_out(
        self, state: SteerState, approach: Approach, command: Command, left: int
    ) -> tuple[SteerState, SteerFrames, StepwiseWork[Tensor]] | None:
        """Solve a step towards the position, so that the order is seen at once, and return it with the work on the
        approach from its end; None where that leaves too little time for the approach."""
        order, settings = command.arrival, state.settings
        assert order is not None
        if (rest := left - settings.commit) < LEAST_FRAMES:
            return None
        # In few evaluations, so that there is time for the approach, and always as many, so that it is always the same.
        quick = replace(settings, evaluations=settings.least_evaluations or 1)
        led = _lead_to(state, replace(command, arrival=None), order, left)
        there, frames = step(replace(state, settings=quick), led)
        there = replace(there, settings=settings)
        if needed_speed(there, order, rest) > state.prior.limits.max_steering_speed:
            return None
        work = StepwiseWork(plan_stitch(self.transitions, there, command, order, rest))
        nothing = there.committed.features[:0]
        return replace(there, approach=replace(approach, planned=nothing, rest=work)), frames, work


def _proceed(work: StepwiseWork[Tensor], began: float, seconds: float | None) -> None:
    """Do as much of the work as the time of a step that began then allows."""
    if seconds is not None:
        work.proceed(seconds - (time.perf_counter() - began))


def _refuse(state: SteerState, order: Arrival, frames: int) -> Refusal | None:
    """Return why an order cannot be met in so many frames; None where it can."""
    left, least, scale = frames / PRIOR_FPS, LEAST_FRAMES / PRIOR_FPS, state.character.scale
    if frames < LEAST_FRAMES:
        reason = f"an arrival in {left:.2f} s is not obeyed: the shortest takes {least:.2f} s"
        return Refusal(order, reason)
    needs, fastest = needed_speed(state, order, frames) * scale, state.prior.limits.max_steering_speed * scale
    if needs <= fastest:
        return None
    away = needs * left
    where = f"{order.position[0]:.2f}, {order.position[1]:.2f} m, {away:.1f} m away"
    needed = f"it needs {needs:.1f} m/s, and {fastest:.1f} m/s is the fastest"
    return Refusal(order, f"an arrival at {where}, in {left:.1f} s is not obeyed: {needed}")


def _lead_to(state: SteerState, command: Command, order: Arrival, left: int) -> Command:
    """Lead to a far target, at the pace that comes there in time; one that would come too early stands."""
    scale = state.character.scale
    here = (state.committed.ground_pose.position_xz * scale).tolist()
    away = (order.position[0] - here[0], order.position[1] - here[1])
    speed = math.hypot(*away) * PRIOR_FPS / left
    if speed < _LEAST_SPEED * scale:
        return replace(command, speed=0.0, heading=state.target.facing, facing=None, turning=None, step_length=None)
    return replace(command, speed=speed, heading=math.atan2(*away), facing=None, turning=None, step_length=None)


def _deliver(state: SteerState, approach: Approach, command: Command) -> tuple[SteerState, SteerFrames]:
    """Deliver the next planned frames, and advance the density over them."""
    planned, start = approach.planned, state.committed.ground_pose
    assert planned is not None
    new, rest = planned[: state.settings.commit], planned[state.settings.commit :]
    after = commit_frames(state, new)
    state, frames = deliver(state, after, new, _read_targets(new, start, state.target), command, rest)
    return replace(state, approach=replace(approach, planned=rest)), frames


def _read_targets(features: Tensor, start: GroundPose, before: SteeringTarget) -> list[SteeringTarget]:
    """Read the targets that frames meet, so that steering continues from their pace."""
    targets, heading, travel = [], float(start.heading), before.heading
    for row in features:
        step_xz = rotations.rotate_ground(LAYOUT.pick(row, "root_displacement_heading"), torch.tensor(heading))
        speed = float(step_xz.norm()) * PRIOR_FPS
        heading += float(LAYOUT.pick(row, "heading_change")[0])
        travel = math.atan2(*step_xz.tolist()) if speed > _LEAST_SPEED else heading
        targets.append(SteeringTarget(speed, travel, heading))
    return targets
