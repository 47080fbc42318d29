"""Who fills a gap: the infiller where it knows enough, a rollout where it would slide, and nobody where one stands.

Between poses that are seconds apart the infiller's answer is the mean of many: feet that hang and slide. Likelihood
does not tell, since a mean is likely; what a viewer sees does: a low foot that moves under the body, a body that goes a
long way round, a limb that jumps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.proposers.answers import GapSource, Proposal
from controllers.inbetweening.proposers.rollout import Roller, Rollout, RolloutSettings, find_whole_gaps
from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.problem.warm_start import keep_warm_start
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings

INFILLER = "infiller"
STANDING_STILL = "standing still"
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))
_SKATE_HEIGHT = 0.025  # metres
_STANDING_CONTACT_LOGIT = 4.0  # log odds of contacts of somebody who stands


@dataclass(frozen=True)
class ChoiceSettings:
    """When others than the infiller are asked, and what counts against an answer."""

    max_bare_frames: int = 30
    """Frames of the longest gap between poses with little known beside them that the infiller fills unasked."""
    context: int = 8
    """Known frames on both sides of a gap from which on the infiller knows how somebody moves."""
    known: int = 60
    """Frames of the longest gap between such that it fills unasked: the mean length that it was trained on."""
    acceptable_cost: float = 0.2
    """Cost, m/s, of an answer with which nobody else is asked."""
    tempos: tuple[float, ...] = (1.0, 0.94, 1.06)
    """Of rollouts, in this order: how long they are before they are brought to the gap's length. Steps then end
    earlier or later, which is what a rollout that starts from one pose cannot choose otherwise."""
    same_pose_distance: float = 0.06
    """Mean distance of the joints, metres, of two poses between which somebody just stands."""
    at_rest: float = 0.15
    """Mean speed of the joints beside a gap, m/s, below which somebody is not about to move."""
    skate: float = 0.5
    """Weight of skating beside sliding."""
    detour_weight: float = 0.5
    """Weight of a way that is longer than the straight one, m/s."""
    unsupported_weight: float = 0.5
    """Weight of the longest time on no planted foot, m/s for a second."""
    missed: float = 0.3
    """Weight of the distance at which a rollout would have arrived, per second: m/s for a metre."""
    max_step_ratio: float = 1.3
    """How much farther than in the infiller's answer, which is a calm one, hands and feet may go in a frame."""
    step: float = 0.08
    """Metres that they may go in a frame at any rate."""
    excess_step_weight: float = 8.0
    """Weight of a metre more than that, m/s."""
    rolling: RolloutSettings = field(
        default_factory=lambda: RolloutSettings(
            temperature=0.0,
            longest=300,
            trajectory=0.2,
            stage=45,
            method=LatentNoiseSolver(
                rounds=2,
                proposal=keep_warm_start,
                lbfgs=LbfgsSettings(max_iterations=16),
                budget=Budget(evaluations=48),
            ),
        )
    )
    """Rollouts: the likeliest ones, without a swarm before L-BFGS, which did not lower the cost here."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """One answer for one gap."""

    body: Motion
    """All frames, on the performer's bones."""
    odds: Float[Tensor, "frames 2"]
    by: str
    cost: float
    rollout: Rollout | None = None


def choose_proposals(
    gap: CanonicalGap,
    proposal: Motion,
    odds: Float[Tensor, "frames 2"],
    targets: EffectorTargets | None = None,
    *,
    densities: Sequence[Density],
    settings: ChoiceSettings | None = None,
) -> Proposal:
    """The proposal, an infiller's, but in gaps where another answer costs a viewer less; and who proposed those.

    Gaps in which nothing is known, with known frames on both sides, count; one after the other in time.
    """
    settings, sources = settings or ChoiceSettings(), []
    roller = Roller.of(gap, proposal, odds, densities, targets) if densities else None
    best = _Candidate(proposal, odds, INFILLER, 0.0)
    for start, stop in find_whole_gaps(gap):
        if _has_enough_context(gap, start, stop, settings):
            sources.append(GapSource(start, stop, INFILLER))
            continue
        best = _choose_candidate(gap, best, roller, (start, stop), settings, wanted=targets)
        sources.append(GapSource(start, stop, best.by))
        if roller is not None:
            roller.body = replace(best.body, skeleton=CANONICAL, root_position=best.body.root_position / gap.scale)
            roller.odds = best.odds
    return Proposal(best.body, best.odds, tuple(sources))


def _has_enough_context(gap: CanonicalGap, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Whether the infiller does."""
    known = ~(gap.turns.any(dim=1) | gap.root)
    before, after = known[max(0, start - settings.context) : start], known[stop : stop + settings.context]
    beside = min(int(before.sum()), int(after.sum()))
    return stop - start <= (settings.known if beside >= settings.context else settings.max_bare_frames)


def _choose_candidate(
    gap: CanonicalGap,
    before: _Candidate,
    roller: Roller | None,
    part: tuple[int, int],
    settings: ChoiceSettings,
    *,
    wanted: EffectorTargets | None,
) -> _Candidate:
    """Of the infiller's answer, standing still, and rollouts of several tempos, the one that costs least."""
    start, stop = part
    first = replace(before, by=INFILLER, cost=compute_artefact_cost(before.body, before.odds, part, settings))
    calm = settings.max_step_ratio * max(settings.step, _find_largest_step(before.body, part))
    on_the_way = wanted is not None and bool(wanted.wanted[start:stop].any())
    if not on_the_way and _is_standing_still(gap, start, stop, settings):
        return _hold_pose(gap, first, part)
    found = [first]
    if roller is None or not settings.rolling.shortest <= stop - start <= settings.rolling.longest:
        return first
    for tempo in settings.tempos:
        if min(one.cost for one in found) < settings.acceptable_cost:
            break
        rolled = roller.roll(start, stop, torch.Generator(), replace(settings.rolling, tempo=tempo))
        body = roller.scale_to_character(rolled.body)
        cost = compute_artefact_cost(body, rolled.odds, part, settings)
        cost += settings.excess_step_weight * max(0.0, _find_largest_step(body, part) - calm)
        cost += settings.missed * rolled.missed * PRIOR_FPS / (stop - start)
        found.append(_Candidate(body, rolled.odds, f"rollout of {roller.density.name}", cost, rolled))
    return min(found, key=lambda one: one.cost)


def compute_artefact_cost(
    motion: Motion, odds: Float[Tensor, "frames 2"], part: tuple[int, int], settings: ChoiceSettings
) -> float:
    """What a viewer sees of a gap that is filled, as a speed, m/s: of what the body stands on, of toes that skate, of
    a way round, of the longest time on no foot.
    """
    start, stop = part[0] - 1, part[1] + 1
    places, fps = motion.joint_positions()[start:stop], float(motion.fps)
    toes, hips = places[:, _TOES], places[:, 0]
    height = estimate_rest_height(motion, contacts.debounced(odds > 0))
    above, speeds = toes[1:, :, 1] - height, torch.diff(toes[..., ::2], dim=0).norm(dim=-1) * fps
    slide = float(contacts.support_speed(above, speeds).mean())
    skate = float((speeds * (1 - above / _SKATE_HEIGHT).clamp(0, 1)).mean())
    ground = hips[:, ::2]
    way = float(torch.diff(ground, dim=0).norm(dim=-1).sum()) - float((ground[-1] - ground[0]).norm())
    hung = worst_frame.measure_longest_unsupported(toes, hips, fps)
    return (
        slide
        + settings.skate * skate
        + settings.detour_weight * way * fps / len(places)
        + settings.unsupported_weight * hung
    )


def _find_largest_step(motion: Motion, part: tuple[int, int]) -> float:
    """Of hands and toes in a gap and into it and out of it, seen from the hips, metres a frame."""
    shown = motion.slice(part[0] - 1, part[1] + 1)
    return worst_frame.measure_peaks(
        shown.joint_positions()[:, _EFFECTORS], shown.root_position, float(motion.fps)
    ).step


def _is_standing_still(gap: CanonicalGap, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Whether somebody is in one place and pose before a gap and after it, and at rest as far as frames beside it
    show.
    """
    places = gap.motion.joint_positions()
    apart = float((places[stop] - places[start - 1]).norm(dim=-1).mean())
    speeds = [0.0]
    for one, other in ((start - 2, start - 1), (stop, stop + 1)):
        if one >= 0 and other < len(places) and not bool(gap.root[[one, other]].any() | gap.turns[[one, other]].any()):
            speeds.append(float((places[other] - places[one]).norm(dim=-1).mean()) * PRIOR_FPS)
    return apart < settings.same_pose_distance and max(speeds) < settings.at_rest


def _hold_pose(gap: CanonicalGap, before: _Candidate, part: tuple[int, int]) -> _Candidate:
    """The pose held, changing slowly into the next."""
    start, stop = part
    root, quats, odds = before.body.root_position.clone(), before.body.local_quat_xyzw.clone(), before.odds.clone()
    root[start:stop], quats[start:stop] = gap.motion.root_position[start:stop], gap.motion.local_quat_xyzw[start:stop]
    body = replace(before.body, root_position=root, local_quat_xyzw=quats)
    toes = body.joint_positions()[start:stop, _TOES, 1]
    odds[start:stop] = torch.where(toes < toes.amin() + 0.025, _STANDING_CONTACT_LOGIT, -_STANDING_CONTACT_LOGIT).to(
        odds
    )
    return _Candidate(body, odds, STANDING_STILL, 0.0)
