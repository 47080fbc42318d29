"""Fill missing frames or joints of a motion on any rig: an in-betweener proposes, MAP refines the proposal, and what is
known stays to the bit.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from controllers.common.canonical_clip import CanonicalClip
from controllers.common.map_refinement import RefinementSettings
from controllers.inbetweening.gap_notes import compose_gap_notes
from controllers.inbetweening.geometry.root_path import move_root_along_curve, move_root_over_places
from controllers.inbetweening.proposers.loose_keys import hold_loose_keys, meet_places, note_drawings, show_drawn_poses
from controllers.inbetweening.proposers.partial_keys import propose_through_keys
from controllers.inbetweening.refine import INFILL_REFINEMENT, refine_gaps
from controllers.inbetweening.shrinkage import shrink
from controllers.inbetweening.simpler import take_simpler
from controllers.inbetweening.solution import InbetweenSolution
from mapctl import contacts
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening import Proposal
from mapctl.inbetweening.effector_targets import EffectorTargets, compute_target_errors, reach_effector_targets
from mapctl.inbetweening.loose_keys import LooseKeys
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import as_rig, from_canonical, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.terms import Term

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
        firm = replace(query, missing=hold_loose_keys(query))
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
