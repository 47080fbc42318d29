"""The anatomy of one actor over a whole motion, on which bodies are built: hips, head, feet and tips of bones."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.joint_names import Part, Role, Side
from mapctl.joint_roles import classify_joints, find_hips
from mapctl.mesh.primitives import Array, frame_along, unit
from mapctl.motion import Motion

_STANDARD_LEG = 0.80
"""Hip to ankle of the person whose measures this package is written for, metres."""
_TIP_LENGTHS = {Part.HEAD: 0.17, Part.HAND: 0.14, Part.TOES: 0.07, Part.FOOT: 0.12, Part.FINGER: 0.02}
"""Lengths of last bones without an End Site in the file, metres."""
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Points:
    """Joints, and the far ends of last bones as further points behind them."""

    parents: tuple[int, ...]
    """Each point's parent; -1 for the root."""
    roles: tuple[Role, ...]
    """Each point's role; a far end has its joint's."""
    world: Array
    """(frames, points, 3) metres."""


@dataclass(frozen=True, eq=False)
class Foot:
    """One foot's own axes and heights, constant over the motion."""

    side: Side
    ankle: int
    """Point index."""
    ball: int
    """Point index of the toe joint, or of the foot's far end."""
    tip: int | None
    """Point index of the toes' far end, if the rig has toes."""
    axes: Array
    """(3, 3) columns left, up from the sole and forward, in the ankle joint's frame."""
    toe_axes: Array
    """(3, 3) columns left, up from the sole and forward, in the toe joint's frame."""
    heights: tuple[float, float]
    """Heights of ankle and ball over the sole, metres."""

    @property
    def bones(self) -> list[tuple[int, int]]:
        """Bone from ankle to ball, and from ball to tip if the rig has toes."""
        return [(self.ankle, self.ball)] + ([] if self.tip is None else [(self.ball, self.tip)])


class Anatomy:
    """Hips, head axes and feet of a motion of any rig and length, which a body is built on."""

    def __init__(self, motion: Motion):
        self.joints = motion.num_joints
        self.rotations = rotations.to_matrix(motion.joint_rotations()).numpy()
        joints, parents = motion.joint_positions().numpy(), motion.skeleton.parents
        self.scale = _thigh_and_shin_length(joints[0], parents, classify_joints(motion.skeleton)) / _STANDARD_LEG
        self.points = _add_tips(motion, joints, self.rotations, self.scale)
        self.hips = 0  # of an unknown rig: its root
        with suppress(RequestError):
            self.hips = find_hips(motion.skeleton)

    @property
    def hips_world(self) -> Array:
        """Return hips positions (frames, 3), metres."""
        return self.points.world[:, self.hips]

    @property
    def seen(self) -> Array:
        """Return positions (frames, n, 3) of hips and all below, metres, without a root on the floor."""
        return self.points.world[:, self.hips :]

    def find(self, part: Part, side: Side = Side.MIDDLE) -> int | None:
        """Find the first joint of a part and side, None if the rig has none."""
        wanted = Role(side, part)
        return next((k for k in range(self.joints) if self.points.roles[k] == wanted), None)

    def children(self, point: int) -> Iterator[int]:
        """Yield the points below a point, joints before far ends."""
        return (k for k, parent in enumerate(self.points.parents) if parent == point)

    def left(self, part: Part) -> Array:
        """Return unit vectors (frames, 3) from a part's right joint to its left; the hips' x axis without such."""
        pair = self.find(part, Side.LEFT), self.find(part, Side.RIGHT)
        if None in pair:
            return self.rotations[:, self.hips, :, 0]
        return unit(self.points.world[:, pair[0]] - self.points.world[:, pair[1]])

    @cached_property
    def forward(self) -> Array:
        """Return unit vectors (frames, 3) along which the body faces, level with the ground."""
        return unit(np.cross(self.left(Part.UPPER_LEG), _UP))

    @cached_property
    def head_axes(self) -> Array:
        """(3, 3) columns left, crown and face in the head joint's frame: on average it faces as the body."""
        head = self.find(Part.HEAD)
        if head is None:
            return np.eye(3)
        tip = next((k for k in self.children(head) if k >= self.joints), head)
        crown = self._to_joint_frame(head, self.points.world[:, tip] - self.points.world[:, head])
        return _axes_from(up=crown.mean(0), forward=self._to_joint_frame(head, self.forward).mean(0))

    @cached_property
    def feet(self) -> tuple[Foot, ...]:
        """Left and right foot, as far as the rig has them."""
        feet = (self._foot(side) for side in (Side.LEFT, Side.RIGHT))
        return tuple(foot for foot in feet if foot is not None)

    def _foot(self, side: Side) -> Foot | None:
        ankle = self.find(Part.FOOT, side)
        below = () if ankle is None else tuple(self.children(ankle))
        if ankle is None or not below:
            return None
        ball = next((k for k in below if self.points.roles[k].part is Part.TOES), below[0])
        tip = next(self.children(ball), None) if ball < self.joints else None
        height = self.points.world[:, [ankle, ball], 1].sum(axis=1)
        flat = height <= np.quantile(height, 0.1)  # frames in which the foot is most likely flat
        along = self.points.world[:, ball] - self.points.world[:, ankle]
        axes = _axes_from(
            up=self._to_joint_frame(ankle, _UP)[flat].mean(0), forward=self._to_joint_frame(ankle, along)[flat].mean(0)
        )
        toe = ball if ball < self.joints else ankle
        level = np.einsum("fij,j->fi", self.rotations[:, ankle], axes[:, 2])
        toe_axes = _axes_from(
            up=self._to_joint_frame(toe, _UP)[flat].mean(0), forward=self._to_joint_frame(toe, level)[flat].mean(0)
        )
        above, low = (self._height(point, flat) for point in (ankle, ball))
        return Foot(side, ankle, ball, tip, axes, toe_axes, (max(above, low + 0.02 * self.scale), low))

    def _height(self, point: int, flat: Array) -> float:
        """Return the height of a point over the ground y = 0 in the flat frames, metres, limited to what a foot can
        have."""
        low, high = 0.02 * self.scale, 0.14 * self.scale
        return float(np.clip(np.median(self.points.world[flat, point, 1]), low, high))

    def _to_joint_frame(self, joint: int, vector: Array) -> Array:
        """Transform world vectors, (frames, 3) or (3,), to a joint's frame."""
        every = np.broadcast_to(vector, (len(self.rotations), 3))
        return np.einsum("fji,fj->fi", self.rotations[:, joint], every)


def _axes_from(*, up: Array, forward: Array) -> Array:
    """Return axes with columns left, up, forward; up is kept."""
    across = np.cross(up, forward)
    if np.linalg.norm(across) < 1e-6 * np.linalg.norm(forward) + 1e-12:
        across = np.array([1.0, 0.0, 0.0])  # arbitrary where the motion does not determine it
    return frame_along(up, across)


def _thigh_and_shin_length(rest: Array, parents: tuple[int, ...], found: tuple[Role, ...]) -> float:
    """Return the length of thigh plus shin, metres; the standard length where no leg is found."""
    for foot, role in enumerate(found):
        if role.part is Part.FOOT:
            knee = parents[foot]
            length = np.linalg.norm(rest[foot] - rest[knee]) + np.linalg.norm(rest[knee] - rest[parents[knee]])
            return float(length) if length > 0.05 else _STANDARD_LEG
    return _STANDARD_LEG


def _add_tips(motion: Motion, joints: Array, turns: Array, scale: float) -> Points:
    found, parents = list(classify_joints(motion.skeleton)), list(motion.skeleton.parents)
    extra = []
    for joint, name in enumerate(motion.skeleton.names):
        leaf, part = joint not in parents[: len(motion.skeleton.names)], found[joint].part
        offset = np.array(motion.skeleton.end_offsets.get(name, (0.0, 0.0, 0.0)))
        if np.linalg.norm(offset) > 0.01 * scale:
            extra.append((joint, joints[:, joint] + turns[:, joint] @ offset))
        elif part in _TIP_LENGTHS and (leaf or part is Part.HEAD):  # eyes and the like do not show the crown
            along = unit(joints[:, joint] - joints[:, parents[joint]])
            extra.append((joint, joints[:, joint] + along * _TIP_LENGTHS[part] * scale))
    world = np.concatenate([joints, *(position[:, None] for _, position in extra)], axis=1)
    return Points((*parents, *(j for j, _ in extra)), (*found, *(found[j] for j, _ in extra)), world)
