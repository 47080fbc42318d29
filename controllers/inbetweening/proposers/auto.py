"""Choose who fills a gap: the infiller where it knows enough, a rollout where it would slide, a held pose where the
body stands still.

Between poses that are seconds apart the infiller's answer is the mean of many: feet that hang and slide. Likelihood
does not show it, since a mean is likely; what a viewer sees does: a low foot that moves under the body, a detour of the
body, a limb that jumps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.proposers.extrapolation import extrapolate_end
from controllers.inbetweening.proposers.rollouts import Roller, RolloutSettings
from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.problem.warm_start import keep_warm_start
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings

STANDING_STILL = "standing still"
"""Name of the source of a gap in which the pose before it is held."""
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))
_SKATE_HEIGHT = 0.025  # metres
_STANDING_CONTACT_LOGIT = 4.0


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
class AutoInbetweener(Inbetweener):
    """The infiller's proposal, but in gaps where a rollout or a held pose costs a viewer less; the end is extended by a
    density that knows what comes before it.
    """

    infiller: Inbetweener
    """Proposes first, and fills all in which something is known."""
    densities: Sequence[Density] = ()
    """Densities to choose rollouts from; without any nothing is rolled."""
    settings: ChoiceSettings = field(default_factory=ChoiceSettings)
    """When others are asked, and what counts against an answer."""

    @property
    def rough(self) -> Inbetweener:
        """The infiller."""
        return self.infiller.rough

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose by whoever costs least in each gap, one after the other in time; nothing is drawn at random."""
        first = self.infiller.propose(query, generator=generator)
        roller = Roller.of(query, first, self.densities) if self.densities else None
        best, others = _Candidate(first.motion, first.contact_logits, first.source, 0.0), list(first.others)
        for start, stop in query.enclosed_gaps:
            if _has_enough_context(query, start, stop, self.settings):
                continue
            before = replace(best, by=first.source)
            best = _choose_candidate(query, before, roller, (start, stop), self.settings)
            others.append(GapSource(start, stop, best.by))
            if roller is not None:
                roller.body, roller.contact_logits = query.to_unit_size(best.body), best.contact_logits
        chosen = replace(first, motion=best.body, contact_logits=best.contact_logits, others=tuple(others))
        return extrapolate_end(query, chosen, self.densities, RolloutSettings())


@dataclass(frozen=True, eq=False)
class _Candidate:
    """One answer for one gap."""

    body: Motion
    """All frames, on the character's bones."""
    contact_logits: Float[Tensor, "frames 2"]
    by: str
    cost: float


def _has_enough_context(query: GapQuery, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Return whether the infiller knows enough beside a gap to fill it unasked."""
    known = ~query.missing.frames
    before, after = known[max(0, start - settings.context) : start], known[stop : stop + settings.context]
    beside = min(int(before.sum()), int(after.sum()))
    return stop - start <= (settings.known if beside >= settings.context else settings.max_bare_frames)


def _choose_candidate(
    query: GapQuery, before: _Candidate, roller: Roller | None, gap: tuple[int, int], settings: ChoiceSettings
) -> _Candidate:
    """Choose the least costly of the infiller's answer, standing still, and rollouts of several tempos."""
    start, stop = gap
    first = replace(before, cost=compute_artefact_cost(before.body, before.contact_logits, gap, settings))
    calm = settings.max_step_ratio * max(settings.step, _find_largest_step(before.body, gap))
    targets = query.effector_targets
    on_the_way = targets is not None and bool(targets.wanted[start:stop].any())
    if not on_the_way and _is_standing_still(query, start, stop, settings):
        return _hold_pose(query, first, gap)
    found = [first]
    if roller is None or not settings.rolling.shortest <= stop - start <= settings.rolling.longest:
        return first
    for tempo in settings.tempos:
        if min(one.cost for one in found) < settings.acceptable_cost:
            break
        rolled = roller.roll(start, stop, torch.Generator(), replace(settings.rolling, tempo=tempo))
        body = query.to_character(rolled.body)
        cost = compute_artefact_cost(body, rolled.contact_logits, gap, settings)
        cost += settings.excess_step_weight * max(0.0, _find_largest_step(body, gap) - calm)
        cost += settings.missed * rolled.missed * PRIOR_FPS / (stop - start)
        found.append(_Candidate(body, rolled.contact_logits, f"rollout of {roller.density.name}", cost))
    return min(found, key=lambda one: one.cost)


def compute_artefact_cost(
    motion: Motion, contact_logits: Float[Tensor, "frames 2"], gap: tuple[int, int], settings: ChoiceSettings
) -> float:
    """Compute what a viewer sees of a filled gap as a speed, m/s: sliding of what the body stands on, skating toes, a
    detour, the longest time on no foot.
    """
    start, stop = gap[0] - 1, gap[1] + 1
    positions, fps = motion.joint_positions()[start:stop], float(motion.fps)
    toes, hips = positions[:, _TOES], positions[:, 0]
    height = estimate_rest_height(motion, contacts.debounced(contact_logits > 0))
    above, speeds = toes[1:, :, 1] - height, torch.diff(toes[..., ::2], dim=0).norm(dim=-1) * fps
    slide = float(contacts.support_speed(above, speeds).mean())
    skate = float((speeds * (1 - above / _SKATE_HEIGHT).clamp(0, 1)).mean())
    ground = hips[:, ::2]
    detour = float(torch.diff(ground, dim=0).norm(dim=-1).sum()) - float((ground[-1] - ground[0]).norm())
    unsupported = worst_frame.measure_longest_unsupported(toes, hips, fps)
    return (
        slide
        + settings.skate * skate
        + settings.detour_weight * detour * fps / len(positions)
        + settings.unsupported_weight * unsupported
    )


def _find_largest_step(motion: Motion, gap: tuple[int, int]) -> float:
    """Find the largest step of hands and toes in a gap, into it and out of it, seen from the hips, metres a frame."""
    shown = motion.slice(gap[0] - 1, gap[1] + 1)
    effectors = shown.joint_positions()[:, _EFFECTORS]
    return worst_frame.measure_peaks(effectors, shown.root_position, float(motion.fps)).step


def _is_standing_still(query: GapQuery, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Return whether the body has one position and pose before a gap and after it, and is at rest as far as frames
    beside it show.
    """
    positions, unknown = query.motion.joint_positions(), query.missing.frames
    apart = float((positions[stop] - positions[start - 1]).norm(dim=-1).mean())
    speeds = [0.0]
    for one, other in ((start - 2, start - 1), (stop, stop + 1)):
        if one >= 0 and other < len(positions) and not bool(unknown[[one, other]].any()):
            speeds.append(float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS)
    return apart < settings.same_pose_distance and max(speeds) < settings.at_rest


def _hold_pose(query: GapQuery, before: _Candidate, gap: tuple[int, int]) -> _Candidate:
    """Hold the pose, which changes slowly into the next."""
    part, body = slice(*gap), before.body
    root, quats, logits = body.root_position.clone(), body.local_quat_xyzw.clone(), before.contact_logits.clone()
    root[part], quats[part] = query.motion.root_position[part], query.motion.local_quat_xyzw[part]
    body = replace(body, root_position=root, local_quat_xyzw=quats)
    toes = body.joint_positions()[part, _TOES, 1]
    planted = torch.where(toes < toes.amin() + 0.025, _STANDING_CONTACT_LOGIT, -_STANDING_CONTACT_LOGIT)
    logits[part] = planted.to(logits)
    return _Candidate(body, logits, STANDING_STILL, 0.0)
