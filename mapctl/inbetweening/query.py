"""Query to an in-betweener, a motion with gaps, and its proposal, a motion without them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets, LooseKeys
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.recording.masks import MissingMask, restore_observed
from mapctl.skeleton import CANONICAL, TOE_JOINTS, leg_length

_MAX_ROOT_KEY_FRAMES = 5  # frames at PRIOR_FPS: hips that are known for longer, a network follows
INTERPOLATION = "interpolation"
"""Name of the source of a gap that stays as it was interpolated."""


@dataclass(frozen=True, eq=False)
class GapQuery:
    """A motion with gaps on canonical joints at PRIOR_FPS, and the targets in them."""

    motion: Motion
    """Motion on the character's own bones, interpolated where values are missing."""
    missing: MissingMask
    """Rotations of canonical joints and root positions that are missing."""
    seconds: Float[Tensor, " frames"]
    """Time of each frame, seconds; 1/30 s apart, but that the last is the clip's."""
    effector_targets: EffectorTargets | None = None
    """World positions that joints are to reach in frames in which they are missing."""
    keep_trajectory: bool = False
    """Whether the root of `motion` shows the requested trajectory where it is missing; it may sway about that."""
    loose: LooseKeys | None = None
    """Ground positions and drawings in frames that are missing; `motion` leads over the positions, and looks along
    them where no heading is known."""

    @property
    def known_positions(self) -> Bool[Tensor, "frames joints"]:
        """Joints whose world position is known, and of the hips the rotation as well."""
        known = self.missing.known_positions
        known[:, 0] &= ~self.missing.joints[:, 0]
        return known

    @property
    def nothing_known(self) -> Bool[Tensor, " frames"]:
        """Frames of which nothing is known."""
        return self.missing.joints.all(dim=1) & self.missing.root

    @property
    def enclosed_gaps(self) -> list[tuple[int, int]]:
        """First frames and one past the last of gaps in which nothing is known, with known frames on both sides."""
        gaps = true_intervals(self.nothing_known[:, None])
        return [(start, stop) for _, start, stop in gaps if start > 0 and stop < self.motion.num_frames]

    @property
    def root_only_keys(self) -> Bool[Tensor, " frames"]:
        """Single frames, or a few, of which nothing is known but the hips' position and rotation."""
        turns, root = self.missing.joints, self.missing.root
        alone = ~root & ~turns[:, 0] & turns[:, 1:].all(dim=1)
        for _, start, stop in true_intervals(alone[:, None].clone()):
            alone[start:stop] = stop - start <= _MAX_ROOT_KEY_FRAMES
        return alone

    def hide_partial_keys(self) -> "GapQuery":
        """Return the query in which keys that give only positions of hands, feet or hips are missing like what is about
        them."""
        hips = self.root_only_keys
        joints = self.missing.joints.index_put((hips, torch.tensor(0)), torch.tensor(True))
        return replace(self, missing=MissingMask(joints, self.missing.root | hips), effector_targets=None)

    @property
    def scale(self) -> float:
        """Ratio of the character's leg length to the canonical one."""
        return leg_length(self.motion.skeleton) / leg_length(CANONICAL)

    def to_unit_size(self, motion: Motion) -> Motion:
        """Return a motion of the character on the canonical skeleton, whose size models know."""
        return replace(motion, skeleton=CANONICAL, root_position=motion.root_position / self.scale)

    def to_character(self, motion: Motion) -> Motion:
        """Return a motion of unit size on the character's bones."""
        return replace(motion, skeleton=self.motion.skeleton, root_position=motion.root_position * self.scale)


@dataclass(frozen=True)
class GapSource:
    """Source of the motion in one gap."""

    start: int
    """First frame of the gap, at PRIOR_FPS."""
    stop: int
    """One past the last frame of the gap."""
    by: str
    """Name of the in-betweener, as in `infiller` or `rollout of locomotion`."""
    reason: str = ""
    """Why another in-betweener that was tried first did not propose; empty where none was."""
    apart: float | None = None
    """Mean distance of joints, metres, at which two sides met that were then joined; None of what has no sides."""
    remark: str = ""
    """Remark on the gap; empty without one."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A motion proposed for all gaps of a query."""

    motion: Motion
    """Motion of the query's frames on the character's bones; what is known may have moved."""
    contact_logits: Float[Tensor, "frames 2"]
    """Contact logits of the left and the right toe."""
    source: str
    """Name of the in-betweener that proposed what `others` did not."""
    others: tuple[GapSource, ...] = ()
    """Gaps that others proposed, or that were left to `source` for a reason."""
    spread: Float[Tensor, "frames joints 2"] | None = None
    """Distances, metres, within which a joint's true position lies in half and in nine of ten of cases; None from an
    in-betweener that does not know how sure it is."""

    def take(self, other: "Proposal", gaps: Sequence[tuple[int, int]]) -> "Proposal":
        """Return this proposal with the motion and contacts that another one has in some gaps, first frames and one
        past the last; the sources stay."""
        taken, logits = torch.zeros(len(self.contact_logits), dtype=torch.bool), self.contact_logits
        for start, stop in gaps:
            taken[start:stop] = True
        motion = restore_observed(other.motion, self.motion, MissingMask.of_frames(taken, self.motion.num_joints))
        logits = torch.where(taken[:, None], other.contact_logits.to(logits), logits)
        return replace(self, motion=motion, contact_logits=logits)

    def lerp(self, other: "Proposal", weight: float, frames: slice) -> "Proposal":
        """Return this proposal with so much weight in some frames, and another one for the rest."""
        motion, logits = self.motion, self.contact_logits.clone()
        quats, root = motion.local_quat_xyzw.clone(), motion.root_position.clone()
        theirs, share = other.motion.local_quat_xyzw[frames], torch.full(quats[frames].shape[:2], weight).to(quats)
        quats[frames] = rotations.slerp(theirs, quats[frames], share)
        root[frames] = torch.lerp(other.motion.root_position[frames], root[frames], weight)
        logits[frames] = torch.lerp(other.contact_logits[frames].to(logits), logits[frames], weight)
        return replace(self, motion=replace(motion, local_quat_xyzw=quats, root_position=root), contact_logits=logits)

    def attribute(self, query: GapQuery) -> tuple[GapSource, ...]:
        """Name the source of each gap with known frames on both sides, and of the others' gaps, in temporal order."""
        named = {other.start: other for other in self.others}
        for start, stop in query.enclosed_gaps:
            if not any(other.start <= start and stop <= other.stop for other in self.others):
                named[start] = GapSource(start, stop, self.source)
        return tuple(named[start] for start in sorted(named))


def estimate_contact_logits(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Estimate contact logits of a canonical motion from how low and slow its toes are."""
    return contacts.to_logits(contacts.detect_contacts(motion.joint_positions()[:, list(TOE_JOINTS)], PRIOR_FPS))
