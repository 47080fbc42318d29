"""Be there, face so, at a time: a walk is steered toward a place that is far, and its end is stitched to it.

Ren et al. 2024 make what lies between two poses; here the first is the last that was delivered, with those before it,
and the second is where the character is to be: in a pose that is given, or in that of one of the moments from which the
prior begins, walking on or standing. A step that is steered toward the place plays while this is worked out. The
density's state is then advanced over what was shown, and steering goes on.
"""

import math
import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.steering.steer import Refusal, SteerFrames, SteerState, step
from controllers.steering.way import LEAST_FRAMES, TransitionMaker, begin_way, commit_frames, needed_speed, plan_way
from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.intent.steering import Arrival, Command, SteeringTarget
from mapctl.pose import decode
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Status
from mapctl.runtime.stepwise import StepwiseWork

_STITCHED_FRAMES = 45  # of the end of a way that is walked first
_LEAST_SPEED = 0.3  # m/s below which nobody sets out: there is time to stand first
_PAST_FRAMES = 60  # of targets that are kept for terms that look back


@dataclass(frozen=True, eq=False)
class Approach:
    """How far an order is carried out."""

    order: Arrival | None
    """The last order, if the last command had one."""
    held: Command
    """The command that is steered by, without an order: the last one, or the one before it where its order is refused.
    """
    planned: Float[Tensor, "frames size"] | None = None
    """Features of the next frames to the place that are not delivered yet, none of them once it is there; None while it
    is walked to."""
    rest: StepwiseWork[Float[Tensor, "rest size"]] | None = None
    """Work that makes the frames after these."""
    refused: bool = False
    """Whether the order is not obeyed."""

    @property
    def _has_planned(self) -> bool:
        return self.planned is not None and len(self.planned) > 0

    def ahead(self) -> Tensor | None:
        """Return what is planned of the next step, if anything is."""
        return self.rest.finish() if self.rest is not None and not self._has_planned else self.planned


@dataclass(frozen=True, eq=False)
class Arriver:
    """A step of steering that obeys orders to be somewhere."""

    transitions: TransitionMaker
    """Who makes the way."""

    def __call__(
        self, state: SteerState, command: Command, *, seconds: float | None = None
    ) -> tuple[SteerState, SteerFrames]:
        """Solve or deliver the next frames, as `controllers.steering.steer.step`. A command whose order cannot be met
        is not obeyed: the one before it holds, and the frames' `refusal` says why."""
        began = time.perf_counter()
        order, plain, refusal = command.arrival, replace(command, arrival=None), None
        approach = state.approach if isinstance(state.approach, Approach) else None
        if order is None:
            return step(replace(state, approach=Approach(None, plain)), plain, seconds=seconds)
        left, new = _arrival_frame(order) - state.frames + 1, approach is None or approach.order is not order
        old = approach
        if approach is None or new:
            refusal = _refuse(state, order)
            before = approach.held if approach and refusal else plain
            approach = Approach(order, before, refused=refusal is not None)
        # Who has to walk first does so until little is left; a way that can be stitched as a whole is.
        most = self.transitions.longest + 1 if new else _STITCHED_FRAMES
        if approach.planned is None and not approach.refused and left <= most:
            ahead = None if old is None else old.ahead()
            planned = state.committed.features[:0] if ahead is None else ahead
            if not len(planned) and (found := self._set_out(state, approach, command, left)) is not None:
                after, frames, work = found
                _proceed(work, began, seconds)
                return after, frames
            held, rest = begin_way(self.transitions, state, command, order, left, planned=planned)
            approach = replace(approach, planned=held, rest=rest)
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

    def _set_out(
        self, state: SteerState, approach: Approach, command: Command, left: int
    ) -> tuple[SteerState, SteerFrames, StepwiseWork[Tensor]] | None:
        """Solve a step towards the place, so that the order is seen at once, and return it with the work of the way
        from its end; None where that leaves too little time for the rest of the way."""
        order, settings = command.arrival, state.settings
        assert order is not None
        if (rest := left - settings.commit) < LEAST_FRAMES:
            return None
        # In few evaluations, so that there is time for the way, and always as many, so that it is always the same.
        quick = replace(settings, evaluations=settings.least_evaluations or 1)
        led = _lead_to(state, replace(command, arrival=None), order, left)
        there, frames = step(replace(state, settings=quick), led)
        there = replace(there, settings=settings)
        if needed_speed(there, order, rest) > state.prior.limits.max_steering_speed:
            return None
        work = StepwiseWork(plan_way(self.transitions, there, command, order, rest))
        nothing = there.committed.features[:0]
        return replace(there, approach=replace(approach, planned=nothing, rest=work)), frames, work


def _proceed(work: StepwiseWork[Tensor], began: float, seconds: float | None) -> None:
    """Do as much of the work as the time of a step that began then allows."""
    if seconds is not None:
        work.proceed(seconds - (time.perf_counter() - began))


def _arrival_frame(order: Arrival) -> int:
    return round(order.by * PRIOR_FPS)


def _refuse(state: SteerState, order: Arrival) -> Refusal | None:
    """Say why an order cannot be met; None where it can."""
    frames, scale = _arrival_frame(order) - state.frames + 1, state.character.scale
    left, least = frames / PRIOR_FPS, LEAST_FRAMES / PRIOR_FPS
    if frames < LEAST_FRAMES:
        reason = f"an arrival in {left:.2f} s is not obeyed: nobody comes anywhere in less than {least:.2f} s"
        return Refusal(order, reason)
    needs, fastest = needed_speed(state, order, frames) * scale, state.prior.limits.max_steering_speed * scale
    if needs <= fastest:
        return None
    away = needs * left
    where = f"{order.place[0]:.2f}, {order.place[1]:.2f} m, {away:.1f} m away"
    needed = f"it needs {needs:.1f} m/s, and {fastest:.1f} m/s is the fastest"
    return Refusal(order, f"an arrival at {where}, in {left:.1f} s is not obeyed: {needed}")


def _lead_to(state: SteerState, command: Command, order: Arrival, left: int) -> Command:
    """Lead to a place that is far, at the pace that comes there in time; who would come too early stands."""
    scale = state.character.scale
    here = (state.committed.place.position_xz * scale).tolist()
    away = (order.place[0] - here[0], order.place[1] - here[1])
    speed = math.hypot(*away) * PRIOR_FPS / left
    if speed < _LEAST_SPEED * scale:
        return replace(command, speed=0.0, heading=state.target.facing, facing=None, turning=None, step_length=None)
    return replace(command, speed=speed, heading=math.atan2(*away), facing=None, turning=None, step_length=None)


def _deliver(state: SteerState, approach: Approach, command: Command) -> tuple[SteerState, SteerFrames]:
    """Deliver the next planned frames, and advance the density over them."""
    planned, character, committed = approach.planned, state.character, state.committed
    assert planned is not None
    new, rest = planned[: state.settings.commit], planned[state.settings.commit :]
    unit = decode(new, committed.place, skeleton=character.unit_skeleton)
    after = commit_frames(state, new)
    ahead = decode(rest, after.place, skeleton=character.unit_skeleton).joint_positions() if len(rest) else None
    forecast = unit.joint_positions()[:0] if ahead is None else ahead
    motion = character.motion(unit)
    overlay, motion = state.overlay.pose(motion, command, forecast * character.scale)
    targets = _read_targets(new, committed.place, state.target)
    velocities = torch.tensor([target.velocity for target in targets])
    frames = SteerFrames(
        motion,
        Status(Outcome.DONE),
        Ledger(),
        features=new,
        contacts=LAYOUT.pick(new, "contacts"),
        steering_targets=tuple(replace(target, speed=target.speed * character.scale) for target in targets),
        forecast=forecast * character.scale,
    )
    next_state = replace(
        state,
        committed=after,
        target=targets[-1],
        past_targets=torch.cat([state.past_targets, velocities])[-_PAST_FRAMES:],
        frames=state.frames + len(new),
        overlay=overlay,
        approach=replace(approach, planned=rest),
    )
    return next_state, frames


def _read_targets(features: Tensor, start: GroundPose, before: SteeringTarget) -> list[SteeringTarget]:
    """Read the targets that frames meet, so that steering goes on from their pace."""
    targets, heading, travel = [], float(start.heading), before.heading
    for row in features:
        step_xz = rotations.rotate_ground(LAYOUT.pick(row, "root_displacement_heading"), torch.tensor(heading))
        speed = float(step_xz.norm()) * PRIOR_FPS
        heading += float(LAYOUT.pick(row, "heading_change")[0])
        travel = math.atan2(*step_xz.tolist()) if speed > _LEAST_SPEED else heading
        targets.append(SteeringTarget(speed, travel, heading))
    return targets
