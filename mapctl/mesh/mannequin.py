"""A mannequin for any skeleton: left limbs blue, right limbs orange, torso in the actor's colour."""

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import MapctlError
from mapctl.joint_names import Part, Side
from mapctl.mesh import colours
from mapctl.mesh.anatomy import Anatomy, Foot
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.primitives import Array, RoundedBoxes, Surface, frame_along
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton

# Radii at a bone's start and end in metres, for a leg of 80 cm; a bone belongs to the part it starts at.
_RADII = {
    Part.NECK: (0.050, 0.046),
    Part.SHOULDER: (0.052, 0.056),
    Part.UPPER_ARM: (0.047, 0.042),
    Part.LOWER_ARM: (0.037, 0.026),
    Part.HAND: (0.033, 0.026),
    Part.FINGER: (0.009, 0.008),
    Part.UPPER_LEG: (0.078, 0.057),
    Part.LOWER_LEG: (0.050, 0.034),
    Part.OTHER: (0.015, 0.012),
}
# Bones from the trunk to a limb, by the part they lead to.
_LINKS = {
    Part.UPPER_LEG: (0.092, 0.081),
    Part.HIPS: (0.092, 0.084),
    Part.SHOULDER: (0.060, 0.056),
    Part.UPPER_ARM: (0.060, 0.056),
    Part.OTHER: (0.015, 0.012),
}
_TRUNK = ((0.0, 0.35, 0.75, 1.0), (0.100, 0.096, 0.110, 0.060))
"""Shares of the distance from hips to neck, and the trunk's radius there, metres."""
_OVERLAP = 0.93
"""A trunk bone starts thinner than the one below ends, so that their skins cut cleanly."""
_TRUNK_PARTS = (Part.HIPS, Part.TORSO)
_TRUNK_SQUASH = (1.22, 1.0, 0.86)
_HAND_SQUASH = (0.55, 1.0, 1.25)
_SKULL = (0.082, 0.112, 0.098)
_VISOR = (0.079, 0.046, 0.088)
_EDGE = 0.022
"""Rounding of the shoes' edges, metres."""
_BOXED = (Part.HEAD, Part.FOOT, Part.TOES)
"""Parts drawn as skull and shoes instead of one capsule a bone."""


@dataclass(frozen=True, eq=False)
class Bones:
    """Capsules between two points each; arrays over bones."""

    ends: Array
    """(bones, 2) point indices."""
    radius: Array
    """(bones, 2) metres."""
    squash: Array
    """(bones, 3) factors of the rounding."""
    rgb: Array
    """(bones, 3) sRGB."""
    height: Array
    """(bones,) share of the distance from hips to shoulders; decides the direction in which a bone is flattened."""


class Mannequin:
    """The body of one actor over a whole motion."""

    def __init__(self, motion: Motion, colour: Array):
        self.anatomy = Anatomy(motion)
        self.colour = colour
        self.bones = _build_bones(self.anatomy, colour)
        self._left = self.anatomy.left(Part.UPPER_LEG), self.anatomy.left(Part.UPPER_ARM)

    @property
    def num_frames(self) -> int:
        """Frames of the motion."""
        return len(self.anatomy.points.world)

    @property
    def seen(self) -> Array:
        """Positions (frames, n, 3) of hips and all below, metres, without a root on the floor."""
        return self.anatomy.seen

    def boxes(self, frame: int) -> tuple[RoundedBoxes, Array]:
        """Return limbs and trunk, skull and shoes in one frame, and the joints (parts,) that carry them."""
        anatomy, head = self.anatomy, self.anatomy.find(Part.HEAD)
        found = [(self._capsules(frame), self.bones.ends[:, 0])]
        if head is not None:
            found.append((_skull(anatomy, head, frame, self.colour), np.array([head, head])))
        for foot in anatomy.feet:
            toe = foot.ball if foot.ball < anatomy.joints else foot.ankle
            found.append((_shoe(anatomy, foot, frame), np.array([foot.ankle, toe][: len(foot.bones)])))
        boxes, joints = zip(*found, strict=True)
        names = ("centre", "frame", "half", "radius", "squash", "rgb")
        whole = RoundedBoxes(*(np.concatenate([getattr(box, name) for box in boxes]) for name in names))
        return whole, np.concatenate(joints)

    def surface(self, frame: int) -> Surface:
        """Return the whole body in one frame."""
        return self.boxes(frame)[0].surface()

    def sticks(self, frame: int) -> tuple[Array, Array, Array]:
        """Return all bones with those of head and feet: ends (n, 2, 3) and radii (n,) in metres, colours (n, 3)."""
        ends, radius, rgb = self._sticks
        return self.anatomy.points.world[frame, ends], radius, rgb

    @cached_property
    def _sticks(self) -> tuple[Array, Array, Array]:
        anatomy, bones = self.anatomy, self.bones
        shoes = [(joints, foot) for foot in anatomy.feet for joints in foot.bones]
        head = anatomy.find(Part.HEAD)
        crown = [(head, tip) for tip in anatomy.children(head) if tip >= anatomy.joints][:1] if head is not None else []
        ends = np.array([*map(tuple, bones.ends), *(joints for joints, _ in shoes), *crown]).reshape(-1, 2)
        wide = np.array([0.045] * len(shoes) + [0.09] * len(crown)) * anatomy.scale
        rgb = [*bones.rgb, *(_limb_colour(foot.side) for _, foot in shoes), *(self.colour for _ in crown)]
        return (
            ends,
            np.concatenate([bones.radius.mean(axis=1) * bones.squash[:, 0], wide]),
            np.array(rgb).reshape(-1, 3),
        )

    def _capsules(self, frame: int) -> RoundedBoxes:
        bones, world = self.bones, self.anatomy.points.world[frame]
        start, stop = world[bones.ends[:, 0]], world[bones.ends[:, 1]]
        low, high = self._left[0][frame], self._left[1][frame]
        across = low + (high - low) * bones.height[:, None]
        half = np.linalg.norm(stop - start, axis=1) / 2
        zero = np.zeros_like(half)
        return RoundedBoxes(
            centre=(start + stop) / 2,
            frame=frame_along(stop - start, across),
            half=np.stack([zero, half, zero], axis=1),
            radius=bones.radius,
            squash=bones.squash,
            rgb=bones.rgb,
        )


def _build_bones(anatomy: Anatomy, colour: Array) -> Bones:
    # No bone leads from a floor root to the hips; none is within skull and shoes, or without length.
    rest = anatomy.points.world[0]
    pairs = [
        (parent, child)
        for child, parent in enumerate(anatomy.points.parents)
        if parent >= anatomy.hips and child > anatomy.hips and anatomy.points.roles[parent].part not in _BOXED
        if np.linalg.norm(rest[child] - rest[parent]) > 0.005 * anatomy.scale
    ]
    ends = pairs or [(anatomy.hips, anatomy.hips)]  # a lone joint is a ball
    shares = _trunk_shares(anatomy)
    return Bones(
        ends=np.array(ends),
        radius=np.array([_radii(anatomy, child, parent, shares) for parent, child in ends]) * anatomy.scale,
        squash=np.array([_squash(anatomy, child, parent) for parent, child in ends]),
        rgb=np.array([_colour(anatomy, parent, colour) for parent, _ in ends]),
        height=shares[np.array(ends)].mean(axis=1),
    )


def _trunk_shares(anatomy: Anatomy) -> Array:
    """Return every point's share of the distance from hips to neck along the bones; 0 for legs, 1 for arms and head."""
    points, top = anatomy.points, anatomy.find(Part.NECK)
    top = anatomy.find(Part.HEAD) if top is None else top
    length = np.zeros(len(points.parents))
    for point, parent in enumerate(points.parents):
        if point > anatomy.hips and parent >= 0:
            length[point] = length[parent] + np.linalg.norm(points.world[0, point] - points.world[0, parent])
    legs = (Part.UPPER_LEG, Part.LOWER_LEG, Part.FOOT, Part.TOES)
    low = np.array([role.part in legs for role in points.roles])
    whole = length[top] if top is not None and length[top] > 0 else 0.5 * anatomy.scale
    return np.where(low, 0.0, np.clip(length / whole, 0.0, 1.0))


def _is_link(anatomy: Anatomy, child: int, parent: int) -> bool:
    """Return whether a bone leads from the trunk to a limb."""
    below, above = anatomy.points.roles[child], anatomy.points.roles[parent]
    return above.part in _TRUNK_PARTS and (below.part in _LINKS) and below.side is not Side.MIDDLE


def _radii(anatomy: Anatomy, child: int, parent: int, shares: Array) -> tuple[float, float]:
    below, above = anatomy.points.roles[child].part, anatomy.points.roles[parent].part
    if above is Part.HAND and below is Part.FINGER:
        return 0.016, 0.013
    if _is_link(anatomy, child, parent):
        return _LINKS[below]
    if above in _TRUNK_PARTS and anatomy.points.roles[parent].side is Side.MIDDLE:
        start, stop = np.interp(shares[[parent, child]], *_TRUNK)
        return float(start) * _OVERLAP, float(stop)
    return _RADII.get(above, _LINKS[Part.UPPER_LEG])


def _squash(anatomy: Anatomy, child: int, parent: int) -> tuple[float, float, float]:
    above = anatomy.points.roles[parent]
    if above.part in _TRUNK_PARTS and not _is_link(anatomy, child, parent):
        return _TRUNK_SQUASH
    return _HAND_SQUASH if above.part is Part.HAND else (1.0, 1.0, 1.0)


def _colour(anatomy: Anatomy, parent: int, colour: Array) -> Array:
    role = anatomy.points.roles[parent]
    if role.part in (*_TRUNK_PARTS, Part.SHOULDER) or role.side is Side.MIDDLE:
        return _lighten(colour) if role.part is Part.NECK else colour
    return _limb_colour(role.side)


def _limb_colour(side: Side) -> Array:
    return colours.rgb(colours.LEFT if side is Side.LEFT else colours.RIGHT)


def _skull(anatomy: Anatomy, head: int, frame: int, colour: Array) -> RoundedBoxes:
    """Return a head with a dark visor where it faces."""
    scale, turn = anatomy.scale, anatomy.rotations[frame, head] @ anatomy.head_axes
    middle = anatomy.points.world[frame, head] + turn @ np.array([0.0, 0.085, 0.012]) * scale
    visor = middle + turn @ np.array([0.0, 0.014, 0.021]) * scale
    return RoundedBoxes(
        centre=np.stack([middle, visor]),
        frame=np.stack([turn, turn]),
        half=np.zeros((2, 3)),
        radius=np.full((2, 2), scale),
        squash=np.array([_SKULL, _VISOR]),
        rgb=np.stack([_lighten(colour), colours.rgb(colours.VISOR)]),
    )


def _lighten(colour: Array) -> Array:
    """Return the colour of head and neck, a little lighter than the trunk."""
    return colours.blend_colours(colour, np.ones(3), 0.18)


def _shoe(anatomy: Anatomy, foot: Foot, frame: int) -> RoundedBoxes:
    """Build heel to ball and, where there are toes, ball to tip; soles on the ground when the foot is flat."""
    world, scale = anatomy.points.world[frame], anatomy.scale
    turn, boxes = anatomy.rotations[frame, foot.ankle] @ foot.axes, []
    reach = float(turn[:, 2] @ (world[foot.ball] - world[foot.ankle])) + (0.03 if foot.tip is None else 0.01) * scale
    boxes.append(_sole(world[foot.ankle], turn, -foot.heights[0], (-0.055 * scale, reach), 0.085, scale))
    if foot.tip is not None:
        turn = anatomy.rotations[frame, foot.ball] @ foot.toe_axes
        reach = max(float(turn[:, 2] @ (world[foot.tip] - world[foot.ball])), 0.04 * scale)
        boxes.append(_sole(world[foot.ball], turn, -foot.heights[1], (-0.035 * scale, reach), 0.055, scale))
    centre, frames, half = (np.stack(values) for values in zip(*boxes, strict=True))
    many, leather = len(boxes), colours.blend_colours(_limb_colour(foot.side), np.zeros(3), 0.28)
    return RoundedBoxes(
        centre, frames, half, np.full((many, 2), _EDGE * scale), np.ones((many, 3)), np.tile(leather, (many, 1))
    )


def _sole(joint: Array, turn: Array, floor: float, along: tuple[float, float], thick: float, scale: float):
    """Return the centre, frame and half extents of a box with its floor over a joint and its reach along it, metres."""
    middle = np.array([0.0, floor + thick * scale / 2, sum(along) / 2])
    half = np.array([0.045 * scale, thick * scale / 2, (along[1] - along[0]) / 2])
    return joint + turn @ middle, turn, np.maximum(half - _EDGE * scale, 0.0)


class SkinnedBody:
    """The mesh of a character, moved by its joints; its bones and marks are those of another body in the same place."""

    def __init__(self, mesh: CharacterMesh, motion: Motion, bones: Mannequin):
        """`motion` is on the joints of the mesh, frame by frame that of `bones`. MapctlError where it is not."""
        if motion.num_joints != len(mesh.rest) or motion.num_frames != bones.num_frames:
            found = f"{motion.num_joints} joints and {motion.num_frames} frames"
            raise MapctlError(f"a mesh of {len(mesh.rest)} joints and {bones.num_frames} frames got {found}")
        self._mesh, self._bones = mesh, bones
        self._positions = motion.joint_positions().numpy()
        self._turns = rotations.to_matrix(motion.joint_rotations()).numpy()

    @property
    def anatomy(self) -> Anatomy:
        """Hips, head and soles."""
        return self._bones.anatomy

    @property
    def num_frames(self) -> int:
        """Frames of the motion."""
        return self._bones.num_frames

    @property
    def seen(self) -> Array:
        """Positions (frames, n, 3) of its bones, and of the vertices that are outermost at rest, metres."""
        vertices = self._mesh.vertices
        outer = np.concatenate([vertices.argmin(axis=0), vertices.argmax(axis=0)])
        joint = self._mesh.joints[outer, self._mesh.weights[outer].argmax(axis=1)]
        turned = np.einsum("fnab,nb->fna", self._turns[:, joint], vertices[outer] - self._mesh.rest[joint])
        return np.concatenate([self._bones.seen, self._positions[:, joint] + turned], axis=1)

    def surface(self, frame: int) -> Surface:
        """Return the mesh in one frame; it is open, as clothes and hair are, and seen from both sides."""
        vertices, normals = self._mesh.pose(self._positions[frame], self._turns[frame])
        return Surface(vertices, self._mesh.faces, self._mesh.rgba, normals, is_open=True)

    def sticks(self, frame: int) -> tuple[Array, Array, Array]:
        """Return all bones in one frame: ends (n, 2, 3) and radii (n,) in metres, colours (n, 3) sRGB."""
        return self._bones.sticks(frame)


Body = Mannequin | SkinnedBody
"""Body drawn for an actor."""


def build_skin(motion: Motion, colour: str = "slate") -> CharacterMesh:
    """Build the body of a motion in its skeleton's rest pose, with the root at the origin; its frames show when feet
    are flat, so it should hold more than one step. Each triangle is carried by one joint.

    `colour` is the torso's: a name of `colours.ACTORS` or `#rrggbb`; RequestError otherwise.
    """
    body = Mannequin(motion, colours.rgb(colour))
    boxes, joints = body.boxes(0)
    whole = boxes.surface()
    joint = np.repeat(joints, len(whole.vertices) // len(joints))
    assert whole.normals is not None, "boxes are lit"
    turn = body.anatomy.rotations[0, joint]
    rest = place_at_rest(motion.skeleton)
    local = np.einsum("nji,nj->ni", turn, whole.vertices - body.anatomy.points.world[0, joint])
    return CharacterMesh(
        vertices=local + rest[joint],
        normals=np.einsum("nji,nj->ni", turn, whole.normals),
        faces=whole.faces,
        rgba=whole.rgba,
        joints=joint[:, None],
        weights=np.ones((len(joint), 1)),
        rest=rest,
    )


def place_at_rest(skeleton: Skeleton) -> Array:
    """Return the joints (joints, 3) in the rest pose, metres, with the root at the origin."""
    rest = np.zeros((skeleton.num_joints, 3))
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        rest[joint] = skeleton.offsets[joint].numpy() + rest[parent]
    return rest


def at_rest(skeleton: Skeleton = CANONICAL) -> Motion:
    """Return one frame of a skeleton in its rest pose, the lowest joint as high as a toe joint of a flat foot."""
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(1, skeleton.num_joints, 1)
    motion = Motion(skeleton, Fraction(30), torch.zeros(1, 3, dtype=torch.float64), still)
    lowest = float(motion.joint_positions()[..., 1].min())
    return replace(motion, root_position=torch.tensor([[0.0, TOE_REST_HEIGHT - lowest, 0.0]], dtype=torch.float64))
