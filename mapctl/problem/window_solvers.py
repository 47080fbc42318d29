"""Solvers of one window: a start, a parametrisation of its frames, and L-BFGS over the unknowns.

The search over a rollout's noise starts at the last window's noise, or at the best of a particle swarm over a few
numbers that steer: noise at a few knots in time, linear in between. All the noise of a window, 66 numbers a frame, is
too many dimensions for a swarm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.pose import BodyPose
from mapctl.problem.density_selection import DensityEnsemble, select_density
from mapctl.problem.objective import Objective, Parametrisation
from mapctl.problem.solution import Ledger, WindowRecord
from mapctl.problem.unknowns import LatentNoise, PoseOffsets, WindowRequest
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsResult, LbfgsSettings, minimise
from mapctl.solver.swarm import SwarmSettings, run_swarm
from mapctl.terms.base import Term
from mapctl.terms.likelihood import LatentPrior, Likelihood
from mapctl.terms.trial import Trial

_STUCK_ENERGY = 8.0
"""Energy a frame, nats, below which no further round is run: a new round starts without curvature pairs, which pays
only where the last one is stuck."""
WarmStartProposal = Callable[[WindowRequest, Float[Tensor, "1 unknowns"], Meter], Float[Tensor, "1 unknowns"]]
"""(request, warm start over the whole window, meter) to the unknowns from which L-BFGS starts."""


_STEERING = [
    column
    for block in ("root_displacement_heading", "heading_change")
    for column in range(LAYOUT.slices[block].start, LAYOUT.slices[block].stop)
]
"""Columns of the noise that the swarm searches."""
_KNOTS, _SPREAD = 4, 0.7  # over the window, and standard deviation of draws at each, in units of the noise


@dataclass(frozen=True)
class SwarmProposal:
    """A particle swarm (Wang et al. 2019, section 5.2) over noise of travel and turning, added to the warm start.

    The unknowns are its values at knots, evenly spaced over the window; between them it is linear.
    """

    settings: SwarmSettings = field(default_factory=SwarmSettings)
    """Number of particles and iterations; with one iteration the best of random draws."""

    def __call__(
        self, request: WindowRequest, warm: Float[Tensor, "1 unknowns"], meter: Meter
    ) -> Float[Tensor, "1 unknowns"]:
        """Return the best point of the swarm, each under its own plan; the meter counts what was evaluated."""

        def unknowns(points: Float[Tensor, "batch size"]) -> Float[Tensor, "batch unknowns"]:
            at_knots = torch.unflatten(points.to(warm.dtype), -1, (_KNOTS, -1)).transpose(1, 2)
            noise = warm.new_zeros(len(points), request.context.frames, LAYOUT.continuous)
            dense = torch.nn.functional.interpolate(at_knots, size=noise.shape[1], mode="linear", align_corners=True)
            noise[..., _STEERING] = dense.transpose(1, 2)
            return warm + noise.flatten(1)

        def energy(points: Float[Tensor, "batch size"]) -> Float[Tensor, " batch"]:
            noise = unknowns(points)
            with torch.no_grad():
                return Objective(LatentNoise.from_unknowns(request.context, noise).build, request.terms).energy(noise)

        start = torch.zeros(_KNOTS * len(_STEERING))
        found = run_swarm(
            energy, start=start, spread=_SPREAD, settings=self.settings, meter=meter, generator=request.generator
        )
        return unknowns(found.x[None])


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """The lowest energy that was found for one window, and where."""

    trial: Trial
    """Motion found: batch of one, detached."""
    warm_start: Float[Tensor, "frames width"]
    """Unknowns by frame, from which the next window, which overlaps this one, may start."""
    ledger: Ledger
    """Energy and residual by term and frame."""
    record: WindowRecord
    """Cost and energies, of all frames; the horizon sets the seconds."""


SingleWindowSolver: TypeAlias = Callable[[WindowRequest], SolvedWindow]
"""Solves one window; its result is detached, and no worse than its start."""


@dataclass(frozen=True)
class LatentNoiseSolver:
    """Propose a start, plan, then run rounds of L-BFGS over the rollout's noise.

    Before each round components and contact bits are planned anew along the current rollout; a round that ends higher
    than the one before it is discarded, since the plan itself is not part of the energy.
    """

    rounds: int = 3
    """Largest number of rounds."""
    lbfgs: LbfgsSettings = field(
        default_factory=lambda: LbfgsSettings(max_iterations=36, relative_energy_tolerance=3e-3)
    )
    """Settings of L-BFGS in one round. A step that wins less than a 300th of the energy is the last: that spares three
    evaluations in ten, and walks are as near their paths (docs/reference/results.md)."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=120))
    """Budget of one window."""
    proposal: WarmStartProposal | None = None
    """Proposal of the first round's start; None: the warm start itself."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window."""
        meter, frames = Meter(self.budget.within(request.seconds)), request.context.frames
        start = _extend_warm_start(request)
        if self.proposal is not None:
            start = self.proposal(request, start, meter)
        unknowns, best = self._run_round(request, start, meter)
        start_energy = best.start_energy
        for _ in range(self.rounds - 1):
            if not meter.remaining or not best.energy > _STUCK_ENERGY * frames:
                break
            replanned, again = self._run_round(request, best.x, meter)
            if not again.energy < best.energy:
                break
            unknowns, best = replanned, again
        solved = _build_solved_window(unknowns, request.terms, best, meter)
        return replace(solved, record=replace(solved.record, start_energy=start_energy))

    def _run_round(self, request: WindowRequest, start: Tensor, meter: Meter) -> tuple[LatentNoise, LbfgsResult]:
        unknowns = LatentNoise.begin_search(request.context, start)
        objective = Objective.of(unknowns, request.terms)
        return unknowns, minimise(objective.energy_and_gradient, start, settings=self.lbfgs, meter=meter)


def _extend_warm_start(request: WindowRequest) -> Float[Tensor, "1 unknowns"]:
    """Return the last window's noise, and beyond it the mean of its prior: a continuation without any other term."""
    noise = request.warm_start.new_zeros(request.context.frames, LAYOUT.continuous)
    for term in request.terms:
        if isinstance(term, LatentPrior) and term.centre is not None:
            noise[:] = term.centre
    noise[: len(request.warm_start)] = request.warm_start[: len(noise)]
    return noise.flatten().unsqueeze(0)


@dataclass(frozen=True, eq=False)
class GuidedNoiseSolver:
    """L-BFGS over the latent noise of a given motion, whose components and contact bits are kept.

    For a motion that is to be changed a little, by its terms.
    """

    guide: Float[Tensor, "frames size"]
    """Features of the window's frames, physical units."""
    share: float = 0.5
    """Share of the guide's noise from which the search starts: 1 is the guide itself, 0 the prior's mean."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=24))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=60))
    """Budget of one window."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window; where the last one overlaps it, the search starts from its noise instead of the guide's."""
        meter, context = Meter(self.budget.within(request.seconds)), request.context
        plan, noise = context.prior.latents(self.guide.unsqueeze(0), context.prior_state)
        start = self.share * noise[0]
        start[: len(request.warm_start)] = request.warm_start[: len(start)]
        heels = context.build_trial(self.guide.unsqueeze(0), plan.contacts)
        unknowns = LatentNoise(context, plan, heel_plan=heels)
        return minimise_window(unknowns, request.terms, start.flatten().unsqueeze(0), self.lbfgs, meter)


def minimise_window(
    unknowns: Parametrisation,
    terms: Sequence[Term],
    start: Float[Tensor, "1 unknowns"],
    lbfgs: LbfgsSettings,
    meter: Meter,
) -> SolvedWindow:
    """Minimise the terms' energies over a window's unknowns; the start itself is kept where nothing finite is found."""
    result = minimise(Objective.of(unknowns, terms).energy_and_gradient, start, settings=lbfgs, meter=meter)
    return _build_solved_window(unknowns, terms, result, meter)


def _build_solved_window(
    unknowns: Parametrisation, terms: Sequence[Term], result: LbfgsResult, meter: Meter
) -> SolvedWindow:
    objective = Objective.of(unknowns, terms)
    trial = objective.build_detached(result.x)
    frames, energies = trial.features.shape[1], (result.start_energy, result.energy)
    return SolvedWindow(
        trial,
        torch.unflatten(result.x[0], -1, (frames, -1)),
        objective.build_ledger(trial),
        WindowRecord(frames, 0.0, meter.evaluations, *energies, outcome=result.status.value),
    )


@dataclass(frozen=True, eq=False)
class PoseOffsetSolver:
    """L-BFGS over the offsets of a proposed motion, window by window.

    Of an ensemble, the density under which a window's proposal is likeliest scores the window, with less weight where
    the proposal is less likely than that density's own data.
    """

    proposal: BodyPose
    """The proposed motion, unbatched."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted in each frame of it."""
    sigma: Float[Tensor, "frames width"]
    """Standard deviations of root, heading and angles by frame (see `BodyPose.pack`): metres and radians."""
    temperature: float = 1.0
    """Temperature of the selected density's likelihood."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=20))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=20))
    """Budget of one window."""
    first_frame: int = 0
    """Frame of the whole motion that the proposal begins at."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window; the proposal stays where nothing finite is found.

        The search starts from the proposal, without a warm start: the frames that the last window's offsets were
        smoothed together with are committed now.
        """
        context, terms = request.context, request.terms
        first = context.first_frame - self.first_frame
        stop = first + context.frames
        proposal, contacts = self.proposal.slice(first, stop), self.contacts[first:stop]
        choice = None
        if isinstance(context.density, DensityEnsemble) and context.density.densities:
            assert isinstance(context.state, tuple)
            densities, features = list(context.density.densities), proposal.features(context.ground_pose, contacts)
            choice = select_density(densities, features, context.state)
            state = context.state[densities.index(choice.density)]
            context = replace(context, density=choice.density, state=state)
            terms = (*terms, Likelihood(self.temperature / choice.weight))
        offsets = PoseOffsets(context, proposal, contacts, self.sigma[first:stop])
        start, meter = torch.zeros(1, offsets.sigma.numel()), Meter(self.budget.within(request.seconds))
        solved = minimise_window(offsets, terms, start, self.lbfgs, meter)
        return replace(solved, record=replace(solved.record, choice=choice))
