"""Rollouts of a density through the gaps of a motion, steered to its next known frames: a different proposal for each
sample (Wang et al. 2019, Eq. 14-19, with the frames after a gap as the target).

A swarm searches latent noise of the root that leads to the next known frames, then L-BFGS all latent noise. The error
that is left at arrival is distributed over the gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.geometry.footholds import hold_planted
from controllers.inbetweening.proposers.rolling import commit_before, insert_rollout, select_likeliest_density
from controllers.inbetweening.proposers.walked import PlaceWalker
from mapctl import contacts
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.problem.receding_horizon import RecedingHorizonSolver
from mapctl.problem.warm_start import SteeringKnots, SwarmProposal
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density, DensityState, Inbetweener
from mapctl.skeleton import CANONICAL, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import FootContact, Keyframe, LatentPrior

EVERY_ROLLOUT_JUMPED = "every rollout jumped"
"""Why a gap is the fallback's that rollouts would take."""
_ENDS = CANONICAL.indices(("leftHand", "rightHand", *TOES))  # what a leg or an arm that is thrown over moves farthest


@dataclass(frozen=True)
class RolloutSettings:
    """Settings of rollouts through gaps."""

    temperature: float = 0.5
    """Standard deviation of a rollout's initial noise: the difference between samples."""
    slow: float = 3.0
    """Frames (sigma) over which that noise is smoothed, at the same deviation: samples then differ in motion, not in
    jitter."""
    sigma_noise: float = 2.0
    """Sigma of the latent prior while steering: above 1 leaves more of the initial noise."""
    sigma_arrival: float = 0.03
    """Sigma of the distance of every joint from the known frames at which a rollout arrives, metres."""
    ahead: int = 15
    """Frames after a gap that are rolled with it, of which the known ones are targets too."""
    footing: FootContact = field(default_factory=lambda: FootContact(0.1, 0.05, 0.05, heels=None))
    """Contact term."""
    shortest: int = 2
    """Frames of the shortest gap that is rolled through: shorter ones leave nothing to vary."""
    longest: int = 180
    """Frames of the longest gap that is rolled through; longer ones are left to the fallback."""
    attempts: int = 3
    """Rollouts through a gap, each from other noise, until one does not jump; then the gap is left to the fallback."""
    jump: float = 1.5
    """A rollout jumps where a hand or a foot steps, relative to the hips, so many times as far as anywhere in the
    fallback's motion: an arrival that noise does not lead to is bought with a leg thrown over in one frame."""
    least_jump: float = 0.12
    """Metres in a frame that no jump stays under, however still the fallback's motion is; hands and feet of a walk step
    as far."""
    method: LatentNoiseSolver = field(
        default_factory=lambda: LatentNoiseSolver(
            rounds=2,
            lbfgs=LbfgsSettings(max_iterations=24),
            budget=Budget(evaluations=96),
            proposal=SwarmProposal(SwarmSettings(particles=8, iterations=5), SteeringKnots(knots=4, spread=0.7)),
        )
    )
    """Solver: the swarm and the search after it."""

    @property
    def span(self) -> str:
        """Range of gaps that are rolled through, in words: seconds from key to key."""
        return f"{(self.shortest + 1) / PRIOR_FPS:.2g} to {(self.longest + 1) / PRIOR_FPS:.2g} s"


@dataclass(frozen=True, eq=False)
class RolloutInbetweener(Inbetweener):
    """In-betweener that rolls the density under which the fallback's proposal is likeliest through unknown gaps."""

    densities: Sequence[Density]
    """Densities to choose from, at least one."""
    fallback: Inbetweener
    """Proposes what is not rolled through, and what comes before and after."""
    settings: RolloutSettings = field(default_factory=RolloutSettings)
    """Settings of the rollouts."""

    @property
    def rough(self) -> Inbetweener:
        """Rough in-betweener of the fallback."""
        return self.fallback.rough

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose a different motion for each sample; gaps too short or too long are left to the fallback, and so are
        gaps in which every attempt jumps, and loose keys but for places that are all that is told, which are walked
        over."""
        if query.loose is not None:
            walked = PlaceWalker(tuple(self.densities)).propose(query, generator=generator)
            return walked or self.fallback.propose(query, generator=generator)
        base = self.fallback.propose(query, generator=generator)
        if not query.enclosed_gaps:
            return base
        roller, others = Roller.of(query, base, self.densities), list(base.others)
        generator, settings = generator or torch.Generator().manual_seed(0), self.settings
        largest = max(settings.least_jump, settings.jump * _measure_largest_step(roller.body))
        for start, stop in query.enclosed_gaps:
            if not settings.shortest <= stop - start <= settings.longest:
                others.append(GapSource(start, stop, base.source, f"rollouts take {settings.span}"))
            elif (rollout := roller.roll_steadily(start, stop, generator, settings, largest)) is None:
                others.append(GapSource(start, stop, base.source, EVERY_ROLLOUT_JUMPED))
            else:
                roller.accept_rollout(rollout)
                others.append(GapSource(start, stop, f"rollout of {roller.density.name}"))
        return replace(base, motion=roller.motion, contact_logits=roller.contact_logits, others=tuple(others))


@dataclass(frozen=True, eq=False)
class Rollout:
    """A density's motion through one gap."""

    start: int
    """First frame of the gap, at PRIOR_FPS."""
    body: Motion
    """The whole motion at unit size, the gap filled."""
    contact_logits: Float[Tensor, "frames 2"]
    """Contact logits of the left and the right toe."""


@dataclass(eq=False)
class Roller:
    """Roller of a density through gaps, one after the other in time, each from the accepted ones before it."""

    query: GapQuery
    """Query with the known values and the targets."""
    body: Motion
    """All frames so far, at unit size."""
    contact_logits: Float[Tensor, "frames 2"]
    """Contact logits so far."""
    density: Density
    """The density that is rolled."""
    state: DensityState | None = None
    """The density's state after `done` frames."""
    done: int = 0
    """Number of frames that the state includes."""

    @staticmethod
    def of(query: GapQuery, proposal: Proposal, densities: Sequence[Density]) -> "Roller":
        """Begin with a proposal, and the density under which it is likeliest."""
        body = query.to_unit_size(proposal.motion)
        return Roller(query, body, proposal.contact_logits.clone(), select_likeliest_density(densities, body))

    @property
    def motion(self) -> Motion:
        """The motion so far, on the character's bones."""
        return self.query.to_character(self.body)

    def roll_steadily(
        self, start: int, stop: int, generator: torch.Generator, settings: RolloutSettings, largest: float
    ) -> Rollout | None:
        """Roll until no hand or foot steps farther than `largest`, metres in a frame; None where all attempts do."""
        for _ in range(settings.attempts):
            rollout = self.roll(start, stop, generator, settings)
            if _measure_largest_step(rollout.body.slice(start - 1, stop + 1)) <= largest:
                return rollout
        return None

    def roll(self, start: int, stop: int, generator: torch.Generator, settings: RolloutSettings) -> Rollout:
        """Roll through frames start to stop; only the density's state is advanced."""
        committed = commit_before(self.body, self.contact_logits, start, self.density, self.state, since=self.done)
        assert not isinstance(committed.state, tuple)
        self.state, self.done = committed.state, start
        arrival = self._build_arrival_target(start, stop, settings)
        frames = len(arrival.places)
        noise = _sample_smooth_noise(frames, generator, settings)
        terms = (LatentPrior(settings.sigma_noise), settings.footing, arrival)
        solver = RecedingHorizonSolver(self.density, method=settings.method)
        window = solver.solve_window(replace(committed, warm_start=noise), terms, frames, generator=generator)
        body, logits = insert_rollout(self.body, self.contact_logits, window, committed.place, (start, stop))
        return Rollout(start, self._hold_planted(body, logits, start, stop), logits)

    def accept_rollout(self, rollout: Rollout) -> None:
        """Accept a rollout, from which later ones go on."""
        self.body, self.contact_logits = rollout.body, rollout.contact_logits

    def _hold_planted(self, body: Motion, logits: Float[Tensor, "frames 2"], start: int, stop: int) -> Motion:
        """Hold planted toes in the gap, which the correction at arrival has moved."""
        planted, free = contacts.debounced(logits > 0), torch.zeros(len(logits), dtype=torch.bool)
        free[start:stop] = True
        held = hold_planted(body, planted, free=free, rest_height=estimate_rest_height(body, planted))
        quats = torch.where(free[:, None, None], held.local_quat_xyzw, body.local_quat_xyzw)
        return replace(body, local_quat_xyzw=quats)

    def _build_arrival_target(self, start: int, stop: int, settings: RolloutSettings) -> Keyframe:
        """Build the target of all joints in the known frames after the gap, and of effectors within it."""
        part = slice(start, stop + settings.ahead)
        known = ~self.query.nothing_known[part]
        last = int(known.nonzero()[-1]) + 1
        positions, known = self.body.joint_positions()[part][:last], known[:last]
        wanted = known[:, None].expand(-1, CANONICAL.num_joints)
        if (targets := self.query.effector_targets) is not None:
            own_targets = targets.wanted[part][:last]
            positions = torch.where(own_targets[..., None], targets.places[part][:last] / self.query.scale, positions)
            wanted = wanted | own_targets
        return Keyframe(positions.float(), wanted, settings.sigma_arrival)


def _measure_largest_step(body: Motion) -> float:
    """Measure how far a hand or a toe steps at most from one frame to the next, relative to the hips, metres."""
    positions = body.joint_positions()
    return worst_frame.measure_peaks(positions[:, _ENDS], positions[:, 0], PRIOR_FPS).step


def _sample_smooth_noise(
    frames: int, generator: torch.Generator, settings: RolloutSettings
) -> Float[Tensor, "frames continuous"]:
    """Sample noise that changes slowly."""
    white = torch.randn(frames, LAYOUT.continuous, generator=generator)
    return settings.temperature * gaussian.unit_variance_matrix(frames, settings.slow, white.dtype) @ white
