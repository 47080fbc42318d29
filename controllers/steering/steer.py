"""Steer a character (rnn paper, section 5.3): a few frames at a time, a second ahead, from the last solution's tail.

`step` is pure: a state and a command go in, the next state and its frames come out, and the same bits for the same
evaluations. It knows no clock; who has a deadline gives the seconds that are left, and gets the best found by then.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import start_from_state
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed
from mapctl.intent.steering import Command, SteeringLimits, SteeringTarget
from mapctl.pose import decode
from mapctl.problem.context import WindowRequest
from mapctl.problem.ledger import Ledger
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.problem.warm_start import BestOfSamples, SteeringKnots
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver, SolvedWindow
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings, LbfgsStatus
from mapctl.terms import FootContact, LatentPrior, RootVelocity, StepLength, Term

_PAST_TARGET_FRAMES = 60  # wishes of the past that are kept: more than the travel term looks back on
_RECENT_FRAMES = 15  # frames of the half second whose wishes must not be missed by far
_MIN_TRAVEL_SPEED = 0.3  # m/s below which a direction of travel means nothing
_KNOTS, _KNOT_SIGMA = 7, 0.8  # of draws for who is stuck: noise of every feature, slow enough to make a step of it
_NEAREST_STARTS = 6  # starts nearest to the wanted speed, of which one is drawn


@dataclass(frozen=True)
class SteerSettings:
    """Sigmas, lengths and effort."""

    horizon: int = 34
    """Frames of a window: what a command changes is found this far ahead."""
    commit: int = 3
    """Frames that a step delivers."""
    evaluations: int = 14
    """Of energy and gradient in a step, at most: what one core does in the time that three frames last."""
    least_evaluations: int = 6
    """In a step, however late it is: with fewer wishes are missed (docs/results.md). Never more than `evaluations`."""
    limits: SteeringLimits = field(default_factory=SteeringLimits)
    """How fast a wish may change."""
    sigma_speed: float = RootVelocity.sigma_speed
    """Along the wanted velocity, m/s."""
    sigma_direction: float = RootVelocity.sigma_direction
    """Across it, radians."""
    sigma_facing: float = RootVelocity.sigma_facing
    """Of the hips' heading, radians."""
    sigma_step: float = StepLength.sigma
    """Of a wanted step length, metres."""
    stuck: float = 0.4
    """Speed, m/s, by which the last half second may miss its wish; beyond it feet are first let off the ground."""
    random_starts: int = 12
    """Random beginnings, tried all at once beside the evaluations, of which the best is searched from then."""
    footing: FootContact = field(default_factory=FootContact)
    """Planted feet."""
    noise: LatentPrior = field(default_factory=lambda: LatentPrior(sigma=2.0))
    """The prior, as in following a curve."""

    def __post_init__(self):
        if not 1 <= self.commit < self.horizon or self.evaluations < 1 or self.least_evaluations < 0:
            raise RequestError(
                f"steering needs 1 <= commit < horizon, evaluations >= 1 and least_evaluations >= 0, got {self}"
            )

    def scaled_to(self, person: Character) -> "SteerSettings":
        """The same for somebody of this size, in metres of the prior's size."""
        if person.scale == 1.0:
            return self
        sigmas = {name: getattr(self, name) / person.scale for name in ("sigma_speed", "sigma_step", "stuck")}
        return replace(self, limits=person.limits(self.limits), footing=person.footing(self.footing), **sigmas)


@dataclass(frozen=True, eq=False)
class SteerState:
    """Everything that the next step depends on; of a fixed size."""

    prior: Density
    """The density."""
    settings: SteerSettings
    """The same in every step, in metres of the prior's size."""
    person: Character
    """Bones of the character, and how long its legs are beside the prior's."""
    committed: CommittedFrames
    """The end of what was delivered."""
    wish: SteeringTarget
    """Of the last delivered frame, in the prior's size."""
    past_targets: Float[Tensor, "past 2"]
    """Wanted velocities of the last delivered frames, oldest first, m/s in the prior's size."""
    frames: int = 1
    """Delivered so far, the first pose among them."""
    terms: tuple[Term, ...] = ()
    """The caller's own, for the prior's size."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SteerFrames(Solution):
    """The new frames of a step, at PRIOR_FPS, where they are in the world; the status says why less was searched than
    the settings allow, if so."""

    contacts: Float[Tensor, "frames 2"]
    """Left and right toe planted, 1 or 0."""
    steering_targets: tuple[SteeringTarget, ...]
    """Of those frames."""
    forecast: Float[Tensor, "ahead joints 3"]
    """World joint positions of the frames that would come next, metres; what the next command changes."""
    evaluations: int = 0
    """Energy-and-gradient evaluations of the step."""


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

    It is one of the prior's starts near the wanted speed and of the command's labels, drawn by the generator: the
    data's slowest for a command to stand. `terms` are the caller's own, the same in every step; they see the character
    at its own size and the time since the first pose. On another `skeleton` (canonical names) strides are as long as
    its legs, and the toes' rest height is that of `settings.footing`; commands, limits and what is delivered are in its
    metres.
    """
    chosen = settings or SteerSettings()
    person = Character(skeleton, chosen.footing.rest_height)
    command = person.command(command)
    starts = (_condition_prior(prior, command.told) if command.told else prior).initial_states
    near = (starts.speed - command.speed).abs().argsort()[:_NEAREST_STARTS]
    pick = int(near[torch.randint(len(near), (1,), generator=generator)])
    state = starts.state.pick(torch.tensor([pick]))
    there = torch.tensor(at) if person.scale == 1.0 else torch.tensor(at) / person.scale
    start = start_from_state(state, GroundPose(there, torch.tensor(command.heading)), person.unit_skeleton)
    first = start.committed.features
    motion = person.motion(decode(first, start.before_first, skeleton=person.unit_skeleton))
    wish = SteeringTarget(float(ground_speed(first)[0]), command.heading, command.heading)
    frames = SteerFrames(
        motion,
        Status(Outcome.DONE),
        Ledger(),
        contacts=LAYOUT.pick(first, "contacts"),
        steering_targets=(_scale_target_to_character(wish, person),),
        forecast=start.committed.joints_world[:0],
    )
    past, own = torch.tensor([wish.velocity]), tuple(person.term(term) for term in terms)
    return SteerState(prior, chosen.scaled_to(person), person, start.committed, wish, past, terms=own), frames


def accept(prior: Density, command: Command) -> tuple[Command, list[str]]:
    """The nearest command that the prior can hold, and a sentence for each number that was changed (Command.within).

    RequestError where it tells the prior what it does not know.
    """
    if command.told:
        _condition_prior(prior, command.told)
    return command.within(prior.limits.max_steering_speed)


def step(state: SteerState, command: Command, *, seconds: float | None = None) -> tuple[SteerState, SteerFrames]:
    """The next frames under a command. With `seconds`, the best found by then but for the least that the settings ask
    for, and a note that says so.

    RequestError where the command tells the prior what it does not know. The first step under new labels takes longer.
    """
    began = time.perf_counter()
    settings, person = state.settings, state.person
    command = person.command(command)
    stuck = _velocity_error(state) > settings.stuck
    if stuck:
        state = _restart_target(state)
    wishes = state.wish.ahead(command, settings.limits, frames=settings.horizon, fps=PRIOR_FPS)
    told = replace(state, prior=_condition_prior(state.prior, command.told)) if command.told else state
    terms = (*_build_steering_terms(state, wishes, command.step_length), *state.terms)
    done, outcome = _solve_step(told, terms, seconds, free=stuck)
    if outcome is not Outcome.DONE:
        unsearched = replace(settings, least_evaluations=0)
        afresh = replace(
            told,
            settings=unsearched,
            committed=replace(state.committed, warm_start=state.committed.warm_start[:0], forecast=None),
        )
        done, _ = _solve_step(afresh, terms, 0.0, free=False)  # the prior's own continuation: never nothing
    new = done.features[-settings.commit :]
    motion = person.motion(decode(new, state.committed.place, skeleton=person.unit_skeleton))
    record, own = done.windows[-1], tuple(wishes[: settings.commit])
    short = record.outcome == LbfgsStatus.OUT_OF_BUDGET.value and record.evaluations < settings.evaluations
    note = f"the deadline came after {record.evaluations} of {settings.evaluations} evaluations"
    status = Status(Outcome.BUDGET, (note,)) if short else Status(Outcome.DONE)
    forecast = done.forecast if done.forecast is not None else done.joints_world[:0]
    forecast = forecast if person.scale == 1.0 else forecast * person.scale
    frames = SteerFrames(
        motion,
        status,
        person.ledger(done.ledger),
        done.windows,
        new,
        time.perf_counter() - began,
        contacts=LAYOUT.pick(new, "contacts"),
        steering_targets=tuple(_scale_target_to_character(wish, person) for wish in own),
        forecast=forecast,
        evaluations=record.evaluations,
    )
    owed = torch.cat([state.past_targets, torch.tensor([wish.velocity for wish in own])])[-_PAST_TARGET_FRAMES:]
    kept = done.discard_history(len(new))
    following = replace(state, committed=kept, wish=own[-1], past_targets=owed, frames=state.frames + len(new))
    return following, frames


def _scale_target_to_character(wish: SteeringTarget, person: Character) -> SteeringTarget:
    return wish if person.scale == 1.0 else replace(wish, speed=wish.speed * person.scale)


@lru_cache(maxsize=64)
def _condition_prior(prior: Density, labels: tuple[str, ...]) -> Density:
    """The prior given the labels; kept, since it takes as long to make as a step may last."""
    return prior.conditioned_on(labels)


def _solve_step(
    state: SteerState, terms: Sequence[Term], seconds: float | None, *, free: bool
) -> tuple[CommittedFrames, Outcome]:
    settings = state.settings
    method: SingleWindowSolver = _limit_evaluations(settings.evaluations, settings.least_evaluations, seconds)
    if free:
        method = _relax_footing_first(state, terms, seconds)
    window = HorizonSettings(frames=settings.horizon, overlap=settings.horizon - settings.commit)
    solver = RecedingHorizonSolver(state.prior, window, state.person.unit_skeleton, method=method)
    frames = len(state.committed.features) + settings.commit
    return solver.solve(
        state.committed, lambda first, count: terms, frames, generator=torch.Generator().manual_seed(state.frames)
    )


def _limit_evaluations(evaluations: int, least: int, seconds: float | None) -> LatentNoiseSolver:
    """One round of so many evaluations at most, fewer by then, but the least in any case."""
    most = max(1, evaluations)
    budget = Budget(most, seconds, min(least, most))
    return LatentNoiseSolver(rounds=1, lbfgs=LbfgsSettings(max_iterations=most), budget=budget)


def _relax_footing_first(state: SteerState, terms: Sequence[Term], seconds: float | None) -> "_RelaxedFootingFirst":
    """The search for who is stuck: the draws are looked at in any case, the evaluations are halved."""
    settings, soon = state.settings, seconds and seconds / 2
    half = _limit_evaluations(settings.evaluations // 2, max(1, settings.least_evaluations // 2), soon)
    few, least = half.budget.evaluations or 1, half.budget.least
    draws = BestOfSamples(settings.random_starts, SteeringKnots(_KNOTS, tuple(LAYOUT.slices)[:-1], _KNOT_SIGMA))
    bold = replace(
        half, proposal=draws, budget=Budget(settings.random_starts + few, soon, settings.random_starts + least)
    )
    return _RelaxedFootingFirst(bold, half, [term for term in terms if term.name != settings.footing.name])


@dataclass(frozen=True)
class _RelaxedFootingFirst:
    """A Method that spends half on the wishes without footing, from the best of some draws, and half on all.

    Who stands has both feet planted, by contact bits that stay while a window is solved: footing then holds what the
    wish would move. The search without it finds a step, and along that step the prior says anew which feet stand.
    """

    relaxed_method: LatentNoiseSolver
    half: LatentNoiseSolver
    relaxed_terms: Sequence[Term]

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        request = replace(request, seconds=request.seconds / 2)
        first = self.relaxed_method(replace(request, terms=self.relaxed_terms))
        second = self.half(replace(request, warm_start=first.warm_start))
        return replace(second, evaluations=first.evaluations + second.evaluations)


def _velocity_error(state: SteerState) -> float:
    """How far the mean velocity of the last half second missed its wishes, m/s."""
    if min(len(state.committed.joints_world) - 1, len(state.past_targets)) < _RECENT_FRAMES:
        return 0.0
    return float((_recent_velocity(state) - state.past_targets[-_RECENT_FRAMES:].mean(0)).norm())


def _recent_velocity(state: SteerState) -> Float[Tensor, "2"]:
    """Of the hips over the ground, mean of the last half second, m/s."""
    past = state.committed.joints_world[-_RECENT_FRAMES - 1 :, 0, ::2]
    return (past[-1] - past[0]) * PRIOR_FPS / _RECENT_FRAMES


def _restart_target(state: SteerState) -> SteerState:
    """The state with a wish that begins anew from how the character moves and faces, and nothing owed.

    A wish that ran ahead (a walk off to the side of who stands and faces elsewhere) leads no search there.
    """
    velocity, facing = _recent_velocity(state), float(state.committed.place.heading)
    speed = float(velocity.norm())
    heading = math.atan2(*velocity.tolist()) if speed > _MIN_TRAVEL_SPEED else facing
    wish = SteeringTarget(speed, heading, facing)
    return replace(state, wish=wish, past_targets=torch.tensor([wish.velocity]).expand(_RECENT_FRAMES, 2))


def _build_steering_terms(
    state: SteerState, wishes: Sequence[SteeringTarget], step_length: float | None
) -> Sequence[Term]:
    settings = state.settings
    travel = RootVelocity(
        torch.tensor([wish.velocity for wish in wishes]),
        state.past_targets,
        facing=torch.tensor([wish.facing for wish in wishes]),
        sigma_speed=settings.sigma_speed,
        sigma_direction=settings.sigma_direction,
        sigma_facing=settings.sigma_facing,
    )
    terms = settings.noise, travel, settings.footing
    return (*terms, StepLength(step_length, sigma=settings.sigma_step)) if step_length else terms
