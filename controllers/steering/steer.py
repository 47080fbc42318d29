"""Steering (Wang et al. 2019, section 5.3): a few frames a step, looking a second ahead, warm-started by the last step.

`step` is pure: a state and a command give the next state and its frames, to the bit for the same evaluations. It has no
clock; a caller with a deadline passes the seconds that are left, and gets the best solution found by then.

Hands that reach and heads that look, live, on top of a steered walk: pose offsets with limited acceleration.

The density that walks knows no reaches, so they are no terms of its windows: arms, trunk and head are turned in the
frames that it delivers, and the next step goes on from the walk alone. A hand is on its way while its place can be
reached within half a second, as the forecast says; who walks past lets it go. Both the way there and the way back are
of minimum jerk.

Ways round obstacles for who is steered: the direction nearest to the commanded one in which nothing is in the way.

One step at a time, without a plan: for curves and times that are known in advance, `controllers.shots.trajectory` finds
the shortest detour.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import start_from_state
from mapctl import rotations
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed
from mapctl.intent.steering import Arrival, Command, SteeringLimits, SteeringTarget
from mapctl.kinematics import inverse
from mapctl.kinematics.inverse import bend_within, find_out, lead_about
from mapctl.kinematics.moving import turn_head
from mapctl.motion import Motion
from mapctl.numerics.easing import MinimumJerkTrack, smootherstep
from mapctl.pose import decode
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver
from mapctl.problem.solution import Ledger, Outcome, Solution, Status
from mapctl.problem.unknowns import WindowRequest
from mapctl.problem.window_solvers import (
    BestOfSamples,
    LatentNoiseSolver,
    SingleWindowSolver,
    SolvedWindow,
    SteeringKnots,
)
from mapctl.protocols import Density
from mapctl.runtime.stepwise import StepwiseWork
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings, LbfgsStatus
from mapctl.terms import FootContact, KeepClear, LatentPrior, RootVelocity, StepLength, Term

_BODY = 0.4  # metres from an obstacle's edge to the hips of who walks past
_LOOK_AHEAD, _LOOK_SECONDS = 0.6, 1.2  # metres, and seconds of walking, in which the way must be clear
_HEADINGS, _WIDEST = 65, math.radians(140.0)  # directions that are tried, and how far off the commanded one
_PLACES = 16  # along each
_GET_OUT = 0.3  # metres of clearance gained by metre, for who is too near already
_STAY = 0.5  # share of a change of direction that counts beside the deviation: who goes left keeps to the left


def lead_around(
    obstacles: tuple[Obstacle, ...], *, place: tuple[float, float], heading: float, wanted: float, speed: float
) -> float:
    """Return the direction of travel, radians, nearest to the `wanted` one that leads clear of obstacles.

    `place` is where one is (x and z, metres), `heading` the direction in which one goes now, `speed` in m/s. Where
    every direction is blocked, the clearest.
    """
    if not obstacles or speed <= 0:
        return wanted
    offsets = torch.linspace(-_WIDEST, _WIDEST, _HEADINGS, dtype=torch.float64)
    angles = wanted + offsets
    along = torch.linspace(0, _LOOK_AHEAD + _LOOK_SECONDS * speed, _PLACES, dtype=torch.float64)
    start = torch.tensor(place, dtype=torch.float64)
    rays = start + along[:, None] * torch.stack([angles.sin(), angles.cos()], dim=-1)[:, None]
    near = float(measure_clearance(obstacles, start))
    lacking = (torch.clamp(near + _GET_OUT * along, max=_BODY) - measure_clearance(obstacles, rays)).amax(dim=1)
    if bool((lacking > 1e-6).all()):
        return float(angles[lacking.argmin()])
    cost = offsets.abs() + _STAY * rotations.wrap_angle(angles - heading).abs()
    return float(angles[torch.where(lacking > 1e-6, torch.inf, cost).argmin()])


_RAISE_SECONDS = 0.7  # in which a hand goes to its place, and back
_TURN_SECONDS = 0.5  # in which a head turns there, and back
_MOVE_SECONDS, _MOVE_SPEED = 0.5, 1.2  # least time in which a hand follows a place that moved, and its mean speed, m/s
_AHEAD_FRAMES = 15  # of the forecast, after which a place must be in reach
_NEAR = 0.45  # metres beyond the arm at which a hand sets out, to reach with a lean or to point there
_LET_GO = 0.1  # metres farther than that, at which a hand lets go
_BEHIND = 0.45  # cosine below zero of the angle to a shoulder's front beyond which nothing is reached
_EASY_SHARE = 0.85  # of an arm's length, beyond which the trunk leans
_BENT_SHARE, _STRETCHED_SHARE = 0.95, 0.99  # of it, between which an arm gives up reaching exactly
_MOST_LEAN = 0.4  # radians that the trunk turns toward a place, twice
_LEAN_EASE = 0.03  # metres out of reach, up to which the trunk hardly moves
_BEGUN_SHARE = 0.15  # of the way, in which an elbow comes to where inverse kinematics has it
_TRUNK = CANONICAL.indices(("spine", "chest"))
_HEAD = "head"


@dataclass(frozen=True, eq=False)
class PartTrack:
    """How far a hand or the head is on its way to a place, and where that is."""

    weight: MinimumJerkTrack
    """Share of the way there, 0 to 1."""
    place: MinimumJerkTrack
    """Place in the world, metres."""

    @staticmethod
    def begin(place: tuple[float, float, float]) -> "PartTrack":
        """Begin without a share."""
        zero = torch.zeros(1, dtype=torch.float64)
        return PartTrack(MinimumJerkTrack.rest_at(zero), MinimumJerkTrack.rest_at(zero.new_tensor(place)))

    @property
    def idle(self) -> bool:
        """Whether it has no share, and will have none."""
        return self.weight.resting and float(self.weight.value) == 0.0

    def aim(self, place: tuple[float, float, float] | None, wanted: bool, seconds: float) -> "PartTrack":
        """Go toward a place if it is wanted, and back if not."""
        found = self
        if place is not None:
            goal = self.place.goal.new_tensor(place)
            way = float((goal - self.place.value).norm())
            moved = self.place.aim(goal, max(_MOVE_SECONDS, way / _MOVE_SPEED))
            found = replace(self, place=MinimumJerkTrack.rest_at(goal) if self.idle else moved)
        return replace(found, weight=found.weight.aim(found.weight.goal.new_tensor([float(wanted)]), seconds))

    def move(self, frames: int) -> tuple["PartTrack", Float[Tensor, " frames"], Float[Tensor, "frames 3"]]:
        """Move on for so many frames; also return share and place in each."""
        track, weights, places = self, [], []
        for _ in range(frames):
            track = PartTrack(track.weight.move(1 / PRIOR_FPS), track.place.move(1 / PRIOR_FPS))
            weights.append(track.weight.value)
            places.append(track.place.value)
        return track, torch.cat(weights), torch.stack(places)


@dataclass(frozen=True, eq=False)
class Overlay:
    """What hands and head are doing beside the walk; `pose` gives the frames and the next overlay."""

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
            place = command.reach.get(name)
            part = parts.get(name) or PartTrack.begin(place or (0.0, 0.0, 0.0))
            on_its_way = bool(part.weight.goal > 0)
            wanted = place is not None and _is_in_reach(name, place, soon, walk.skeleton, keep=on_its_way)
            if wanted or name in parts:
                parts[name] = part.aim(place, wanted, _RAISE_SECONDS)
        if command.look_at is not None or _HEAD in parts:
            part = parts.get(_HEAD) or PartTrack.begin(command.look_at or (0.0, 0.0, 0.0))
            parts[_HEAD] = part.aim(command.look_at, command.look_at is not None, _TURN_SECONDS)
        return parts


def _is_in_reach(
    name: str, place: tuple[float, float, float], joints: Float[Tensor, "joints 3"], skeleton: Skeleton, *, keep: bool
) -> bool:
    """Return whether a hand gets to a place from a pose, with a lean of the trunk; one on its way a little farther."""
    limb = LIMBS[name]
    away = joints.new_tensor(place) - joints[limb.upper]
    near = float(away.norm()) < limb.length(skeleton) + _NEAR + _LET_GO * keep
    return near and float(away @ find_out(name, joints[None])[0]) > -_BEHIND * float(away.norm())


def _lean(walk: Motion, arms: Mapping[str, tuple[Tensor, Tensor]]) -> Motion:
    """Turn the trunk toward what arms alone do not reach, about as far as brings the shoulders there: they go there on
    a circle, so that a second lean is needed where the way is long."""
    joints, turn = walk.joint_positions(), torch.zeros(walk.num_frames, 3, dtype=torch.float64)
    for name, (weight, place) in arms.items():
        limb = LIMBS[name]
        length = limb.length(walk.skeleton)
        shoulder, away = joints[:, limb.upper] - joints[:, _TRUNK[0]], place - joints[:, limb.upper]
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
    """Bend arms of a motion so that hands are by their shares on the way from where they are to the places."""
    joints, world = motion.joint_positions(), motion.joint_rotations()
    quats = motion.local_quat_xyzw.clone()
    for name, (weight, place) in arms.items():
        limb, offsets = LIMBS[name], motion.skeleton.offsets.to(joints)
        length = limb.length(motion.skeleton)
        aim = place.to(joints) - joints[:, limb.upper]
        aim = bend_within(aim, length, easy=_BENT_SHARE, most=_STRETCHED_SHARE)
        own, out = joints[:, limb.end] - joints[:, limb.upper], find_out(name, joints)
        aim = lead_about(own, aim, weight.to(joints), out=out)
        turned, bent = inverse.reach(limb, world[:, limb.upper], quats[:, limb.lower], aim, offsets)
        above = world[:, CANONICAL.parents[limb.upper]]
        begun = smootherstep(weight / _BEGUN_SHARE).to(joints)
        for joint, local in ((limb.upper, rotations.multiply(rotations.inverse(above), turned)), (limb.lower, bent)):
            quats[:, joint] = rotations.slerp(quats[:, joint], local.to(quats), begun)
    return replace(motion, local_quat_xyzw=quats)


KEPT_FRAMES = 11
"""Last frames whose features are kept: who goes to a place begins as it came here."""
_PAST_TARGET_FRAMES = 60  # past targets that are kept: more than the root velocity term looks back on
_RECENT_FRAMES = 15  # frames, half a second, over which the velocity error is measured
_MIN_TRAVEL_SPEED = 0.3  # m/s below which the velocity has no direction
_FAR_TURN = math.radians(75)  # beyond which a start may turn faster than the limits
_NEAREST_STARTS = 6  # initial states nearest to the requested speed, of which one is sampled
_RISE, _FALL = 0.1, 0.4  # share of the last step in what is expected: another process makes steps longer, none shorter
_FORGET = 0.9  # of an evaluation's time after a step that had none to make: else there would never be one again
_LONGEST_REST = 0.02  # seconds: a rest beyond it was interrupted by another process
_KNOTS, _KNOT_SIGMA = 7, 0.8  # samples: noise of every feature, slow enough for a step


@dataclass(frozen=True)
class SteerSettings:
    """Sigmas, window lengths and budget."""

    horizon: int = 34
    """Frames of a window, the look-ahead included."""
    commit: int = 3
    """Frames that a step commits and delivers."""
    evaluations: int = 14
    """Most evaluations of energy and gradient in a step: what one core computes while three frames are shown."""
    least_evaluations: int = 6
    """Evaluations for which the loop gives a step time, however late it is: with fewer, targets are missed
    (docs/reference/results.md). Never more than `evaluations`."""
    limits: SteeringLimits = field(default_factory=SteeringLimits)
    """How fast a steering target may change."""
    sigma_speed: float = RootVelocity.sigma_speed
    """Sigma of the speed along the target velocity, m/s."""
    sigma_direction: float = RootVelocity.sigma_direction
    """Sigma of the velocity's direction, radians."""
    sigma_facing: float = RootVelocity.sigma_facing
    """Sigma of the hips' heading, radians."""
    sigma_step: float = StepLength.sigma
    """Sigma of a requested step length, metres."""
    stuck: float = 0.4
    """Velocity error over the last half second, m/s, beyond which a step is first solved without contacts."""
    standing: float = 0.25
    """Mean speed over the last half second, m/s, below which a character whose target ahead is faster than it by more
    than `stuck` is solved that way at once: it would count as stuck half a second later."""
    sigma_leaving: float = 0.1
    """Sigma of the hips' heading in such steps, radians, where it is smaller than `sigma_facing`: who has to turn for a
    start finds his first step sooner where the body turns first."""
    leaving_turn: float = 1.6
    """Factor of the turn rate of `limits` at which the target may turn when somebody who stands is to go far aside."""
    random_starts: int = 12
    """Random warm starts of that solve, evaluated in one batch beside the evaluations; it begins at the best."""
    footing: FootContact = field(default_factory=FootContact)
    """Contact term."""
    noise: LatentPrior = field(default_factory=lambda: LatentPrior(sigma=2.0))
    """Prior on the latent noise, as in path following."""

    def scaled_to(self, character: Character) -> "SteerSettings":
        """Return the settings for a character of this size, in metres of the prior's size."""
        names = "sigma_speed", "sigma_step", "stuck", "standing"
        sigmas = {name: getattr(self, name) / character.scale for name in names}
        return replace(self, limits=character.limits(self.limits), footing=character.footing(self.footing), **sigmas)


@dataclass(frozen=True)
class StepCost:
    """Times of a step."""

    evaluation: float = 0.003
    """Seconds of an evaluation, its share of all else in a step included."""
    rest: float = 0.005
    """Seconds of a step before its search begins and after it ends."""

    def needed_seconds(self, evaluations: int) -> float:
        """Return the seconds of a step that makes so many evaluations."""
        return self.rest + evaluations * self.evaluation

    def learn(self, seconds: float, evaluations: int, *, search: float | None, cut_short: bool) -> "StepCost":
        """Return the cost as known after a step of so many seconds, whose search had `search` seconds, None without
        a limit, and ended by that limit if it was cut short."""
        one = _expect(self.evaluation, seconds / evaluations) if evaluations else _FORGET * self.evaluation
        rest = self.rest
        if cut_short and search is not None:
            rest = min(_LONGEST_REST, _expect(rest, max(0.0, seconds - search)))
        return StepCost(one, rest)


@dataclass(frozen=True, eq=False)
class Approach:
    """How far an order to be somewhere is carried out."""

    order: Arrival | None
    """The last order, if the last command had one."""
    held: Command
    """The command that is steered by, without an order: the last one, or the one before it where its order is refused.
    """
    planned: Float[Tensor, "frames size"] | None = None
    """Features of the next frames to the target that are not delivered yet, none of them once it is there; None while
    it is walked to."""
    rest: StepwiseWork[Float[Tensor, "rest size"]] | None = None
    """Work that computes the frames after these."""
    refused: bool = False
    """Whether the order is not obeyed."""

    def ahead(self) -> Tensor | None:
        """Return the next planned frames, if there are any."""
        has_planned = self.planned is not None and len(self.planned) > 0
        return self.rest.finish() if self.rest is not None and not has_planned else self.planned


@dataclass(frozen=True, eq=False)
class Refusal:
    """An order that is not obeyed."""

    order: Arrival
    """The order."""
    reason: str
    """Reason, with numbers."""


@dataclass(frozen=True, eq=False)
class SteerState:
    """Everything that the next step depends on; of a fixed size."""

    prior: Density
    """Density of the character's motion."""
    settings: SteerSettings
    """Settings of every step, in metres of the prior's size."""
    character: Character
    """Bones and size of the character."""
    committed: CommittedFrames
    """Last of the delivered frames."""
    target: SteeringTarget
    """Steering target of the last delivered frame, in the prior's size."""
    past_targets: Float[Tensor, "past 2"]
    """Target velocities of the last delivered frames, oldest first, m/s in the prior's size."""
    frames: int = 1
    """Frames delivered so far, the first pose included."""
    terms: tuple[Term, ...] = ()
    """The caller's own terms, for the prior's size."""
    overlay: Overlay = field(default_factory=Overlay)
    """What hands and head are doing beside the walk."""
    cost: StepCost = field(default_factory=StepCost)
    """What steps have cost lately."""
    approach: Approach | None = None
    """Last order to be somewhere, and how far it is carried out (`controllers.steering.arrival`)."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SteerFrames(Solution):
    """New frames of a step, at PRIOR_FPS, in the world; the status says if a deadline cut the search short."""

    contacts: Float[Tensor, "frames 2"]
    """Contacts of the left and the right toe, 1 or 0."""
    steering_targets: tuple[SteeringTarget, ...]
    """Steering targets of the frames."""
    forecast: Float[Tensor, "ahead joints 3"]
    """World joint positions of the frames that would come next, metres; the next command changes them."""
    evaluations: int = 0
    """Energy-and-gradient evaluations of the step."""
    refusal: Refusal | None = None
    """An order to be somewhere that is not obeyed; said once."""


def begin(
    prior: Density,
    command: Command,
    *,
    generator: torch.Generator,
    at: tuple[float, float] = (0.0, 0.0),
    settings: SteerSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
) -> tuple[SteerState, SteerFrames]:
    """Place a character at x and z (metres) that faces along the command, and return its first pose.

    The generator samples it from the prior's initial states near the command's speed and with its labels; the slowest
    for a command to stand. `terms` are the caller's own, the same in every step; they see the character at its own size
    and the time since the first pose. On another `skeleton` (canonical names) strides are as long as its legs, and the
    toes' rest height is that of `settings.footing`; commands, limits and delivered frames are in its metres.
    """
    chosen = settings or SteerSettings()
    character = Character(skeleton, chosen.footing.rest_height)
    command = character.command(command)
    starts = (condition_prior(prior, command.labels) if command.labels else prior).initial_states
    nearest = (starts.speed - command.speed).abs().argsort()[:_NEAREST_STARTS]
    pick = int(nearest[torch.randint(len(nearest), (1,), generator=generator)])
    state = starts.state.pick(torch.tensor([pick]))
    ground_pose = GroundPose(
        torch.tensor(at, dtype=torch.float32) / character.scale, torch.tensor(command.heading, dtype=torch.float32)
    )
    start = start_from_state(state, ground_pose, character.unit_skeleton)
    first = start.committed.features
    motion = character.motion(decode(first, start.before_first, skeleton=character.unit_skeleton))
    target = SteeringTarget(float(ground_speed(first)[0]), command.heading, command.heading)
    frames = SteerFrames(
        motion,
        Status(Outcome.DONE),
        Ledger(),
        contacts=LAYOUT.pick(first, "contacts"),
        steering_targets=(_scale_to_character(target, character),),
        forecast=start.committed.joints_world[:0],
    )
    past_targets, unit_terms = torch.tensor([target.velocity]), tuple(character.term(term) for term in terms)
    return SteerState(
        prior, chosen.scaled_to(character), character, start.committed, target, past_targets, terms=unit_terms
    ), frames


def accept(prior: Density, command: Command) -> tuple[Command, list[str]]:
    """Return the nearest feasible command, and a note on each number that was changed (Command.within).

    RequestError for labels that the prior does not know.
    """
    if command.labels:
        condition_prior(prior, command.labels)
    return command.within(prior.limits.max_steering_speed)


def step(state: SteerState, command: Command, *, seconds: float | None = None) -> tuple[SteerState, SteerFrames]:
    """Solve the next frames under a command, but for its arrival (see `controllers.steering.arrival`). Within `seconds`
    the best solution so far is returned, with a note; without an evaluation where there is no time for one: then the
    last plan is carried on. What must be done in any case takes about 4 ms.

    RequestError for labels that the prior does not know. The first step under new labels takes longer.
    """
    began = time.perf_counter()
    settings, character = state.settings, state.character
    asked, command = command, character.command(_lead_around(state, command))
    stuck = _velocity_error(state) > settings.stuck
    if stuck:
        state = _restart_target(state)
    targets, leaving = _plan_targets(state, command)
    conditioned = replace(state, prior=condition_prior(state.prior, command.labels)) if command.labels else state
    free = stuck or leaving
    sigma_facing = min(settings.sigma_facing, settings.sigma_leaving) if free else settings.sigma_facing
    terms = (*_build_steering_terms(state, targets, command.step_length, sigma_facing), *state.terms)
    if asked.obstacles:
        terms = (*terms, character.term(KeepClear(asked.obstacles)))
    search = None if seconds is None else max(0.0, seconds - state.cost.rest)
    done, outcome = _solve_step(conditioned, terms, search, free=free)
    if outcome is not Outcome.DONE:
        cold = replace(state.committed, warm_start=state.committed.warm_start[:0], forecast=None)
        restarted = replace(conditioned, committed=cold)
        done, _ = _solve_step(restarted, terms, 0.0, free=False)  # the prior's own continuation, which always exists
    new = done.features[-settings.commit :]
    forecast = (done.forecast if done.forecast is not None else done.joints_world[:0]) * character.scale
    motion = character.motion(decode(new, state.committed.place, skeleton=character.unit_skeleton))
    overlay, motion = state.overlay.pose(motion, asked, forecast)
    record, committed_targets = done.windows[-1], tuple(targets[: settings.commit])
    cut_short = record.outcome == LbfgsStatus.OUT_OF_BUDGET.value and record.evaluations < settings.evaluations
    note = f"the deadline came after {record.evaluations} of {settings.evaluations} evaluations"
    status = Status(Outcome.BUDGET, (note,)) if cut_short else Status(Outcome.DONE)
    ledger, spent = character.ledger(done.ledger), time.perf_counter() - began
    frames = SteerFrames(
        motion,
        status,
        ledger,
        done.windows,
        new,
        spent,
        contacts=LAYOUT.pick(new, "contacts"),
        steering_targets=tuple(_scale_to_character(target, character) for target in committed_targets),
        forecast=forecast,
        evaluations=record.evaluations,
    )
    velocities = torch.tensor([target.velocity for target in committed_targets])
    next_state = replace(
        state,
        committed=done.discard_history(max(len(new), KEPT_FRAMES)),
        target=committed_targets[-1],
        past_targets=torch.cat([state.past_targets, velocities])[-_PAST_TARGET_FRAMES:],
        frames=state.frames + len(new),
        overlay=overlay,
        cost=state.cost.learn(time.perf_counter() - began, record.evaluations, search=search, cut_short=cut_short),
    )
    return next_state, frames


def _lead_around(state: SteerState, command: Command) -> Command:
    """Lead a command round its obstacles, in the character's metres; one to turn on and on is left to its terms."""
    if not command.obstacles or command.turning is not None:
        return command
    x, _, z = (state.committed.joints_world[-1, 0] * state.character.scale).tolist()
    heading = state.target.heading if state.target.speed > 0 else float(state.committed.place.heading)
    led = lead_around(command.obstacles, place=(x, z), heading=heading, wanted=command.heading, speed=command.speed)
    return command if led == command.heading else replace(command, heading=led)


def _scale_to_character(target: SteeringTarget, character: Character) -> SteeringTarget:
    return replace(target, speed=target.speed * character.scale)


@lru_cache(maxsize=64)
def condition_prior(prior: Density, labels: tuple[str, ...]) -> Density:
    """Condition the prior on labels; cached, since it takes as long as a step may last."""
    return prior.conditioned_on(labels)


def _solve_step(
    state: SteerState, terms: Sequence[Term], seconds: float | None, *, free: bool
) -> tuple[CommittedFrames, Outcome]:
    settings = state.settings
    method: SingleWindowSolver = _limit_evaluations(state, settings.evaluations, seconds)
    if free:
        half = _limit_evaluations(state, settings.evaluations // 2, seconds and seconds / 2)
        method = _relax_footing_first(half, settings.random_starts, terms, settings.footing)
    window = HorizonSettings(frames=settings.horizon, overlap=settings.horizon - settings.commit)
    solver = RecedingHorizonSolver(state.prior, window, state.character.unit_skeleton, method=method)
    frames = len(state.committed.features) + settings.commit
    return solver.solve(
        state.committed, lambda first, count: terms, frames, generator=torch.Generator().manual_seed(state.frames)
    )


def _limit_evaluations(state: SteerState, evaluations: int, seconds: float | None) -> LatentNoiseSolver:
    """Build a solver of one round within these evaluations and seconds, which begins none that it cannot end."""
    most = max(1, evaluations)
    budget = Budget(most, seconds, evaluation_seconds=state.cost.evaluation)
    return LatentNoiseSolver(rounds=1, lbfgs=LbfgsSettings(max_iterations=most), budget=budget)


def _velocity_error(state: SteerState) -> float:
    """Compute the error of the mean velocity over the last half second, m/s."""
    if min(len(state.committed.joints_world) - 1, len(state.past_targets)) < _RECENT_FRAMES:
        return 0.0
    return float((_recent_velocity(state) - state.past_targets[-_RECENT_FRAMES:].mean(0)).norm())


def _plan_targets(state: SteerState, command: Command) -> tuple[list[SteeringTarget], bool]:
    """Return the targets of a window, and whether a standing character is told to go, who may turn faster."""
    settings, target = state.settings, state.target
    targets = target.ahead(command, settings.limits, frames=settings.horizon, fps=PRIOR_FPS)
    leaving = _is_leaving(state, targets)
    if leaving and abs(math.remainder(command.heading - target.heading, 2 * math.pi)) > _FAR_TURN:
        limits = replace(settings.limits, turn_rate=settings.leaving_turn * settings.limits.turn_rate)
        targets = target.ahead(command, limits, frames=settings.horizon, fps=PRIOR_FPS)
    return targets, leaving


def _is_leaving(state: SteerState, targets: Sequence[SteeringTarget]) -> bool:
    """Whether a standing character is told to go."""
    if len(state.committed.joints_world) <= _RECENT_FRAMES:
        return False
    speed = float(_recent_velocity(state).norm())
    return speed < state.settings.standing and targets[-1].speed > speed + state.settings.stuck


def _recent_velocity(state: SteerState) -> Float[Tensor, "2"]:
    """Compute the mean velocity of the hips over the ground in the last half second, m/s."""
    past = state.committed.joints_world[-_RECENT_FRAMES - 1 :, 0, ::2]
    return (past[-1] - past[0]) * PRIOR_FPS / _RECENT_FRAMES


def _restart_target(state: SteerState) -> SteerState:
    """Restart the steering target from the character's velocity and facing, without past targets.

    A target far ahead of a stuck character (a walk to its side while it stands) guides no search.
    """
    velocity, facing = _recent_velocity(state), float(state.committed.place.heading)
    speed = float(velocity.norm())
    heading = math.atan2(*velocity.tolist()) if speed > _MIN_TRAVEL_SPEED else facing
    target = SteeringTarget(speed, heading, facing)
    return replace(state, target=target, past_targets=torch.tensor([target.velocity]).expand(_RECENT_FRAMES, 2))


def _build_steering_terms(
    state: SteerState, targets: Sequence[SteeringTarget], step_length: float | None, sigma_facing: float
) -> Sequence[Term]:
    settings = state.settings
    velocity = RootVelocity(
        torch.tensor([target.velocity for target in targets]),
        state.past_targets,
        facing=torch.tensor([target.facing for target in targets]),
        sigma_speed=settings.sigma_speed,
        sigma_direction=settings.sigma_direction,
        sigma_facing=sigma_facing,
    )
    terms = settings.noise, velocity, settings.footing
    return (*terms, StepLength(step_length, sigma=settings.sigma_step)) if step_length else terms


def _relax_footing_first(
    half: LatentNoiseSolver, samples: int, terms: Sequence[Term], footing: FootContact
) -> SingleWindowSolver:
    """Build a window solver that spends half on all terms but contacts, from the best of some samples, and half on all
    terms, each with half of the time.

    A standing character has both feet planted, by contacts that are fixed while a window is solved: the contact term
    then prevents any step. The search without it finds one, along which the prior predicts new contacts.
    """
    space = SteeringKnots(_KNOTS, tuple(LAYOUT.slices)[:-1], _KNOT_SIGMA)
    budget = replace(half.budget, evaluations=samples + (half.budget.evaluations or 1))
    relaxed = replace(half, proposal=BestOfSamples(samples, space), budget=budget)
    others = [term for term in terms if term.name != footing.name]

    def solve(request: WindowRequest) -> SolvedWindow:
        request = replace(request, seconds=request.seconds / 2)
        first = relaxed(replace(request, terms=others))
        second = half(replace(request, warm_start=first.warm_start))
        return replace(second, evaluations=first.evaluations + second.evaluations)

    return solve


def _expect(known: float, last: float) -> float:
    return known + (_RISE if last > known else _FALL) * (last - known)
