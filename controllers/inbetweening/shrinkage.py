"""Shrinkage of a proposal towards interpolation, gap by gap: no worse than that where a network is out of its depth.

A gap's answer is  b + w (p - b),  b the interpolation and p the proposal. With mean squared errors B and P of the two,
w = B^s / (B^s + P^s): for s = 1 the best weights where the errors are independent (Bates and Granger 1969). B follows
from the velocities beside the gap. P is what the network itself expects, corrected by tests where the truth is known:
frames of which the same is hidden beside the gap. The logarithm of the network's error there over the expected one
estimates that of the gap, as far as n tests discern a clip's own mean from noise (Efron and Morris 1973).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.missing import compute_velocity_share, interpolate_missing
from mapctl.inbetweening.query import GapSource, estimate_contact_logits
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import MissingMask

_SHARPNESS = 1.75  # s above: over unseen clips and their copies in varied poses the error is flat from 1.5 to 2.5
_TEST_NOISE = 0.5  # variance of a test's logarithm over that between clips, over the same
_RESOLUTION = 2e-6  # square metres: no error is known better than to 1.4 mm
_STRAIGHT_ERROR, _SPLINE_ERROR = 0.030, 0.019
"""Mean squared error of straight lines over that of the velocities beside a gap times its duration, in gaps of any
length; and what of it a cubic of the whole velocity removes: the mean square of t (1 - t) (2 - t) / 2."""
_MEDIAN, _PERCENTILE_90 = 0.85, 1.65  # of a gap's mean error, over the expected root mean square
_HOLE_DISTANCE = 10  # known frames between a gap and a hole of its length


def shrink(
    proposal: Proposal, query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator | None = None
) -> Proposal:
    """Shrink a proposal with a spread towards the query's motion in gaps with known frames on both sides of which
    nothing else is asked; the spread becomes that of the answer. The in-betweener, which proposed, is tested."""
    views = {gap: _View.of(query, gap) for gap in _find_gaps(proposal, query)}
    simple_errors = {gap: error for gap, view in views.items() if (error := view.expect_simple_error(query, gap))}
    if proposal.spread is None or not simple_errors:
        return proposal
    tests, hidden = {gap: _lay_tests(query.missing, gap) for gap in simple_errors}, query.missing
    for gap, several in tests.items():
        for hole, _ in several:
            hidden = views[gap].hide(hidden, hole)
    motion = interpolate_missing(query.motion, hidden)
    trial = replace(query, motion=motion, missing=hidden, effector_targets=None)
    tried = inbetweener.propose(trial, generator=generator) if any(tests.values()) else proposal
    simple = replace(proposal, motion=query.motion, contact_logits=estimate_contact_logits(query.motion))
    done, spread, remarks = proposal, proposal.spread.clone(), []
    for gap, simple_error in simple_errors.items():
        view, part = views[gap], slice(*gap)
        surprises = [view.measure_surprise(query, tried, judged) for _, judged in tests[gap]]
        own = view.expect_error(proposal, gap) * math.exp(sum(surprises) / (len(surprises) + _TEST_NOISE))
        weight = 1 / (1 + (own / simple_error) ** _SHARPNESS)
        done = done.lerp(simple, weight, part)
        size = math.sqrt((1 - weight) ** 2 * simple_error + weight**2 * own)
        shape = spread[part].log().mean(dim=-1, keepdim=True).exp()
        spread[part] = size * (shape / shape[:, view.shown].mean()) * torch.tensor([_MEDIAN, _PERCENTILE_90])
        if weight < 0.5:
            remark = f"{100 * (1 - weight):.0f} % interpolation: the motion is unfamiliar to the {proposal.source}"
            remarks.append(GapSource(*gap, proposal.source, remark=remark))
    return replace(done, spread=spread, others=(*proposal.others, *remarks))


_Frames = tuple[int, int]  # first frame, and one past the last


@dataclass(frozen=True)
class _View:
    """Positions that depend on what is missing in a gap; all joints that are known, and the root if it is, are held."""

    joints: Bool[Tensor, " joints"]
    """Joints whose rotations are missing."""
    root: bool
    """Whether the root position is."""
    shown: Bool[Tensor, " joints"]
    """Joints whose positions depend on these."""

    @staticmethod
    def of(query: GapQuery, gap: _Frames) -> "_View":
        missing = query.missing.slice(*gap)
        shown = ~query.known_positions[slice(*gap)].all(dim=0)
        return _View(missing.joints.any(dim=0), bool(missing.root.any()), shown)

    def compute_positions(self, motion: Motion) -> Float[Tensor, "frames shown 3"]:
        """Compute the positions, metres."""
        held = motion.local_quat_xyzw.new_tensor([0.0, 0.0, 0.0, 1.0])
        quats = torch.where(self.joints[:, None], motion.local_quat_xyzw, held)
        root = motion.root_position if self.root else torch.zeros_like(motion.root_position)
        return replace(motion, local_quat_xyzw=quats, root_position=root).joint_positions()[:, self.shown]

    def hide(self, missing: MissingMask, frames: _Frames) -> MissingMask:
        """Return the mask in which the same is missing in other frames, too."""
        joints, root = missing.joints.clone(), missing.root.clone()
        joints[slice(*frames)] |= self.joints
        root[slice(*frames)] |= self.root
        return MissingMask(joints, root)

    def expect_error(self, proposal: Proposal, frames: _Frames) -> float:
        """Compute the mean squared error that a proposal's spread expects, square metres."""
        assert proposal.spread is not None, "only proposals with a spread are judged"
        return float(proposal.spread[slice(*frames)][:, self.shown].prod(dim=-1).mean()) + _RESOLUTION

    def expect_simple_error(self, query: GapQuery, gap: _Frames) -> float | None:
        """Compute the mean squared error of interpolation that the velocities beside a gap let expect, square metres;
        None without any: bare poses are no evidence against a proposal."""
        (start, stop), known = gap, ~query.missing.frames
        positions, length = self.compute_positions(query.motion), stop - start + 1
        straight = (positions[stop] - positions[start - 1]) / length
        excess = [
            float((positions[last] - positions[last - 1] - straight).square().sum(dim=-1).mean())
            for last in (start - 1, stop + 1)
            if 0 < last < len(known) and bool(known[last - 1 : last + 1].all())
        ]
        if not excess:
            return None
        share = float(compute_velocity_share(length, fps=float(PRIOR_FPS)))
        bent = _STRAIGHT_ERROR - _SPLINE_ERROR * share**2
        return bent * length**2 * sum(excess) / len(excess) + _RESOLUTION

    def measure_surprise(self, query: GapQuery, tried: Proposal, judged: _Frames) -> float:
        """Measure the logarithm of a proposal's squared error in frames that it was not shown, over the expected."""
        truth, proposed = self.compute_positions(query.motion), self.compute_positions(tried.motion)
        error = float((truth - proposed)[slice(*judged)].square().sum(dim=-1).mean())
        return math.log((error + _RESOLUTION) / self.expect_error(tried, judged))


def _find_gaps(proposal: Proposal, query: GapQuery) -> list[_Frames]:
    """Find the gaps between known frames that are the proposer's own, without parts that are requested in them."""
    if query.keep_trajectory or query.loose is not None:
        return []
    missing, asked = query.missing.frames, query.missing.root & ~query.nothing_known
    if query.effector_targets is not None:
        asked = asked | query.effector_targets.wanted.any(dim=1)
    for other in proposal.others:
        asked[other.start : other.stop] |= other.by != proposal.source
    return [
        (start, stop)
        for _, start, stop in true_intervals(missing[:, None])
        if start > 0 and stop < len(missing) and not bool(asked[start:stop].any())
    ]


def _lay_tests(missing: MissingMask, gap: _Frames) -> list[tuple[_Frames, _Frames]]:
    """Lay a hole of the gap's length into the known frames on either side; where neither has room, hide half of those
    that there are, together with the gap. Return what is hidden in a row, and which frames of it are judged."""
    (start, stop), known, length = gap, ~missing.frames, gap[1] - gap[0]
    before, after = _count_known(known[:start].flip(0)), _count_known(known[stop:])
    holes = [
        (first, first + length)
        for room, first in ((before, start - _HOLE_DISTANCE - length), (after, stop + _HOLE_DISTANCE))
        if room >= length + 2 * _HOLE_DISTANCE
    ]
    if holes:
        return [(hole, hole) for hole in holes]
    first, last = start - min(before // 2, length), stop + min(after // 2, length)
    return [((first, last), side) for side in ((first, start), (stop, last)) if side[1] - side[0] > 1]


def _count_known(known: Bool[Tensor, " frames"]) -> int:
    """Count the known frames that are a gap's own: up to the end, or half of those up to the next gap."""
    run = int(known.long().cumprod(0).sum())
    return run if run == len(known) else run // 2
