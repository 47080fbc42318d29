"""Select the initial state of a motion along a curve, and its ground pose on the curve."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.numerics import gaussian
from mapctl.pose import decode
from mapctl.problem.objective import Objective
from mapctl.problem.receding_horizon import CommittedFrames
from mapctl.problem.unknowns import LatentNoise, WindowContext
from mapctl.protocols import Density, DensityState
from mapctl.rotations import wrap_angle
from mapctl.skeleton import Skeleton
from mapctl.terms import Term

_CANDIDATES = 24
_BEST_CANDIDATES = 4
_LOOK_AHEAD = 34
_ROLLOUT_FRAMES = 120  # frames of plain rollout that show how a candidate walks without terms
_SPEED_SIGMA = 0.1  # m/s between a candidate's own speed and the wanted one that count as one standard deviation
_SWAY_SECONDS = 0.35
_TYPICAL_SWAY_QUANTILE = 0.65  # quantile among candidates; over the median, since plain rollouts sway less than mocap


@dataclass(frozen=True, eq=False)
class MotionStart:
    """Beginning of a motion."""

    committed: CommittedFrames
    """First frame, as the receding-horizon solver takes it."""
    before_first: GroundPose
    """Ground pose before the first frame, from which `mapctl.pose.decode` integrates."""


def select_initial_state(
    prior: Density,
    curve: Curve,
    arcs: Float[Tensor, " frames"],
    terms_of: Callable[[int, int], Sequence[Term]],
    *,
    skeleton: Skeleton,
    generator: torch.Generator,
) -> MotionStart:
    """Select, among the prior's initial states near the requested speed, one whose plain rollout fits the terms best.

    Each candidate begins at the curve's first point, with the heading at which the first half second of its plain
    rollout is parallel to the curve. It is scored by the energy of the first window, by the difference of the speed
    that it settles at from the requested one, and by how unusual its sway is among the candidates. The generator picks
    among the best few, so that seeds give different walks.
    """
    wanted = float(arcs[1] - arcs[0]) * PRIOR_FPS
    ahead = min(_LOOK_AHEAD, len(arcs) - 1)
    near = (prior.initial_states.speed - wanted).abs().argsort()[:_CANDIDATES]
    state = prior.initial_states.state.pick(near)
    noise = torch.zeros(len(near), _ROLLOUT_FRAMES, LAYOUT.continuous)
    with torch.no_grad():
        features, _ = prior.rollout(state, noise, prior.plan(state, noise))
    ground_poses = GroundPose(
        curve.ground_point(0.0).float().expand(len(near), 2), _align_headings(features[:, :ahead], curve, arcs)
    )
    before, planted = torch.zeros(0, skeleton.num_joints, 3), LAYOUT.pick(state.last_frame, "contacts") > 0.5
    context = WindowContext(prior, state, ground_poses, before, ahead, skeleton, planted, first_frame=1)
    flat = noise[:, :ahead].flatten(1)
    with torch.no_grad():
        energy = Objective(LatentNoise.from_unknowns(context, flat).build, terms_of(1, ahead)).energy(flat) / ahead
    # The plain rollout soon leaves the curve, where its energy means little: it counts for a tenth.
    best = (0.1 * energy + _candidate_energy(features, wanted)).argsort()[:_BEST_CANDIDATES]
    pick = int(best[torch.randint(len(best), (1,), generator=generator)])
    ground_pose = GroundPose(ground_poses.position_xz[pick], ground_poses.heading[pick])
    return start_from_state(state.pick(torch.tensor([pick])), ground_pose, skeleton)


def _candidate_energy(features: Float[Tensor, "starts frames size"], wanted: float) -> Float[Tensor, " starts"]:
    """Compute each candidate's energy of speed and sway, nats: deviation from the requested and from the typical."""
    speed = ground_speed(features).mean(-1)
    sway = _sway(features)
    spread = (sway.quantile(0.75) - sway.quantile(0.25)).clamp_min(1e-4) / 2
    unusual = (sway - sway.quantile(_TYPICAL_SWAY_QUANTILE)) / spread
    return 0.5 * ((speed - wanted) / _SPEED_SIGMA).square() + 0.5 * unusual.square()


def _sway(features: Float[Tensor, "starts frames size"]) -> Float[Tensor, " starts"]:
    """Compute the sway without a curve: rms sideways departure of the root from its smoothed trajectory, metres."""
    ground, _ = integrate_root(features, GroundPose.origin())
    smooth = gaussian.averaging_matrix(ground.shape[1], _SWAY_SECONDS * PRIOR_FPS, ground.dtype) @ ground
    direction = torch.nn.functional.normalize(torch.gradient(smooth, dim=1)[0], dim=-1)
    departure = ground - smooth
    sideways = departure[..., 0] * direction[..., 1] - departure[..., 1] * direction[..., 0]
    edge = min(round(2 * _SWAY_SECONDS * PRIOR_FPS), ground.shape[1] // 4)
    return sideways[:, edge:-edge].square().mean(-1).sqrt()


def start_from_state(state: DensityState, ground_pose: GroundPose, skeleton: Skeleton) -> MotionStart:
    """Begin a motion in a density's state (batch of one) with its first frame at a ground pose."""
    first = state.last_frame
    displacement, turn = (LAYOUT.pick(first[0], name) for name in ("root_displacement_heading", "heading_change"))
    before = ground_pose.before(displacement, turn[0])
    joints = decode(first, before, skeleton=skeleton).joint_positions().to(first.dtype)
    return MotionStart(CommittedFrames(state, ground_pose, first, joints), before)


def _align_headings(features: Tensor, curve: Curve, arcs: Tensor) -> Float[Tensor, " starts"]:
    """Compute each initial state's heading at which the first half second of its rollout is parallel to the curve."""
    half = features.shape[1] // 2
    ground, _ = integrate_root(features, GroundPose.origin())
    direction = curve.point(arcs[half]) - curve.point(0.0)
    wanted = torch.atan2(direction[0], direction[-1]).float()
    walked = torch.atan2(ground[:, half - 1, 0], ground[:, half - 1, 1])
    return wrap_angle(wanted - walked)
