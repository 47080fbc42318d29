"""Choice of the proposer of each gap: a network, a tweener in long gaps that the network does not fill or hardly moves
in, a stitcher where hands, feet or hips are told between two poses, a held pose where the body stands still.

Rollouts of a density have no part in it: their feet slide less as proposed, but the MAP stage plants the feet of
either, and then the pose transformer's answer is nearer to mocap in all that it fills.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from controllers.inbetweening.proposers.partial_keys import propose_through_keys
from controllers.inbetweening.proposers.rollouts import RolloutSettings, extrapolate_end
from controllers.inbetweening.proposers.slerp import StitchedInbetweener, walk_over_places
from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import INTERPOLATION
from mapctl.metrics.liveliness import measure_path_length
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES

STANDING_STILL = "standing still"
"""Name of the source of a gap in which the pose before it is held."""
_TOES = CANONICAL.indices(TOES)
_PLANTED_HEIGHT = 0.025  # metres above the lowest toe
_LIVELY = 0.5
"""Path of the joints seen from the hips, over that of the tweener, from which on a long gap without keys in it is the
network's all the same: walks it fills better, where it knows nothing it hardly moves."""
_STYLED = 60  # frames of the shortest gap that is a tweener's that was given a style: in less there is no room for one
_STITCHED = 60  # frames of the longest gap between whole poses, with partial keys in it, that is a stitcher's
_HELD = 46  # frames of the shortest gap in which a pose is held
_ASTRAY = 0.03  # metres over the ground from which on standing hips are astray, and the pose is held
_SAME_POSE_DISTANCE = 0.06  # mean distance of the joints, metres, below which two poses count as one
_AT_REST = 0.15  # mean speed of the joints beside a gap, m/s, below which the body is at rest


@dataclass(frozen=True, eq=False)
class AutoInbetweener(Inbetweener):
    """In-betweener that takes a network's proposal, except in gaps that are a tweener's or a stitcher's and where a
    pose is held; the end is extrapolated by a density.
    """

    network: Inbetweener
    """In-betweener that proposes first, and fills gaps in which something is known."""
    densities: Sequence[Density] = ()
    """Densities for the end, and for walks over places; without any both are the network's or the tweener's."""
    long: int = 181
    """Frames of the shortest gap between whole poses, with partial keys in it or none, that can be a tweener's."""
    tweener: Inbetweener | None = None
    """In-betweener for long gaps between whole poses; without one they are the network's."""
    stitcher: Callable[[], Inbetweener] | None = None
    """Loader of the stitcher, for short gaps between whole poses in which parts of the body are told; without one they
    are the network's. It is called where there is such a gap."""

    @property
    def rough(self) -> Inbetweener:
        """Rough in-betweener of the network."""
        return self.network.rough

    @property
    def takes_partial_keys(self) -> bool:
        """Whether the network does."""
        return self.network.takes_partial_keys

    @property
    def has_style(self) -> bool:
        """Whether the tweener was told one."""
        return self.tweener is not None and self.tweener.has_style

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose for each gap what its length and the poses beside it ask for.

        Loose keys are the tweener's, if there is one; keys that give positions alone are walked over by a density
        where that knows such walks.
        """
        if query.loose is not None:
            walked = walk_over_places(query, self.densities, generator)
            return walked or (self.tweener or self.network).propose(query, generator=generator)
        made = self.network.propose(query, generator=generator)
        long = [gap for gap in query.hide_partial_keys().enclosed_gaps if self._is_tweeners(query, *gap)]
        if long and self.tweener is not None:
            tweened, _ = propose_through_keys(query, self.tweener, generator)
            long = [gap for gap in long if self.has_style or not self._keeps(query, made, tweened, gap)]
            made = _fill_from(tweened, made, query, long)
        told = [gap for gap in query.hide_partial_keys().enclosed_gaps if self._is_stitchers(query, *gap)]
        if told and self.stitcher is not None:
            proposed = _Given(made)  # and not asked again for what the stitcher leaves
            stitched = StitchedInbetweener(self.stitcher(), lambda: proposed).propose(query, generator=generator)
            made = _fill_from(stitched, made, query, told)
        for gap in query.enclosed_gaps:
            # Who was told to move in a style moves; tweeners let others tremble.
            held = not self.has_style if _is_within(gap, long) else _goes_astray(query, made, gap)
            if held and _is_standing_still(query, *gap):
                made = _hold_pose(query, made, gap)
        if self.has_style:
            made = _note_no_style(query, made, [gap for gap in query.enclosed_gaps if not _is_within(gap, long)])
        return extrapolate_end(query, made, self.densities, RolloutSettings())

    def _is_tweeners(self, query: GapQuery, start: int, stop: int) -> bool:
        """Return whether a gap is the tweener's: long, or with room for the style that it was told."""
        if self.tweener is None or query.keep_trajectory:
            return False
        shortest = _STYLED if self.has_style else self.long
        return stop - start >= shortest and not _is_beside_part(query, start, stop)

    def _keeps(self, query: GapQuery, made: Proposal, tweened: Proposal, gap: tuple[int, int]) -> bool:
        """Return whether a gap stays the network's: it fills the whole of it, and the body moves there."""
        by = {source.by for source in made.attribute(query) if (source.start, source.stop) == gap}
        if INTERPOLATION in by or _has_parts_within(query, *gap):
            return False
        path, other = (measure_path_length(one.motion.slice(gap[0] - 1, gap[1] + 1)) for one in (made, tweened))
        return path >= _LIVELY * other

    def _is_stitchers(self, query: GapQuery, start: int, stop: int) -> bool:
        """Return whether a gap is the stitcher's: short, with more told in it than the poses beside it."""
        if query.keep_trajectory or self._is_tweeners(query, start, stop) or _is_beside_part(query, start, stop):
            return False
        return stop - start <= _STITCHED and _has_parts_within(query, start, stop)


@dataclass(frozen=True, eq=False)
class _Given(Inbetweener):
    """Proposes what it was given, whatever is asked."""

    proposal: Proposal

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        return self.proposal


def _is_beside_part(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether a frame beside a gap is known in part."""
    edges = [start - 1, stop]
    return bool(query.missing.joints[edges].any() | query.missing.root[edges].any())


def _has_parts_within(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether places of hands, feet or hips are told within a gap."""
    within, targets = slice(start, stop), query.effector_targets
    return bool(query.root_only_keys[within].any() or (targets is not None and targets.wanted[within].any()))


def _is_within(gap: tuple[int, int], gaps: Sequence[tuple[int, int]]) -> bool:
    """Return whether a gap is one of others, or between partial keys in one of them."""
    return any(start <= gap[0] and gap[1] <= stop for start, stop in gaps)


def _fill_from(proposal: Proposal, made: Proposal, query: GapQuery, gaps: Sequence[tuple[int, int]]) -> Proposal:
    """Fill gaps as another proposal has them."""
    sources = proposal.attribute(query)
    others = tuple(source for source in sources if _is_within((source.start, source.stop), gaps))
    return replace(made.take(proposal, gaps), others=(*made.others, *others))


def _is_standing_still(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether the body has the same whole pose and position before and after a gap, and is at rest in known
    frames beside it.
    """
    targets = query.effector_targets
    told = targets is not None and bool(targets.wanted[start:stop].any())
    if stop - start < _HELD or query.keep_trajectory or told or _is_beside_part(query, start, stop):
        return False
    positions, unknown = query.motion.joint_positions(), query.missing.frames
    apart = float((positions[stop] - positions[start - 1]).norm(dim=-1).mean())
    speeds = [0.0]
    for one, other in ((start - 2, start - 1), (stop, stop + 1)):
        if one >= 0 and other < len(positions) and not bool(unknown[[one, other]].any()):
            speeds.append(float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS)
    return apart < _SAME_POSE_DISTANCE and max(speeds) < _AT_REST


def _goes_astray(query: GapQuery, made: Proposal, gap: tuple[int, int]) -> bool:
    """Return whether a proposal takes the hips far from the straight way through a gap."""
    part = slice(*gap)
    off = (made.motion.root_position - query.motion.root_position)[part, ::2].norm(dim=-1)
    return float(off.max()) > _ASTRAY * query.scale


def _hold_pose(query: GapQuery, made: Proposal, gap: tuple[int, int]) -> Proposal:
    """Hold the pose, interpolated slowly to the next."""
    part, logits = slice(*gap), made.contact_logits.clone()
    toes = query.motion.joint_positions()[part, _TOES, 1]
    logits[part] = contacts.to_logits(toes < toes.amin() + _PLANTED_HEIGHT).to(logits)
    return _fill_from(Proposal(query.motion, logits, STANDING_STILL), made, query, [gap])


def _note_no_style(query: GapQuery, made: Proposal, gaps: Sequence[tuple[int, int]]) -> Proposal:
    """Say of gaps that they are not in the style that was told."""
    reason, sources = "too short, or with parts told, for a style", made.attribute(query)
    said = tuple(replace(one, reason=one.reason or reason) for one in sources if (one.start, one.stop) in gaps)
    return replace(made, others=(*made.others, *said))
