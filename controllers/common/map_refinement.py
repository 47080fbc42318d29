"""MAP refinement of a proposal: as near to it as its uncertainty asks for, with planted feet (Wang et al. 2019, Eq.
18-19).

A receding horizon over offsets from the proposal's poses (see mapctl.problem.window_solvers), each window solved by
L-BFGS.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import compute_rest_log_probability, debounced, fit_supports
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics.intervals import count_frames_to_observed
from mapctl.pose import BodyPose, decode
from mapctl.problem import density_selection
from mapctl.problem.density_selection import DensityEnsemble, DensityInterval
from mapctl.problem.receding_horizon import CommittedFrames, HorizonSettings, RecedingHorizonSolver
from mapctl.problem.solution import Ledger, Outcome, WindowRecord
from mapctl.problem.unknowns import SMOOTH_FRAMES
from mapctl.problem.window_solvers import PoseOffsetSolver
from mapctl.protocols import Density
from mapctl.recording import Capture
from mapctl.recording.masks import MissingMask
from mapctl.skeleton import TOE_JOINTS, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk, Keyframe, LatentPrior, Term

_CLEARANCE_RAMP = 8.0  # frames next to ones in which a toe was observed over which the clearance term rises
_NOISE_SHARE = 0.35  # sigma of the proposal where it was observed, as a share of the capture's noise


@dataclass(frozen=True)
class RefinementSettings:
    """Sigmas and search of MAP refinement."""

    footing: FootContact = field(default_factory=lambda: FootContact(0.1, 0.03, 0.02, heels=None))
    """Contact term; toes rest on the supports that the contacts show. Loose, since mocap's planted toes move by 6
    cm/s."""
    jerk: Jerk | None = None
    """Jerk term, over its number of frames of each window; None leaves it out."""
    clearance: Clearance | None = None
    """Clearance term of swinging toes that were not observed; None leaves it out."""
    unobserved_sigma_deg: float = 5.0
    """Sigma of the proposed angles of unobserved joints, degrees."""
    unobserved_sigma_cm: float = 5.0
    """Sigma of the proposed position of unobserved hips, centimetres."""
    uncertainty_ramp: float = 0.0
    """Frames next to observed ones over which the sigmas of unobserved ones rise from zero; 0 for at once."""
    temperature: float = 8.0
    """Temperature of a density's likelihood, if there is one; above 1 it counts less, since the proposal has seen the
    data too."""
    window: HorizonSettings = field(default_factory=lambda: HorizonSettings(96, 24, beyond_end=False))
    """Lengths of windows."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=20))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=20))
    """Budget of one window."""


@dataclass(frozen=True, eq=False)
class RefinedMotion:
    """A refined proposal."""

    motion: Motion
    """Motion at the prior's rate."""
    contacts: Bool[Tensor, "frames 2"]
    """Contacts of the left and the right toe."""
    supports: Float[Tensor, "frames 2"]
    """Height at which each toe rests, metres, before the refinement (see `fit_supports`)."""
    ledger: Ledger
    """Energy and residual by term and frame."""
    windows: tuple[WindowRecord, ...]
    """Cost of each window."""

    def density_intervals(self, motion: Motion) -> tuple[DensityInterval, ...]:
        """Return density and its weight in each window, in frames of a motion of this one's duration at any rate; none
        where no density was given."""
        ends = accumulate(window.frames for window in self.windows)
        stops = [min(motion.num_frames, round(end * float(motion.fps) / PRIOR_FPS)) for end in ends]
        stops[-1] = motion.num_frames
        return tuple(
            DensityInterval(start, stop, choice.density.name, choice.nats, choice.weight)
            for start, stop, window in zip([0, *stops], stops, self.windows, strict=False)
            if (choice := window.choice) is not None and start < stop
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
    trust: Float[Tensor, "frames joints"] | None = None,
) -> RefinedMotion:
    """Refine a proposal with these contact logits, which count as far as the toes rest (see
    `compute_rest_log_probability`); `capture` holds the observation mask and the noise. `targets` are
    positions that joints are to reach, `terms` join the others in every window and see the first frame of the proposal
    as `first_frame` of the whole motion. `trust` multiplies the sigmas of what was not observed, by joint: where the
    proposal is surer than usual it is below 1.

    In each window the density counts under which the proposal is likeliest, and less where it is out of its depth.
    """
    pose = BodyPose.of_motion(proposal)
    start = _extrapolate_backward(pose)
    root, angle = _compute_proposal_sigma(capture, settings, trust)
    planted, supports = _find_contacts(proposal, contacts, root, angle)
    observed = MissingMask(~capture.seen[0], ~capture.seen_root[0]).known_positions[:, TOE_JOINTS]
    clearing = _ramp_from_observed(observed, _CLEARANCE_RAMP)

    def terms_of(first: int, frames: int) -> list[Term]:
        part = slice(first, first + frames)
        found: list[Term] = [LatentPrior(1.0), replace(settings.footing, supports=supports[part]), *terms]
        if settings.clearance is not None:
            found.append(replace(settings.clearance, rest_height=supports[part], share=clearing[part]))
        if settings.jerk is not None:
            found.append(settings.jerk)
        if targets is not None:
            found.append(Keyframe(targets.positions[part], targets.wanted[part]))
        return found

    ensemble = DensityEnsemble(
        [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    )
    sigma = torch.cat([root.expand(-1, 3), angle.repeat_interleave(3, dim=-1)], dim=-1)  # in the order of pose.pack
    solver = RecedingHorizonSolver(
        ensemble,
        settings.window,
        proposal.skeleton,
        method=PoseOffsetSolver(
            pose, planted, sigma, settings.temperature, settings.lbfgs, settings.budget, first_frame
        ),
    )
    # The densities begin in states that make the first window's proposal likely.
    first = slice(0, min(settings.window.frames, proposal.num_frames))
    states = ensemble.infer_state(pose.slice(0, first.stop).features(start, planted[first]))
    before = torch.zeros(0, proposal.num_joints, 3)
    done = CommittedFrames(states, start, torch.zeros(0, LAYOUT.size), before, discarded=first_frame)
    done, outcome = solver.solve(done, terms_of, proposal.num_frames, generator=torch.Generator())
    if outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    motion = decode(done.features, start, skeleton=proposal.skeleton)
    return RefinedMotion(motion, planted, supports, done.ledger, done.windows)


def _extrapolate_backward(pose: BodyPose) -> GroundPose:
    """Extrapolate the ground pose before the first frame, so that the first frame's velocities are the second's."""
    ground, heading = pose.root_position[:, ::2], pose.heading
    here = GroundPose(ground[0], heading[0])
    if len(heading) == 1:
        return here
    return here.before(rotations.rotate_ground(ground[1] - ground[0], -heading[0]), heading[1] - heading[0])


def estimate_rest_height(motion: Motion, contacts: Bool[Tensor, "frames 2"]) -> Float[Tensor, "frames 2"]:
    """Estimate the height at which each toe of a canonical motion rests in each frame, metres."""
    return fit_supports(motion.joint_positions()[:, motion.skeleton.indices(TOES)], contacts)


def _find_contacts(
    proposal: Motion,
    logits: Float[Tensor, "frames 2"],
    root: Float[Tensor, "frames 1"],
    angle: Float[Tensor, "frames joints"],
) -> tuple[Bool[Tensor, "frames 2"], Float[Tensor, "frames 2"]]:
    """Find contacts, likely by the logits and by the toes' rest both, and supports, metres. Errors of the proposal are
    normal with these sigmas of root and angles, and smooth over SMOOTH_FRAMES."""
    positions = proposal.joint_positions()
    toes, noise = positions[:, proposal.skeleton.indices(TOES)], []
    for joint in proposal.skeleton.indices(TOES):
        variance, above = root.square().expand(-1, 3), proposal.skeleton.parents[joint]
        while above >= 0:
            lever = (positions[:, joint] - positions[:, above]).square()
            variance = variance + angle[:, above, None].square() * (lever.sum(dim=-1, keepdim=True) - lever)
            above = proposal.skeleton.parents[above]
        noise.append(variance)
    variance = torch.stack(noise, dim=1)
    # The derivative of errors with the correlation exp(-t^2 / 4 SMOOTH_FRAMES^2).
    speed_noise = variance.mean(dim=-1).sqrt() * float(proposal.fps) / (math.sqrt(2) * SMOOTH_FRAMES)
    resting = compute_rest_log_probability(toes, positions[:, 0], float(proposal.fps), speed_noise)
    planted = debounced(torch.nn.functional.logsigmoid(logits) + resting > math.log(0.5))
    return planted, fit_supports(toes, planted, variance[..., 1].sqrt())


def _compute_proposal_sigma(
    capture: Capture, settings: RefinementSettings, trust: Float[Tensor, "frames joints"] | None
) -> tuple[Float[Tensor, "frames 1"], Float[Tensor, "frames joints"]]:
    """Compute the sigmas of the root's coordinates, metres, and of joints' angles, radians, by frame."""
    ramp, ramp_root = (
        _ramp_from_observed(observed, settings.uncertainty_ramp)
        for observed in (capture.seen[0], capture.seen_root[0][:, None])
    )
    factor = torch.ones(ramp.shape) if trust is None else trust
    unobserved = math.radians(settings.unobserved_sigma_deg) * ramp * factor
    angle = torch.where(capture.seen[0], _NOISE_SHARE * capture.sigma[0], unobserved).clamp_min(1e-4)
    unobserved_root = settings.unobserved_sigma_cm / 100 * ramp_root[:, 0] * factor[:, 0]
    root = torch.where(capture.seen_root[0], _NOISE_SHARE * capture.sigma_root[0], unobserved_root)
    # Feet are planted even in a capture without noise, if only by half a millimetre.
    return root.clamp_min(5e-4)[:, None], angle


def _ramp_from_observed(observed: Bool[Tensor, "frames columns"], ramp: float) -> Float[Tensor, "frames columns"]:
    """Ramp from 0 where a column is observed smoothly to 1 so many frames away; 1 throughout for a ramp of 0 frames."""
    if ramp <= 0 or bool(observed.all()):
        return torch.ones(observed.shape)
    distance = count_frames_to_observed(observed.T).amin(dim=-1).T
    return torch.sin(0.5 * math.pi * (distance / ramp).clamp(max=1)).square()
