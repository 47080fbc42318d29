"""Choice of the proposer of each gap: a network with enough context, a rollout where the network would slide, a held
pose where the body stands still.

Between poses that are seconds apart a network's proposal is the mean of many motions: feet float and slide. The
likelihood does not show it, since a mean is likely; visible artefacts do: skating feet, a detour of the body, a limb
that jumps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.proposers.extrapolation import extrapolate_end
from controllers.inbetweening.proposers.rollouts import Roller, RolloutSettings
from controllers.inbetweening.proposers.walked import PlaceWalker
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


@dataclass(frozen=True)
class ChoiceSettings:
    """Thresholds at which other proposers are tried, and weights of the cost of a proposal."""

    max_bare_frames: int = 45
    """Frames of the longest gap with little context in which only the network is tried."""
    context: int = 8
    """Known frames on both sides of a gap that are enough context for the network."""
    known: int = 60
    """Frames of the longest gap with enough context in which only the network is tried."""
    long: int = 181
    """Frames of the shortest gap between whole poses that is a tweener's."""
    styled: int = 60
    """And where the tweener was told a style: in less than 2 s there is no room for one."""
    acceptable_cost: float = 0.2
    """Cost, m/s, of a proposal below which no other one is tried."""
    tempos: tuple[float, ...] = (1.0, 0.94, 1.06)
    """Tempos of rollouts in the order in which they are tried: their length relative to the gap's before time is
    warped. Steps then end earlier or later, which a rollout that starts from one pose cannot choose otherwise."""
    same_pose_distance: float = 0.06
    """Mean distance of the joints, metres, below which two poses count as one."""
    at_rest: float = 0.15
    """Mean speed of the joints beside a gap, m/s, below which the body is at rest."""
    skate: float = 0.5
    """Weight of skating toes beside sliding of the support."""
    detour_weight: float = 0.5
    """Weight of the trajectory's excess length over the straight one, m/s for m/s."""
    unsupported_weight: float = 0.5
    """Weight of the longest time on no planted foot, m/s for a second."""
    missed: float = 0.3
    """Weight of a rollout's error at arrival, per second of the gap: m/s for a metre."""
    max_step_ratio: float = 1.3
    """Largest ratio of the step of hands and feet in a frame to that of the network's proposal, which is calm."""
    step: float = 0.08
    """Step of hands and feet in a frame that is always allowed, metres."""
    excess_step_weight: float = 8.0
    """Weight of a step beyond both, m/s for a metre."""
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
    """Settings of rollouts: the likeliest ones, without a swarm before L-BFGS, which did not lower the cost here."""


@dataclass(frozen=True, eq=False)
class AutoInbetweener(Inbetweener):
    """In-betweener that takes a network's proposal, except in gaps where a rollout or a held pose has a lower cost;
    the end is extrapolated by a density.
    """

    network: Inbetweener
    """In-betweener that proposes first, and fills gaps in which something is known."""
    densities: Sequence[Density] = ()
    """Densities for rollouts; without any nothing is rolled."""
    settings: ChoiceSettings = field(default_factory=ChoiceSettings)
    """Thresholds and weights of the choice."""
    tweener: Inbetweener | None = None
    """In-betweener for long gaps between whole poses; without one they are the others'."""

    @property
    def rough(self) -> Inbetweener:
        """Rough in-betweener of the network."""
        return self.network.rough

    @property
    def takes_partial_keys(self) -> bool:
        """Whether the network does; rollouts then leave gaps with such keys to it."""
        return self.network.takes_partial_keys

    @property
    def has_style(self) -> bool:
        """Whether the tweener was told one."""
        return self.tweener is not None and self.tweener.has_style

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the candidate with the lowest cost in each gap, one after the other in time, without sampling.

        Loose keys are the tweener's, if there is one; places that are all that is told are walked over by a density
        where that knows such walks.
        """
        if query.loose is not None:
            walked = PlaceWalker(tuple(self.densities)).propose(query, generator=generator)
            return walked or (self.tweener or self.network).propose(query, generator=generator)
        first = self.network.propose(query, generator=generator)
        gaps = [gap for gap in query.enclosed_gaps if not _has_enough_context(query, *gap, self.settings)]
        if self.takes_partial_keys:
            gaps = [gap for gap in gaps if not _has_partial_keys(query, *gap)]
        long = self._propose_long(query, gaps, generator)
        roller = Roller.of(query, first, self.densities) if self.densities and gaps else None
        best, others = _Candidate(first.motion, first.contact_logits, first.source, 0.0), list(first.others)
        unfilled = {other.start: other.by for other in first.others}
        for start, stop in gaps:
            before = replace(best, by=unfilled.get(start, first.source))
            if long is not None and self._is_tweeners(query, start, stop):
                best = _fill_from(long, before, (start, stop))
                if not self.has_style:
                    best = _choose_still(query, best, (start, stop), self.settings)
            else:
                best = _choose_candidate(query, before, roller, (start, stop), self.settings)
            told = first.others if long is None or best.by != long.source else long.others
            reason = next((other.reason for other in told if other.start == start), "")
            others.append(GapSource(start, stop, best.by, reason or self._note_no_style(query, start, stop)))
            if roller is not None:
                roller.body, roller.contact_logits = query.to_unit_size(best.body), best.contact_logits
        if self.has_style:
            told = {other.start for other in others}
            short = [gap for gap in query.enclosed_gaps if gap[0] not in told]
            others += [GapSource(*gap, first.source, self._note_no_style(query, *gap)) for gap in short]
        chosen = replace(first, motion=best.body, contact_logits=best.contact_logits, others=tuple(others))
        return extrapolate_end(query, chosen, self.densities, RolloutSettings())

    def _propose_long(
        self, query: GapQuery, gaps: Sequence[tuple[int, int]], generator: torch.Generator | None
    ) -> Proposal | None:
        """Return the tweener's proposal, where there is a tweener and a gap for it."""
        if self.tweener is None or query.keep_trajectory:
            return None
        wanted = any(self._is_tweeners(query, *gap) for gap in gaps)
        return self.tweener.propose(query, generator=generator) if wanted else None

    def _note_no_style(self, query: GapQuery, start: int, stop: int) -> str:
        """Say where a style was told and a gap is not the tweener's."""
        lost = self.has_style and (query.keep_trajectory or not self._is_tweeners(query, start, stop))
        return "too short, or with parts told, for a style" if lost else ""

    def _is_tweeners(self, query: GapQuery, start: int, stop: int) -> bool:
        """Return whether a gap is the tweener's: long, or with room for the style that it was told."""
        shortest = self.settings.styled if self.has_style else self.settings.long
        return stop - start >= shortest and not _has_partial_keys(query, start, stop)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """One candidate for one gap."""

    body: Motion
    """All frames, on the character's bones."""
    contact_logits: Float[Tensor, "frames 2"]
    by: str
    cost: float


def _has_enough_context(query: GapQuery, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Return whether a gap has enough context that only the infiller is tried."""
    known = ~query.missing.frames
    before, after = known[max(0, start - settings.context) : start], known[stop : stop + settings.context]
    beside = min(int(before.sum()), int(after.sum()))
    return stop - start <= (settings.known if beside >= settings.context else settings.max_bare_frames)


def _has_partial_keys(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether a hand or a foot has a target in a gap, or a frame beside it is known in part."""
    targets, missing = query.effector_targets, query.missing
    edges = [start - 1, stop]
    partly = missing.joints[edges].any() | missing.root[edges].any()
    return bool(partly) or (targets is not None and bool(targets.wanted[start:stop].any()))


def _fill_from(proposal: Proposal, before: _Candidate, gap: tuple[int, int]) -> _Candidate:
    """Fill a gap as another proposal has it."""
    part, body, logits = slice(*gap), before.body, before.contact_logits.clone()
    root, quats = body.root_position.clone(), body.local_quat_xyzw.clone()
    root[part], quats[part] = proposal.motion.root_position[part], proposal.motion.local_quat_xyzw[part]
    logits[part] = proposal.contact_logits[part].to(logits)
    return _Candidate(replace(body, root_position=root, local_quat_xyzw=quats), logits, proposal.source, 0.0)


def _choose_still(query: GapQuery, made: _Candidate, gap: tuple[int, int], settings: ChoiceSettings) -> _Candidate:
    """Hold the pose where the body stands still; else take what is made."""
    return _hold_pose(query, made, gap) if _is_standing_still(query, *gap, settings) else made


def _choose_candidate(
    query: GapQuery, before: _Candidate, roller: Roller | None, gap: tuple[int, int], settings: ChoiceSettings
) -> _Candidate:
    """Choose the least costly of the network's proposal, standing still, and rollouts of several tempos."""
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
    """Compute the cost of visible artefacts in a filled gap as a speed, m/s: sliding of the support, skating toes, a
    detour, the longest unsupported time.
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
    """Find the largest step of hands and toes relative to the hips in a gap and across its edges, metres a frame."""
    shown = motion.slice(gap[0] - 1, gap[1] + 1)
    effectors = shown.joint_positions()[:, _EFFECTORS]
    return worst_frame.measure_peaks(effectors, shown.root_position, float(motion.fps)).step


def _is_standing_still(query: GapQuery, start: int, stop: int, settings: ChoiceSettings) -> bool:
    """Return whether the body has the same pose and position before and after a gap, and is at rest in known frames
    beside it.
    """
    positions, unknown = query.motion.joint_positions(), query.missing.frames
    apart = float((positions[stop] - positions[start - 1]).norm(dim=-1).mean())
    speeds = [0.0]
    for one, other in ((start - 2, start - 1), (stop, stop + 1)):
        if one >= 0 and other < len(positions) and not bool(unknown[[one, other]].any()):
            speeds.append(float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS)
    return apart < settings.same_pose_distance and max(speeds) < settings.at_rest


def _hold_pose(query: GapQuery, before: _Candidate, gap: tuple[int, int]) -> _Candidate:
    """Hold the pose, interpolated slowly to the next."""
    part, body = slice(*gap), before.body
    root, quats, logits = body.root_position.clone(), body.local_quat_xyzw.clone(), before.contact_logits.clone()
    root[part], quats[part] = query.motion.root_position[part], query.motion.local_quat_xyzw[part]
    body = replace(body, root_position=root, local_quat_xyzw=quats)
    toes = body.joint_positions()[part, _TOES, 1]
    logits[part] = contacts.to_logits(toes < toes.amin() + _SKATE_HEIGHT).to(logits)
    return _Candidate(body, logits, STANDING_STILL, 0.0)
