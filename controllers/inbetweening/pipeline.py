"""Fill missing frames or joints of a motion on any rig: an in-betweener proposes, MAP refines the proposal, and what is
known stays to the bit."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, TypedDict, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from controllers.inbetweening.keyframes import fit_drawings, measure_drawing_error
from controllers.inbetweening.proposers import propose_through_keys
from controllers.inbetweening.shrinkage import shrink
from controllers.shots.uneven import Footing
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
    lead_over_positions,
    reach_effector_targets,
)
from mapctl.inbetweening.missing import blend_seams, interpolate_missing
from mapctl.inbetweening.query import GapSource
from mapctl.inbetweening.root_trajectory import lead_over_keys
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals, widen
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.problem.solution import Ledger, Outcome, Solution, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.recording import Capture
from mapctl.recording.fusion import transfer_change
from mapctl.recording.masks import MissingMask, restore_observed
from mapctl.retarget import RigMap, as_rig, from_canonical, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk, Term

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


class FillOptions(TypedDict, total=False):
    """Options of every job that fills gaps."""

    refinement: RefinementSettings | None
    """How MAP refines the proposal, as by INFILL_REFINEMENT if not given; None leaves it as proposed, on rigid bones
    and with exact keys."""
    densities: Sequence[Density]
    """Densities of which the likeliest joins the MAP stage."""
    terms: Sequence[Term]
    """Terms that join the MAP stage."""
    rig: Rig | None
    """The motion's rig, where it is not the one that would be recognised."""
    generator: torch.Generator | None
    """Source of all random draws; one with seed 0 if not given."""


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
    """The part of `seconds` spent on the in-betweener's proposal."""
    gap_notes: tuple[str, ...] = ()
    """A note on each of these gaps: proposer, error estimate, remarks."""
    footing: Footing | None = None
    """How feet stand and swing on a ground that is not flat."""

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
        """Return gaps with their sources, contacts at PRIOR_FPS, and compute of each filled frame.

        `sides_apart_cm` is the farthest at which two sides met, if any did; `fallback` lists gaps, in frames at
        PRIOR_FPS, that were not the in-betweener's that was requested.
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
            **({} if self.footing is None else {"footing": self.footing.as_row()}),
            "timing": {
                "draw_ms": 1000 * self.proposal_seconds,
                "finish_ms": 1000 * (self.seconds - self.proposal_seconds),
            },
            "contacts": self.contacts.tolist(),
            "frame_ms": self.frame_ms,
        }


_CONTEXT_FRAMES = 16  # frames at the prior's rate, on either side of a gap, that the MAP stage sees
_USUAL_ERROR = 0.03  # metres: median error of a joint at which the sigmas of INFILL_REFINEMENT hold
_TRUST_RANGE = (0.1, 1.0)  # of an error over the usual one; above 1 MAP moved proposals no nearer to the truth


def fill(
    motion: Motion,
    missing: MissingMask,
    inbetweener: Inbetweener,
    *,
    targets: EffectorTargets | None = None,
    loose: LooseKeys | None = None,
    curve: Curve | None = None,
    **options: Unpack[FillOptions],
) -> InbetweenSolution:
    """Fill missing values of a motion.

    `targets` are positions of the rig's hands and feet in frames in which they are missing, `loose` positions over the
    ground and drawings in such frames; the hips follow `curve` while they are missing. RequestError for terms where the
    MAP stage is left out.
    """
    refinement, began = options.get("refinement", INFILL_REFINEMENT), time.perf_counter()
    if options.get("terms") and refinement is None:
        raise RequestError("terms belong to the MAP stage, which is left out")
    generator = options.get("generator") or torch.Generator().manual_seed(0)
    # The query: the clip at the prior's rate on canonical joints, led along what is requested.
    clip = CanonicalClip.of(motion, missing, options.get("rig"))
    if curve is not None:
        clip = replace(clip, canonical=_lead_along_curve(clip.canonical, missing.root, curve))
    if loose is not None:
        clip = replace(clip, canonical=_lead_over_ground(clip, loose))
    asked = clip.query(effector_targets=targets, keep_trajectory=curve is not None, loose=loose)
    query = _pose_drawings(asked, inbetweener, generator)
    # The proposal, on the keys and shrunk towards interpolation as far as it is doubtful.
    answer, reached = propose_through_keys(query, inbetweener, generator)
    answer = shrink(answer, query, inbetweener.rough, generator)
    if query.loose is not None and bool(query.loose.placed.any()):
        known = query.motion.root_position
        root = lead_over_keys(answer.motion.root_position, known, query.missing.root, query.loose)
        answer = replace(answer, motion=replace(answer.motion, root_position=root))
    proposed = time.perf_counter()
    # MAP, gap by gap with its context. The hips stay at the positions of loose keys, and as high as proposed.
    canonical, ledger, windows = answer.motion, Ledger(), ()
    quats, root = canonical.local_quat_xyzw.clone(), canonical.root_position.clone()
    unknown_root = query.missing.root if query.loose is None else query.missing.root & ~query.loose.placed
    unknown = MissingMask(query.missing.joints, unknown_root)
    spread = answer.spread
    trust = None if spread is None else (spread[..., 0] / _USUAL_ERROR).clamp(*_TRUST_RANGE).float()
    near = widen(unknown.frames, _CONTEXT_FRAMES)  # gaps whose contexts overlap are one window
    for _, first, last in true_intervals(near[:, None]):
        if refinement is None or last - first < 2:
            continue
        part, part_unknown = slice(first, last), unknown.slice(first, last)
        proposal = canonical.slice(first, last)
        refined = refine(
            proposal,
            answer.contact_logits[part],
            Capture.of_motion(
                proposal,
                seen=~part_unknown.joints,
                seen_root=~part_unknown.root,
                sigma=torch.zeros(CANONICAL.num_joints),
                sigma_root=0.0,
            ),
            refinement,
            densities=options.get("densities", ()),
            targets=None if reached is None else EffectorTargets(reached.positions[part], reached.wanted[part]),
            terms=options.get("terms", ()),
            first_frame=first,
            trust=None if trust is None else trust[part],
        )
        quats[part] = torch.where(part_unknown.joints[..., None], refined.motion.local_quat_xyzw, quats[part])
        root[part] = torch.where(part_unknown.root[:, None], refined.motion.root_position, root[part])
        ledger, windows = ledger.join(refined.ledger), (*windows, *refined.windows)
    if refinement is not None:
        canonical = replace(canonical, root_position=root, local_quat_xyzw=quats)
    # The result on the rig: seams, then targets and positions to the millimetre.
    done, unreached = _reach_targets(clip, clip.back(canonical, asked), targets)
    done, abrupt = _meet_positions(clip, done, loose), ()
    if targets is None and loose is None and curve is None:
        done, abrupt = take_simpler(done, clip.restore_observed(clip.interpolated), missing)
    notes = (*_note_open_ends(clip, answer, loose), *_note_drawings(canonical, asked), *abrupt)
    return InbetweenSolution(
        done,
        Status(Outcome.DONE).with_notes(notes).with_notes(unreached, infeasible=bool(unreached)),
        ledger,
        windows,
        seconds=time.perf_counter() - began,
        proposal_seconds=proposed - began,
        missing=missing,
        rig=as_rig(clip.rigmap),
        contacts=contacts.debounced(answer.contact_logits > 0),
        sources=answer.attribute(query),
        gap_notes=_note_gaps(query, answer, clip),
    )


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

        In a frame of the query is missing what is in either of the two of the clip about it, but no more than in the
        most complete one nearby: less than 1/60 s from a known value, its interpolation is as good as known.
        """
        canonical, missing = self.canonical, self.missing
        shown = _resample_to_end(canonical)
        at = torch.arange(shown.num_frames, dtype=torch.float64) * float(canonical.fps) / PRIOR_FPS
        at = at.clamp(max=canonical.num_frames - 1)
        low = (at + 1e-9).floor().long()
        high = torch.where(at - low > _TIE_FRAMES, low + 1, low).clamp(max=canonical.num_frames - 1)
        missing_values = torch.cat([missing.joints, missing.root[:, None]], dim=1)
        best = _find_most_complete_frames(at, missing_values.sum(dim=1))
        fuller = missing_values[best].sum(dim=1) < (missing_values[low] | missing_values[high]).sum(dim=1)
        low, high = torch.where(fuller, best, low), torch.where(fuller, best, high)
        joints, fps = self._missing_canonical_joints(), float(canonical.fps)
        seconds, mask = at / fps, MissingMask(joints[low] | joints[high], missing.root[low] | missing.root[high])
        targets = effector_targets and effector_targets.shown(seconds, fps=fps)
        return GapQuery(shown, mask, seconds, targets, keep_trajectory, loose and loose.shown(seconds, fps=fps))

    def back(self, generated: Motion, query: GapQuery) -> Motion:
        """Return an answer to the query on the rig, at the clip's rate, with blended seams and what is known to the
        bit. If the answer is the query's own interpolation, return the interpolation on the rig."""
        filled = self.interpolated
        if generated is not query.motion or query.keep_trajectory or query.loose is not None:
            if self.canonical.fps != PRIOR_FPS:
                generated = transfer_change(self.canonical, query.motion, generated, query.seconds)
            filled = from_canonical(generated, self.rigmap, self.interpolated)
            filled = blend_seams(restore_observed(filled, self.interpolated, self.missing), self.missing)
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


def _resample_to_end(canonical: Motion) -> Motion:
    """Resample to PRIOR_FPS; an end that is far from the last frame there gets a frame of its own."""
    last = canonical.num_frames - 1
    moments = int(last * PRIOR_FPS / canonical.fps) + 1
    over = last * PRIOR_FPS / canonical.fps - (moments - 1)
    if over <= Fraction(1, 2):
        return canonical.resample(PRIOR_FPS)
    frame = torch.arange(canonical.num_frames + math.ceil(canonical.fps / PRIOR_FPS)).clamp(max=last)
    return canonical.pick(frame).resample(PRIOR_FPS).slice(0, moments + 1)


def _find_most_complete_frames(
    at: Float[Tensor, " shown"], missing_counts: Int[Tensor, " frames"]
) -> Int[Tensor, " shown"]:
    """Find for each time, in frames of the clip, the frame with the fewest missing values of those nearer to it than to
    another time; the nearest of several; any other frame if there is none."""
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


_MAX_EDGE_DISTANCE = 1.0  # metres from a gap's edge to the curve


def _lead_along_curve(motion: Motion, missing: Bool[Tensor, " frames"], curve: Curve) -> Motion:
    """Move and orient the hips of a canonical motion along the curve, at constant speed, in frames in which they are
    missing. The offset from the curve is interpolated from one edge of a gap to the other. RequestError for a gap that
    begins or ends far from the curve."""
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
        position = curve.point(at) + torch.lerp(offsets[0], offsets[1], share[:, None])
        turns = curve.heading(torch.stack([first, last])) - facing[edges]
        turns = rotations.wrap_angle(turns)
        turn = curve.heading(at) - torch.lerp(turns[0], turns[1], share)
        root[start:stop, ::2] = position
        own = rotations.about_y(turn - heading(quats[start:stop, 0]))
        quats[start:stop, 0] = rotations.multiply(own, quats[start:stop, 0])
    return replace(motion, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))


def _lead_over_ground(clip: CanonicalClip, loose: LooseKeys) -> Motion:
    """Lead the canonical hips over the positions of loose keys where their position is missing, and turn them along
    that trajectory where no frame gives their rotation. At a height that no frame gives they stand."""
    motion, missing_root, hips = clip.canonical, clip.missing.root, clip.rigmap.joint_of[0]
    missing_hips = missing_root if hips is None else clip.missing.joints[:, hips]
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    ground = torch.where(loose.placed[:, None], loose.ground, root[:, ::2])
    facing = heading(quats[:, 0])
    led, looked = lead_over_positions(
        ground[None], facing[None], placed=(loose.placed | ~missing_root)[None], faced=~missing_hips[None]
    )
    root[:, ::2] = torch.where(missing_root[:, None], led[0], root[:, ::2])
    if bool(missing_root.all()):
        root[:, 1] = estimate_standing_height(motion.skeleton)
    turn = torch.where(missing_hips, looked[0] - facing, 0.0)
    quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def _pose_drawings(query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator) -> GapQuery:
    """Return a query that has poses instead of drawings, fitted about what an in-betweener proposes; their position
    stays open where it is not given."""
    loose = query.loose
    if loose is None or not bool(loose.drawn.any()):
        return query
    first, drawn = inbetweener.propose(query, generator=generator).motion, loose.drawings
    fitted = fit_drawings(first, loose, faced=not bool(query.missing.joints[:, 0].all()))
    root, quats = query.motion.root_position.clone(), query.motion.local_quat_xyzw.clone()
    quats[drawn], root[drawn, 1] = fitted.local_quat_xyzw[drawn], fitted.root_position[drawn, 1]
    missing = MissingMask(query.missing.joints & ~drawn[:, None], query.missing.root)
    shown = interpolate_missing(replace(query.motion, local_quat_xyzw=quats), missing)
    positions = replace(loose, drawn=torch.zeros_like(loose.drawn))
    return replace(query, motion=replace(shown, root_position=root), missing=missing, loose=positions)


_POSITION_SECONDS = 0.5  # over which what the hips are moved by fades away from a position
_REPORTED_ERROR = 0.001  # metres from a target beyond which there is a note
_REACH_TOLERANCE = 1e-4  # metres from a target within which it is reached
_MAX_REACH_ATTEMPTS = 6


def _meet_positions(clip: CanonicalClip, filled: Motion, loose: LooseKeys | None) -> Motion:
    """Move the hips, smoothly, by the little that resampling and the MAP stage leave them from their positions."""
    if loose is None or not bool(loose.placed.any()):
        return filled
    canonical, rigmap = to_canonical(filled, as_rig(clip.rigmap))
    root, free = canonical.root_position.clone(), clip.missing.root
    off = torch.where((loose.placed & free)[:, None], loose.ground - root[:, ::2], 0.0)
    moved = interpolate_offsets(off, loose.placed | ~free, seconds=_POSITION_SECONDS, fps=float(filled.fps))
    root[:, ::2] += torch.where(free[:, None], moved, 0.0)
    return clip.restore_observed(from_canonical(replace(canonical, root_position=root), rigmap, filled))


def _reach_targets(
    clip: CanonicalClip, filled: Motion, targets: EffectorTargets | None
) -> tuple[Motion, tuple[str, ...]]:
    """Bend limbs until they are at their targets; also note those that are out of reach."""
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
        aim = EffectorTargets(targets.positions + there.joint_positions() - found, targets.wanted)
    if float(errors.max()) <= _REPORTED_ERROR:
        return done, ()
    worst = int(errors.argmax())
    return done, (f"frame {worst}: a limb stays {100 * float(errors.max()):.1f} cm from its target, out of reach",)


def _note_gaps(query: GapQuery, answer: Proposal, clip: CanonicalClip) -> tuple[str, ...]:
    """Note each gap of a proposal, in frames of the clip: proposer, error estimate (of the gap with the largest) and
    remarks. Gaps without remarks share one note by proposer."""
    fps, lost = float(clip.original.fps), torch.cat([clip.missing.joints, clip.missing.root[:, None]], dim=1)
    edges = [0, *((lost[1:] != lost[:-1]).any(dim=1).nonzero()[:, 0] + 1).tolist(), len(lost)]
    noted: dict[object, list[GapSource]] = {}
    for number, source in enumerate(answer.attribute(query)):
        plain = not (source.reason or source.remark) and source.by == answer.source
        noted.setdefault(source.by if plain else number, []).append(source)
    notes = []
    for key, sources in sorted(noted.items(), key=lambda item: isinstance(item[0], str)):
        frames, words = [], [sources[0].by]
        for source in sources:
            inside = math.ceil(float(query.seconds[source.start]) * fps - _TIE_FRAMES)
            last = max(inside, math.floor(float(query.seconds[source.stop - 1]) * fps + _TIE_FRAMES))
            first, stop = max(edge for edge in edges if edge <= inside), min(edge for edge in edges if edge > last)
            frames.append(f"{first}:{stop}")
        if answer.spread is not None and sources[0].by == answer.source:
            errors = [100 * answer.spread[one.start : one.stop].mean(dim=(0, 1)) for one in sources]
            median, percentile_90 = max(errors, key=lambda error: float(error[1])).tolist()
            words.append(
                f"by its own estimate joints within {median:.1f} cm of the truth in half of cases and within"
                f" {percentile_90:.1f} cm in nine of ten"
            )
        if not isinstance(key, str):
            words += filter(None, (sources[0].reason, sources[0].remark))
        notes.append(f"frames {', '.join(frames)}: {', '.join(words)}")
    return tuple(notes)


def _note_open_ends(clip: CanonicalClip, answer: Proposal, loose: LooseKeys | None) -> tuple[str, ...]:
    """Note which in-betweener extrapolates gaps that have one edge only."""
    notes, missing = [], clip.missing.root if loose is None else clip.missing.root & ~loose.placed & ~loose.drawings
    if bool(missing[0]):
        notes.append(
            f"a gap at the beginning: the motion is extended backwards by {answer.source}, with nothing before it to"
            " meet"
        )
    if bool(missing[-1]):
        at_end = [other.by for other in answer.others if other.stop == answer.motion.num_frames]
        by = at_end[0] if at_end else answer.source
        notes.append(f"a gap at the end: the motion is extended by {by}, with nothing after it to meet")
    return tuple(notes)


_REPORTED_DRAWING_ERROR = 0.03  # metres from where a joint is drawn, on average, beyond which there is a note


def _note_drawings(motion: Motion, query: GapQuery) -> tuple[str, ...]:
    """Note drawings of a query that a motion does not look like."""
    if query.loose is None:
        return ()
    positions, frames = motion.joint_positions(), query.loose.drawings.nonzero()[:, 0].tolist()
    missed = {frame: measure_drawing_error(positions[frame], query.loose, frame) for frame in frames}
    return tuple(
        f"at {float(query.seconds[frame]):.2f} s joints stay {100 * error:.0f} cm from where they are drawn, on"
        " average: bones do not look so"
        for frame, error in missed.items()
        if error > _REPORTED_DRAWING_ERROR
    )


_MOST = 130.0  # m/s^2 of a joint over 1/30 s: one frame in a thousand of mocap's has more


def take_simpler(generated: Motion, simple: Motion, missing: MissingMask) -> tuple[Motion, tuple[str, ...]]:
    """Take the simple answer in gaps whose result, beside the known frames or between them, is accelerated more than
    anything in the clip, than mocap and than the simple one; also return a note of each. Both motions are equal where
    nothing is missing."""
    lost, step = missing.frames, max(1, round(float(generated.fps) / PRIOR_FPS))
    if generated.num_frames < 2 * step + 1 or not bool(lost.any()):
        return generated, ()
    known = ~lost.unfold(0, 2 * step + 1, 1).any(dim=-1)
    bends, simple_bends = _compute_accelerations(generated, step), _compute_accelerations(simple, step)
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
    return restore_observed(simple, generated, taken), tuple(notes)


def _compute_accelerations(motion: Motion, step: int) -> Float[Tensor, " bends"]:
    """Compute the largest acceleration of any joint about each frame, m/s^2, over so many frames before and after."""
    positions = motion.joint_positions()
    bends = positions[2 * step :] - 2 * positions[step:-step] + positions[: -2 * step]
    return bends.norm(dim=-1).amax(dim=-1) * (float(motion.fps) / step) ** 2
