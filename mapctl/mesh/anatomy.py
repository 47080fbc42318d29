"""The anatomy of one actor over a whole motion, on which bodies are built: hips, head, feet and tips of bones."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch

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
_MAX_FRAMES = 200  # of which joints' mean rotations are taken
_LIMBS = (  # parts from trunk to tip, and the direction of the left one in the bind pose
    ((Part.UPPER_ARM, Part.LOWER_ARM, Part.HAND), unit(np.array([1.0, -1.0, 0.0]))),
    ((Part.UPPER_LEG, Part.LOWER_LEG, Part.FOOT), unit(np.array([0.18, -1.0, 0.0]))),
)


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


@dataclass(frozen=True, eq=False)
class Limb:
    """An arm or a leg."""

    side: Side
    parts: tuple[Part, Part, Part]
    """Parts that upper, lower and last bone start at."""
    joints: tuple[int, ...]
    """Joints from shoulder or hip to hand or foot, those between included; the last may be the end of a bone."""
    middle: int
    """Elbow or knee."""
    direction: Array
    """(3,) unit vector along which it is straight in the bind pose."""


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

    @cached_property
    def limbs(self) -> tuple[Limb, ...]:
        """Arms and legs that are found: from the named last joint up to the named first one, or two joints above."""
        found = []
        for parts, direction in _LIMBS:
            for side, mirror in ((Side.LEFT, 1.0), (Side.RIGHT, -1.0)):
                lower, end = self.find(parts[1], side), self.find(parts[2], side)
                end = next(self.children(lower), None) if end is None and lower is not None else end
                chain = [] if end is None else self.find_path(end)
                named = {self.points.roles[joint].part: k for k, joint in enumerate(chain)}
                last = named.get(parts[0], 2)
                if 2 <= last < len(chain):
                    inner = [k for k in range(1, last) if self.points.roles[chain[k]].part is parts[1]] or [last // 2]
                    joints = tuple(reversed(chain[: last + 1]))
                    found.append(Limb(side, parts, joints, chain[inner[-1]], direction * [mirror, 1.0, 1.0]))
        return tuple(found)

    @cached_property
    def left(self) -> Array:
        """Return unit vectors (frames, 3) from the right hip to the left; the hips' x axis without such."""
        pair = [limb.joints[0] for limb in self.limbs if limb.parts[0] is Part.UPPER_LEG]
        if len(pair) < 2:
            return self.rotations[:, self.hips, :, 0]
        return unit(self.points.world[:, pair[0]] - self.points.world[:, pair[1]])

    @cached_property
    def forward(self) -> Array:
        """Return unit vectors (frames, 3) along which the body faces, level with the ground."""
        return unit(np.cross(self.left, _UP))

    @cached_property
    def bind_pose(self) -> tuple[Array, Array]:
        """Positions (points, 3) and joint rotations (joints, 3, 3) of the pose in which a body is built, metres.

        The body stands upright with the hips at the origin, faces +Z and spreads straight limbs, so that they deform
        little in most motions; joints turn about their bones as they do on average over the motion.
        """
        points, count = self.points, len(self.rotations)
        some = self.rotations[np.linspace(0, count - 1, min(count, _MAX_FRAMES)).astype(int)]
        flat = {foot.ankle: foot.axes.T for foot in self.feet}
        flat |= {foot.ball: foot.toe_axes.T for foot in self.feet if foot.ball < self.joints}
        bind, place = np.tile(np.eye(3), (self.joints, 1, 1)), np.zeros((len(points.parents), 3))
        bind[self.hips] = self._pelvis_axes.T
        done = self.find_path(self.hips)  # what is above the hips moves with them
        for joint in done[1:]:
            turned = bind[self.hips] @ np.swapaxes(some[:, self.hips], 1, 2) @ some[:, joint]
            bind[joint] = _average_rotations(turned)
        for point, parent in enumerate(points.parents):
            if parent < 0:
                continue
            offset = points.world[0, point] - points.world[0, parent]
            place[point] = place[parent] + bind[parent] @ self.rotations[0, parent].T @ offset
            if point >= self.joints or point in done:
                continue
            part = points.roles[point].part
            if point in flat:
                bind[point] = flat[point]
            elif part in (Part.FINGER, Part.TOES, Part.OTHER) and point not in self._bones:
                bind[point] = bind[parent]
            else:
                bind[point] = self._average(point, bind[parent] @ np.swapaxes(some[:, parent], 1, 2) @ some[:, point])
        return place - place[self.hips], bind

    def find_path(self, joint: int) -> list[int]:
        """Return a joint and all above it."""
        path = [joint]
        while self.points.parents[path[-1]] >= 0:
            path.append(self.points.parents[path[-1]])
        return path

    def _average(self, joint: int, turns: Array) -> Array:
        """Return the mean (3, 3) of a joint's rotations (frames, 3, 3) with its bone in the bind pose's direction."""
        bone, direction = self._bones.get(joint, (np.zeros(3), _UP))
        if np.linalg.norm(bone) > 1e-3 * self.scale:
            along, straight = (torch.from_numpy(v) for v in (turns @ bone, np.tile(direction, (len(turns), 1))))
            turns = rotations.to_matrix(rotations.between_vectors(along, straight)).numpy() @ turns
        return _average_rotations(turns)

    @cached_property
    def _bones(self) -> dict[int, tuple[Array, Array]]:
        """Bones of limbs and head by joint: the bone in the joint's frame, metres, and its direction when bound."""
        pairs = [(a, b, limb.direction) for limb in self.limbs for a, b in pairwise(limb.joints)]
        pairs += [(limb.joints[-1], self.find_tip(limb.joints[-1]), limb.direction) for limb in self.limbs]
        head = self.find(Part.HEAD)
        pairs += [] if head is None else [(head, self.find_tip(head), _UP)]
        found = {}
        for joint, end, direction in pairs:
            if joint < self.joints:
                bone = self.points.world[0, end].reshape(-1, 3).mean(axis=0) - self.points.world[0, joint]
                found[joint] = self.rotations[0, joint].T @ bone, direction
        return found

    def find_tip(self, joint: int) -> list[int]:
        """Return the points at the far end of a hand's or a head's bone: its fingers or its tip, else all below."""
        below, part = list(self.children(joint)), self.points.roles[joint].part
        wanted = (Part.FINGER, part) if part is Part.HAND else (part,)
        return [k for k in below if self.points.roles[k].part in wanted] or below or [joint]

    @cached_property
    def _pelvis_axes(self) -> Array:
        """(3, 3) columns left, up and forward in the hips' frame."""
        neck = self.find(Part.NECK)
        top = self.find(Part.HEAD) if neck is None else neck
        up = _UP if top is None else self.points.world[:, top] - self.hips_world
        return _axes_from(
            up=self._to_joint_frame(self.hips, up).mean(axis=0),
            forward=self._to_joint_frame(self.hips, np.cross(self.left, up)).mean(axis=0),
        )

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


_CROWN = 0.5  # mean cosine between a head's tip and the neck's direction, below which the tip is no crown


def _add_tips(motion: Motion, joints: Array, turns: Array, scale: float) -> Points:
    found, parents = list(classify_joints(motion.skeleton)), list(motion.skeleton.parents)
    extra = []
    for joint, name in enumerate(motion.skeleton.names):
        leaf, part = joint not in parents[: len(motion.skeleton.names)], found[joint].part
        tip = turns[:, joint] @ np.array(motion.skeleton.end_offsets.get(name, (0.0, 0.0, 0.0)))
        along = unit(joints[:, joint] - joints[:, parents[joint]])
        # The tip of a head that is written in a sensor's axes, or ahead to its eyes, is no crown.
        aside = part is Part.HEAD and float((unit(tip) * along).sum(axis=-1).mean()) < _CROWN
        if float(np.linalg.norm(tip[0])) > 0.01 * scale and not aside:
            extra.append((joint, joints[:, joint] + tip))
        elif part in _TIP_LENGTHS and (leaf or part is Part.HEAD):  # eyes and the like do not show the crown
            extra.append((joint, joints[:, joint] + along * _TIP_LENGTHS[part] * scale))
    world = np.concatenate([joints, *(position[:, None] for _, position in extra)], axis=1)
    return Points((*parents, *(j for j, _ in extra)), (*found, *(found[j] for j, _ in extra)), world)


def _average_rotations(turns: Array) -> Array:
    """Return the rotation (3, 3) nearest to the mean of rotations (n, 3, 3)."""
    u, _, vt = np.linalg.svd(turns.mean(axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
