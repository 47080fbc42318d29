"""Rollouts of a density through the gaps of a motion, steered to arrive where it goes on: another proposal than an
infiller's, and a different one for each draw (rnn paper, Eq. 14-19, with what comes after a gap as the wish).

A swarm looks for noise of the root that leads to the next known frames; L-BFGS over all noise then goes there. What is
still missed is spread over the gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.canonical_gap import CanonicalGap
from mapctl import choosing, gaussian, rotations
from mapctl.capture.faults import runs
from mapctl.features import LAYOUT, PRIOR_FPS, Place, decode, encode, root_places
from mapctl.gaps.closing import closed_places, closed_rotations
from mapctl.gaps.targets import Targets
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.methods import LatentMethod, SolvedWindow
from mapctl.solver.proposals import SteeringKnots, Swarm, zero_start
from mapctl.solver.swarm import SwarmSettings
from mapctl.solver.variables import Context
from mapctl.terms import Footing, Keyframe, Noise

_SURE = 4.0  # log odds of a rollout's contacts
_BEFORE = 5  # frames that tell how somebody goes on
_PAST = 3  # frames before a gap that terms look back on


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
    arrival: float = 0.03
    """Distance of every joint from the known frame at which a rollout arrives, metres."""
    ahead: int = 15
    """Frames after a gap that are rolled with it, so that it arrives as those known among them ask."""
    footing: Footing = field(default_factory=lambda: Footing(sigma_speed=0.1, sigma_height=0.05, sigma_below=0.05))
    """Planted feet."""
    shortest: int = 2
    """Frames of the shortest gap that is rolled through: shorter ones leave nothing to vary."""
    longest: int = 180
    """Frames that are rolled at a time; what is longer is left to the given proposal."""
    method: LatentMethod = field(default_factory=lambda: LatentMethod(
        rounds=2, lbfgs=LbfgsSettings(max_iterations=24), budget=Budget(evaluations=96),
        proposal=Swarm(SwarmSettings(particles=8, iterations=5), SteeringKnots(knots=4, spread=0.7))))  # fmt: skip
    """The swarm and the search after it."""


def rolled(
    gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], targets: Targets | None = None, *,
    densities: Sequence[Any], generator: torch.Generator, settings: RolloutSettings | None = None,
) -> tuple[Motion, Float[Tensor, "frames 2"]]:  # fmt: skip
    """The proposal with rollouts in those of its gaps in which nothing is known and that have known frames on both
    sides; and the log odds of its contacts.

    Of the densities the one is rolled under which the proposal is likeliest. `targets` are places wanted on the way.
    """
    settings, skeleton = settings or RolloutSettings(), proposal.skeleton
    body = Motion(CANONICAL, proposal.fps, proposal.root_position / gap.scale, proposal.local_quat_xyzw)
    density = likeliest(densities, body)
    lost, state, done, odds = gap.turns.all(dim=1) & gap.root, None, 0, odds.clone()
    for _, start, stop in runs(lost[:, None]):
        if start == 0 or stop == len(lost) or not settings.shortest <= stop - start <= settings.longest:
            continue
        features, place = _until(body, odds, start)
        state = density.likely_state(features) if state is None else state
        state, done = density.advance(state, features[None, done:]), start
        arrival = _arrival(body, lost, (start, stop), gap.scale, targets, settings)
        context = Context(density, state, place, _past(body, start), len(arrival.places))
        terms = (Noise(settings.sigma_noise), settings.footing, arrival)
        window = settings.method(context, terms, _drawn(context.frames, generator, settings), generator)
        body, odds = _put_in(body, odds, window, place, start, stop)
    return replace(body, skeleton=skeleton, root_position=body.root_position * gap.scale), odds


def extended(
    gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], *, densities: Sequence[Any],
    settings: RolloutSettings | None = None,
) -> tuple[Motion, Float[Tensor, "frames 2"], str | None]:  # fmt: skip
    """The proposal with the likeliest rollout from where it is last known to its end, if nothing is known there; the
    log odds of its contacts; and the name of the density that was rolled, None if the proposal stays as it is.

    It does where the first density (that of locomotion) does not find what comes before as likely as its own data:
    densities then stop or turn away. None runs backwards, so a beginning stays as well.
    """
    settings, lost = settings or RolloutSettings(), gap.turns.all(dim=1) & gap.root
    start, stop = len(lost) - int(lost.flip(0).long().cumprod(0).sum()), len(lost)
    # What stood before other gaps tells, and not what fills them.
    since = int(lost[:start].nonzero()[-1]) + 1 if bool(lost[:start].any()) else 0
    if start == stop or start - since < _BEFORE or not densities:
        return proposal, odds, None
    body = Motion(CANONICAL, proposal.fps, proposal.root_position / gap.scale, proposal.local_quat_xyzw)
    known = body.slice(since, start)
    judge = densities[0].blurred(choosing.spread())
    if choosing.likeliest_of_motion([judge], known).weight < 1:
        return proposal, odds, None
    density = likeliest(densities, known)
    while start < stop:
        features, place = _until(body, odds, start)
        state = density.advance(density.likely_state(features), features[None])
        context = Context(density, state, place, _past(body, start), min(settings.longest, stop - start))
        terms = (Noise(settings.sigma_noise), settings.footing)
        still = torch.zeros(context.frames, LAYOUT.continuous)
        window = replace(settings.method, proposal=zero_start)(context, terms, still, torch.Generator())
        body, odds = _put_in(body, odds, window, place, start, start + context.frames)
        start += context.frames
    body = replace(body, skeleton=proposal.skeleton, root_position=body.root_position * gap.scale)
    return body, odds, density.name


def likeliest(densities: Sequence[Any], motion: Motion) -> Any:
    """The density under which a canonical motion, seen with a proposal's errors, is likeliest."""
    if len(densities) == 1:
        return densities[0]
    blurred = [density.blurred(choosing.spread()) for density in densities]
    return densities[blurred.index(choosing.likeliest_of_motion(blurred, motion).density)]


def _until(body: Motion, odds: Tensor, start: int) -> tuple[Float[Tensor, "frames size"], Place]:
    """What there is before a gap, with the proposal's own contacts, single precision; and where it ends."""
    features, before = encode(body.slice(0, max(2, start)))
    ground, heading = root_places(features, before)
    features[:, LAYOUT.slices["contacts"]] = (odds[: len(features)] > 0).to(features)
    return features[:start].float(), Place(ground[start - 1].float(), heading[start - 1].float())


def _past(body: Motion, start: int) -> Float[Tensor, "past joints 3"]:
    first = max(0, start - _PAST)
    return body.slice(first, start).joint_positions().float()


def _arrival(
    body: Motion, lost: Bool[Tensor, " frames"], gap: tuple[int, int], scale: float, targets: Targets | None,
    settings: RolloutSettings,
) -> Keyframe:  # fmt: skip
    """Where a rollout is to be in the known frames after its gap, and at places wanted on the way."""
    part = slice(gap[0], gap[1] + settings.ahead)
    known = ~lost[part]
    last = int(known.nonzero()[-1]) + 1
    places, known = body.joint_positions()[part][:last], known[:last]
    wanted = known[:, None].expand(-1, CANONICAL.num_joints)
    if targets is not None:
        told = targets.wanted[part][:last]
        places = torch.where(told[..., None], targets.places[part][:last] / scale, places)
        wanted = wanted | told
    return Keyframe(places.float(), wanted, settings.arrival)


def _drawn(frames: int, generator: torch.Generator, settings: RolloutSettings) -> Float[Tensor, "frames continuous"]:
    """Noise that changes slowly."""
    white = torch.randn(frames, LAYOUT.continuous, generator=generator)
    weight = gaussian.weights(frames, settings.slow, white.dtype)
    return settings.temperature * (weight / weight.square().sum(dim=-1, keepdim=True).sqrt()) @ white


def _put_in(
    body: Motion, odds: Tensor, window: SolvedWindow, place: Place, start: int, stop: int
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """The rollout in its gap, moved so that it arrives at the frame after it, if there is one; its contacts."""
    made = decode(window.trial.features[0], Place(place.position_xz.double(), place.heading.double()))
    count = stop - start
    share = torch.sin(0.5 * torch.pi * torch.arange(1, count + 1) / (count + 1)).square()[:, None].double()
    root, quats, odds = body.root_position.clone(), body.local_quat_xyzw.clone(), odds.clone()
    root[start:stop], quats[start:stop] = made.root_position[:count], made.local_quat_xyzw[:count]
    if count < len(made.root_position):
        root[start:stop] += share * (root[stop] - made.root_position[count])
        turn = rotations.multiply(rotations.inverse(made.local_quat_xyzw[count]), quats[stop])
        turned = rotations.from_rotation_vector(share[..., None] * rotations.to_rotation_vector(turn))
        quats[start:stop] = rotations.multiply(quats[start:stop], turned)
    put = torch.zeros(len(root), dtype=torch.bool)
    put[start:stop] = True
    root = closed_places(root, put, fps=PRIOR_FPS)
    quats = closed_rotations(quats, put[:, None].expand(-1, CANONICAL.num_joints), fps=PRIOR_FPS)
    odds[start:stop] = _SURE * (2 * window.trial.contacts[0, :count].to(odds) - 1)
    return replace(body, root_position=root, local_quat_xyzw=quats), odds
