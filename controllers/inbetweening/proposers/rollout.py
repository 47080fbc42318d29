"""Rollouts of a density through the gaps of a motion, steered to arrive where it goes on: another proposal than an
infiller's, and a different one for each draw (rnn paper, Eq. 14-19, with what comes after a gap as the wish).

A swarm looks for noise of the root that leads to the next known frames; L-BFGS over all noise then goes there. What is
still missed is spread over the gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.geometry.footholds import hold_planted
from controllers.inbetweening.geometry.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from controllers.inbetweening.proposers.answers import GapSource, Proposal
from mapctl import contacts, rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.problem.receding_horizon import CommittedFrames, RecedingHorizonSolver, replay
from mapctl.problem.warm_start import SteeringKnots, SwarmProposal, keep_warm_start
from mapctl.problem.window_solvers import LatentNoiseSolver, SolvedWindow
from mapctl.protocols import Density, DensityState
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import FootContact, Keyframe, LatentPrior

_ROLLOUT_CONTACT_LOGIT = 4.0  # log odds of a rollout's contacts
_MIN_KNOWN_FRAMES = 5  # frames that tell how somebody goes on
_PAST_FRAMES = 3  # frames before a gap that terms look back on


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


def roll_through_gaps(
    gap: CanonicalGap,
    proposal: Motion,
    odds: Float[Tensor, "frames 2"],
    targets: EffectorTargets | None = None,
    *,
    densities: Sequence[Density],
    generator: torch.Generator,
    settings: RolloutSettings | None = None,
) -> Proposal:
    """The proposal with rollouts in those of its gaps in which nothing is known and that have known frames on both
    sides; the log odds of its contacts; and which gaps these are.

    Of the densities the one is rolled under which the proposal is likeliest. `targets` are places wanted on the way.
    """
    settings = settings or RolloutSettings()
    roller, sources = Roller.of(gap, proposal, odds, densities, targets), []
    for start, stop in find_whole_gaps(gap):
        if settings.shortest <= stop - start <= settings.longest:
            roller.accept_rollout(roller.roll(start, stop, generator, settings))
            sources.append(GapSource(start, stop, f"rollout of {roller.density.name}"))
    return Proposal(roller.motion, roller.odds, tuple(sources))


def find_whole_gaps(gap: CanonicalGap) -> list[tuple[int, int]]:
    """First frames and one past the last of gaps in which nothing is known, with known frames on both sides."""
    lost = gap.turns.all(dim=1) & gap.root
    return [(start, stop) for _, start, stop in true_intervals(lost[:, None]) if start > 0 and stop < len(lost)]


@dataclass(frozen=True, eq=False)
class Rollout:
    """What a density makes of one gap."""

    start: int
    """First frame of the gap, at the prior's rate."""
    body: Motion
    """The whole motion on canonical bones, the gap filled."""
    odds: Float[Tensor, "frames 2"]
    """Log odds of its contacts."""
    missed: float
    """Mean distance of the joints from where they were to arrive, before that was spread over the gap, metres."""


@dataclass(eq=False)
class Roller:
    """Rolls a density through gaps, one after the other in time; what is put into one is what the next goes on from."""

    gap: CanonicalGap
    """What is known."""
    skeleton: Skeleton
    """Bones of the performer."""
    body: Motion
    """All frames so far, on canonical bones."""
    odds: Float[Tensor, "frames 2"]
    """Log odds of contacts."""
    density: Density
    """That is rolled."""
    targets: EffectorTargets | None
    """Places wanted on the way."""
    state: DensityState | None = None
    """Of the density, after `done` frames."""
    done: int = 0
    """Frames that the state has seen."""

    @staticmethod
    def of(
        gap: CanonicalGap, proposal: Motion, odds: Tensor, densities: Sequence[Density], targets: EffectorTargets | None
    ) -> "Roller":
        """By the density under which the proposal is likeliest."""
        body = Motion(CANONICAL, proposal.fps, proposal.root_position / gap.scale, proposal.local_quat_xyzw)
        return Roller(gap, proposal.skeleton, body, odds.clone(), select_likeliest_density(densities, body), targets)

    @property
    def motion(self) -> Motion:
        """So far, on the performer's bones."""
        return self.scale_to_character(self.body)

    def scale_to_character(self, body: Motion) -> Motion:
        """On the performer's bones."""
        return replace(body, skeleton=self.skeleton, root_position=body.root_position * self.gap.scale)

    def roll(self, start: int, stop: int, generator: torch.Generator, settings: RolloutSettings) -> Rollout:
        """A rollout through frames start to stop; changes nothing but what was seen before them."""
        features, place = _encode_before_gap(self.body, self.odds, start)
        state = self.state
        if state is None or self.done < start:
            state = replay(self.density, features, state, since=self.done)
        self.state, self.done = state, start
        committed = CommittedFrames(state, place, features, _compute_past_joints(self.body, start))
        arrival = self._build_arrival_target(start, stop, settings)
        frames, targets = len(arrival.places), [arrival]
        if settings.trajectory is not None:
            targets.append(self._build_trajectory_target(start, stop, frames, settings))
        solver = RecedingHorizonSolver(self.density, method=settings.method)
        noise = _sample_smooth_noise(frames, generator, settings)
        window = _solve_in_stages(solver, committed, targets, noise, generator, settings)
        body, odds, missed = _insert_rollout(self.body, self.odds, window, place, start, stop, settings.tempo)
        return Rollout(start, self._planted(body, odds, start, stop), odds, missed)

    def accept_rollout(self, rollout: Rollout) -> None:
        """Go on from this one."""
        self.body, self.odds = rollout.body, rollout.odds

    def _planted(self, body: Motion, odds: Tensor, start: int, stop: int) -> Motion:
        """With toes that stay where they stand in the gap: arriving where it must has moved them."""
        stands, free = contacts.debounced(odds > 0), torch.zeros(len(odds), dtype=torch.bool)
        free[start:stop] = True
        held = hold_planted(body, stands, free=free, rest_height=estimate_rest_height(body, stands))
        quats = torch.where(free[:, None, None], held.local_quat_xyzw, body.local_quat_xyzw)
        return replace(body, local_quat_xyzw=quats)

    def _build_trajectory_target(self, start: int, stop: int, frames: int, settings: RolloutSettings) -> Keyframe:
        """Where the proposal has the hips in the gap, in the rollout's own time."""
        count = stop - start
        own = max(1, round(count * settings.tempo))
        at = (torch.arange(own) + 1) * (count + 1) / (own + 1) - 1
        hips = self.body.root_position[start : start + count][at.round().long().clamp(0, count - 1)]
        goals = torch.zeros(frames, CANONICAL.num_joints, 3)
        asked = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
        goals[:own, 0], asked[:own, 0] = hips.float(), True
        return Keyframe(goals, asked, settings.trajectory or 1.0, name="trajectory")

    def _build_arrival_target(self, start: int, stop: int, settings: RolloutSettings) -> Keyframe:
        """Where a rollout is to be in the known frames after its gap, and at places wanted on the way, in its own
        time.
        """
        count = stop - start
        own = max(1, round(count * settings.tempo))
        part = slice(start, stop + settings.ahead)
        known = ~(self.gap.turns.all(dim=1) & self.gap.root)[part]
        last = int(known.nonzero()[-1]) + 1
        places, known = self.body.joint_positions()[part][:last], known[:last]
        wanted = known[:, None].expand(-1, CANONICAL.num_joints)
        if self.targets is not None:
            told = self.targets.wanted[part][:last]
            places = torch.where(told[..., None], self.targets.places[part][:last] / self.gap.scale, places)
            wanted = wanted | told
        if own == count:
            return Keyframe(places.float(), wanted, settings.sigma_arrival)
        frames, joints = own + last - count, CANONICAL.num_joints
        goals, asked = torch.zeros(frames, joints, 3), torch.zeros(frames, joints, dtype=torch.bool)
        goals[own:], asked[own:] = places[count:].float(), wanted[count:]
        for frame in wanted[:count].any(dim=1).nonzero()[:, 0].tolist():
            at = min(own - 1, round((frame + 1) * (own + 1) / (count + 1)) - 1)
            goals[at], asked[at] = places[frame].float(), wanted[frame]
        return Keyframe(goals, asked, settings.sigma_arrival)


def extrapolate_end(
    gap: CanonicalGap,
    proposal: Motion,
    odds: Float[Tensor, "frames 2"],
    *,
    densities: Sequence[Density],
    settings: RolloutSettings | None = None,
) -> Proposal:
    """The proposal with the likeliest rollout from where it is last known to its end, if nothing is known there; the
    log odds of its contacts; and by which density, if it does not stay as it is.

    It does where the first density (that of locomotion) does not find what comes before as likely as its own data:
    densities then stop or turn away. None runs backwards, so a beginning stays as well.
    """
    settings, lost = settings or RolloutSettings(), gap.turns.all(dim=1) & gap.root
    start, stop = len(lost) - int(lost.flip(0).long().cumprod(0).sum()), len(lost)
    # What stood before other gaps tells, and not what fills them.
    since = int(lost[:start].nonzero()[-1]) + 1 if bool(lost[:start].any()) else 0
    if start == stop or start - since < _MIN_KNOWN_FRAMES or not densities:
        return Proposal(proposal, odds)
    body = Motion(CANONICAL, proposal.fps, proposal.root_position / gap.scale, proposal.local_quat_xyzw)
    known = body.slice(since, start)
    judge = densities[0].with_observation_noise(density_selection.proposal_sigma())
    if density_selection.select_density_for_motion([judge], known).weight < 1:
        return Proposal(proposal, odds)
    density, first = select_likeliest_density(densities, known), start
    solver = RecedingHorizonSolver(density, method=replace(settings.method, proposal=keep_warm_start))
    while start < stop:
        features, place = _encode_before_gap(body, odds, start)
        committed = CommittedFrames(replay(density, features), place, features, _compute_past_joints(body, start))
        terms, count = (LatentPrior(settings.sigma_noise), settings.footing), min(settings.longest, stop - start)
        window = solver.solve_window(committed, terms, count, generator=torch.Generator())
        body, odds, _ = _insert_rollout(body, odds, window, place, start, start + count)
        start += count
    body = replace(body, skeleton=proposal.skeleton, root_position=body.root_position * gap.scale)
    return Proposal(body, odds, (GapSource(first, stop, f"density {density.name}"),))


def select_likeliest_density(densities: Sequence[Density], motion: Motion) -> Density:
    """The density under which a canonical motion, seen with a proposal's errors, is likeliest."""
    if len(densities) == 1:
        return densities[0]
    blurred = [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    return densities[blurred.index(density_selection.select_density_for_motion(blurred, motion).density)]


def _encode_before_gap(body: Motion, odds: Tensor, start: int) -> tuple[Float[Tensor, "frames size"], GroundPose]:
    """What there is before a gap, with the proposal's own contacts, single precision; and where it ends."""
    features, before = encode(body.slice(0, max(2, start)))
    ground, heading = integrate_root(features, before)
    features[:, LAYOUT.slices["contacts"]] = (odds[: len(features)] > 0).to(features)
    return features[:start].float(), GroundPose(ground[start - 1].float(), heading[start - 1].float())


def _compute_past_joints(body: Motion, start: int) -> Float[Tensor, "past joints 3"]:
    first = max(0, start - _PAST_FRAMES)
    return body.slice(first, start).joint_positions().float()


def _solve_in_stages(
    solver: RecedingHorizonSolver,
    committed: CommittedFrames,
    targets: Sequence[Keyframe],
    noise: Tensor,
    generator: torch.Generator,
    settings: RolloutSettings,
) -> SolvedWindow:
    """The rollout of as many frames as `noise` has that comes nearest to the targets, the first frames alone first."""

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
    """Noise that changes slowly."""
    white = torch.randn(frames, LAYOUT.continuous, generator=generator)
    return settings.temperature * gaussian.unit_variance_matrix(frames, settings.slow, white.dtype) @ white


def _insert_rollout(
    body: Motion, odds: Tensor, window: SolvedWindow, place: GroundPose, start: int, stop: int, tempo: float = 1.0
) -> tuple[Motion, Float[Tensor, "frames 2"], float]:
    """The rollout in its gap, moved so that it arrives at the frame after it, if there is one; its contacts; and by how
    much it had missed that frame, mean distance of the joints, metres.
    """
    made = decode(window.trial.features[0], GroundPose(place.position_xz.double(), place.heading.double()))
    stands, count, missed = window.trial.contacts[0], stop - start, 0.0
    made, stands = _warp_time(made, stands, max(1, round(count * tempo)), count)
    share = torch.sin(0.5 * torch.pi * torch.arange(1, count + 1) / (count + 1)).square()[:, None].double()
    root, quats, odds = body.root_position.clone(), body.local_quat_xyzw.clone(), odds.clone()
    root[start:stop], quats[start:stop] = made.root_position[:count], made.local_quat_xyzw[:count]
    if count < len(made.root_position):
        there, here = body.slice(stop, stop + 1), made.slice(count, count + 1)
        missed = float((there.joint_positions() - here.joint_positions()).norm(dim=-1).mean())
        root[start:stop] += share * (root[stop] - made.root_position[count])
        turn = rotations.multiply(rotations.inverse(made.local_quat_xyzw[count]), quats[stop])
        turned = rotations.from_rotation_vector(share[..., None] * rotations.to_rotation_vector(turn))
        quats[start:stop] = rotations.multiply(quats[start:stop], turned)
    put = torch.zeros(len(root), dtype=torch.bool)
    put[start:stop] = True
    root = blend_seams_in_positions(root, put, fps=PRIOR_FPS)
    quats = blend_seams_in_rotations(quats, put[:, None].expand(-1, CANONICAL.num_joints), fps=PRIOR_FPS)
    odds[start:stop] = _ROLLOUT_CONTACT_LOGIT * (2 * stands[:count].to(odds) - 1)
    return replace(body, root_position=root, local_quat_xyzw=quats), odds, missed


def _warp_time(
    made: Motion, stands: Bool[Tensor, "rolled 2"], own: int, count: int
) -> tuple[Motion, Bool[Tensor, "frames 2"]]:
    """What took `own` frames, from the frame before to the one after them, in `count`; nothing more after that."""
    if own == count:
        return made, stands
    last = min(len(made.root_position) - 1, own)
    at = (torch.arange(count + 1, dtype=torch.float64) + 1) * (own + 1) / (count + 1) - 1
    at = at.clamp(0, last)
    low, high = at.floor().long(), at.ceil().long()
    share = (at - low)[:, None]
    quats = rotations.slerp(made.local_quat_xyzw[low], made.local_quat_xyzw[high], share.expand(-1, made.num_joints))
    root = torch.lerp(made.root_position[low], made.root_position[high], share)
    return replace(made, root_position=root, local_quat_xyzw=quats), stands[at.round().long()]
