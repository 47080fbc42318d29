"""BVH files to Motion and back, on the file's own skeleton and in its own channel layout.

A position channel replaces its joint's OFFSET when read. Lengths are scaled to metres by the size of the body
(see `units`), and scaled back when written. Frames of a joint that are as they were read get the numbers they had.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats import bvh_text, euler, missing
from mapctl.formats.atomic import write_bytes
from mapctl.formats.bvh_text import AXES, Hierarchy, Offset
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import shorten
from mapctl.formats.units import LONGEST_FRAME, SHORTEST_FRAME, FileUnit, frame_rate, guess_unit, longest_chain_length
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

POSITIONS = ("Xposition", "Yposition", "Zposition")
ROTATIONS = ("Zrotation", "Xrotation", "Yrotation")
"""Channels of motions that came in no layout; the order most tools write."""
WRITTEN_UNITS = (0.01, 1.0, 0.001)
"""Units of motions that came in no layout, metres: the first in which the reader finds the body's size. Of the largest
and the smallest unit one is right for every size."""
STILL_METRES = 1e-6
"""What varies less than this needs no position channel."""
STILL_SHARE = 1e-6
"""A joint whose offset varies by less than this part of the body's reach stays still; files round to 1e-7."""


@dataclass(frozen=True, eq=False)
class BvhLayout(FileUnit):
    """What `Motion.source` keeps of a BVH file, so that it is written as it came."""

    hierarchy: Hierarchy
    """Joints with their channels and OFFSET lines, in the file's unit."""
    fps: Fraction
    """Frames per second that the frame time was read as."""
    frame_time: str
    """Frame time as printed, seconds."""
    encoding: str = "utf-8"
    """How names are encoded."""
    values: np.ndarray | None = None
    """(frames, channels) that were read, file unit and degrees, NaN where lost; what is unchanged is written so."""

    @property
    def decimals(self) -> int:
        """Digits after the point that keep a chain of bones within 0.01 mm."""
        return 6 if self.metres_per_unit < 0.02 else 8


def load(path: str | PathLike[str]) -> Motion:
    """Read a BVH file of any Euler order, with 0 to 6 channels a joint, in any of the units of `units`.

    The root's translation is `root_position` and its offset in the skeleton is zero. Another joint's
    translation is its offset where it stays still, else `moving_offsets`. FileFormatError says what is
    wrong, in which line.
    """
    return _read(bvh_text.read(path))[0]


def load_with_missing(path: str | PathLike[str]) -> tuple[Motion, MissingValues]:
    """Read a BVH file in which some values are NaN, and which they are; FileFormatError where all of them are.

    The position of a joint that stays still is known in every frame if it is in one; if it is in none, it is at OFFSET.
    """
    return _read(bvh_text.read(path, lossy=True))


def _read(text: bvh_text.BvhText) -> tuple[Motion, MissingValues]:
    tree, lost = text.hierarchy, np.isnan(text.values)
    values = _fill_missing(tree, text.values)
    _, rest, moving = _classify_translations(tree, values)
    unit = guess_unit(tree.names, tree.parents, rest, end_offsets=tree.end_offsets, moving=moving)
    layout = BvhLayout(
        unit.metres_per_unit,
        tree,
        frame_rate(text.frame_time),
        text.frame_time,
        text.encoding,
        text.values,
        unit_doubt=unit.unit_doubt,
    )
    return _build_motion(layout, values), _find_missing(tree, lost, moving)


def _build_motion(layout: BvhLayout, values: np.ndarray) -> Motion:
    """Build the motion of channels (frames, channels) in the layout's order and unit."""
    tree, scale = layout.hierarchy, layout.metres_per_unit
    travels, rest, moving = _classify_translations(tree, values)
    ends = {tree.names[j]: (x * scale, y * scale, z * scale) for j, (x, y, z) in tree.end_offsets.items()}
    return Motion(
        skeleton=Skeleton(tree.names, tree.parents, torch.from_numpy(rest * scale), ends),
        fps=layout.fps,
        root_position=torch.from_numpy(travels[0] * scale),
        local_quat_xyzw=_quaternions(tree, values),
        moving_offsets={joint: torch.from_numpy(travels[joint] * scale) for joint in moving},
        source=layout,
    )


def _fill_missing(tree: Hierarchy, values: np.ndarray) -> np.ndarray:
    """Fill in the channels that are NaN with numbers."""
    if not np.isnan(values).any():
        return values
    done = missing.hold_last(values)
    for joint, columns in enumerate(tree.position_columns()):
        own = list(columns.values())
        done[:, own] = missing.interpolate_nan(values[:, own], np.array(tree.offsets[joint])[list(columns)])
    return done


def _find_missing(tree: Hierarchy, lost: np.ndarray, moving: Sequence[int]) -> MissingValues:
    """Find the missing values by joint; a joint without channels is missing where all channels are. One known frame
    tells the position of a joint that stays still."""
    whole = np.all(lost, axis=1)
    rotations = np.tile(whole[:, None], len(tree.names))
    places = np.zeros_like(rotations)
    places[:, 0] = whole
    for _, joints, columns in tree.rotation_groups():
        rotations[:, joints] |= lost[:, columns].any(axis=-1)
    for joint, columns in enumerate(tree.position_columns()):
        own = lost[:, list(columns.values())]
        if joint == 0 or joint in moving or own.all(axis=0).any():
            places[:, joint] |= own.any(axis=1)
    return MissingValues(torch.from_numpy(rotations), torch.from_numpy(places))


def unit_of(motion: Motion) -> float | None:
    """Return metres per unit of the BVH or AMC file that a motion was read from; None for other motions."""
    return motion.source.metres_per_unit if isinstance(motion.source, FileUnit) else None


def convert_unit(motion: Motion, metres_per_unit: float) -> Motion:
    """Return the motion as its file has it if a unit of the file is so many metres, whatever the file declares.

    A character of another size than its file's is none of that file any more.
    """
    source, old = motion.source, motion.skeleton
    scale = metres_per_unit / getattr(source, "metres_per_unit", 1.0)
    if isinstance(source, FileUnit):
        source = replace(source, metres_per_unit=metres_per_unit, unit_doubt="")
    elif scale == 1:
        return motion
    else:
        source = None
    ends = {name: (x * scale, y * scale, z * scale) for name, (x, y, z) in old.end_offsets.items()}
    return replace(
        motion,
        skeleton=Skeleton(old.names, old.parents, old.offsets * scale, ends),
        root_position=motion.root_position * scale,
        moving_offsets={joint: track * scale for joint, track in motion.moving_offsets.items()},
        source=source,
    )


def add_root_to_layout(source: object | None, name: str) -> BvhLayout | None:
    """Return the layout of a BVH file with a joint above its root, which has that one's channels if they are six, and
    stays still in the numbers that were read; None for what is no layout."""
    if not isinstance(source, BvhLayout):
        return None
    tree, values = source.hierarchy, source.values
    own = tree.channels[0] if len(tree.channels[0]) == len(POSITIONS + ROTATIONS) else POSITIONS + ROTATIONS
    above = Hierarchy(
        (name, *tree.names),
        (-1, *(parent + 1 for parent in tree.parents)),
        ((0.0, 0.0, 0.0), *tree.offsets),
        (own, *tree.channels),
        {joint + 1: offset for joint, offset in tree.end_offsets.items()},
    )
    still = None if values is None else np.concatenate([np.zeros((len(values), len(own))), values], axis=1)
    return replace(source, hierarchy=above, values=still)


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a BVH file, in the layout the motion was read in where its skeleton still has the same joints.

    Else in centimetres, or where a body of that size would be read in another unit in metres or millimetres, with root
    OFFSET 0, six channels on the root and on joints that travel, three elsewhere. A channel is added where the source's
    layout cannot hold the motion. Same motion, same bytes.
    RequestError where the motion holds a NaN or the file cannot be written; then nothing is written.
    """
    check_finite(motion, path)
    layout = choose_layout(motion, path)
    order = [motion.skeleton.index(name) for name in layout.hierarchy.names]
    quat_xyzw = as_array(motion.local_quat_xyzw)[:, order]
    translations = all_translations(motion)[:, order] / layout.metres_per_unit
    tree = fit_hierarchy(layout, translations, quat_xyzw)
    values = _keep_source_values(layout, tree, translations, quat_xyzw)
    text = bvh_text.compose(tree, layout.frame_time, values, decimals=layout.decimals)
    write_bytes(path, text.encode(layout.encoding))


def _classify_translations(tree: Hierarchy, values: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray, list[int]]:
    """Return translations (frames, 3), file unit, of the root and of every joint with position channels, rest offsets
    (joints, 3) in the file's unit, and which joints travel within their parent.

    A channel that repeats OFFSET up to rounding is taken as OFFSET, so that clips of one rig agree.
    """
    travels, rest = {}, np.array(tree.offsets)
    for joint, columns in enumerate(tree.position_columns()):
        if columns or joint == 0:
            travels[joint] = np.tile(tree.offsets[joint], (len(values), 1))
            travels[joint][:, list(columns)] = values[:, list(columns.values())]
            rest[joint] = travels[joint][0]
    still, moving = STILL_SHARE * longest_chain_length(tree.parents, np.linalg.norm(rest, axis=1), {}), []
    for joint, track in travels.items():
        low, high, offset = track.min(0), track.max(0), np.array(tree.offsets[joint])
        if joint == 0:
            rest[joint] = 0.0
        elif (np.maximum(high - offset, offset - low) <= still).all():
            rest[joint] = offset
        elif (high - low <= still).all():
            rest[joint] = (low + high) / 2
        else:
            rest[joint] = offset
            moving.append(joint)
    return travels, rest, moving


def _quaternions(tree: Hierarchy, values: np.ndarray) -> Float[Tensor, "frames joints 4"]:
    """Return the local rotations, continuous in sign over time; joints of one Euler order at once."""
    quat_xyzw = np.empty((len(values), len(tree.names), 4))
    for axes, joints, columns in tree.rotation_groups():
        quat_xyzw[:, joints] = euler.to_quat_xyzw(np.deg2rad(values[:, columns]), axes)
    return rotations.make_sign_continuous(torch.from_numpy(quat_xyzw))


def channel_values(tree: Hierarchy, translations: np.ndarray, quat_xyzw: np.ndarray) -> np.ndarray:
    """Return the motion block (frames, channels), file unit and degrees."""
    values = np.zeros((len(quat_xyzw), len(tree.labels())))
    for joint, columns in enumerate(tree.position_columns()):
        values[:, list(columns.values())] = translations[:, joint, list(columns)]
    for axes, joints, columns in tree.rotation_groups():
        values[:, columns] = np.rad2deg(euler.from_quat_xyzw(quat_xyzw[:, joints], axes))
    return values


def _keep_source_values(
    layout: BvhLayout, tree: Hierarchy, translations: np.ndarray, quat_xyzw: np.ndarray
) -> np.ndarray:
    """Return the motion block, with the numbers that were read where a joint is unchanged.

    They are read again to compare: a motion's tensors may have been written into.
    """
    values, own, old = channel_values(tree, translations, quat_xyzw), layout.values, layout.hierarchy
    if own is None or len(own) != len(values):
        return values
    before = _build_motion(layout, _fill_missing(old, own))
    turns, places = as_array(before.local_quat_xyzw), all_translations(before) / layout.metres_per_unit
    turned = (turns == quat_xyzw).all(-1) | (turns == -quat_xyzw).all(-1)
    there = np.all(np.isclose(places, translations, rtol=1e-12, atol=1e-12), axis=-1)
    same = [now == then for now, then in zip(tree.channels, old.channels, strict=True)]
    for joint, (now, then) in enumerate(zip(tree.position_columns(), old.position_columns(), strict=True)):
        if same[joint]:
            at, numbers = list(now.values()), own[:, list(then.values())]
            kept = there[:, joint] & np.isfinite(numbers).all(-1)
            values[:, at] = np.where(kept[:, None], numbers, values[:, at])
    read = {
        joint: columns
        for _, joints, group in old.rotation_groups()
        for joint, columns in zip(joints, group, strict=True)
    }
    for axes, joints, group in tree.rotation_groups():
        for joint, at in zip(joints, group, strict=True):
            if same[joint] and turned[:, joint].any():
                numbers = own[:, read[joint]]
                kept = turned[:, joint] & np.isfinite(numbers).all(-1)
                values[:, at] = euler.keep_source_angles(values[:, at], numbers, kept, axes)
    return values


def all_translations(motion: Motion) -> np.ndarray:
    """Return translations (frames, joints, 3), metres: each joint in its parent's frame, the root in the world."""
    translations = np.tile(as_array(motion.skeleton.offsets), (motion.num_frames, 1, 1))
    translations[:, 0] = as_array(motion.root_position)
    for joint, track in motion.moving_offsets.items():
        translations[:, joint] = as_array(track)
    return translations


def check_finite(motion: Motion, path: str | PathLike[str]) -> None:
    """Raise RequestError, naming joint and frame, unless all positions and rotations can be written."""
    length = np.linalg.norm(as_array(motion.local_quat_xyzw), axis=-1)
    bad = ~np.isfinite(all_translations(motion)).all(-1) | ~(abs(length - 1) < 0.01)
    if bad.any():
        frame, joint = np.argwhere(bad)[0]
        what = f"{motion.skeleton.names[joint]} at frame {frame}"
        raise RequestError(f"cannot write {path}: {what} has no finite position and rotation")


def as_array(values: Tensor) -> np.ndarray:
    """Return a float64 array, wherever the tensor is."""
    return values.detach().cpu().double().numpy()


def choose_layout(motion: Motion, path: str | PathLike[str]) -> BvhLayout:
    """Choose the layout to write a motion in; RequestError where BVH has no form for its names or frame rate."""
    layout, skeleton = motion.source, motion.skeleton
    if not isinstance(layout, BvhLayout) or (layout.hierarchy.names, layout.hierarchy.parents) != (
        skeleton.names,
        skeleton.parents,
    ):  # it came in no layout, or its joints are others now
        layout = _default_layout(motion)
    if layout.fps != motion.fps or not layout.frame_time:
        layout = replace(layout, fps=motion.fps, frame_time=_format_frame_time(motion.fps, path))
    _check_names(layout, path)
    ends = {
        joint: _in_unit(skeleton.end_offsets[name], layout.metres_per_unit)
        for joint, name in enumerate(layout.hierarchy.names)
        if name in skeleton.end_offsets
    }
    return replace(layout, hierarchy=replace(layout.hierarchy, end_offsets=ends))


def fit_hierarchy(layout: BvhLayout, translations: np.ndarray, quat_xyzw: np.ndarray) -> Hierarchy:
    """Fit the layout's hierarchy to this motion, with channels added where a joint's own cannot hold it.

    `translations` (frames, joints, 3) in the file's unit, `quat_xyzw` (frames, joints, 4), joints in file order. OFFSET
    is the source's along axes with a channel, which replaces it, and the motion's along the others.
    """
    tree, still = layout.hierarchy, STILL_METRES / layout.metres_per_unit
    channels, offsets = [], []
    travel = np.ptp(translations, axis=0) > still
    for joint, columns in enumerate(tree.position_columns()):
        lacks = any(travel[joint, axis] and axis not in columns for axis in range(3))
        channels.append(_widen_channels(tree.channels[joint], quat_xyzw[:, joint : joint + 1], add_positions=lacks))
        axes = range(3) if lacks else columns
        own, wanted = tree.offsets[joint], translations[0, joint]
        offsets.append(tuple(own[axis] if axis in axes else float(wanted[axis]) for axis in range(3)))
    return replace(tree, channels=tuple(channels), offsets=tuple(offsets))


def _widen_channels(channels: tuple[str, ...], quat_xyzw: np.ndarray, *, add_positions: bool) -> tuple[str, ...]:
    turns = tuple(c for c in channels if c.endswith("rotation"))
    rotations = turns if euler.can_represent(quat_xyzw, [AXES[c[0]] for c in turns]) else ROTATIONS
    if not add_positions and rotations == turns:
        return channels
    return (POSITIONS if add_positions else tuple(c for c in channels if c not in turns)) + rotations


def _default_layout(motion: Motion) -> BvhLayout:
    """Return a layout with root OFFSET 0, joints depth first as BVH nests them (the canonical order is not)."""
    skeleton, moving = motion.skeleton, motion.moving_offsets
    order, unit = _depth_first(skeleton), _written_unit(motion)
    channels = [(POSITIONS if j == 0 or j in moving else ()) + ROTATIONS for j in order]
    offsets = [_in_unit(skeleton.offsets[j].tolist(), unit) if j else (0.0, 0.0, 0.0) for j in order]
    parents = [order.index(skeleton.parents[j]) if j else -1 for j in order]
    names = tuple(skeleton.names[j] for j in order)
    return BvhLayout(unit, Hierarchy(names, tuple(parents), tuple(offsets), tuple(channels), {}), motion.fps, "")


def _written_unit(motion: Motion) -> float:
    """Return the first of WRITTEN_UNITS in which the reader finds the body's size."""
    skeleton, offsets = motion.skeleton, as_array(motion.skeleton.offsets)
    for unit in WRITTEN_UNITS:
        ends = {skeleton.index(name): _in_unit(offset, unit) for name, offset in skeleton.end_offsets.items()}
        found = guess_unit(
            skeleton.names, skeleton.parents, offsets / unit, end_offsets=ends, moving=motion.moving_offsets
        )
        if found.metres_per_unit == unit:
            return unit
    return WRITTEN_UNITS[0]


def _depth_first(skeleton: Skeleton) -> list[int]:
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting += reversed(skeleton.children(order[-1]))
    return order


def _in_unit(offset: Sequence[float], metres_per_unit: float) -> Offset:
    x, y, z = (value / metres_per_unit for value in offset)
    return x, y, z


def _format_frame_time(fps: Fraction, path: str | PathLike[str]) -> str:
    if not SHORTEST_FRAME <= 1 / fps <= LONGEST_FRAME:
        allowed = f"{1 / LONGEST_FRAME:g} to {1 / SHORTEST_FRAME:g}"
        raise RequestError(f"cannot write {path}: {float(fps):g} frames per second, allowed are {allowed}")
    return f"{float(1 / fps):.9f}"


def _check_names(layout: BvhLayout, path: str | PathLike[str]) -> None:
    """Refuse names that would not be read back: a name ends at a brace or a line's end and loses outer blanks."""
    for name in layout.hierarchy.names:
        broken = not name or name != name.strip() or any(mark in name for mark in "{}\r\n\0")
        if broken or name.encode(layout.encoding, "replace").decode(layout.encoding) != name:
            raise RequestError(f"cannot write {path}: BVH has no form for the joint name {shorten(name)}")
