"""The MAP stage of denoising: as near to the proposal as its doubts ask for, on feet that stand (rnn paper, Eq. 18-19).

Windows of poses about the proposal (see mapctl.problem.pose_offsets), solved one after the other by L-BFGS; each looks
ahead into the next, and the next goes on from where its committed frames end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import debounced
from mapctl.features import GroundPose, decode, integrate_root
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.problem import density_selection
from mapctl.problem.density_selection import DensityChoice, DensityInterval
from mapctl.problem.ledger import Ledger
from mapctl.problem.objective import Objective
from mapctl.problem.pose_offsets import Guide, PoseOffsets
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings, minimise
from mapctl.terms import Clearance, FootContact, Jerk, Keyframe, LatentPrior, Likelihood, Term
from mapctl.terms.foot_contact import TOES

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
    evaluations: int
    """Spent in all."""
    stretches: tuple[DensityInterval, ...] = ()
    """Of each window, which density was used; none where none was given."""


def refine(
    proposal: Motion,
    contacts: Float[Tensor, "frames 2"],
    capture: Capture,
    settings: RefinementSettings,
    *,
    densities: Sequence[Any] = (),
    targets: EffectorTargets | None = None,
) -> RefinedMotion:
    """Solve every window; `contacts` are log odds, `capture` tells what was seen and how noisy it was. `targets` are
    places that joints are wanted at.

    In each window that density counts under which the proposal is likeliest, and less where it is out of its depth.
    """
    guide = guide_of(proposal, debounced(contacts > 0))
    sigma = _compute_proposal_sigma(capture, settings)
    footing = replace(settings.footing, rest_height=estimate_rest_height(proposal, guide.contacts))
    clearing = _ramp_from_observed(_find_observed_toes(capture), settings.clearance_ramp)
    judges = [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    place = _extrapolate_backward(guide)
    done = _WindowStart(place, torch.zeros(0, proposal.num_joints, 3), torch.zeros(2, dtype=torch.bool), ())
    frames, pieces, spent, ledger, first = proposal.num_frames, [], 0, Ledger(), 0
    stretches: list[DensityInterval] = []
    while first < frames:
        stop = min(frames, first + settings.frames)
        count = stop - first if stop == frames else settings.frames - settings.ahead
        poses = PoseOffsets(
            guide.slice(first, stop),
            sigma[first:stop],
            done.place,
            done.before,
            done.contacts,
            proposal.skeleton,
            smooth=settings.smooth,
        )
        terms: list[Term] = [LatentPrior(1.0), footing]
        if judges:
            poses, done, choice = _select_density(poses, done, judges)
            terms.append(Likelihood(settings.temperature / choice.weight))
            stretches.append(DensityInterval(first, first + count, choice.density.name, choice.nats, choice.weight))
        if settings.clearance is not None:
            terms.append(replace(settings.clearance, rest_height=footing.rest_height, share=clearing[first:stop]))
        if settings.jerk is not None:
            terms.append(settings.jerk)
        if targets is not None:
            terms.append(Keyframe(targets.places[first:stop], targets.wanted[first:stop]))
        features, used, entries, done = _refine_window(poses, terms, count, settings, done, judges)
        pieces.append(features)
        spent, first, ledger = spent + used, first + count, ledger.join(entries)
    motion = decode(torch.cat(pieces), place, skeleton=proposal.skeleton)
    return RefinedMotion(motion, guide.contacts, ledger, spent, tuple(stretches))


@dataclass(frozen=True, eq=False)
class _WindowStart:
    """What a window goes on from."""

    place: GroundPose
    before: Tensor
    contacts: Tensor
    states: Sequence[Any]


def _refine_window(
    poses: PoseOffsets,
    terms: Sequence[Term],
    count: int,
    settings: RefinementSettings,
    before: _WindowStart,
    judges: Sequence[Any],
) -> tuple[Tensor, int, Ledger, _WindowStart]:
    """The first `count` frames of one window; one without a finite solution is left as it was proposed."""
    objective, meter = Objective(poses.build, terms), Meter(settings.budget)
    start = torch.zeros(1, poses.sigma.numel())
    found = minimise(objective.energy_and_gradient, start, settings=settings.lbfgs, meter=meter)
    with torch.no_grad():
        trial = poses.build(found.x if bool(torch.isfinite(found.energy).all()) else start)
        features = trial.features[:, :count]
        ground, heading = integrate_root(features[0], poses.place)
        joints = torch.cat([poses.before, trial.joints_world[0, :count]])[-settings.past :]
        states = [judge.advance(state, features) for judge, state in zip(judges, before.states, strict=True)]
    done = _WindowStart(GroundPose(ground[-1], heading[-1]), joints, poses.guide.contacts[count - 1], states)
    return features[0], meter.evaluations, objective.build_ledger(trial).slice(count), done


def _select_density(
    poses: PoseOffsets, done: _WindowStart, judges: Sequence[Any]
) -> tuple[PoseOffsets, _WindowStart, DensityChoice]:
    """The window scored by the density under which its guide is likeliest; the first window's states are looked for."""
    with torch.no_grad():
        features = poses.build(torch.zeros(1, poses.sigma.numel())).features[0]
    if not done.states:
        done = replace(done, states=[judge.infer_state(features) for judge in judges])
    choice = density_selection.select_density(judges, features, done.states)
    state = done.states[judges.index(choice.density)]
    return replace(poses, density=choice.density, state=state), done, choice


def _extrapolate_backward(guide: Guide) -> GroundPose:
    """The place from which the first frame's step and turn are as the second's: nobody begins by standing still."""
    place = GroundPose(guide.root[0, ::2], guide.heading[0])
    if len(guide.root) == 1:
        return place
    turn = guide.heading[1] - guide.heading[0]
    step = rotations.rotate_ground(guide.root[1, ::2] - guide.root[0, ::2], -guide.heading[0])
    return place.before(step, turn)


def guide_of(motion: Motion, contacts: Bool[Tensor, "frames 2"]) -> Guide:
    """A canonical motion as a guide, single precision."""
    heading, tilt = rotations.split_heading(motion.local_quat_xyzw[:, 0])
    joints = rotations.to_rotation_vector(motion.local_quat_xyzw[:, 1:]).flatten(1)
    angles = torch.cat([rotations.to_rotation_vector(tilt)[:, ::2], joints], dim=-1)
    return Guide(motion.root_position.float(), rotations.unwrap_angle(heading).float(), angles.float(), contacts)


def anchor_to_contacts(motion: Motion, contacts: Bool[Tensor, "frames 2"]) -> Motion:
    """The motion carried over the ground so that its planted toes, on average over a few frames, do not travel.

    For captures whose body drifts against its feet. Feet that roll or turn while they stand are taken to do so.
    """
    toes = [motion.skeleton.index(name) for name in TOES]
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
    toes = [motion.skeleton.index(name) for name in TOES]
    heights = motion.joint_positions()[:, toes, 1]
    planted = heights[contacts]
    return float(planted.median() if len(planted) else heights.quantile(0.05))


def _compute_proposal_sigma(capture: Capture, settings: RefinementSettings) -> Float[Tensor, "frames width"]:
    """Sigma of root, heading and angles by frame (see `Guide.packed`)."""
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
