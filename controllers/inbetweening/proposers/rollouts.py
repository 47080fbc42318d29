"""Rollouts of a density through the gaps of a motion, steered to arrive where it goes on: a different proposal for each
draw (Wang et al. 2019, Eq. 14-19, with what comes after a gap as the wish).

A swarm searches noise of the root that leads to the next known frames; L-BFGS over all noise then goes there. What is
still missed is spread over the gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.geometry.footholds import hold_planted
from controllers.inbetweening.proposers.rolling import commit_before, insert_rollout, select_likeliest_density
from mapctl import contacts
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.problem.receding_horizon import CommittedFrames, RecedingHorizonSolver
from mapctl.problem.warm_start import SteeringKnots, SwarmProposal
from mapctl.problem.window_solvers import LatentNoiseSolver, SolvedWindow
from mapctl.protocols import Density, DensityState, Inbetweener
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import FootContact, Keyframe, LatentPrior


@dataclass(frozen=True)
class RolloutSettings:
    """How gaps are rolled through."""

    temperature: float = 0.5
    """Standard deviation of the noise that a rollout starts from: what makes one differ from the next."""
    slow: float = 3.0
    """Frames (sigma) over which that noise is smoothed, at the same deviation: others do the same differently, they
    do not tremble differently."""
    sigma_noise: float = 2.0
    """Of the noise prior while steering: above 1 leaves more of what was drawn."""
    sigma_arrival: float = 0.03
    """Distance of every joint from the known frame at which a rollout arrives, metres."""
    ahead: int = 15
    """Frames after a gap that are rolled with it, so that it arrives as those known among them ask."""
    footing: FootContact = field(
        default_factory=lambda: FootContact(sigma_speed=0.1, sigma_height=0.05, sigma_below=0.05)
    )
    """Planted feet."""
    shortest: int = 2
    """Frames of the shortest gap that is rolled through: shorter ones leave nothing to vary."""
    trajectory: float | None = None
    """Distance of the hips from the proposal's trajectory, metres, as a sigma; None leaves them where they go."""
    stage: int = 0
    """Frames after which a longer rollout is solved first, then after twice as many, and so on, each from where the one
    before it ended: from nothing, what is far ahead hardly turns a body. 0 solves all at once."""
    tempo: float = 1.0
    """How much longer than the gap a rollout is before its time is brought to the gap's: below 1, it is slowed down.
    A step that would end too early or too late ends in time."""
    longest: int = 180
    """Frames that are rolled at a time; what is longer is left to the given proposal."""
    method: LatentNoiseSolver = field(
        default_factory=lambda: LatentNoiseSolver(
            rounds=2,
            lbfgs=LbfgsSettings(max_iterations=24),
            budget=Budget(evaluations=96),
            proposal=SwarmProposal(SwarmSettings(particles=8, iterations=5), SteeringKnots(knots=4, spread=0.7)),
        )
    )
    """The swarm and the search after it."""

    @property
    def span(self) -> str:
        """The gaps that are rolled through, in words: seconds from key to key."""
        return f"{(self.shortest + 1) / PRIOR_FPS:.2g} to {(self.longest + 1) / PRIOR_FPS:.2g} s"


@dataclass(frozen=True, eq=False)
class RolloutInbetweener(Inbetweener):
    """Rolls the density under which the fallback's proposal is likeliest through gaps of which nothing is known."""

    densities: Sequence[Density]
    """Densities to choose from, at least one."""
    fallback: Inbetweener
    """Proposes what is not rolled through, and what comes before and after."""
    settings: RolloutSettings = field(default_factory=RolloutSettings)
    """How gaps are rolled through."""

    @property
    def rough(self) -> Inbetweener:
        """The fallback's, before anything is rolled."""
        return self.fallback.rough

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose a different motion for each draw; gaps too short or too long are left to the fallback."""
        base = self.fallback.propose(query, generator=generator)
        roller, others = Roller.of(query, base, self.densities), list(base.others)
        draws, settings = generator or torch.Generator().manual_seed(0), self.settings
        for start, stop in query.enclosed_gaps:
            if settings.shortest <= stop - start <= settings.longest:
                roller.accept_rollout(roller.roll(start, stop, draws, settings))
                others.append(GapSource(start, stop, f"rollout of {roller.density.name}"))
            else:
                others.append(GapSource(start, stop, base.source, f"rollouts take {settings.span}"))
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
    missed: float
    """Mean distance of the joints from where they were to arrive, before that was spread over the gap, metres."""


@dataclass(eq=False)
class Roller:
    """Rolls a density through gaps, one after the other in time; what is put into one is what the next goes on from."""

    query: GapQuery
    """What is known and wanted."""
    body: Motion
    """All frames so far, at unit size."""
    contact_logits: Float[Tensor, "frames 2"]
    """Contact logits so far."""
    density: Density
    """The density that is rolled."""
    state: DensityState | None = None
    """The density's state after `done` frames."""
    done: int = 0
    """Frames that the state has seen."""

    @staticmethod
    def of(query: GapQuery, proposal: Proposal, densities: Sequence[Density]) -> "Roller":
        """Begin with a proposal, and the density under which it is likeliest."""
        body = query.to_unit_size(proposal.motion)
        return Roller(query, body, proposal.contact_logits.clone(), select_likeliest_density(densities, body))

    @property
    def motion(self) -> Motion:
        """The motion so far, on the character's bones."""
        return self.query.to_character(self.body)

    def roll(self, start: int, stop: int, generator: torch.Generator, settings: RolloutSettings) -> Rollout:
        """Roll through frames start to stop; changes nothing but what the density has seen before them."""
        committed = commit_before(self.body, self.contact_logits, start, self.density, self.state, since=self.done)
        assert not isinstance(committed.state, tuple)
        self.state, self.done = committed.state, start
        arrival = self._build_arrival_target(start, stop, settings)
        frames, targets = len(arrival.places), [arrival]
        if settings.trajectory is not None:
            targets.append(self._build_trajectory_target(start, stop, frames, settings))
        solver = RecedingHorizonSolver(self.density, method=settings.method)
        noise = _sample_smooth_noise(frames, generator, settings)
        window = _solve_in_stages(solver, committed, targets, noise, generator, settings)
        body, logits, missed = insert_rollout(
            self.body, self.contact_logits, window, committed.place, (start, stop), tempo=settings.tempo
        )
        return Rollout(start, self._hold_planted(body, logits, start, stop), logits, missed)

    def accept_rollout(self, rollout: Rollout) -> None:
        """Go on from this rollout."""
        self.body, self.contact_logits = rollout.body, rollout.contact_logits

    def _hold_planted(self, body: Motion, logits: Float[Tensor, "frames 2"], start: int, stop: int) -> Motion:
        """Hold toes where they stand in the gap: arriving where it must has moved them."""
        planted, free = contacts.debounced(logits > 0), torch.zeros(len(logits), dtype=torch.bool)
        free[start:stop] = True
        held = hold_planted(body, planted, free=free, rest_height=estimate_rest_height(body, planted))
        quats = torch.where(free[:, None, None], held.local_quat_xyzw, body.local_quat_xyzw)
        return replace(body, local_quat_xyzw=quats)

    def _build_trajectory_target(self, start: int, stop: int, frames: int, settings: RolloutSettings) -> Keyframe:
        """Build the target of the hips in the gap: where the proposal has them, in the rollout's own time."""
        count = stop - start
        own = max(1, round(count * settings.tempo))
        at = (torch.arange(own) + 1) * (count + 1) / (own + 1) - 1
        hips = self.body.root_position[start : start + count][at.round().long().clamp(0, count - 1)]
        goals = torch.zeros(frames, CANONICAL.num_joints, 3)
        asked = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
        goals[:own, 0], asked[:own, 0] = hips.float(), True
        return Keyframe(goals, asked, settings.trajectory or 1.0, name="trajectory")

    def _build_arrival_target(self, start: int, stop: int, settings: RolloutSettings) -> Keyframe:
        """Build the target of all joints in the known frames after the gap, and of effectors on the way, in the
        rollout's own time.
        """
        count = stop - start
        own = max(1, round(count * settings.tempo))
        part = slice(start, stop + settings.ahead)
        known = ~self.query.nothing_known[part]
        last = int(known.nonzero()[-1]) + 1
        places, known = self.body.joint_positions()[part][:last], known[:last]
        wanted = known[:, None].expand(-1, CANONICAL.num_joints)
        if (targets := self.query.effector_targets) is not None:
            own_targets = targets.wanted[part][:last]
            places = torch.where(own_targets[..., None], targets.places[part][:last] / self.query.scale, places)
            wanted = wanted | own_targets
        if own == count:
            return Keyframe(places.float(), wanted, settings.sigma_arrival)
        frames, joints = own + last - count, CANONICAL.num_joints
        goals, asked = torch.zeros(frames, joints, 3), torch.zeros(frames, joints, dtype=torch.bool)
        goals[own:], asked[own:] = places[count:].float(), wanted[count:]
        for frame in wanted[:count].any(dim=1).nonzero()[:, 0].tolist():
            at = min(own - 1, round((frame + 1) * (own + 1) / (count + 1)) - 1)
            goals[at], asked[at] = places[frame].float(), wanted[frame]
        return Keyframe(goals, asked, settings.sigma_arrival)


def _solve_in_stages(
    solver: RecedingHorizonSolver,
    committed: CommittedFrames,
    targets: Sequence[Keyframe],
    noise: Tensor,
    generator: torch.Generator,
    settings: RolloutSettings,
) -> SolvedWindow:
    """Solve a rollout of as many frames as `noise` has towards the targets, the first frames alone first."""

    def solve(frames: int) -> SolvedWindow:
        part = slice(0, frames)
        near = [replace(target, places=target.places[part], wanted=target.wanted[part]) for target in targets]
        terms = (LatentPrior(settings.sigma_noise), settings.footing, *near)
        return solver.solve_window(replace(committed, warm_start=noise[part]), terms, frames, generator=generator)

    for frames in range(settings.stage, len(noise), settings.stage) if settings.stage else ():
        noise = torch.cat([solve(frames).warm_start, noise[frames:]])
    return solve(len(noise))


def _sample_smooth_noise(
    frames: int, generator: torch.Generator, settings: RolloutSettings
) -> Float[Tensor, "frames continuous"]:
    """Sample noise that changes slowly."""
    white = torch.randn(frames, LAYOUT.continuous, generator=generator)
    return settings.temperature * gaussian.unit_variance_matrix(frames, settings.slow, white.dtype) @ white
