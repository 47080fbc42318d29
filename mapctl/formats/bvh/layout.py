"""How a BVH file lays out its skeleton and channels: as a motion came, or for those that came in none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from os import PathLike

import numpy as np

from mapctl.errors import RequestError
from mapctl.formats.bvh import euler
from mapctl.formats.bvh.hierarchy import AXES, Hierarchy, Offset
from mapctl.formats.frame_rate import LONGEST_FRAME, SHORTEST_FRAME
from mapctl.formats.text import shorten
from mapctl.formats.units import FileUnit, guess_unit
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


def choose_layout(motion: Motion, path: str | PathLike[str]) -> BvhLayout:
    """Choose the layout to write a motion in; RequestError where BVH has no form for its names or frame rate."""
    layout = _source_layout(motion) or _default_layout(motion)
    if layout.fps != motion.fps or not layout.frame_time:
        layout = replace(layout, fps=motion.fps, frame_time=_format_frame_time(motion.fps, path))
    _check_names(layout, path)
    ends = {
        joint: _in_unit(motion.skeleton.end_offsets[name], layout.metres_per_unit)
        for joint, name in enumerate(layout.hierarchy.names)
        if name in motion.skeleton.end_offsets
    }
    return replace(layout, hierarchy=replace(layout.hierarchy, end_offsets=ends))


def _source_layout(motion: Motion) -> BvhLayout | None:
    """Return the layout that the motion was read in, if its skeleton still has the same joints."""
    if not isinstance(motion.source, BvhLayout):
        return None
    tree, skeleton = motion.source.hierarchy, motion.skeleton
    return motion.source if (tree.names, tree.parents) == (skeleton.names, skeleton.parents) else None


def add_root(layout: BvhLayout, name: str) -> BvhLayout:
    """Return the layout with a joint above its root, which has that one's channels if they are six, and stays still in
    the numbers that were read."""
    tree, values = layout.hierarchy, layout.values
    own = tree.channels[0] if len(tree.channels[0]) == len(POSITIONS + ROTATIONS) else POSITIONS + ROTATIONS
    above = Hierarchy(
        (name, *tree.names),
        (-1, *(parent + 1 for parent in tree.parents)),
        ((0.0, 0.0, 0.0), *tree.offsets),
        (own, *tree.channels),
        {joint + 1: offset for joint, offset in tree.end_offsets.items()},
    )
    still = None if values is None else np.concatenate([np.zeros((len(values), len(own))), values], axis=1)
    return replace(layout, hierarchy=above, values=still)


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
    skeleton, offsets = motion.skeleton, motion.skeleton.offsets.detach().cpu().double().numpy()
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
