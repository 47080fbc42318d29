"""Masks: frames and joints of a recording that its user marks as unreliable. CSV with columns joint, start, stop."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike

import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import read_table, shorten
from mapctl.joint_names import describe_nearest, find_joint
from mapctl.joint_roles import classify_joints
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget import RigMap, canonical_joints
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

_COLUMNS = ("joint", "start", "stop")
_FRAME = re.compile(r"[+-]?[0-9]{1,12}")
ALL, ROOT = "*", "root position"
"""Names of masks that stand for everything, and for the position of the root."""


@dataclass(frozen=True)
class Mask:
    """Frames in which a joint counts as missing."""

    joint: str
    """Joint name on the recording's rig or canonical, in any case; `*` for all, `root position` for the root's."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last frame."""


def load_masks(path: str | PathLike[str]) -> tuple[Mask, ...]:
    """Read a CSV, its columns in any order; FileFormatError names the wrong line. A header alone masks nothing."""
    (line, names), *rows = read_table(path, f"a CSV of the columns {','.join(_COLUMNS)}") or [(1, [])]
    if not set(_COLUMNS) <= set(names) or len(set(names)) < len(names):
        found = shorten(",".join(names)) if names else "nothing"
        raise FileFormatError(path, f"needs the columns {', '.join(_COLUMNS)}, each once; found {found}", line)
    masks = []
    for line, words in rows:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", line)
        row = dict(zip(names, words, strict=True))
        if not row["joint"] or not all(_FRAME.fullmatch(row[name]) for name in ("start", "stop")):
            got = shorten(",".join(words))
            raise FileFormatError(path, f"expected a joint and two whole frames, got {got}", line)
        mask = Mask(row["joint"], int(row["start"]), int(row["stop"]))
        if not 0 <= mask.start < mask.stop:
            raise FileFormatError(path, f"needs 0 <= start < stop, got {mask.start} and {mask.stop}", line)
        masks.append(mask)
    return tuple(masks)


def masks_from_missing(motion: Motion, missing: MissingValues) -> tuple[Mask, ...]:
    """Return masks of what a file marks as missing. A joint that travels beside the body is lost with its position."""
    travels, joints = motion.travelling_joint, missing.rotations.clone()
    below = motion.skeleton.children(0)
    if travels == 0 and len(below) == 1 and bool(missing.positions[:, below[0]].all()):
        travels = below[0]  # hips under a root that stays on the ground: the body's way is not known anywhere
    for joint in motion.moving_offsets:
        if joint != travels:
            joints[:, joint] |= missing.positions[:, joint]
    lost = [Mask(motion.skeleton.names[joint], start, stop) for joint, start, stop in true_intervals(joints)]
    return (*lost, *(Mask(ROOT, start, stop) for _, start, stop in true_intervals(missing.positions[:, travels, None])))


@dataclass(frozen=True, eq=False)
class MissingMask:
    """Mask of the missing values of a motion."""

    joints: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation is missing, by joint of the rig."""
    root: Bool[Tensor, " frames"]
    """Whether the body's position is missing."""

    @staticmethod
    def of_masks(motion: Motion, masks: Sequence[Mask], rigmap: RigMap, *, keep_position: bool = True) -> "MissingMask":
        """Build the mask from masks by joint. Where a joint is missing so is its parent's rotation, unless the parent
        has other children that show it. RequestError for joints and frames that the motion has not, and where nothing
        of it is left: no joint, or no position of the body unless that may be so."""
        missing = expand_masks(motion, masks)
        for child, parent in enumerate(CANONICAL.parents):
            own, above = rigmap.joint_of[child], rigmap.joint_of[parent] if parent >= 0 else None
            if own is not None and above is not None and len(CANONICAL.children(parent)) == 1:
                missing.joints[:, above] |= missing.joints[:, own]
        if (keep_position and missing.root.all()) or bool(missing.joints.all()):
            raise RequestError(f"the gaps leave nothing of the motion's {motion.num_frames} frames to go by")
        return missing

    @staticmethod
    def of_frames(missing: Bool[Tensor, " frames"], joints: int) -> "MissingMask":
        """Build the mask of whole frames of a motion with so many joints."""
        return MissingMask(missing[:, None].expand(-1, joints).clone(), missing)

    @property
    def frames(self) -> Bool[Tensor, " frames"]:
        """Frames in which anything is missing."""
        return self.root | self.joints.any(dim=1)

    @property
    def known_positions(self) -> Bool[Tensor, "frames joints"]:
        """Joints of a canonical motion whose world position is known: the root's and all rotations above them are."""
        known = [~self.root]
        for parent in CANONICAL.parents[1:]:
            known.append(known[parent] & ~self.joints[:, parent])
        return torch.stack(known, dim=1)

    def slice(self, start: int, stop: int) -> "MissingMask":
        """Return frames start to stop."""
        return MissingMask(self.joints[start:stop], self.root[start:stop])


def restore_observed(motion: Motion, original: Motion, missing: MissingMask) -> Motion:
    """Return the original with its missing values from `motion`, of the same rig and length; all else to the bit."""
    moving = {
        joint: torch.where(missing.root[:, None], motion.moving_offsets[joint], values)
        for joint, values in original.moving_offsets.items()
    }
    return replace(
        original,
        moving_offsets=moving,
        root_position=torch.where(missing.root[:, None], motion.root_position, original.root_position),
        local_quat_xyzw=torch.where(missing.joints[..., None], motion.local_quat_xyzw, original.local_quat_xyzw),
    )


def expand_valid_masks(motion: Motion, masks: Sequence[Mask]) -> MissingMask:
    """Expand masks that leave something of every joint; RequestError for others, as `expand_masks`."""
    missing = expand_masks(motion, masks)
    lost = [ROOT] * bool(missing.root.all())
    lost += [motion.skeleton.names[joint] for joint in missing.joints.all(dim=0).nonzero()[:, 0].tolist()]
    if lost:
        raise RequestError(f"the masks leave nothing of {lost[0]} in {motion.num_frames} frames")
    return missing


def expand_masks(motion: Motion, masks: Sequence[Mask]) -> MissingMask:
    """Expand masks by joint; RequestError for joints that the rig has not, and frames beyond the end."""
    names = motion.skeleton.names
    masks = resolve_joint_names(motion, masks)
    joints = torch.zeros(motion.num_frames, len(names), dtype=torch.bool)
    root = torch.zeros(motion.num_frames, dtype=torch.bool)
    for mask in masks:
        if mask.stop > motion.num_frames:
            raise RequestError(f"the mask of {mask.joint} ends at {mask.stop}, the recording at {motion.num_frames}")
        if mask.joint in (ALL, ROOT):
            root[mask.start : mask.stop] = True
        if mask.joint == ALL:
            joints[mask.start : mask.stop] = True
        elif mask.joint != ROOT:
            joints[mask.start : mask.stop, names.index(mask.joint)] = True
    return MissingMask(joints, root)


def resolve_joint_names(motion: Motion, masks: Sequence[Mask], rig: Rig | None = None) -> tuple[Mask, ...]:
    """Rename the masks' joints to the names of the motion's own rig.

    `rig` wins over what would be recognised. RequestError, with the nearest names, for joints that it has not.
    """
    known, names, own = cache(lambda: canonical_joints(motion, rig)), motion.skeleton.names, {}
    for wanted in {mask.joint for mask in masks} - {ALL, ROOT}:
        joint = find_joint(wanted, names, known)
        if joint is None:
            nearest = describe_nearest(wanted, names, classify_joints(motion.skeleton))
            raise RequestError(f"no joint {wanted!r} to mask; {nearest}")
        own[wanted] = names[joint]
    return tuple(replace(mask, joint=own.get(mask.joint, mask.joint)) for mask in masks)


def slice_masks(masks: Sequence[Mask], start: int, stop: int, *, since: int = 0) -> tuple[Mask, ...]:
    """Return the masks of frames start to stop, counted from there, as far as they hold from frame `since` on."""
    clipped = [Mask(m.joint, max(m.start, start, since) - start, min(m.stop, stop) - start) for m in masks]
    return tuple(mask for mask in clipped if mask.start < mask.stop)


def write_back_masked(motion: Motion, clean: Motion, masks: Sequence[Mask]) -> Motion:
    """Return the motion with what is masked of its first frames taken from a clean version of them.

    So that a joint which is lost for long is known by its earlier estimate.
    """
    shared = clean.num_frames
    done = restore_observed(clean, motion.slice(0, shared), expand_masks(motion, masks).slice(0, shared))
    return done.join(motion.slice(shared, motion.num_frames)) if shared < motion.num_frames else done
