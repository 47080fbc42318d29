"""BVH files to Motion and back, on the file's own skeleton and in its own channel layout.

A position channel replaces its joint's OFFSET when read. Lengths are scaled to metres by the size of the body
(see `units`), and scaled back when written. Frames of a joint that are as they were read get the numbers they had.
"""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats import missing
from mapctl.formats.atomic import write_bytes
from mapctl.formats.bvh import euler
from mapctl.formats.bvh import layout as bvh_layout
from mapctl.formats.bvh import text as bvh_text
from mapctl.formats.bvh.hierarchy import Hierarchy
from mapctl.formats.bvh.layout import BvhLayout
from mapctl.formats.frame_rate import frame_rate
from mapctl.formats.missing import MissingValues
from mapctl.formats.units import FileUnit, guess_unit, longest_chain_length
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

STILL_SHARE = 1e-6
"""A joint whose offset varies by less than this part of the body's reach stays still; files round to 1e-7."""


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
    return Motion(
        skeleton=_build_skeleton(tree, rest * scale, scale),
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
    """Return the layout of a BVH file with a joint above its root, with six channels; None for what is no layout."""
    return bvh_layout.add_root(source, name) if isinstance(source, BvhLayout) else None


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a BVH file, in the layout the motion was read in where its skeleton still has the same joints.

    Else in centimetres, or where a body of that size would be read in another unit in metres or millimetres, with root
    OFFSET 0, six channels on the root and on joints that travel, three elsewhere. A channel is added where the source's
    layout cannot hold the motion. Same motion, same bytes.
    RequestError where the motion holds a NaN or the file cannot be written; then nothing is written.
    """
    check_finite(motion, path)
    layout = bvh_layout.choose_layout(motion, path)
    order = [motion.skeleton.index(name) for name in layout.hierarchy.names]
    quat_xyzw = as_array(motion.local_quat_xyzw)[:, order]
    translations = all_translations(motion)[:, order] / layout.metres_per_unit
    tree = bvh_layout.fit_hierarchy(layout, translations, quat_xyzw)
    values = _keep_source_values(layout, tree, translations, quat_xyzw)
    text = bvh_text.compose(tree, layout.frame_time, values, decimals=layout.decimals)
    write_bytes(path, text.encode(layout.encoding))


def _translations(tree: Hierarchy, values: np.ndarray) -> dict[int, np.ndarray]:
    """Return translations (frames, 3), file unit, of the root and of every joint with position channels."""
    travels = {}
    for joint, columns in enumerate(tree.position_columns()):
        if columns or joint == 0:
            travels[joint] = np.tile(tree.offsets[joint], (len(values), 1))
            travels[joint][:, list(columns)] = values[:, list(columns.values())]
    return travels


def _classify_translations(tree: Hierarchy, values: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray, list[int]]:
    """Return translations as `_translations` does, rest offsets (joints, 3) in the file's unit, and which joints travel
    within their parent.

    A channel that repeats OFFSET up to rounding is taken as OFFSET, so that clips of one rig agree.
    """
    travels, rest = _translations(tree, values), np.array(tree.offsets)
    for joint, track in travels.items():
        rest[joint] = track[0]
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


def _build_skeleton(tree: Hierarchy, offsets: np.ndarray, scale: float) -> Skeleton:
    ends = {tree.names[j]: (x * scale, y * scale, z * scale) for j, (x, y, z) in tree.end_offsets.items()}
    return Skeleton(tree.names, tree.parents, torch.from_numpy(offsets), ends)


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
