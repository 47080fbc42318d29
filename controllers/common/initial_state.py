"""Choose the moment of mocap that a motion begins from, and how it stands on the curve."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.features import LAYOUT, GroundPose, ground_speed, integrate_root
from mapctl.numerics import gaussian
from mapctl.pose import decode
from mapctl.problem.context import WindowContext
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.objective import Objective
from mapctl.problem.receding_horizon import CommittedFrames
from mapctl.protocols import Density, DensityState
from mapctl.rotations import wrap_angle
from mapctl.skeleton import Skeleton
from mapctl.terms import Term

_CANDIDATES = 24
_BEST_CANDIDATES = 4
_LOOK_AHEAD = 34
_ROLLOUT_FRAMES = 120  # frames of plain rollout that show how a candidate walks when nobody asks for anything
_SPEED_SIGMA = 0.1  # m/s between a candidate's own speed and the wanted one that count as one standard deviation
_SWAY_SECONDS = 0.35
_TYPICAL_SWAY_QUANTILE = 0.65  # quantile among candidates; over the median, since plain rollouts sway less than people


@dataclass(frozen=True, eq=False)
class MotionStart:
    """Where a motion begins."""

    committed: CommittedFrames
    """The first frame, as the window solver wants it."""
    before_first: GroundPose
    """The place from which `features.decode` leads to the first frame."""


def select_initial_state(
    prior: Density,
    curve: Curve,
    arcs: Float[Tensor, " frames"],
    terms_of: Callable[[int, int], Sequence[Term]],
    *,
    skeleton: Skeleton,
    fps: float,
    generator: torch.Generator,
) -> MotionStart:
    """Of the prior's starts near the wanted speed, one of those that fit the wishes best with nobody steering.

    Each candidate stands on the curve's first point and is turned so that the first half second of its plain rollout
    goes along the curve. It is scored by the energy of the first window, by how far the speed it falls into is from
    the wanted one, and by how unusual its sway is among the candidates. The generator picks among the best few, so that
    seeds give different walks.
    """
    wanted = float(arcs[1] - arcs[0]) * fps
    ahead = min(_LOOK_AHEAD, len(arcs) - 1)
    near = (prior.initial_states.speed - wanted).abs().argsort()[:_CANDIDATES]
    state = prior.initial_states.state.pick(near)
    noise = torch.zeros(len(near), _ROLLOUT_FRAMES, LAYOUT.continuous)
    with torch.no_grad():
        features, _ = prior.rollout(state, noise, prior.plan(state, noise))
    places = GroundPose(_first_point(curve).expand(len(near), 2), _align_headings(features[:, :ahead], curve, arcs))
    before, planted = torch.zeros(0, skeleton.num_joints, 3), LAYOUT.pick(state.last_frame, "contacts") > 0.5
    context = WindowContext(prior, state, places, before, ahead, skeleton, fps, planted, first_frame=1)
    flat = noise[:, :ahead].flatten(1)
    with torch.no_grad():
        energy = Objective(LatentNoise.from_unknowns(context, flat).build, terms_of(1, ahead)).energy(flat) / ahead
    # The plain rollout soon leaves the curve, and its energy then says little: it counts for a tenth.
    best = (0.1 * energy + _candidate_energy(features, wanted, fps)).argsort()[:_BEST_CANDIDATES]
    pick = int(best[torch.randint(len(best), (1,), generator=generator)])
    place = GroundPose(places.position_xz[pick], places.heading[pick])
    return start_from_state(state.pick(torch.tensor([pick])), place, skeleton)


def _candidate_energy(
    features: Float[Tensor, "starts frames size"], wanted: float, fps: float
) -> Float[Tensor, " starts"]:
    """Nats: how far each candidate's own speed is from the wanted one, and its sway from the usual one."""
    speed = ground_speed(features).mean(-1)
    sway = _sway(features, fps)
    spread = (sway.quantile(0.75) - sway.quantile(0.25)).clamp_min(1e-4) / 2
    unusual = (sway - sway.quantile(_TYPICAL_SWAY_QUANTILE)) / spread
    return 0.5 * ((speed - wanted) / _SPEED_SIGMA).square() + 0.5 * unusual.square()


def _sway(features: Float[Tensor, "starts frames size"], fps: float) -> Float[Tensor, " starts"]:
    """Sway without a curve: rms of the root's sideways departure from its own smoothed trajectory, metres."""
    ground, _ = integrate_root(features, GroundPose.origin())
    smooth = gaussian.averaging_matrix(ground.shape[1], _SWAY_SECONDS * fps, ground.dtype) @ ground
    way = torch.nn.functional.normalize(torch.gradient(smooth, dim=1)[0], dim=-1)
    apart = ground - smooth
    sideways = apart[..., 0] * way[..., 1] - apart[..., 1] * way[..., 0]
    edge = min(round(2 * _SWAY_SECONDS * fps), ground.shape[1] // 4)
    return sideways[:, edge:-edge].square().mean(-1).sqrt()


def start_from_state(state: DensityState, place: GroundPose, skeleton: Skeleton) -> MotionStart:
    """A density's state (batch of one) as the beginning of a motion whose first frame stands at a place."""
    first = state.last_frame
    before = place.before(
        LAYOUT.pick(first[0], "root_displacement_heading"), LAYOUT.pick(first[0], "heading_change")[0]
    )
    joints = decode(first, before, skeleton=skeleton).joint_positions().to(first.dtype)
    return MotionStart(CommittedFrames(state, place, first, joints), before)


def _first_point(curve: Curve) -> Float[Tensor, "2"]:
    return curve.point(0.0)[..., :: curve.dims - 1].float()


def _align_headings(features: Tensor, curve: Curve, arcs: Tensor) -> Float[Tensor, " starts"]:
    """Heading of each start's frame that makes the rollout's way over the first half second parallel to the curve's."""
    half = features.shape[1] // 2
    ground, _ = integrate_root(features, GroundPose.origin())
    way = curve.point(arcs[half]) - curve.point(0.0)
    wanted = torch.atan2(way[0], way[-1]).float()
    walked = torch.atan2(ground[:, half - 1, 0], ground[:, half - 1, 1])
    return wrap_angle(wanted - walked)
