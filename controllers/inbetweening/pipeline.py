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

from controllers.common.map_refinement import StandingSettings
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.gap_notes import notes_of
from controllers.inbetweening.geometry.root_path import along
from controllers.inbetweening.geometry.seam_blending import closed_places, closed_rotations
from controllers.inbetweening.proposers.answers import Another, GapSource
from controllers.inbetweening.proposers.partial_keys import propose_through
from controllers.inbetweening.refine import FINISHING, stood
from mapctl import contacts, rotations
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import Targets, missed, reached
from mapctl.inbetweening.missing import Lost, put_back, straight
from mapctl.motion import Motion
from mapctl.numerics.intervals import runs
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Inbetweener
from mapctl.recording.frequency_bands import upsampled
from mapctl.retarget import from_canonical, places_on_rig, to_canonical
from mapctl.retarget.rigs import Rig

Method = Literal["infiller", "map", "linear"]
_MISSED = 0.001  # metres from a wanted place that are worth a word
_HAIR = 1e-4  # metres from it that are nothing
_AIMS = 6  # tries at most


@dataclass(frozen=True)
class InfillSettings:
    """How gaps are filled."""

    method: Method = "map"
    """`infiller` leaves the proposal as it is, but for rigid bones; `map` finishes it; `linear` knows no network."""
    standing: StandingSettings = field(default_factory=lambda: FINISHING)
    """The MAP stage."""


@dataclass(frozen=True, eq=False)
class Infilled:
    """A whole motion, and how it became so."""

    motion: Motion
    """On the given rig, at its rate, with all of its frames."""
    lost: Lost
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
            for _, start, stop in runs(self.lost.frames[:, None])
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
    lost: Lost,
    infiller: Inbetweener | None,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    targets: Targets | None = None,
    course: Curve | None = None,
    another: Another | None = None,
) -> Infilled:
    """What is lost of a motion, filled in; RequestError for a method without its network.

    `targets` are places that the rig's hands and feet are wanted at in frames in which they are lost; along `course`
    the hips go while they are; `another` proposal may take the place of the infiller's.
    """
    settings, began = settings or InfillSettings(), time.perf_counter()
    if infiller is None and settings.method != "linear":
        raise RequestError(f"method {settings.method} needs an infiller")
    base = straight(motion, lost)
    if settings.method == "linear" or infiller is None:
        nothing = torch.zeros(0, 2, dtype=torch.bool)
        done, notes = _on_target(put_back(base, motion, lost), targets, lost, motion, rig)
        return Infilled(done, lost, nothing, Ledger(), time.perf_counter() - began, notes)
    canonical, rigmap = to_canonical(base, rig)
    if course is not None:
        canonical = along(canonical, lost.root, course)
    gap = CanonicalGap.of(canonical, lost, rigmap.joint_of)
    shown = None if targets is None else targets.shown(gap.seconds, fps=float(motion.fps))
    answer, shown = propose_through(gap, infiller, shown, held=course is not None, another=another)
    stands, ledger, made = contacts.steadied(answer.odds > 0), Ledger(), answer.motion
    if settings.method == "map":
        made, ledger = stood(made, answer.odds, gap, settings.standing, densities, shown)
    filled = from_canonical(_at_rate_of(canonical, made, gap.seconds), rigmap, base)
    done = _closed(put_back(filled, base, lost), lost, motion)
    done, notes = _on_target(done, targets, lost, motion, rig)
    gaps = notes_of(gap, made, answer.sources, fps=float(motion.fps))
    return Infilled(done, lost, stands, ledger, time.perf_counter() - began, notes, answer.sources, gaps)


def end_notes(lost: Lost, first: str, by: str) -> tuple[str, ...]:
    """On gaps that have one edge only: who extends the motion into the first, and into the last."""
    notes = []
    if bool(lost.root[0]):
        notes.append(
            f"a gap at the beginning: the motion is extended backwards by the {first}, with nothing before it to meet"
        )
    if bool(lost.root[-1]):
        notes.append(f"a gap at the end: the motion is extended by the {by}, with nothing after it to meet")
    return tuple(notes)


def _at_rate_of(canonical: Motion, proposal: Motion, seconds: Float[Tensor, " shown"]) -> Motion:
    """The proposal at the given motion's rate, by splines through its frames."""
    if canonical.fps == PRIOR_FPS:
        return proposal
    frames, fps = canonical.num_frames, float(canonical.fps)
    quats = rotations.sign_continuous(proposal.local_quat_xyzw)
    quats = torch.nn.functional.normalize(upsampled(quats, seconds, fps=fps, frames=frames), dim=-1)
    return replace(
        canonical,
        root_position=upsampled(proposal.root_position, seconds, fps=fps, frames=frames),
        local_quat_xyzw=quats,
    )


def _closed(filled: Motion, lost: Lost, original: Motion) -> Motion:
    """On the rig, with seams that run on; what is known is the original's."""
    fps = float(original.fps)
    moving = {joint: closed_places(values, lost.root, fps=fps) for joint, values in filled.moving_offsets.items()}
    closed = replace(
        filled,
        moving_offsets=moving,
        root_position=closed_places(filled.root_position, lost.root, fps=fps),
        local_quat_xyzw=closed_rotations(filled.local_quat_xyzw, lost.joints, fps=fps),
    )
    return put_back(closed, original, lost)


def _on_target(
    filled: Motion, targets: Targets | None, lost: Lost, original: Motion, rig: Rig | None
) -> tuple[Motion, tuple[str, ...]]:
    """With limbs that are at their places to the hair; and a word on those that do not reach."""
    if targets is None:
        return filled, ()
    canonical, rigmap = to_canonical(filled, rig)
    aim, done, away = targets, filled, torch.full((1,), torch.inf)
    for _ in range(_AIMS):
        there = reached(canonical, aim, lost.frames)
        done = put_back(from_canonical(there, rigmap, filled), original, lost)
        found = places_on_rig(done, rigmap)
        before, away = away, missed(found, targets)
        if float(away.max()) < _HAIR or float((away - before).abs().max()) < _HAIR:
            break
        # Joints that only the rig has carry a limb's end elsewhere than on canonical joints.
        aim = Targets(targets.places + there.joint_positions() - found, targets.wanted)
    notes = ()
    if float(away.max()) > _MISSED:
        worst = int(away.argmax())
        notes = (f"frame {worst}: a limb stays {100 * float(away.max()):.1f} cm from its place, out of reach",)
    return done, notes
