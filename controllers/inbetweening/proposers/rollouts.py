"""Rollouts of a density through the gaps of a motion, steered to its next known frames: a different proposal for each
sample (Wang et al. 2019, Eq. 14-19, with the frames after a gap as the target).

A swarm searches latent noise of the root that leads to the next known frames, then L-BFGS all latent noise. The error
that is left at arrival is distributed over the gap.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.proposers.slerp import walk_over_places
from mapctl import contacts, rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.inbetweening.whole_body import bend_limbs
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import fill_missing, true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.problem.receding_horizon import CommittedFrames, RecedingHorizonSolver, replay
from mapctl.problem.window_solvers import LatentNoiseSolver, SolvedWindow, SteeringKnots, SwarmProposal, keep_warm_start
from mapctl.protocols import Density, DensityState, Inbetweener
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import FootContact, Keyframe, LatentPrior

_TOES = list(TOE_JOINTS)
_STANCE_FADE_SECONDS = 0.12  # over which a swinging foot's correction fades away from its contacts


def hold_planted(
    motion: Motion,
    planted: Bool[Tensor, "frames 2"],
    *,
    free: Bool[Tensor, " frames"],
    rest_height: Float[Tensor, "frames 2"],
) -> Motion:
    """Hold the toes (left, right) of a canonical motion at one position during each contact, in frames that are free.

    A contact that begins or ends in frames that are not free keeps its position there; others are held at the mean of
    their positions, at `rest_height` (metres). Between contacts the correction fades. Hips and the feet's orientations
    stay.
    """
    positions, goals = motion.joint_positions(), motion.joint_positions().clone()
    for foot, toe in enumerate(_TOES):
        offset = torch.zeros_like(positions[:, toe])
        for _, start, stop in true_intervals(planted[:, foot, None]):
            part = slice(start, stop)
            offset[part] = _compute_stance_offset(positions[part, toe], ~free[part], rest_height[part, foot])
        firm = ~free | planted[:, foot]
        goals[:, CANONICAL.parents[toe]] += interpolate_offsets(
            offset, firm, seconds=_STANCE_FADE_SECONDS, fps=float(motion.fps)
        )
    turning = free[:, None].expand(-1, CANONICAL.num_joints)
    return bend_limbs(motion, motion, goals, torch.zeros_like(turning), turning)


def _compute_stance_offset(
    positions: Float[Tensor, "contact 3"], anchored: Bool[Tensor, " contact"], rest_height: Float[Tensor, " contact"]
) -> Float[Tensor, "contact 3"]:
    """Compute the offsets from a contact's positions to the anchored ones, interpolated linearly, or to their mean."""
    if bool(anchored.any()):
        return fill_missing(positions[None], anchored[None])[0] - positions
    middle = positions.mean(dim=0)
    middle[1] = rest_height.mean()
    return middle - positions


_PAST_FRAMES = 3  # frames before a gap that terms look back on


def select_likeliest_density(densities: Sequence[Density], motion: Motion) -> Density:
    """Select the density under which a canonical motion, with a proposal's observation noise, is likeliest."""
    if len(densities) == 1:
        return densities[0]
    blurred = [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    return densities[blurred.index(density_selection.select_density_for_motion(blurred, motion).density)]


def commit_before(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    start: int,
    density: Density,
    state: DensityState | None = None,
    *,
    since: int = 0,
) -> CommittedFrames:
    """Commit a motion's frames before a gap, with their contacts, single precision; a density's `state` is advanced
    from frame `since` on.
    """
    features, before = encode(body.slice(0, max(2, start)))
    ground, heading = integrate_root(features, before)
    features[:, LAYOUT.slices["contacts"]] = (contact_logits[: len(features)] > 0).to(features)
    features = features[:start].float()
    ground_pose = GroundPose(ground[start - 1].float(), heading[start - 1].float())
    past = body.slice(max(0, start - _PAST_FRAMES), start).joint_positions().float()
    advanced = state if state is not None and since >= start else replay(density, features, state, since=since)
    return CommittedFrames(advanced, ground_pose, features, past)


def insert_rollout(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    window: SolvedWindow,
    ground_pose: GroundPose,
    gap: tuple[int, int],
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """Insert a rollout in its gap, corrected so that it arrives at the frame after it, if there is one; also return the
    contact logits.
    """
    start, stop = gap
    made = decode(window.trial.features[0], GroundPose(ground_pose.position_xz.double(), ground_pose.heading.double()))
    count, planted = stop - start, window.trial.contacts[0]
    root, quats, logits = body.root_position.clone(), body.local_quat_xyzw.clone(), contact_logits.clone()
    root[start:stop], quats[start:stop] = made.root_position[:count], made.local_quat_xyzw[:count]
    if count < len(made.root_position):
        there, here = body.slice(stop, stop + 1), made.slice(count, count + 1)
        root[start:stop], quats[start:stop] = _arrive(here, there, root[start:stop], quats[start:stop])
    new = torch.zeros(len(root), dtype=torch.bool)
    new[start:stop] = True
    root = blend_seams_in_positions(root, new, fps=PRIOR_FPS)
    quats = blend_seams_in_rotations(quats, new[:, None].expand(-1, CANONICAL.num_joints), fps=PRIOR_FPS)
    logits[start:stop] = contacts.to_logits(planted[:count]).to(logits)
    return replace(body, root_position=root, local_quat_xyzw=quats), logits


def _arrive(
    here: Motion, there: Motion, root: Float[Tensor, "frames 3"], quats: Float[Tensor, "frames joints 4"]
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 4"]]:
    """Spread what a rollout arrives `here` instead of `there` over all its frames: none of it in the two frames before,
    all of it in two after, so that it leaves and arrives at its own pace."""
    turn = rotations.to_rotation_vector(
        rotations.multiply(rotations.inverse(here.local_quat_xyzw), there.local_quat_xyzw)
    )
    firm = torch.ones(len(root) + 4, dtype=torch.bool)
    firm[2:-2] = False
    miss = root.new_zeros(len(firm), 3 + 3 * quats.shape[1])
    miss[-2:] = torch.cat([there.root_position - here.root_position, turn.flatten(1)], dim=1)
    offsets = interpolate_offsets(miss, firm, seconds=math.inf, fps=PRIOR_FPS)[2:-2]
    turns = rotations.from_rotation_vector(offsets[:, 3:].unflatten(1, (-1, 3)))
    return root + offsets[:, :3], rotations.multiply(quats, turns)


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
        gaps in which every attempt jumps, and loose keys but for those that give positions alone, which are walked
        over."""
        if query.loose is not None:
            walked = walk_over_places(query, self.densities, generator)
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


_MIN_KNOWN_FRAMES = 5  # fewest frames from which a motion is extrapolated


def extrapolate_end(
    query: GapQuery, proposal: Proposal, densities: Sequence[Density], settings: RolloutSettings
) -> Proposal:
    """Extrapolate a proposal from the last known frame to its end, if nothing is known there.

    It stays unchanged where the first density (that of locomotion) does not find the frames before as likely as its own
    data: densities then stop or turn away. None runs backwards, so a beginning stays as well.
    """
    missing, stop = query.nothing_known, query.motion.num_frames
    start = stop - int(missing.flip(0).long().cumprod(0).sum())
    # Only frames since the gap before count, not what fills that.
    since = int(missing[:start].nonzero()[-1]) + 1 if bool(missing[:start].any()) else 0
    if start == stop or start - since < _MIN_KNOWN_FRAMES or not densities:
        return proposal
    body, logits = query.to_unit_size(proposal.motion), proposal.contact_logits
    known = body.slice(since, start)
    blurred = densities[0].with_observation_noise(density_selection.proposal_sigma())
    if density_selection.select_density_for_motion([blurred], known).weight < 1:
        return proposal
    density = select_likeliest_density(densities, known)
    solver = RecedingHorizonSolver(density, method=replace(settings.method, proposal=keep_warm_start))
    for first in range(start, stop, settings.longest):
        committed, count = commit_before(body, logits, first, density), min(settings.longest, stop - first)
        terms = (LatentPrior(settings.sigma_noise), settings.footing)
        window = solver.solve_window(committed, terms, count, generator=torch.Generator())
        body, logits = insert_rollout(body, logits, window, committed.place, (first, first + count))
    source = GapSource(start, stop, f"density {density.name}")
    return replace(proposal, motion=query.to_character(body), contact_logits=logits, others=(*proposal.others, source))
