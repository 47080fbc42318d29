"""Fill missing frames or joints of a motion on any rig: an in-betweener proposes, MAP refines the proposal, and what is
known stays to the bit.

Shrinkage of a proposal towards interpolation, gap by gap: no worse than that where a network is out of its depth.

A gap's answer is  b + w (p - b),  b the interpolation and p the proposal. With mean squared errors B and P of the two,
w = B^s / (B^s + P^s): for s = 1 the best weights where the errors are independent (Bates and Granger 1969). B follows
from the velocities beside the gap. P is what the network itself expects, corrected by tests where the truth is known:
frames of which the same is hidden beside the gap. The logarithm of the network's error there over the expected one
estimates that of the gap, as far as n tests discern a clip's own mean from noise (Efron and Morris 1973).
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from controllers.inbetweening.keyframes import fit_drawings, measure_drawing_error
from controllers.inbetweening.proposers import STANDING_STILL, propose_through_keys
from mapctl import contacts, rotations
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.effector_targets import (
    EffectorTargets,
    LooseKeys,
    compute_target_errors,
    estimate_standing_height,
    lead_over_places,
    reach_effector_targets,
)
from mapctl.inbetweening.missing import MissingMask, compute_velocity_share, interpolate_missing, restore_observed
from mapctl.inbetweening.query import GapSource, estimate_contact_logits
from mapctl.inbetweening.root_trajectory import lead_over_keys
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.kinematics import heading
from mapctl.metrics.body import measure_path_length
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.problem.solution import Ledger, Outcome, Solution, Status, WindowRecord
from mapctl.protocols import Density, Inbetweener
from mapctl.recording import Capture
from mapctl.recording.fusion import transfer_change
from mapctl.retarget import RigMap, as_rig, from_canonical, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, leg_length
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk, Term

_CONTEXT_FRAMES = 16  # frames at the prior's rate, on either side of a gap, that the MAP stage sees
_USUAL_ERROR = 0.03  # metres: median error of a joint at which the sigmas below hold
_TRUST_RANGE = (0.1, 1.0)  # of that factor; above 1 the MAP stage moved proposals no nearer to the truth
INFILL_REFINEMENT = RefinementSettings(
    uncertainty_ramp=8.0,
    unobserved_sigma_deg=2.0,
    unobserved_sigma_cm=2.0,
    jerk=Jerk(sigma=150.0, frames=96),
    clearance=Clearance(),
    footing=FootContact(0.1, 0.05, 0.05, heels=None),
    budget=Budget(evaluations=16),
    lbfgs=LbfgsSettings(max_iterations=16),
)
"""Settings about an infiller's proposal, whose error is larger than a denoiser's: heights of toes stay near the
network's, since styles differ in them, except those of toes that skate; a jerk term. More evaluations lower no
error of a gap."""


def refine_gaps(
    proposal: Proposal,
    query: GapQuery,
    targets: EffectorTargets | None,
    settings: RefinementSettings,
    densities: Sequence[Density],
    terms: Sequence[Term],
) -> tuple[Motion, Ledger, tuple[WindowRecord, ...]]:
    """Refine a proposal gap by gap; also returns the ledger and the cost of its windows."""
    motion, missing = proposal.motion, query.missing
    quats, root = motion.local_quat_xyzw.clone(), motion.root_position.clone()
    trust = None if proposal.spread is None else _compute_trust(proposal.spread)
    ledger, windows = Ledger(), []
    for first, last in _find_gap_windows(missing.frames):
        if last - first < 2:
            continue
        part, part_missing = slice(first, last), missing.slice(first, last)
        capture = Capture.of_motion(
            motion.slice(first, last),
            seen=~part_missing.joints,
            seen_root=~part_missing.root,
            sigma=torch.zeros(CANONICAL.num_joints),
            sigma_root=0.0,
        )
        refined = refine(
            motion.slice(first, last),
            proposal.contact_logits[part],
            capture,
            settings,
            densities=densities,
            targets=None if targets is None else EffectorTargets(targets.places[part], targets.wanted[part]),
            terms=terms,
            first_frame=first,
            trust=None if trust is None else trust[part],
        )
        quats[part] = torch.where(part_missing.joints[..., None], refined.motion.local_quat_xyzw, quats[part])
        root[part] = torch.where(part_missing.root[:, None], refined.motion.root_position, root[part])
        ledger, windows = ledger.join(refined.ledger), [*windows, *refined.windows]
    return replace(motion, root_position=root, local_quat_xyzw=quats), ledger, tuple(windows)


def _compute_trust(spread: Float[Tensor, "frames joints 2"]) -> Float[Tensor, "frames joints"]:
    """Compute by which factor the sigmas of a proposal change: its median error beside the usual one."""
    return (spread[..., 0] / _USUAL_ERROR).clamp(*_TRUST_RANGE).float()


def _find_gap_windows(missing: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """Find first frame and one past the last of each gap with its context; gaps whose contexts overlap are merged."""
    near = missing.clone()
    for _, start, stop in true_intervals(missing[:, None]):
        near[max(0, start - _CONTEXT_FRAMES) : stop + _CONTEXT_FRAMES] = True
    return [(start, stop) for _, start, stop in true_intervals(near[:, None])]


@dataclass(frozen=True)
class Pick:
    """Which of several answers this is."""

    name: str
    """Name of this answer."""
    energies: Mapping[str, float]
    """Mean energies of a frame by the names of all answers, nats."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class InbetweenSolution(Solution):
    """A complete motion on the given rig, at its rate, with all of its frames."""

    missing: MissingMask
    """Values that were filled in, by joint of the rig."""
    rig: Rig
    """The rig as it was identified."""
    contacts: Bool[Tensor, "frames 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=torch.bool))
    """Contacts of the left and the right toe, at PRIOR_FPS."""
    sources: tuple[GapSource, ...] = ()
    """Proposer of the motion in each gap in which nothing was known."""
    proposal_seconds: float = 0.0
    """Of `seconds`, those in which the in-betweener proposed."""
    pick: Pick | None = None
    """Which of several answers this is; None where one alone was made."""
    gap_notes: tuple[str, ...] = ()
    """A note on each of these gaps: proposer, error estimate, remarks."""

    @property
    def frame_ms(self) -> float:
        """Compute of each filled frame, milliseconds."""
        return 1000 * self.seconds / max(1, int(self.missing.frames.sum()))

    def list_gaps(self) -> list[dict[str, Any]]:
        """List what was filled in: frames, how many joints of the rig, and whether the body's position was missing."""
        joints, root = self.missing.joints, self.missing.root
        return [
            {
                "start": start,
                "stop": stop,
                "joints": int(joints[start:stop].any(dim=0).sum()),
                "root": bool(root[start:stop].any()),
            }
            for _, start, stop in true_intervals(self.missing.frames[:, None])
        ]

    def details(self) -> dict[str, Any]:
        """Return gaps, who filled them, contacts at PRIOR_FPS, and compute of each filled frame.

        `sides_apart_cm` is the farthest at which two sides met, if any did; `fallback` lists gaps, in frames at
        PRIOR_FPS, that were not the in-betweener's that was asked for.
        """
        apart = [100 * source.apart for source in self.sources if source.apart is not None]
        return {
            "gaps": self.list_gaps(),
            "gap_notes": list(self.gap_notes),
            "fallback": [
                {"start": source.start, "stop": source.stop, "by": source.by, "reason": source.reason}
                for source in self.sources
                if source.reason
            ],
            **({"sides_apart_cm": max(apart)} if apart else {}),
            **({"picked": self.pick.name, "draws": dict(self.pick.energies)} if self.pick else {}),
            "timing": {
                "draw_ms": 1000 * self.proposal_seconds,
                "finish_ms": 1000 * (self.seconds - self.proposal_seconds),
            },
            "contacts": self.contacts.tolist(),
            "frame_ms": self.frame_ms,
        }


_TIE_FRAMES = 1e-6  # frames


@dataclass(frozen=True, eq=False)
class CanonicalClip:
    """A clip with missing values, on its own rig and on canonical joints."""

    original: Motion
    """The clip as given; its missing values may be anything."""
    missing: MissingMask
    """Missing values, by joint of the rig."""
    interpolated: Motion
    """The clip with its missing values interpolated."""
    canonical: Motion
    """The interpolated clip on canonical joints and the performer's bones, at its own rate."""
    rigmap: RigMap
    """Map from the rig to canonical joints."""

    @staticmethod
    def of(motion: Motion, missing: MissingMask, rig: Rig | None = None) -> "CanonicalClip":
        """Make a clip canonical; `rig` overrides recognition. RequestError for a rig that is not recognised."""
        interpolated = interpolate_missing(motion, missing)
        return CanonicalClip(motion, missing, interpolated, *to_canonical(interpolated, rig))

    def query(
        self,
        *,
        effector_targets: EffectorTargets | None = None,
        keep_trajectory: bool = False,
        loose: LooseKeys | None = None,
    ) -> GapQuery:
        """Build the query for in-betweeners, at PRIOR_FPS; targets and loose keys are by frame of the clip.

        A frame of the query between two of the clip is the nearby frame with the fewest missing values, if that has
        fewer than the two.
        """
        canonical, missing = self.canonical, self.missing
        whole = _resample_to_end(canonical)
        at = torch.arange(whole.num_frames, dtype=torch.float64) * float(canonical.fps) / PRIOR_FPS
        at = at.clamp(max=canonical.num_frames - 1)
        low = (at + 1e-9).floor().long()
        high = torch.where(at - low > _TIE_FRAMES, low + 1, low).clamp(max=canonical.num_frames - 1)
        missing_values = torch.cat([missing.joints, missing.root[:, None]], dim=1)
        best = _find_most_complete_frames(at, missing_values.sum(dim=1))
        snapped = missing_values[best].sum(dim=1) < (missing_values[low] | missing_values[high]).sum(dim=1)
        at = torch.where(snapped, best.to(at), at)
        low, high = torch.where(snapped, best, low), torch.where(snapped, best, high)
        quats = torch.where(snapped[:, None, None], canonical.local_quat_xyzw[best], whole.local_quat_xyzw)
        root = torch.where(snapped[:, None], canonical.root_position[best], whole.root_position)
        shown = replace(whole, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))
        joints, seconds = self._missing_canonical_joints(), at / float(canonical.fps)
        if effector_targets is not None:
            effector_targets = effector_targets.shown(seconds, fps=float(canonical.fps))
        if loose is not None:
            loose = loose.shown(seconds, fps=float(canonical.fps))
        mask = MissingMask(joints[low] | joints[high], missing.root[low] | missing.root[high])
        return GapQuery(shown, mask, seconds, effector_targets, keep_trajectory, loose)

    def back(self, made: Motion, query: GapQuery) -> Motion:
        """Return an answer to the query on the rig, at the clip's rate, with blended seams and what is known to the
        bit. If the answer is the query's own interpolation, return the interpolation on the rig.
        """
        filled = self.interpolated
        if made is not query.motion or query.keep_trajectory or query.loose is not None:
            at_prior_rate = self.canonical.fps == PRIOR_FPS
            own = made if at_prior_rate else transfer_change(self.canonical, query.motion, made, query.seconds)
            filled = from_canonical(own, self.rigmap, self.interpolated)
            filled = self._blend_seams(restore_observed(filled, self.interpolated, self.missing))
        return self.restore_observed(filled)

    def restore_observed(self, motion: Motion) -> Motion:
        """Return the original with its missing values from a motion on its rig."""
        return restore_observed(motion, self.original, self.missing)

    def _missing_canonical_joints(self) -> Bool[Tensor, "frames joints"]:
        """Find the canonical joints whose rotation is missing; an End Site rotates with its parent."""
        columns = []
        for joint, own in enumerate(self.rigmap.joint_of):
            columns.append(columns[CANONICAL.parents[joint]] if own is None else self.missing.joints[:, own])
        return torch.stack(columns, dim=1)

    def _blend_seams(self, filled: Motion) -> Motion:
        fps, missing = float(self.original.fps), self.missing
        moving = {
            joint: blend_seams_in_positions(values, missing.root, fps=fps)
            for joint, values in filled.moving_offsets.items()
        }
        return replace(
            filled,
            moving_offsets=moving,
            root_position=blend_seams_in_positions(filled.root_position, missing.root, fps=fps),
            local_quat_xyzw=blend_seams_in_rotations(filled.local_quat_xyzw, missing.joints, fps=fps),
        )


def _resample_to_end(canonical: Motion) -> Motion:
    """Resample to PRIOR_FPS; an end that is far from the last frame there gets a frame of its own."""
    last = canonical.num_frames - 1
    moments = int(last * PRIOR_FPS / canonical.fps) + 1
    over = last * PRIOR_FPS / canonical.fps - (moments - 1)
    if over <= Fraction(1, 2):
        return canonical.resample(PRIOR_FPS)
    frame = torch.arange(canonical.num_frames + math.ceil(canonical.fps / PRIOR_FPS)).clamp(max=last)
    held = replace(
        canonical, root_position=canonical.root_position[frame], local_quat_xyzw=canonical.local_quat_xyzw[frame]
    )
    return held.resample(PRIOR_FPS).slice(0, moments + 1)


def _find_most_complete_frames(
    at: Float[Tensor, " shown"], missing_counts: Int[Tensor, " frames"]
) -> Int[Tensor, " shown"]:
    """Find for each time, in frames of the clip, the frame with the fewest missing values of those nearer to it than to
    another time; the nearest of several; any other frame if there is none.
    """
    edges = (at[1:] + at[:-1]) / 2 + _TIE_FRAMES  # a frame midway between two times belongs to the earlier one
    beyond = at.new_full((1,), torch.inf)
    own, last = at.round().long(), len(missing_counts) - 1
    reach = math.ceil(float(torch.diff(at).max()) / 2) + 1 if len(at) > 1 else last
    frames = own[:, None] + torch.arange(-reach, reach + 1)
    near = (frames > torch.cat([-beyond, edges])[:, None]) & (frames <= torch.cat([edges, beyond])[:, None])
    inside = near & (frames >= 0) & (frames <= last)
    frames = frames.clamp(0, last)
    cost = missing_counts[frames] + (frames - at[:, None]).abs() / (2 * reach + 2)
    best = torch.where(inside, cost, torch.inf).argmin(dim=1, keepdim=True)
    return torch.where(inside.any(dim=1), frames.gather(1, best)[:, 0], missing_counts.argmax())


_SHARPNESS = 1.75  # s above: over unseen clips and their copies in varied poses the error is flat from 1.5 to 2.5
_TEST_NOISE = 0.5  # variance of a test's logarithm over that between clips, over the same
_RESOLUTION = 2e-6  # square metres: no error is known better than to 1.4 mm
_STRAIGHT_ERROR, _SPLINE_ERROR = 0.030, 0.019
"""Mean squared error of straight lines over that of the velocities beside a gap times its duration, in gaps of any
length; and what of it a cubic of the whole velocity removes: the mean square of t (1 - t) (2 - t) / 2."""
_MEDIAN, _PERCENTILE_90 = 0.85, 1.65  # of a gap's mean error, over the expected root mean square
_HOLE_DISTANCE = 10  # known frames between a gap and a hole of its length


@dataclass(frozen=True)
class _Frames:
    """Frames from `start` up to `stop`."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def part(self) -> slice:
        """The frames as a slice."""
        return slice(self.start, self.stop)


def shrink(
    proposal: Proposal, query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator | None = None
) -> Proposal:
    """Shrink a proposal with a spread towards the query's motion in gaps with known frames on both sides of which
    nothing else is asked; the spread becomes that of the answer. The in-betweener, which proposed, is tested."""
    views = {gap: _View.of(query, gap) for gap in _find_gaps(proposal, query)}
    simple_errors = {gap: error for gap, view in views.items() if (error := view.expect_simple_error(query, gap))}
    views = {gap: views[gap] for gap in simple_errors}
    if proposal.spread is None or not views:
        return proposal
    tests, hidden = {gap: _lay_tests(query.missing, gap) for gap in views}, query.missing
    for gap, several in tests.items():
        for hole, _ in several:
            hidden = views[gap].hide(hidden, hole)
    trial = replace(query, motion=interpolate_missing(query.motion, hidden), missing=hidden)
    tried = inbetweener.propose(trial, generator=generator) if any(tests.values()) else proposal
    simple = replace(proposal, motion=query.motion, contact_logits=estimate_contact_logits(query.motion))
    done, spread, remarks = proposal, proposal.spread.clone(), []
    for gap, view in views.items():
        surprises = [view.measure_surprise(query, tried, judged) for _, judged in tests[gap]]
        own = view.expect_error(proposal, gap) * math.exp(sum(surprises) / (len(surprises) + _TEST_NOISE))
        weight = 1 / (1 + (own / simple_errors[gap]) ** _SHARPNESS)
        done = done.lerp(simple, weight, gap.part)
        size = math.sqrt((1 - weight) ** 2 * simple_errors[gap] + weight**2 * own)
        shape = spread[gap.part].log().mean(dim=-1, keepdim=True).exp()
        shape = shape / shape[:, view.shown].mean()
        spread[gap.part] = size * shape * torch.tensor([_MEDIAN, _PERCENTILE_90])
        if weight < 0.5:
            remark = f"{100 * (1 - weight):.0f} % interpolation: the motion is unfamiliar to the {proposal.source}"
            remarks.append(GapSource(gap.start, gap.stop, proposal.source, remark=remark))
    return replace(done, spread=spread, others=(*proposal.others, *remarks))


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
        """Return the view of a gap."""
        missing = query.missing.slice(gap.start, gap.stop)
        shown = ~query.known_positions[gap.part].all(dim=0)
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
        joints[frames.part] |= self.joints
        root[frames.part] |= self.root
        return MissingMask(joints, root)

    def expect_error(self, proposal: Proposal, frames: _Frames) -> float:
        """Compute the mean squared error that a proposal's spread expects, square metres."""
        assert proposal.spread is not None, "only proposals with a spread are judged"
        return float(proposal.spread[frames.part][:, self.shown].prod(dim=-1).mean()) + _RESOLUTION

    def expect_simple_error(self, query: GapQuery, gap: _Frames) -> float | None:
        """Compute the mean squared error of interpolation that the velocities beside a gap let expect, square metres;
        None without any: bare poses are no evidence against a proposal."""
        positions, known, length = self.compute_positions(query.motion), ~query.missing.frames, len(gap) + 1
        straight = (positions[gap.stop] - positions[gap.start - 1]) / length
        excess = [
            float((positions[last] - positions[last - 1] - straight).square().sum(dim=-1).mean())
            for last in (gap.start - 1, gap.stop + 1)
            if 0 < last < len(known) and bool(known[last - 1 : last + 1].all())
        ]
        if not excess:
            return None
        share = float(compute_velocity_share(length, fps=float(PRIOR_FPS)))
        bent = _STRAIGHT_ERROR - _SPLINE_ERROR * share**2
        return bent * length**2 * sum(excess) / len(excess) + _RESOLUTION

    def measure_surprise(self, query: GapQuery, tried: Proposal, judged: _Frames) -> float:
        """Measure the logarithm of a proposal's squared error in frames that it was not shown, over the expected."""
        truth, made = self.compute_positions(query.motion), self.compute_positions(tried.motion)
        error = float((truth - made)[judged.part].square().sum(dim=-1).mean())
        return math.log((error + _RESOLUTION) / self.expect_error(tried, judged))


def _find_gaps(proposal: Proposal, query: GapQuery) -> list[_Frames]:
    """Find the gaps between known frames that are the proposer's own, without parts that are asked for in them."""
    if query.keep_trajectory or query.loose is not None:
        return []
    missing, asked = query.missing.frames, query.missing.root & ~query.nothing_known
    if query.effector_targets is not None:
        asked = asked | query.effector_targets.wanted.any(dim=1)
    for other in proposal.others:
        asked[other.start : other.stop] |= other.by != proposal.source
    return [
        _Frames(start, stop)
        for _, start, stop in true_intervals(missing[:, None])
        if start > 0 and stop < len(missing) and not bool(asked[start:stop].any())
    ]


def _lay_tests(missing: MissingMask, gap: _Frames) -> list[tuple[_Frames, _Frames]]:
    """Lay a hole of the gap's length into the known frames on either side; where neither has room, hide half of those
    that there are, together with the gap. Return what is hidden in a row, and which frames of it are judged."""
    known, length = ~missing.frames, len(gap)
    before, after = _count_known(known[: gap.start].flip(0)), _count_known(known[gap.stop :])
    holes = [
        _Frames(start, start + length)
        for room, start in ((before, gap.start - _HOLE_DISTANCE - length), (after, gap.stop + _HOLE_DISTANCE))
        if room >= length + 2 * _HOLE_DISTANCE
    ]
    if holes:
        return [(hole, hole) for hole in holes]
    wider = _Frames(gap.start - min(before // 2, length), gap.stop + min(after // 2, length))
    sides = (_Frames(wider.start, gap.start), _Frames(gap.stop, wider.stop))
    return [(wider, side) for side in sides if len(side) > 1]


def _count_known(known: Bool[Tensor, " frames"]) -> int:
    """Count the known frames that are a gap's own: up to the end, or half of those up to the next gap."""
    run = int(known.long().cumprod(0).sum())
    return run if run == len(known) else run // 2


_INFILLER, _INFILLER_FRAMES = "infiller", 75
"""Name of the source whose longest gaps in training were of so many frames: their mean length and a deviation."""
_TRAVELLING_SPEED = 0.35  # m/s of hips with canonical legs, from one end of a gap to the other: a body that travels
_MORPH_RATIO, _MIN_MORPH_FRAMES = 1.3, 45
"""Largest ratio of a morph's path to the straight one, and fewest frames: an interpolation instead of a motion."""
_STILL_SPEED = 0.12  # m/s of the joints below which a body is still: there is no motion to miss


def compose_gap_notes(query: GapQuery, made: Motion, answer: Proposal, *, fps: float) -> tuple[str, ...]:
    """Compose a line for each gap of a proposal, in frames of the motion at `fps`; gaps without remarks share one by
    proposer.
    """
    sources = answer.attribute(query)
    lines: list[str] = []
    plain: dict[str, list[GapSource]] = {}
    for source in sources:
        remarks = _describe_gap(query, made, source)
        if not remarks and source.by == answer.source:
            plain.setdefault(source.by, []).append(source)
        else:
            lines.append(_join_remarks([source], query, answer, remarks, fps))
    return (*lines, *(_join_remarks(each, query, answer, [], fps) for each in plain.values()))


def _join_remarks(
    sources: Sequence[GapSource], query: GapQuery, answer: Proposal, remarks: Sequence[str], fps: float
) -> str:
    """Join the frames, the proposer, the error estimate (of the gap with the largest), and further remarks."""
    where = ", ".join(_format_frames(query, source, fps) for source in sources)
    found = [answer.spread[one.start : one.stop] for one in sources if answer.spread is not None]
    sure = []
    if found and sources[0].by == answer.source:
        median, percentile_90 = max(
            (100 * each.mean(dim=(0, 1)) for each in found), key=lambda one: float(one[1])
        ).tolist()
        sure = [
            f"by its own estimate joints within {median:.1f} cm of the truth in half of cases and within"
            f" {percentile_90:.1f} cm in nine of ten"
        ]
    return f"frames {where}: {', '.join([sources[0].by, *sure, *remarks])}"


def _format_frames(query: GapQuery, source: GapSource, fps: float) -> str:
    """Format a gap in frames of the motion's own rate."""
    first = 0 if source.start == 0 else round(float(query.seconds[source.start - 1]) * fps) + 1
    last = len(query.seconds) - 1
    stop = round(float(query.seconds[min(source.stop, last)]) * fps)
    return f"{first}:{stop + (source.stop > last)}"


def _describe_gap(query: GapQuery, made: Motion, source: GapSource) -> list[str]:
    """List remarks on one gap beyond its proposer and error estimate."""
    remarks, seconds = [*filter(None, (source.reason, source.remark))], (source.stop - source.start) / PRIOR_FPS
    if source.stop - source.start > _INFILLER_FRAMES and source.by == _INFILLER:
        remarks.append(f"and {seconds:.1f} s are longer than the {_INFILLER_FRAMES / PRIOR_FPS:.0f} s that it knows")
    if _is_morph(query, made, source):
        remarks.append("a still morph: it goes hardly further than straight from one pose to the other; give more keys")
    return remarks


def is_travelling(motion: Motion, start: int, stop: int) -> bool:
    """Return whether the body (canonical joints) travels in a gap, faster than a shift of weight."""
    distance = float((motion.root_position[stop] - motion.root_position[start])[::2].norm())
    fastest_still = _TRAVELLING_SPEED * (stop - start) / float(motion.fps)
    return distance * leg_length(CANONICAL) / leg_length(motion.skeleton) > fastest_still


def _is_morph(query: GapQuery, made: Motion, source: GapSource) -> bool:
    """Return whether a long gap is filled by little more than an interpolation although the body moves around it."""
    if source.stop - source.start < _MIN_MORPH_FRAMES or source.by == STANDING_STILL:
        return False
    first, end = max(0, source.start - 1), min(source.stop + 1, query.motion.num_frames)
    path_length, straight = (measure_path_length(each.slice(first, end)) for each in (made, query.motion))
    travelling = is_travelling(query.motion, max(0, source.start - 1), min(source.stop, len(query.missing.root) - 1))
    speed, straight_speed = (each * PRIOR_FPS / (source.stop - source.start) for each in (path_length, straight))
    still = straight_speed < _STILL_SPEED and _is_still_beside(query, source)
    return speed < max(_STILL_SPEED, _MORPH_RATIO * straight_speed) and (travelling or not still)


def _is_still_beside(query: GapQuery, source: GapSource) -> bool:
    """Return whether known frames beside a gap, if there are any, hardly move."""
    positions = query.motion.joint_positions()
    for one, other in ((source.start - 2, source.start - 1), (source.stop, source.stop + 1)):
        if one < 0 or other >= len(positions) or bool(query.missing.root[[one, other]].any()):
            continue
        if float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS > _STILL_SPEED:
            return False
    return True


_MAX_EDGE_DISTANCE = 1.0  # metres from a gap's edge to the curve


def move_root_along_curve(motion: Motion, missing: Bool[Tensor, " frames"], curve: Curve) -> Motion:
    """Move and orient the hips of a canonical motion along the curve, at constant speed, in frames in which they are
    missing.

    The offset from the curve is interpolated from one edge of a gap to the other. RequestError for a gap that begins or
    ends far from the curve.
    """
    if curve.dims != 2:
        raise RequestError("the hips follow a curve on the ground, of x and z")
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    facing = heading(quats[:, 0])
    for _, start, stop in true_intervals(missing[:, None]):
        edges = [frame for frame in (start - 1, stop) if 0 <= frame < motion.num_frames]
        if len(edges) == 1:
            raise RequestError(f"the gap {start}:{stop} has one edge only: a curve needs both")
        arcs = curve.nearest(root[edges][:, ::2])
        offsets = root[edges][:, ::2] - curve.point(arcs)
        if (far := float(offsets.norm(dim=-1).max())) > _MAX_EDGE_DISTANCE:
            raise RequestError(
                f"the gap {start}:{stop} begins or ends {far:.1f} m beside the curve;"
                f" {_MAX_EDGE_DISTANCE:g} m is the most"
            )
        share = (torch.arange(start, stop) - (start - 1)).double() / (stop - start + 1)
        first, last = arcs
        if curve.closed and last < first:
            last = last + curve.length
        at = first + share * (last - first)
        position = curve.point(at) + _interpolate_edges(offsets, share)
        turns = curve.heading(torch.stack([first, last])) - facing[edges]
        turn = curve.heading(at) - _interpolate_edges(rotations.wrap_angle(turns)[:, None], share)[:, 0]
        root[start:stop, 0], root[start:stop, 2] = position[:, 0], position[:, 1]
        own = rotations.about_y(turn - heading(quats[start:stop, 0]))
        quats[start:stop, 0] = rotations.multiply(own, quats[start:stop, 0])
    return replace(motion, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))


def _interpolate_edges(
    ends: Float[Tensor, "2 width"], share: Float[Tensor, " frames"]
) -> Float[Tensor, "frames width"]:
    return torch.lerp(ends[0], ends[1], share[:, None])


def move_root_over_places(
    motion: Motion, missing_root: Bool[Tensor, " frames"], missing_hips: Bool[Tensor, " frames"], loose: LooseKeys
) -> Motion:
    """Move the hips of a canonical motion over the places of loose keys where their position is missing, and turn them
    along that way where no frame tells their rotation. At a height that no frame tells they stand."""
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    ground = torch.where(loose.placed[:, None], loose.ground, root[:, ::2])
    facing = heading(quats[:, 0])
    way, looked = lead_over_places(
        ground[None], facing[None], placed=(loose.placed | ~missing_root)[None], faced=~missing_hips[None]
    )
    root[:, ::2] = torch.where(missing_root[:, None], way[0], root[:, ::2])
    if bool(missing_root.all()):
        root[:, 1] = estimate_standing_height(motion.skeleton)
    turn = torch.where(missing_hips, looked[0] - facing, 0.0)
    quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    return replace(motion, root_position=root, local_quat_xyzw=quats)


_MOST = 130.0  # m/s^2 of a joint over 1/30 s: one frame in a thousand of mocap's has more


def take_simpler(made: Motion, simple: Motion, missing: MissingMask) -> tuple[Motion, tuple[str, ...]]:
    """Take the simple answer in gaps whose result, beside the known frames or between them, is accelerated more than
    anything in the clip, than mocap and than the simple one; also return a note of each. Both motions are equal where
    nothing is missing."""
    lost, step = missing.frames, max(1, round(float(made.fps) / PRIOR_FPS))
    if made.num_frames < 2 * step + 1 or not bool(lost.any()):
        return made, ()
    known = ~lost.unfold(0, 2 * step + 1, 1).any(dim=-1)
    bends, simple_bends = _compute_accelerations(made, step), _compute_accelerations(simple, step)
    limit, poor = max([_MOST, *bends[known].tolist()]), torch.zeros_like(lost)
    notes = []
    for _, start, stop in true_intervals(lost[:, None]):
        rows = slice(max(0, start - 2 * step), min(len(bends), stop))
        strain, other = (float(each[rows].max()) / limit for each in (bends, simple_bends))
        if strain > max(1.0, other):
            poor[start:stop] = True
            notes.append(
                f"frames {start}:{stop}: interpolation; the result was {strain:.1f} times as abrupt as any capture"
            )
    taken = MissingMask(missing.joints & poor[:, None], missing.root & poor)
    return restore_observed(simple, made, taken), tuple(notes)


def _compute_accelerations(motion: Motion, step: int) -> Float[Tensor, " bends"]:
    """Compute the largest acceleration of any joint about each frame, m/s^2, over so many frames before and after."""
    positions = motion.joint_positions()
    bends = positions[2 * step :] - 2 * positions[step:-step] + positions[: -2 * step]
    return bends.norm(dim=-1).amax(dim=-1) * (float(motion.fps) / step) ** 2


_REPORTED_PLACE_ERROR = 0.03  # metres from where a joint is drawn, on average, beyond which there is a note


def show_drawn_poses(query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator) -> GapQuery:
    """Return a query that has poses instead of drawings, fitted about what an in-betweener proposes; their place stays
    open where it is not told."""
    loose = query.loose
    if loose is None or not bool(loose.drawn.any()):
        return query
    first = inbetweener.propose(query, generator=generator).motion
    fitted = fit_drawings(first, loose, faced=not bool(query.missing.joints[:, 0].all()))
    drawn = loose.drawings
    root, quats = query.motion.root_position.clone(), query.motion.local_quat_xyzw.clone()
    quats[drawn], root[drawn, 1] = fitted.local_quat_xyzw[drawn], fitted.root_position[drawn, 1]
    missing = MissingMask(query.missing.joints & ~drawn[:, None], query.missing.root)
    shown = interpolate_missing(replace(query.motion, local_quat_xyzw=quats), missing)
    places = replace(loose, drawn=torch.zeros_like(loose.drawn))
    return replace(query, motion=replace(shown, root_position=root), missing=missing, loose=places)


def meet_places(proposal: Proposal, query: GapQuery) -> Proposal:
    """Lead the hips of a proposal over the places of loose keys."""
    if query.loose is None or not bool(query.loose.placed.any()):
        return proposal
    motion, known, lost = proposal.motion, query.motion.root_position, query.missing.root
    root = lead_over_keys(motion.root_position, known, lost, query.loose)
    return replace(proposal, motion=replace(motion, root_position=root))


def note_drawings(motion: Motion, query: GapQuery) -> tuple[str, ...]:
    """Note drawings of a query that a motion does not look like."""
    if query.loose is None:
        return ()
    places, frames = motion.joint_positions(), query.loose.drawings.nonzero()[:, 0].tolist()
    missed = {frame: measure_drawing_error(places[frame], query.loose, frame) for frame in frames}
    return tuple(
        f"at {float(query.seconds[frame]):.2f} s joints stay {100 * error:.0f} cm from where they are drawn, on"
        " average: bones do not look so"
        for frame, error in missed.items()
        if error > _REPORTED_PLACE_ERROR
    )


_REPORTED_ERROR = 0.001  # metres from a target beyond which there is a note
_REACH_TOLERANCE = 1e-4  # metres from a target within which it is reached
_MAX_REACH_ATTEMPTS = 6
_PLACE_SECONDS = 0.5  # over which what the hips are moved by fades away from a place


@dataclass(frozen=True)
class InfillSettings:
    """Settings of in-betweening."""

    finish: bool = True
    """Whether MAP refines the proposal; if not it stays as proposed, on rigid bones and with exact keys."""
    refinement: RefinementSettings = field(default_factory=lambda: INFILL_REFINEMENT)
    """Sigmas and search of the MAP stage."""


def fill(
    motion: Motion,
    missing: MissingMask,
    inbetweener: Inbetweener,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    targets: EffectorTargets | None = None,
    loose: LooseKeys | None = None,
    curve: Curve | None = None,
    generator: torch.Generator | None = None,
) -> InbetweenSolution:
    """Fill missing values of a motion.

    `targets` are positions of the rig's hands and feet in frames in which they are missing, `loose` places over the
    ground and drawings in such frames; the hips follow `curve` while they are missing. The MAP stage adds `terms`, and
    the likeliest of `densities` its likelihood; RequestError for terms where it is left out.
    """
    settings, began = settings or InfillSettings(), time.perf_counter()
    if terms and not settings.finish:
        raise RequestError("terms belong to the MAP stage, which is left out")
    generator = generator or torch.Generator().manual_seed(0)
    clip = CanonicalClip.of(motion, missing, rig)
    if curve is not None:
        clip = replace(clip, canonical=move_root_along_curve(clip.canonical, missing.root, curve))
    if loose is not None:
        clip = _lead_over_places(clip, loose)
    query = clip.query(effector_targets=targets, keep_trajectory=curve is not None, loose=loose)
    asked, query = query, show_drawn_poses(query, inbetweener, generator)
    answer, reached = propose_through_keys(query, inbetweener, generator)
    answer = meet_places(shrink(answer, query, inbetweener.rough, generator), query)
    proposed = time.perf_counter()
    made, ledger, windows = answer.motion, Ledger(), ()
    if settings.finish:
        # The hips stay at the positions of loose keys, over the ground and as high as proposed.
        root = query.missing.root if query.loose is None else query.missing.root & ~query.loose.placed
        firm = replace(query, missing=MissingMask(query.missing.joints, root))
        made, ledger, windows = refine_gaps(answer, firm, reached, settings.refinement, densities, terms)
    done, unreached = _reach_targets(clip, clip.back(made, asked), targets)
    done, abrupt = _meet_places(clip, done, loose), ()
    if targets is None and loose is None and curve is None:
        done, abrupt = take_simpler(done, clip.restore_observed(clip.interpolated), missing)
    status = (
        Status(Outcome.DONE).with_notes(_note_open_ends(clip, answer, loose)).with_notes(note_drawings(made, asked))
    )
    status = status.with_notes(abrupt).with_notes(unreached, infeasible=bool(unreached))
    return InbetweenSolution(
        done,
        status,
        ledger,
        windows,
        seconds=time.perf_counter() - began,
        proposal_seconds=proposed - began,
        missing=missing,
        rig=as_rig(clip.rigmap),
        contacts=contacts.debounced(answer.contact_logits > 0),
        sources=answer.attribute(query),
        gap_notes=compose_gap_notes(query, made, answer, fps=float(motion.fps)),
    )


def _lead_over_places(clip: CanonicalClip, loose: LooseKeys) -> CanonicalClip:
    """Lead the interpolation between keys over the places of loose ones."""
    hips = clip.rigmap.joint_of[0]
    turned = clip.missing.root if hips is None else clip.missing.joints[:, hips]
    return replace(clip, canonical=move_root_over_places(clip.canonical, clip.missing.root, turned, loose))


def _meet_places(clip: CanonicalClip, filled: Motion, loose: LooseKeys | None) -> Motion:
    """Move the hips, smoothly, by the little that resampling and the MAP stage leave them from their places."""
    if loose is None or not bool(loose.placed.any()):
        return filled
    canonical, rigmap = to_canonical(filled, as_rig(clip.rigmap))
    root, free = canonical.root_position.clone(), clip.missing.root
    off = torch.where((loose.placed & free)[:, None], loose.ground - root[:, ::2], 0.0)
    moved = interpolate_offsets(off, loose.placed | ~free, seconds=_PLACE_SECONDS, fps=float(filled.fps))
    root[:, ::2] += torch.where(free[:, None], moved, 0.0)
    return clip.restore_observed(from_canonical(replace(canonical, root_position=root), rigmap, filled))


def _note_open_ends(clip: CanonicalClip, answer: Proposal, loose: LooseKeys | None) -> tuple[str, ...]:
    """Note which in-betweener extrapolates gaps that have one edge only."""
    notes, missing = [], clip.missing.root if loose is None else clip.missing.root & ~loose.placed & ~loose.drawings
    if bool(missing[0]):
        by = answer.source
        notes.append(
            f"a gap at the beginning: the motion is extended backwards by {by}, with nothing before it to meet"
        )
    if bool(missing[-1]):
        end = max(answer.others, key=lambda one: one.stop, default=None)
        by = end.by if end is not None and end.stop == answer.motion.num_frames else answer.source
        notes.append(f"a gap at the end: the motion is extended by {by}, with nothing after it to meet")
    return tuple(notes)


def _reach_targets(
    clip: CanonicalClip, filled: Motion, targets: EffectorTargets | None
) -> tuple[Motion, tuple[str, ...]]:
    """Bend limbs until they are at their targets; and note those that are out of reach."""
    if targets is None:
        return filled, ()
    canonical, rigmap = to_canonical(filled, as_rig(clip.rigmap))
    aim, done, errors = targets, filled, torch.full((1,), torch.inf)
    for _ in range(_MAX_REACH_ATTEMPTS):
        there = reach_effector_targets(canonical, aim, clip.missing.frames)
        done = clip.restore_observed(from_canonical(there, rigmap, filled))
        found = rig_joint_positions(done, rigmap)
        before, errors = errors, compute_target_errors(found, targets)
        if float(errors.max()) < _REACH_TOLERANCE or float((errors - before).abs().max()) < _REACH_TOLERANCE:
            break
        # Joints that only the rig has offset an effector from its canonical position.
        aim = EffectorTargets(targets.places + there.joint_positions() - found, targets.wanted)
    if float(errors.max()) <= _REPORTED_ERROR:
        return done, ()
    worst = int(errors.argmax())
    return done, (f"frame {worst}: a limb stays {100 * float(errors.max()):.1f} cm from its target, out of reach",)
