"""Steering (Wang et al. 2019, section 5.3): a few frames a step, looking a second ahead, warm-started by the last step.

`step` is pure: a state and a command give the next state and its frames, to the bit for the same evaluations. It has no
clock; a caller with a deadline passes the seconds that are left, and gets the best solution found by then. Obstacles
are passed by the direction nearest to the commanded one that is clear, one step at a time, without a plan: for curves
that are known in advance, `controllers.shots.trajectory` finds the shortest detour.
"""

import math
import pickle
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import start_from_state
from controllers.steering.overlay import Overlay
from controllers.steering.stand import Stand, find_pose, find_stand
from controllers.steering.steps import PlannedSteps, needs_steps, plan_steps
from mapctl import rotations
from mapctl.arguments import read_number, read_point
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.intent.steering import STEP_LENGTHS, Arrival, Command, SteeringLimits, SteeringTarget
from mapctl.motion import Motion
from mapctl.pose import BodyPose, decode
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver, replay
from mapctl.problem.solution import Ledger, Outcome, Solution, Status
from mapctl.problem.window_solvers import GuidedNoiseSolver, LatentNoiseSolver, SingleWindowSolver
from mapctl.protocols import Density
from mapctl.runtime.stepwise import StepwiseWork
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings, LbfgsStatus
from mapctl.terms import FootContact, KeepClear, LatentPrior, RootVelocity, StepLength, Term

_BODY = 0.4  # metres from an obstacle's edge to the hips that pass it
_LOOK_AHEAD, _LOOK_SECONDS = 0.6, 1.2  # metres, and seconds of walking, in which the path must be clear
_HEADINGS, _WIDEST = 65, math.radians(140.0)  # directions that are tried, and how far off the commanded one
_SAMPLES = 16  # along each
_GET_OUT = 0.3  # metres of clearance gained by metre, where it is too near already
_STAY = 0.5  # share of a change of direction that counts beside the deviation, which keeps the side


def lead_around(
    obstacles: tuple[Obstacle, ...], *, position: tuple[float, float], heading: float, wanted: float, speed: float
) -> float:
    """Return the direction of travel, radians, nearest to the `wanted` one that leads clear of obstacles.

    `position` is the position (x and z, metres), `heading` the direction of travel now, `speed` in m/s. Where every
    direction is blocked, the clearest.
    """
    if not obstacles or speed <= 0:
        return wanted
    offsets = torch.linspace(-_WIDEST, _WIDEST, _HEADINGS, dtype=torch.float64)
    angles = wanted + offsets
    along = torch.linspace(0, _LOOK_AHEAD + _LOOK_SECONDS * speed, _SAMPLES, dtype=torch.float64)
    start = torch.tensor(position, dtype=torch.float64)
    rays = start + along[:, None] * torch.stack([angles.sin(), angles.cos()], dim=-1)[:, None]
    near = float(measure_clearance(obstacles, start))
    lacking = (torch.clamp(near + _GET_OUT * along, max=_BODY) - measure_clearance(obstacles, rays)).amax(dim=1)
    if bool((lacking > 1e-6).all()):
        return float(angles[lacking.argmin()])
    cost = offsets.abs() + _STAY * rotations.wrap_angle(angles - heading).abs()
    return float(angles[torch.where(lacking > 1e-6, torch.inf, cost).argmin()])


KEPT_FRAMES = 11
"""Last frames whose features are kept: an arrival continues from them."""
_JUDGED_FRAMES = 60  # that are kept for terms that look back
_PAST_TARGET_FRAMES = 60  # past targets that are kept: more than the root velocity term looks back on
_SIGMA_FACING = 0.15  # radians of the hips' heading
_REST_FRAMES, _STANDING = 8, 0.25  # over which a body at rest goes at less than so many m/s
_WIDER = 2.0  # times that the prior is along planned steps, which it takes for less likely than they are
_ALONG_STEPS = 2  # evaluations along planned steps, which obey the command already
_ENOUGH = 1e-2  # share of the energy: a search ends where an iteration wins less
_FASTEST_PLANNED = 1.5  # m/s beyond which a body slows down before its steps are planned
_NEAREST_STARTS = 6  # initial states nearest to the requested speed, of which one is sampled
_RISE, _FALL = 0.1, 0.4  # share of the last step in what is expected: another process makes steps longer, none shorter
_FORGET = 0.9  # of an evaluation's time after a step that had none to make: else there would never be one again
_LONGEST_REST = 0.02  # seconds: a rest beyond it was interrupted by another process


@dataclass(frozen=True)
class SteerSettings:
    """Window lengths, budget and limits."""

    horizon: int = 24
    """Frames of a window, the look-ahead included."""
    commit: int = 3
    """Frames that a step commits and delivers."""
    evaluations: int = 6
    """Most evaluations of energy and gradient in a step."""
    least_evaluations: int = 4
    """Evaluations for which the loop gives a step time, however late it is: with fewer, commands are missed. Never more
    than `evaluations`."""
    limits: SteeringLimits = field(default_factory=SteeringLimits)
    """How fast a steering target may change."""
    footing: FootContact = field(default_factory=FootContact)
    """Contact term."""
    noise: LatentPrior = field(default_factory=LatentPrior)
    """Prior on the latent noise, as in path following."""
    liveliness: float = 0.35
    """Standard deviation of the noise that is drawn once for each frame, about which the prior of a walk is centred, as
    in path following."""

    def scaled_to(self, character: Character) -> "SteerSettings":
        """Return the settings for a character of this size, in metres of the prior's size."""
        return replace(self, limits=character.limits(self.limits), footing=character.footing(self.footing))


@dataclass(frozen=True)
class StepCost:
    """Times of a step."""

    evaluation: float = 0.003
    """Seconds of an evaluation, its share of all else in a step included."""
    rest: float = 0.005
    """Seconds of a step before its search begins and after it ends."""

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
    seed: int = 0
    """Seed of the noise that is drawn for walks."""
    frames: int = 1
    """Frames delivered so far, the first pose included."""
    terms: tuple[Term, ...] = ()
    """The caller's own terms, for the prior's size."""
    overlay: Overlay = field(default_factory=Overlay)
    """Motion of hands and head on top of the walk."""
    cost: StepCost = field(default_factory=StepCost)
    """Cost of recent steps."""
    steps: PlannedSteps | None = None
    """Planned steps from which the search of a step starts; what is left of the last ones."""
    stand: Stand | None = None
    """Where the body stands; None where it does not."""
    approach: Approach | None = None
    """Last order to be somewhere, and how far it is carried out (`controllers.steering.arrival`)."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SteerFrames(Solution):
    """New frames of a step, at PRIOR_FPS, in the world; the status notes a search that a deadline cut short."""

    contacts: Float[Tensor, "frames 2"]
    """Contacts of the left and the right toe, 1 or 0."""
    root_velocity: Float[Tensor, "frames 2"]
    """Velocity of the hips over the ground, x and z in the world, m/s."""
    steering_targets: tuple[SteeringTarget, ...]
    """Steering targets of the frames."""
    forecast: Float[Tensor, "ahead joints 3"]
    """World joint positions of the frames that would come next, metres; the next command changes them."""
    ahead: Motion | None = None
    """Poses of those frames, without reaches; None with the first pose."""
    evaluations: int = 0
    """Energy-and-gradient evaluations of the step."""
    refusal: Refusal | None = None
    """An order to be somewhere that is not obeyed; given once."""

    @property
    def trajectory(self) -> Float[Tensor, "ahead 3"]:
        """Ground trajectory of the forecast: x and z of the hips, metres, and their heading, radians, not wrapped."""
        if self.ahead is None:
            return torch.zeros(0, 3)
        pose = BodyPose.of_motion(self.ahead)
        return torch.cat([pose.root_position[:, ::2], pose.heading[:, None]], dim=1)


Stepper: TypeAlias = Callable[..., tuple[SteerState, SteerFrames]]
"""(state, command, seconds=...) to the next state and frames: `step`, or a `controllers.steering.arrival.Arriver`."""


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
    """Put a character at x and z (metres) that faces along the command, and return its first pose.

    The generator samples it from the prior's initial states near the command's speed and with its labels; the slowest
    for a command to stand. `terms` are the caller's own, the same in every step; they see the character at its own size
    and the time since the first pose. On another `skeleton` (canonical names) strides are as long as its legs, and the
    toes' rest height is that of `settings.footing`; commands, limits and delivered frames are in its metres.
    """
    chosen = settings or SteerSettings()
    character, position = Character(skeleton, chosen.footing.rest_height), read_point(at, 2, "the first position")
    command = character.command(command)
    starts = condition_prior(prior, command.labels).initial_states
    nearest = (starts.speed - command.speed).abs().argsort()[:_NEAREST_STARTS]
    pick = int(nearest[torch.randint(len(nearest), (1,), generator=generator)])
    state = starts.state.pick(torch.tensor([pick]))
    ground_pose = GroundPose(
        torch.tensor(position, dtype=torch.float32) / character.scale,
        torch.tensor(command.heading, dtype=torch.float32),
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
        root_velocity=_ground_velocity(first, start.before_first) * character.scale,
        steering_targets=(character.target(target),),
        forecast=start.committed.joints_world[:0],
    )
    past_targets, unit_terms = torch.tensor([target.velocity]), tuple(character.term(term) for term in terms)
    seed = int(torch.randint(2**31, (), generator=generator))
    return SteerState(
        prior, chosen.scaled_to(character), character, start.committed, target, past_targets, seed, terms=unit_terms
    ), frames


def accept(prior: Density, command: Command) -> tuple[Command, list[str]]:
    """Return the nearest feasible command, and a note on each number that was changed (Command.within).

    RequestError for labels that the prior does not know.
    """
    condition_prior(prior, command.labels)
    return command.within(prior.limits.max_steering_speed)


def step(state: SteerState, command: Command, *, seconds: float | None = None) -> tuple[SteerState, SteerFrames]:
    """Solve the next frames under a command, but for its arrival (see `controllers.steering.arrival`). Within `seconds`
    the best solution so far is returned, with a note; without an evaluation where there is no time for one: then the
    last plan is carried on. What must be done in any case takes about 4 ms. Without a limit of time, the budget is
    `SteerSettings.evaluations`, and the same state and command give the same frames to the bit.

    RequestError for labels that the prior does not know. The first step under new labels takes longer (`warm_up`).
    """
    began, settings, character = time.perf_counter(), state.settings, state.character
    seconds = None if seconds is None else read_number(seconds, "the seconds of a step")
    asked, command = command, character.command(_lead_around(state, command))
    steps = _find_steps(state, command)
    if steps is None and (stand := _find_stand(state, command)) is not None:
        return _stand_still(replace(state, stand=stand), asked, began)
    if steps is None and needs_steps(command, float(state.committed.ground_pose.heading)):
        command = replace(command, speed=0.0, heading=command.hips_heading)  # it comes to rest first
    state = replace(state, steps=steps, stand=None)
    if steps is None:
        targets = state.target.ahead(command, settings.limits, frames=settings.horizon, fps=PRIOR_FPS)
    else:
        targets = steps.targets_of(settings.horizon)
    conditioned = replace(state, prior=condition_prior(state.prior, command.labels))
    if steps is None:
        noise = replace(settings.noise, centre=_draw_noise(state))
    else:
        noise = replace(settings.noise, sigma=_WIDER * settings.noise.sigma)
    terms = (noise, *_build_steering_terms(state, targets, command.step_length), *state.terms)
    if asked.obstacles:
        terms = (*terms, character.term(KeepClear(asked.obstacles)))
    search = None if seconds is None else max(0.0, seconds - state.cost.rest)
    done, outcome = _solve_step(conditioned, terms, search)
    if outcome is not Outcome.DONE:
        cold = replace(state.committed, warm_start=state.committed.warm_start[:0])
        restarted = replace(conditioned, committed=cold, steps=None)
        done, _ = _solve_step(restarted, terms, 0.0)  # the prior's own continuation, which always exists
    new, record = done.features[-settings.commit :], done.windows[-1]
    most = _most_evaluations(state)
    cut_short = record.outcome == LbfgsStatus.OUT_OF_BUDGET.value and record.evaluations < most
    note = f"the deadline came after {record.evaluations} of {most} evaluations"
    status = Status(Outcome.BUDGET, (note,)) if cut_short else Status(Outcome.DONE)
    committed = done.discard_history(max(len(new), KEPT_FRAMES))
    after, frames = deliver(state, committed, new, targets[: settings.commit], asked, done.ahead, done.forecast)
    after = replace(after, steps=steps and steps.after(len(new)))
    ledger, spent = character.ledger(done.ledger), time.perf_counter() - began
    cost = state.cost.learn(spent, record.evaluations, search=search, cut_short=cut_short)
    return replace(after, cost=cost), replace(
        frames, status=status, ledger=ledger, windows=done.windows, seconds=spent, evaluations=record.evaluations
    )


def deliver(
    state: SteerState,
    committed: CommittedFrames,
    new: Float[Tensor, "frames size"],
    targets: Sequence[SteeringTarget],
    command: Command,
    ahead: Float[Tensor, "ahead size"] | None,
    joints: Float[Tensor, "ahead joints 3"] | None = None,
) -> tuple[SteerState, SteerFrames]:
    """Return the state after new frames, with what is committed then and their targets, and the frames as they are
    shown, with the forecast of those after them, all at the prior's size: features and, where they are known, world
    joints."""
    character, start = state.character, state.committed.ground_pose
    motion = character.motion(decode(new, start, skeleton=character.unit_skeleton))
    forecast, following = committed.joints_world[:0], None
    if ahead is not None and len(ahead):
        following = character.motion(decode(ahead, committed.ground_pose, skeleton=character.unit_skeleton))
        forecast = following.joint_positions() if joints is None else joints * character.scale
    overlay, motion = state.overlay.pose(motion, command, forecast)
    frames = SteerFrames(
        motion,
        Status(Outcome.DONE),
        Ledger(),
        features=new,
        contacts=LAYOUT.pick(new, "contacts"),
        root_velocity=_ground_velocity(new, start) * character.scale,
        steering_targets=tuple(map(character.target, targets)),
        forecast=forecast,
        ahead=following,
    )
    velocities = torch.tensor([target.velocity for target in targets])
    next_state = replace(
        state,
        committed=committed,
        target=targets[-1],
        past_targets=torch.cat([state.past_targets, velocities])[-_PAST_TARGET_FRAMES:],
        frames=state.frames + len(new),
        overlay=overlay,
    )
    return next_state, frames


def _ground_velocity(features: Float[Tensor, "frames size"], start: GroundPose) -> Float[Tensor, "frames 2"]:
    """Compute the velocity of the hips over the ground in each frame after a ground pose, m/s at the prior's size."""
    ground, _ = integrate_root(features, start)
    return torch.cat([start.position_xz[None], ground]).diff(dim=0) * PRIOR_FPS


def warm_up(state: SteerState, commands: Iterable[Command], *, stepper: Stepper | None = None) -> None:
    """Compile, load and condition what steps under commands like these need on first use, for seconds, so that none of
    a game's does. The state stays as it is. One command for each set of labels is enough; `stepper` as in the loop."""
    for command in commands:
        (stepper or step)(state, command)
        step(state, replace(command, step_length=command.step_length or STEP_LENGTHS[0] * state.character.scale))


def save(state: SteerState) -> bytes:
    """Pickle a state without its prior; work on an arrival is finished first. With its prior, and whole,
    a state can be pickled and copied as any value."""
    return pickle.dumps({name: value for name, value in vars(state).items() if name != "prior"})


def restore(saved: bytes, prior: Density) -> SteerState:
    """Return a saved state, with the same prior: it goes on to the bit as the one that was saved. As with any pickle,
    only bytes of your own."""
    return SteerState(prior, **pickle.loads(saved))  # noqa: S301


def _lead_around(state: SteerState, command: Command) -> Command:
    """Lead a command round its obstacles, in the character's metres; one to turn on and on is left to its terms."""
    if not command.obstacles or command.turning is not None:
        return command
    x, _, z = (state.committed.joints_world[-1, 0] * state.character.scale).tolist()
    heading = state.target.heading if state.target.speed > 0 else float(state.committed.ground_pose.heading)
    led = lead_around(command.obstacles, position=(x, z), heading=heading, wanted=command.heading, speed=command.speed)
    return replace(command, heading=led)


@lru_cache(maxsize=64)
def condition_prior(prior: Density, labels: tuple[str, ...]) -> Density:
    """Condition the prior on labels, if there are any; cached, since it takes as long as a step may last."""
    return prior.conditioned_on(labels) if labels else prior


def _solve_step(state: SteerState, terms: Sequence[Term], seconds: float | None) -> tuple[CommittedFrames, Outcome]:
    settings, steps, most = state.settings, state.steps, max(1, _most_evaluations(state))
    lbfgs = LbfgsSettings(max_iterations=most, relative_energy_tolerance=_ENOUGH)
    budget = Budget(most, seconds, evaluation_seconds=state.cost.evaluation)  # begins none that it cannot end
    if steps is None:
        method: SingleWindowSolver = LatentNoiseSolver(rounds=1, lbfgs=lbfgs, budget=budget)
    else:
        method = GuidedNoiseSolver(steps.window(settings.horizon), 1.0, lbfgs, budget)
        state = replace(state, committed=replace(state.committed, warm_start=state.committed.warm_start[:0]))
    window = HorizonSettings(frames=settings.horizon, overlap=settings.horizon - settings.commit)
    solver = RecedingHorizonSolver(state.prior, window, state.character.unit_skeleton, method=method)
    frames = len(state.committed.features) + settings.commit
    return solver.solve(
        state.committed, lambda first, count: terms, frames, generator=torch.Generator().manual_seed(state.frames)
    )


def _most_evaluations(state: SteerState) -> int:
    most = state.settings.evaluations
    return most if state.steps is None else min(most, _ALONG_STEPS)


def _find_steps(state: SteerState, command: Command) -> PlannedSteps | None:
    """Find the planned steps from which the search starts: those under way, or new ones where no walk leads to what is
    commanded."""
    steps, stands, heading = state.steps, _stands(state), float(state.committed.ground_pose.heading)
    if steps is not None and steps.obey(command, heading):
        return steps
    starts = steps is not None or stands or _is_at_rest(state)
    stops = command.speed == 0 and command.turning is None and not stands
    if not stops and not needs_steps(command, heading, starts=starts):
        return None
    if float(_recent_velocity(state).norm()) > _FASTEST_PLANNED:
        return None
    stand, limits = _find_mean_stand(state, command), state.settings.limits
    return plan_steps(_find_pose(state), state.committed.joints_world, stand, command, limits)


def _stands(state: SteerState) -> bool:
    """Return whether the body has come to a stand."""
    return state.stand is not None or (state.steps is not None and state.steps.ended)


def _find_stand(state: SteerState, command: Command) -> Stand | None:
    """Find the stand of a body at rest that is to stand as it does."""
    if command.speed > 0 or command.turning is not None or not (_stands(state) or _is_at_rest(state)):
        return None
    return state.stand or Stand(_find_pose(state), _find_mean_stand(state, command))


def _is_at_rest(state: SteerState) -> bool:
    """Return whether the body hardly went in the last quarter of a second."""
    known = len(state.committed.joints_world) > _REST_FRAMES
    return known and float(_recent_velocity(state).norm()) < _STANDING / state.character.scale


def _find_pose(state: SteerState) -> Motion:
    committed, skeleton = state.committed, state.character.unit_skeleton
    return find_pose(committed.features[-1], committed.ground_pose, skeleton)


def _find_mean_stand(state: SteerState, command: Command) -> Motion:
    """Return the stand where the body is, in the mean pose of the slower half of the prior's initial states."""
    starts = condition_prior(state.prior, command.labels).initial_states
    mean = starts.state.last_frame[starts.speed <= starts.speed.median()].mean(dim=0)
    skeleton, toe_height = state.character.unit_skeleton, state.settings.footing.rest_height
    return find_stand(mean, state.committed.ground_pose, skeleton, toe_height)


def _stand_still(state: SteerState, command: Command, began: float) -> tuple[SteerState, SteerFrames]:
    """Deliver the next frames of a stand, without a search."""
    assert state.stand is not None
    stand, features = state.stand.advance(state.settings.horizon)
    new, ahead = features[: state.settings.commit], features[state.settings.commit :]
    stand = replace(stand, frames=state.stand.frames + len(new))
    facing = float(state.committed.ground_pose.heading)
    target = SteeringTarget(0.0, facing, facing)
    after, frames = deliver(state, commit_frames(state, new), new, [target] * len(new), command, ahead)
    return replace(after, stand=stand, steps=None), replace(frames, seconds=time.perf_counter() - began)


def commit_frames(state: SteerState, new: Float[Tensor, "frames size"]) -> CommittedFrames:
    """Return what is committed after frames that were not solved: the density's state is advanced over them."""
    committed = state.committed
    start = GroundPose(committed.ground_pose.position_xz.double(), committed.ground_pose.heading.double())
    ground, facing = integrate_root(new.double(), start)  # in single precision a long one would miss the target
    unit = decode(new, committed.ground_pose, skeleton=state.character.unit_skeleton)
    joints = torch.cat([committed.joints_world, unit.joint_positions().to(committed.joints_world)])
    return replace(
        committed,
        state=replay(state.prior, new, committed.state),  # pyright: ignore[reportArgumentType]
        ground_pose=GroundPose(ground[-1].float(), facing[-1].float()),
        features=torch.cat([committed.features, new]),
        joints_world=joints[-_JUDGED_FRAMES:],
        warm_start=committed.warm_start[:0],
    ).discard_history(KEPT_FRAMES)


def _recent_velocity(state: SteerState) -> Float[Tensor, "2"]:
    """Compute the mean velocity of the hips over the ground in the last quarter of a second, m/s."""
    past = state.committed.joints_world[-_REST_FRAMES - 1 :, 0, ::2]
    return (past[-1] - past[0]) * PRIOR_FPS / max(1, len(past) - 1)


def _build_steering_terms(
    state: SteerState, targets: Sequence[SteeringTarget], step_length: float | None
) -> Sequence[Term]:
    scale = state.character.scale
    velocity = RootVelocity(
        torch.tensor([target.velocity for target in targets]),
        state.past_targets,
        facing=torch.tensor([target.facing for target in targets]),
        sigma_speed=RootVelocity.sigma_speed / scale,
        sigma_facing=_SIGMA_FACING,
    )
    terms = velocity, state.settings.footing
    return (*terms, StepLength(step_length, sigma=StepLength.sigma / scale)) if step_length else terms


def _draw_noise(state: SteerState) -> Float[Tensor, "frames continuous"]:
    """Draw the noise of a window: that of a frame is the same in every window."""
    frames, one = range(state.frames, state.frames + state.settings.horizon), torch.Generator()
    drawn = [torch.randn(LAYOUT.continuous, generator=one.manual_seed(state.seed + frame)) for frame in frames]
    return state.settings.liveliness * torch.stack(drawn)


def _expect(known: float, last: float) -> float:
    return known + (_RISE if last > known else _FALL) * (last - known)
