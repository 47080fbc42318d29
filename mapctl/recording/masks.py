"""Masks: the frames and joints of a recording that its user marks as unreliable. CSV with the columns joint, start,
stop."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike

import torch
from torch import Tensor

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import read_table, shorten
from mapctl.joint_names import describe_nearest, find_joint
from mapctl.joint_roles import classify_joints
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget import canonical_joints
from mapctl.retarget.rigs import Rig

_COLUMNS = ("joint", "start", "stop")
_FRAME = re.compile(r"[+-]?[0-9]{1,12}")
ALL, ROOT = "*", "root position"
"""Names of masks that stand for everything, and for the position of the root."""


@dataclass(frozen=True)
class Mask:
    """Frames in which a joint counts as missing."""

    joint: str
    """Joint name on the recording's own rig or canonical, in any case; `*` for all of it, `root position` for the
    root's."""
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
    """Return masks of what a file marks as missing. A joint that travels beside the body's own travel is lost with its
    position."""
    travels, joints = motion.travelling_joint, missing.rotations.clone()
    below = motion.skeleton.children(0)
    if travels == 0 and len(below) == 1 and bool(missing.positions[:, below[0]].all()):
        travels = below[0]  # hips under a root that stays on the ground: the body's way is not known anywhere
    for joint in motion.moving_offsets:
        if joint != travels:
            joints[:, joint] |= missing.positions[:, joint]
    lost = [Mask(motion.skeleton.names[joint], start, stop) for joint, start, stop in true_intervals(joints)]
    return (*lost, *(Mask(ROOT, start, stop) for _, start, stop in true_intervals(missing.positions[:, travels, None])))


def expand_valid_masks(motion: Motion, masks: Sequence[Mask]) -> tuple[Tensor, Tensor]:
    """Expand masks to masked joints (frames, joints) and root positions (frames,), checked.

    RequestError for joints that the rig has not (with the nearest that it has), frames beyond the end, and joints of
    which nothing would be left.
    """
    for mask in masks:
        if mask.stop > motion.num_frames:
            raise RequestError(f"the mask of {mask.joint} ends at {mask.stop}, the recording at {motion.num_frames}")
    joints, root = expand_masks(motion, masks)
    if root.all() or joints.all(dim=0).any():
        gone = "root position" if root.all() else motion.skeleton.names[int(joints.all(dim=0).nonzero()[0])]
        raise RequestError(f"the masks leave nothing of {gone} in {motion.num_frames} frames")
    return joints, root


def expand_masks(motion: Motion, masks: Sequence[Mask]) -> tuple[Tensor, Tensor]:
    """Expand masks to masked joints (frames, joints) and root positions (frames,)."""
    names = motion.skeleton.names
    masks = resolve_joint_names(motion, masks)
    joints = torch.zeros(motion.num_frames, len(names), dtype=torch.bool)
    root = torch.zeros(motion.num_frames, dtype=torch.bool)
    for mask in masks:
        if mask.joint in (ALL, ROOT):
            root[mask.start : mask.stop] = True
        if mask.joint == ALL:
            joints[mask.start : mask.stop] = True
        elif mask.joint != ROOT:
            joints[mask.start : mask.stop, names.index(mask.joint)] = True
    return joints, root


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


def slice_masks(masks: Sequence[Mask], start: int, stop: int) -> tuple[Mask, ...]:
    """Return the masks of frames start to stop, counted from there."""
    clipped = [Mask(m.joint, max(m.start, start) - start, min(m.stop, stop) - start) for m in masks]
    return tuple(mask for mask in clipped if mask.start < mask.stop)


def trim_masks_before(masks: Sequence[Mask], frame: int) -> tuple[Mask, ...]:
    """Return the masks as far as they hold from that frame on."""
    cut = [Mask(m.joint, max(m.start, frame), m.stop) for m in masks]
    return tuple(mask for mask in cut if mask.start < mask.stop)


def write_back_masked(motion: Motion, clean: Motion, masks: Sequence[Mask]) -> Motion:
    """Return the motion with what is masked of its first frames taken from a clean version of them.

    So that a joint which is lost for long is known by its earlier estimate.
    """
    shared = clean.num_frames
    joints, root = expand_masks(motion, masks)
    joints, root = joints[:shared], root[:shared]
    if not bool(joints.any() | root.any()):
        return motion
    quats, position = motion.local_quat_xyzw.clone(), motion.root_position.clone()
    quats[:shared] = torch.where(joints[..., None], clean.local_quat_xyzw, quats[:shared])
    position[:shared] = torch.where(root[:, None], clean.root_position, position[:shared])
    moving = dict(motion.moving_offsets)
    for joint, values in moving.items():
        kept = torch.where(root[:, None], clean.moving_offsets[joint], values[:shared])
        moving[joint] = torch.cat([kept, values[shared:]])
    return replace(motion, local_quat_xyzw=quats, root_position=position, moving_offsets=moving)
