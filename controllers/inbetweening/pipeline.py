"""Make whole what lacks frames or joints, on any rig: an infiller proposes joint positions (infilling paper), inverse
kinematics makes them rotations of rigid bones, and the MAP stage puts the feet down; what is known stays to the bit.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.gap_notes import compose_gap_notes
from controllers.inbetweening.geometry.root_path import move_root_along_curve
from controllers.inbetweening.geometry.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from controllers.inbetweening.proposers.answers import GapSource, Proposer
from controllers.inbetweening.proposers.partial_keys import propose_through
from controllers.inbetweening.refine import INFILL_REFINEMENT, refine_gaps
from mapctl import contacts, rotations
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets, compute_target_errors, reach_effector_targets
from mapctl.inbetweening.missing import MissingMask, interpolate_missing, restore_observed
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.frequency_bands import upsample
from mapctl.retarget import from_canonical, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig

InfillMethod = Literal["infiller", "map", "linear"]
_REPORTED_MISS = 0.001  # metres from a wanted place that are worth a word
_REACH_TOLERANCE = 1e-4  # metres from it that are nothing
_MAX_REACH_ATTEMPTS = 6  # tries at most


@dataclass(frozen=True)
class InfillSettings:
    """How gaps are filled."""

    method: InfillMethod = "map"
    """`infiller` leaves the proposal as it is, but for rigid bones; `map` finishes it; `linear` knows no network."""
    refinement: RefinementSettings = field(default_factory=lambda: INFILL_REFINEMENT)
    """The MAP stage."""


@dataclass(frozen=True, eq=False)
class InfillResult:
    """A whole motion, and how it became so."""

    motion: Motion
    """On the given rig, at its rate, with all of its frames."""
    lost: MissingMask
    """What was filled in."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted, at the prior's rate."""
    ledger: Ledger
    """Of the MAP stage, by term and frame at the prior's rate, of the frames that it saw."""
    seconds: float = 0.0
    """Compute, wall clock."""
    notes: tuple[str, ...] = ()
    """What the user should know."""
    sources: tuple[GapSource, ...] = ()
    """Who proposed what in gaps in which nothing was known."""
    gap_notes: tuple[str, ...] = ()
    """A line on each of these: who, how sure, and what nobody knows."""

    def summary(self) -> dict[str, Any]:
        """For a report, in plain numbers."""
        filled = int(self.lost.frames.sum())
        gaps = [
            {
                "start": start,
                "stop": stop,
                "joints": int(self.lost.joints[start:stop].any(dim=0).sum()),
                "root": bool(self.lost.root[start:stop].any()),
            }
            for _, start, stop in true_intervals(self.lost.frames[:, None])
        ]
        return {
            "frames": self.motion.num_frames,
            "fps": float(self.motion.fps),
            "gaps": gaps,
            "ledger": self.ledger.summary(),
            "seconds": self.seconds,
            "frame_ms": 1000 * self.seconds / max(1, filled),
            "contacts": [[bool(bit) for bit in row] for row in self.contacts.tolist()],
            "notes": list(self.notes),
            "gap_notes": list(self.gap_notes),
        }


def fill(
    motion: Motion,
    lost: MissingMask,
    infiller: Inbetweener | None,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    rig: Rig | None = None,
    targets: EffectorTargets | None = None,
    course: Curve | None = None,
    another: Proposer | None = None,
) -> InfillResult:
    """What is lost of a motion, filled in; RequestError for a method without its network.

    `targets` are places that the rig's hands and feet are wanted at in frames in which they are lost; along `course`
    the hips go while they are; `another` proposal may take the place of the infiller's.
    """
    settings, began = settings or InfillSettings(), time.perf_counter()
    if infiller is None and settings.method != "linear":
        raise RequestError(f"method {settings.method} needs an infiller")
    base = interpolate_missing(motion, lost)
    if settings.method == "linear" or infiller is None:
        nothing = torch.zeros(0, 2, dtype=torch.bool)
        done, notes = _reach_targets(restore_observed(base, motion, lost), targets, lost, motion, rig)
        return InfillResult(done, lost, nothing, Ledger(), time.perf_counter() - began, notes)
    canonical, rigmap = to_canonical(base, rig)
    if course is not None:
        canonical = move_root_along_curve(canonical, lost.root, course)
    gap = CanonicalGap.of(canonical, lost, rigmap.joint_of)
    shown = None if targets is None else targets.shown(gap.seconds, fps=float(motion.fps))
    answer, shown = propose_through(gap, infiller, shown, held=course is not None, another=another)
    stands, ledger, made = contacts.debounced(answer.odds > 0), Ledger(), answer.motion
    if settings.method == "map":
        made, ledger = refine_gaps(made, answer.odds, gap, settings.refinement, densities, shown)
    filled = from_canonical(_resample_like(canonical, made, gap.seconds), rigmap, base)
    done = _blend_seams(restore_observed(filled, base, lost), lost, motion)
    done, notes = _reach_targets(done, targets, lost, motion, rig)
    gaps = compose_gap_notes(gap, made, answer.sources, fps=float(motion.fps))
    return InfillResult(done, lost, stands, ledger, time.perf_counter() - began, notes, answer.sources, gaps)


def note_open_ends(lost: MissingMask, first: str, by: str) -> tuple[str, ...]:
    """On gaps that have one edge only: who extends the motion into the first, and into the last."""
    notes = []
    if bool(lost.root[0]):
        notes.append(
            f"a gap at the beginning: the motion is extended backwards by the {first}, with nothing before it to meet"
        )
    if bool(lost.root[-1]):
        notes.append(f"a gap at the end: the motion is extended by the {by}, with nothing after it to meet")
    return tuple(notes)


def _resample_like(canonical: Motion, proposal: Motion, seconds: Float[Tensor, " shown"]) -> Motion:
    """The proposal at the given motion's rate, by splines through its frames."""
    if canonical.fps == PRIOR_FPS:
        return proposal
    frames, fps = canonical.num_frames, float(canonical.fps)
    quats = rotations.make_sign_continuous(proposal.local_quat_xyzw)
    quats = torch.nn.functional.normalize(upsample(quats, seconds, fps=fps, frames=frames), dim=-1)
    return replace(
        canonical,
        root_position=upsample(proposal.root_position, seconds, fps=fps, frames=frames),
        local_quat_xyzw=quats,
    )


def _blend_seams(filled: Motion, lost: MissingMask, original: Motion) -> Motion:
    """On the rig, with seams that run on; what is known is the original's."""
    fps = float(original.fps)
    moving = {
        joint: blend_seams_in_positions(values, lost.root, fps=fps) for joint, values in filled.moving_offsets.items()
    }
    closed = replace(
        filled,
        moving_offsets=moving,
        root_position=blend_seams_in_positions(filled.root_position, lost.root, fps=fps),
        local_quat_xyzw=blend_seams_in_rotations(filled.local_quat_xyzw, lost.joints, fps=fps),
    )
    return restore_observed(closed, original, lost)


def _reach_targets(
    filled: Motion, targets: EffectorTargets | None, lost: MissingMask, original: Motion, rig: Rig | None
) -> tuple[Motion, tuple[str, ...]]:
    """With limbs that are at their places to the hair; and a word on those that do not reach."""
    if targets is None:
        return filled, ()
    canonical, rigmap = to_canonical(filled, rig)
    aim, done, away = targets, filled, torch.full((1,), torch.inf)
    for _ in range(_MAX_REACH_ATTEMPTS):
        there = reach_effector_targets(canonical, aim, lost.frames)
        done = restore_observed(from_canonical(there, rigmap, filled), original, lost)
        found = rig_joint_positions(done, rigmap)
        before, away = away, compute_target_errors(found, targets)
        if float(away.max()) < _REACH_TOLERANCE or float((away - before).abs().max()) < _REACH_TOLERANCE:
            break
        # Joints that only the rig has carry a limb's end elsewhere than on canonical joints.
        aim = EffectorTargets(targets.places + there.joint_positions() - found, targets.wanted)
    notes = ()
    if float(away.max()) > _REPORTED_MISS:
        worst = int(away.argmax())
        notes = (f"frame {worst}: a limb stays {100 * float(away.max()):.1f} cm from its place, out of reach",)
    return done, notes
