"""The MAP stage of denoising: as near to the proposal as its doubts ask for, on feet that stand (rnn paper, Eq. 18-19).

Windows of poses about the proposal (see mapctl.problem.pose_offsets), solved one after the other by L-BFGS; each looks
ahead into the next, and the next goes on from where its committed frames end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import debounced
from mapctl.features import LAYOUT, GroundPose
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.pose import BodyPose, decode
from mapctl.problem import density_selection
from mapctl.problem.density_selection import DensityEnsemble, DensityInterval
from mapctl.problem.ledger import Ledger
from mapctl.problem.pose_offsets import PoseOffsetSolver
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver, TermsOf
from mapctl.problem.solution import Outcome, WindowRecord
from mapctl.protocols import Density
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk, Keyframe, LatentPrior, Term

_DRIFT_SIGMA_FRAMES = 3.0  # frames, sigma, over which the travel of planted toes is averaged


@dataclass(frozen=True)
class RefinementSettings:
    """Sigmas and search."""

    footing: FootContact = field(
        default_factory=lambda: FootContact(sigma_speed=0.1, sigma_height=0.03, sigma_below=0.02)
    )
    """Planted feet; the rest height is the performer's own. Loose, since mocap's own planted toes move by 6 cm/s, and
    not every floor is level."""
    jerk: Jerk | None = None
    """Jerk, if it is to cost something: of as many frames of each window as the term says."""
    clearance: Clearance | None = None
    """Toes that swing, if they are to clear the ground where nothing shows whether they do."""
    clearance_ramp: float = 8.0
    """Frames next to ones in which a toe's place was seen over which that is asked for more and more."""
    share: float = 0.35
    """Doubt about a proposal that was seen, as a share of the capture's noise."""
    unobserved_sigma_deg: float = 5.0
    """Doubt about the angles of joints that were not."""
    unobserved_sigma_cm: float = 5.0
    """Doubt about the place of hips that were not."""
    uncertainty_ramp: float = 0.0
    """Frames next to seen ones over which the doubt about unseen ones rises from nothing; 0 for at once."""
    smooth: float = 2.0
    """Frames (sigma) over which a correction reaches."""
    temperature: float = 8.0
    """Of a density's likelihood, if there is one; above 1 it is trusted less, since the proposal knows the data too."""
    frames: int = 96
    """Of a window."""
    ahead: int = 24
    """Of them that the next window solves again."""
    past: int = 40
    """Committed frames that terms may look back on."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=20))
    """Of one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=20))
    """Of one window."""


@dataclass(frozen=True, eq=False)
class RefinedMotion:
    """What the stage makes of a proposal."""

    motion: Motion
    """At the prior's rate."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted."""
    ledger: Ledger
    """By term and frame."""
    windows: tuple[WindowRecord, ...]
    """Cost of each window."""

    @property
    def density_intervals(self) -> tuple[DensityInterval, ...]:
        """Which density counted in each window, in frames at PRIOR_FPS; none where none was given."""
        stops = list(accumulate(window.frames for window in self.windows))
        return tuple(
            DensityInterval(stop - window.frames, stop, choice.density.name, choice.nats, choice.weight)
            for stop, window in zip(stops, self.windows, strict=True)
            if (choice := window.choice) is not None
        )


def refine(
    proposal: Motion,
    contacts: Float[Tensor, "frames 2"],
    capture: Capture,
    settings: RefinementSettings,
    *,
    densities: Sequence[Density] = (),
    targets: EffectorTargets | None = None,
    terms: Sequence[Term] = (),
    first_frame: int = 0,
) -> RefinedMotion:
    """Solve every window; `contacts` are logits, `capture` tells what was observed and how noisy it was. `targets` are
    positions wanted of joints, `terms` join the others in every window and see the first frame of the proposal as
    `first_frame` of the whole motion.

    In each window that density counts under which the proposal is likeliest, and less where it is out of its depth.
    """
    stands = debounced(contacts > 0)
    pose = BodyPose.of_motion(proposal)
    start = _extrapolate_backward(pose)
    sigma = _compute_proposal_sigma(capture, settings)
    ensemble = DensityEnsemble([one.with_observation_noise(density_selection.proposal_sigma()) for one in densities])
    solver = RecedingHorizonSolver(
        ensemble,
        HorizonSettings(settings.frames, settings.ahead, settings.past, beyond_end=False),
        proposal.skeleton,
        method=PoseOffsetSolver(
            pose, stands, sigma, settings.smooth, settings.temperature, settings.lbfgs, settings.budget, first_frame
        ),
    )
    # The densities' states are those that make the first window's proposal likely.
    first = slice(0, min(settings.frames, proposal.num_frames))
    states = ensemble.infer_state(pose.slice(0, first.stop).features(start, stands[first]))
    before = torch.zeros(0, proposal.num_joints, 3)
    done = CommittedFrames(states, start, torch.zeros(0, LAYOUT.size), before, discarded=first_frame)
    terms_of = _lay_terms(settings, estimate_rest_height(proposal, stands), capture, targets, terms)
    done, outcome = solver.solve(done, terms_of, proposal.num_frames, generator=torch.Generator())
    if outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    motion = decode(done.features, start, skeleton=proposal.skeleton)
    return RefinedMotion(motion, stands, done.ledger, done.windows)


def _lay_terms(
    settings: RefinementSettings,
    rest_height: float,
    capture: Capture,
    targets: EffectorTargets | None,
    more: Sequence[Term],
) -> TermsOf:
    """Lay the terms of each window."""
    footing = replace(settings.footing, rest_height=rest_height)
    clearing = _ramp_from_observed(_find_observed_toes(capture), settings.clearance_ramp)

    def terms_of(first: int, frames: int) -> list[Term]:
        part = slice(first, first + frames)
        terms: list[Term] = [LatentPrior(1.0), footing, *more]
        if settings.clearance is not None:
            terms.append(replace(settings.clearance, rest_height=rest_height, share=clearing[part]))
        if settings.jerk is not None:
            terms.append(settings.jerk)
        if targets is not None:
            terms.append(Keyframe(targets.places[part], targets.wanted[part]))
        return terms

    return terms_of


def _extrapolate_backward(pose: BodyPose) -> GroundPose:
    """The ground pose from which the first frame's step and turn are the second's: nobody begins by standing still."""
    ground, heading = pose.root_position[:, ::2], pose.heading
    here = GroundPose(ground[0], heading[0])
    if len(heading) == 1:
        return here
    return here.before(rotations.rotate_ground(ground[1] - ground[0], -heading[0]), heading[1] - heading[0])


def anchor_to_contacts(motion: Motion, contacts: Bool[Tensor, "frames 2"]) -> Motion:
    """The motion carried over the ground so that its planted toes, on average over a few frames, do not travel.

    For captures whose body drifts against its feet. Feet that roll or turn while they stand are taken to do so.
    """
    toes = motion.skeleton.indices(TOES)
    ground = motion.joint_positions()[:, toes][..., ::2]
    step = torch.diff(ground, dim=0, prepend=ground[:1])
    planted = (contacts & torch.cat([contacts[:1], contacts[:-1]])).to(step)
    weight = gaussian.pairwise_weights(len(step), _DRIFT_SIGMA_FRAMES, step.dtype)
    drift = torch.einsum("ts,sfc,sf->tc", weight, step, planted)
    # Nothing is known far from any contact: the drift fades out there.
    drift = drift / (torch.einsum("ts,sf->t", weight, planted) + 0.5)[:, None]
    way = torch.cumsum(drift, dim=0)
    moved = torch.stack([way[:, 0], torch.zeros_like(way[:, 0]), way[:, 1]], dim=-1)
    return replace(motion, root_position=motion.root_position - moved)


def estimate_rest_height(motion: Motion, contacts: Bool[Tensor, "frames 2"]) -> float:
    """Of the performer's planted toes, metres; where none is planted, of low ones."""
    toes = motion.skeleton.indices(TOES)
    heights = motion.joint_positions()[:, toes, 1]
    planted = heights[contacts]
    return float(planted.median() if len(planted) else heights.quantile(0.05))


def _compute_proposal_sigma(capture: Capture, settings: RefinementSettings) -> Float[Tensor, "frames width"]:
    """Sigma of root, heading and angles by frame (see `BodyPose.pack`)."""
    unseen = math.radians(settings.unobserved_sigma_deg) * _ramp_from_observed(
        capture.seen[0], settings.uncertainty_ramp
    )
    angle = torch.where(capture.seen[0], settings.share * capture.sigma[0], unseen).clamp_min(1e-4)
    away = (
        settings.unobserved_sigma_cm
        / 100
        * _ramp_from_observed(capture.seen_root[0][:, None], settings.uncertainty_ramp)[:, 0]
    )
    root = torch.where(capture.seen_root[0], settings.share * capture.sigma_root[0], away)
    hips = angle[:, :1]
    # Feet are put down even in a capture without noise, if only by half a millimetre.
    root = root.clamp_min(5e-4)[:, None]
    return torch.cat([root.expand(-1, 3), hips.expand(-1, 3), angle[:, 1:].repeat_interleave(3, dim=-1)], dim=-1)


def _find_observed_toes(capture: Capture) -> Bool[Tensor, "frames 2"]:
    """Whether the places of the toes were: the hips', and the rotations of all joints that carry them."""
    seen = capture.seen_root[0][:, None].repeat(1, len(TOES))
    for foot, name in enumerate(TOES):
        joint = CANONICAL.parents[CANONICAL.index(name)]
        while joint >= 0:
            seen[:, foot] &= capture.seen[0, :, joint]
            joint = CANONICAL.parents[joint]
    return seen


def _ramp_from_observed(seen: Bool[Tensor, "frames columns"], ease: float) -> Float[Tensor, "frames columns"]:
    """0 where something is seen, rising smoothly to 1 so many frames away from there; 1 throughout for no frames."""
    if ease <= 0 or bool(seen.all()):
        return torch.ones(seen.shape)
    frame = torch.arange(len(seen))[None]
    away = torch.minimum((frame - last_observed(seen.T)).abs(), (frame - next_observed(seen.T)).abs()).T
    share = torch.sin(0.5 * math.pi * (away / ease).clamp(max=1)).square()
    return torch.where(seen.any(dim=0), share, 1.0)
