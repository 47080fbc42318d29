"""The joints of an armature as mapctl gets them: heads of bones, in a world of metres with Y up."""

from collections.abc import Generator
from dataclasses import dataclass, field
from fractions import Fraction

import bpy
import numpy as np
from mathutils import Matrix, Quaternion

from .actions import Channel, name_channel
from .exchange import WorldMotion, join_signs, orthonormalise, to_quaternions, transpose
from .process import AddonError, Step

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From Blender's axes, Z up and facing -Y, to mapctl's, Y up and facing +Z."""
_UNEVEN = 1e-3  # what scales may differ by, relative
_NO_ANGLE = 1e-6  # sine of half an angle below which its axis is rounding
_FEWEST = 10  # bones that deform, from which on the others are left out


@dataclass(frozen=True)
class Control:
    """A bone of a generated rig that is keyed so that joints come out where they should."""

    bone: str
    """Name of the control."""
    joint: int
    """Joint with which it moves as one."""
    carrier: int | None
    """Joint with which it moves while it is not keyed itself; None for the armature."""
    travels: bool = False
    """Whether its location is keyed, too."""


@dataclass(frozen=True, eq=False)
class Body:
    """Joints, parents first, and the bones that show how they are."""

    names: tuple[str, ...]
    """Joint names: those of the bones that deform."""
    bones: tuple[str, ...]
    """Bone that moves with each joint."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for joint 0."""
    heads: np.ndarray
    """Joints at rest in the armature's space, (joints, 3)."""
    rests: np.ndarray
    """Matrices of `bones` at rest in the armature's space, (joints, 4, 4)."""
    ends: dict[str, np.ndarray]
    """Tails of last bones in the armature's space, by joint."""
    frame: np.ndarray
    """From the armature's space to mapctl's axes and metres as it is turned and scaled, but not moved, (4, 4)."""
    movable: frozenset[int] = frozenset()
    """Joints that may travel within their parent."""
    controls: tuple[Control, ...] = ()
    """Controls that are keyed on a generated rig; without any, `bones` are keyed."""
    switches: dict[str, str] = field(default_factory=dict)
    """Custom property of a bone of a generated rig that is keyed to 1, by bone."""

    def to_world(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) in the armature's space to mapctl's, with the armature at the origin."""
        return positions @ self.frame[:3, :3].T


def measure_world(armature: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Measure how the armature's space lies in mapctl's world now, (4, 4); AddonError for scales that deform it."""
    matrix = np.array(armature.matrix_world, dtype=np.float64)
    gram = matrix[:3, :3].T @ matrix[:3, :3]
    even = np.trace(gram) / 3
    if not np.allclose(gram, even * np.eye(3), atol=_UNEVEN * even) or even == 0:
        raise AddonError(f"{armature.name} is scaled unevenly: apply its scale (Object > Apply > Scale)")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise AddonError(f"{armature.name} is mirrored by a negative scale: apply its scale (Object > Apply > Scale)")
    turned = np.eye(4)
    turned[:3] = Y_UP @ matrix[:3] * scene.unit_settings.scale_length
    return turned


def measure_frame(armature: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Measure the same without the armature's position."""
    turned = measure_world(armature, scene)
    turned[:3, 3] = 0.0
    return turned


def take_bones(armature: bpy.types.Object, scene: bpy.types.Scene) -> Body:
    """Take the bones of an armature as joints: the tree in which most bones deform, down to the last of these.

    AddonError for an armature without bones.
    """
    trees = [[root, *root.children_recursive] for root in armature.data.bones if root.parent is None]
    if not trees:
        raise AddonError(f"{armature.name} has no bones")
    whole = max(trees, key=lambda tree: (sum(bone.use_deform for bone in tree), len(tree)))
    needed = {bone.name for bone in whole if bone.use_deform or any(b.use_deform for b in bone.children_recursive)}
    bones = _order([bone for bone in whole if len(needed) < _FEWEST or bone.name in needed])
    numbers = {bone.name: number for number, bone in enumerate(bones)}
    last = set(numbers) - {bone.parent.name for bone in bones if bone.parent}
    return Body(
        names=tuple(numbers),
        bones=tuple(numbers),
        parents=tuple(numbers[bone.parent.name] if bone.parent else -1 for bone in bones),
        heads=np.array([bone.head_local for bone in bones], dtype=np.float64),
        rests=np.array([bone.matrix_local for bone in bones], dtype=np.float64),
        ends={bone.name: np.array(bone.tail_local, dtype=np.float64) for bone in bones if bone.name in last},
        frame=measure_frame(armature, scene),
        movable=frozenset(number for number, bone in enumerate(bones) if bone.parent and not bone.use_connect),
    )


def _order(bones: list[bpy.types.Bone]) -> list[bpy.types.Bone]:
    """Order bones so that parents come first."""
    return sorted(bones, key=lambda bone: len(bone.parent_recursive))


def measure_fps(scene: bpy.types.Scene) -> Fraction:
    """Measure the scene's frame rate: 24 / 1.001 is 24000/1001."""
    return Fraction(scene.render.fps) / Fraction(scene.render.fps_base).limit_denominator(100_000)


def take_rest(body: Body, fps: Fraction) -> WorldMotion:
    """Take two frames of the rest pose, with the armature at the origin."""
    rest = body.to_world(body.heads)
    rotations = np.tile(np.eye(3), (2, len(body.names), 1, 1))
    return WorldMotion(body.names, body.parents, rest, fps, rotations, np.stack([rest, rest]))


def sample_motion(
    armature: bpy.types.Object, body: Body, scene: bpy.types.Scene, frames: range
) -> Generator[Step, None, tuple[WorldMotion, np.ndarray]]:
    """Sample the joints in every frame, as Blender evaluates them with all constraints; also return how the armature
    lies in the world then, (frames, 4, 4). The scene's frame is another one afterwards."""
    poses, worlds = np.empty((len(frames), len(body.bones), 4, 4)), np.empty((len(frames), 4, 4))
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        worlds[number] = measure_world(armature, scene)
        poses[number] = read_poses(armature, body.bones)
        yield Step("reading the action", number + 1, len(frames))
    moved = poses @ np.linalg.inv(body.rests)
    basis = orthonormalise(worlds[:, None, :3, :3])
    rotations = basis @ orthonormalise(moved[..., :3, :3]) @ transpose(orthonormalise(body.frame[:3, :3]))
    positions = np.einsum("fjab,jb->fja", worlds[:, None] @ moved, add_one(body.heads))[..., :3]
    return WorldMotion(
        body.names, body.parents, body.to_world(body.heads), measure_fps(scene), rotations, positions
    ), worlds


def sample_worlds(
    armature: bpy.types.Object, scene: bpy.types.Scene, frames: range
) -> Generator[Step, None, np.ndarray]:
    """Sample how the armature lies in the world in every frame, (frames, 4, 4): once where nothing can move it."""
    if armature.parent is None and not armature.constraints:
        return np.tile(measure_world(armature, scene), (len(frames), 1, 1))
    worlds = np.empty((len(frames), 4, 4))
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        worlds[number] = measure_world(armature, scene)
        yield Step("reading the armature's position", number + 1, len(frames))
    return worlds


def read_poses(armature: bpy.types.Object, bones: tuple[str, ...]) -> np.ndarray:
    """Read the matrices of bones in the armature's space as they are evaluated now, (bones, 4, 4)."""
    pose = armature.pose.bones
    return np.array([pose[name].matrix for name in bones], dtype=np.float64)


def to_armature(motion: WorldMotion, body: Body, worlds: np.ndarray) -> np.ndarray:
    """Convert a motion of the body to what moves each joint from its rest in the armature's space, (frames, joints, 4,
    4): rotations and positions, no scale."""
    order = [motion.names.index(name) for name in body.names]
    rotations, rest = motion.rotations[:, order], body.to_world(body.heads)
    moved = np.zeros((len(rotations), len(order), 4, 4))
    moved[..., :3, :3] = rotations
    moved[..., :3, 3] = motion.positions[:, order] - (rotations @ rest[..., None])[..., 0]
    moved[..., 3, 3] = 1.0
    return np.linalg.inv(worlds)[:, None] @ moved @ body.frame


def add_one(positions: np.ndarray) -> np.ndarray:
    """Append the 1 of homogeneous coordinates."""
    return np.concatenate([positions, np.ones((*positions.shape[:-1], 1))], axis=-1)


_MOST_PASSES = 8
_CLOSE = 1e-6  # of the body's size, and radians: where controls are as they should be


@dataclass(frozen=True, eq=False)
class Keys:
    """F-curves with which a bone is keyed."""

    bone: str
    matrices: np.ndarray
    """Matrices relative to the bone's rest and its parent, (frames, 4, 4)."""
    travels: bool


def pose_bones(armature: bpy.types.Object, body: Body, moved: np.ndarray, travelling: frozenset[int]) -> list[Keys]:
    """Find what the bones of a body are keyed with; joint 0 and the `travelling` ones with their location, too."""
    poses, keys = moved @ body.rests, []
    for joint, (name, parent) in enumerate(zip(body.bones, body.parents, strict=True)):
        bone = armature.data.bones[name]
        if parent < 0:
            carried = np.broadcast_to(body.rests[joint], poses[:, joint].shape)
        else:
            carried = poses[:, parent] @ np.linalg.inv(body.rests[parent]) @ body.rests[joint]
        basis = np.linalg.inv(carried) @ poses[:, joint]
        if parent >= 0 and not (bone.use_inherit_rotation and bone.use_local_location):
            basis = _ask_blender(bone, poses[:, joint], poses[:, parent])
        keys.append(Keys(name, basis, joint == 0 or joint in travelling))
    return keys


def _ask_blender(bone: bpy.types.Bone, poses: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Find what a bone is keyed with that does not simply follow its parent."""
    rest, above = bone.matrix_local, bone.parent.matrix_local
    return np.array(
        [
            bone.convert_local_to_pose(
                Matrix(pose), rest, parent_matrix=Matrix(parent), parent_matrix_local=above, invert=True
            )
            for pose, parent in zip(poses, parents, strict=True)
        ]
    )


def solve_controls(
    armature: bpy.types.Object, body: Body, scene: bpy.types.Scene, frames: range, moved: np.ndarray
) -> Generator[Step, None, list[Keys]]:
    """Find what the controls of a generated rig are keyed with.

    Each is moved as its joint still has to move, on the assumption that it goes along with its carrier; Blender then
    shows where the joints are, until they are right. So whatever lies between the controls is accounted for.
    """
    found = np.empty((len(body.controls), len(frames), 4, 4))
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        for _ in range(_MOST_PASSES):
            actual = _read_moved(armature, body)
            if measure_distance(body, actual, moved[number]) < _CLOSE:
                break
            for control in body.controls:
                _correct(armature, control, actual, moved[number])
            bpy.context.view_layer.update()
        found[:, number] = [armature.pose.bones[control.bone].matrix_basis for control in body.controls]
        yield Step("setting the controls", number + 1, len(frames))
    return [Keys(control.bone, found[n], control.travels) for n, control in enumerate(body.controls)]


def _read_moved(armature: bpy.types.Object, body: Body) -> np.ndarray:
    """Read what moves each joint from its rest now, without scale, (joints, 4, 4)."""
    moved = read_poses(armature, body.bones) @ np.linalg.inv(body.rests)
    positions = np.einsum("jab,jb->ja", moved, add_one(body.heads))[:, :3]
    moved[:, :3, :3] = orthonormalise(moved[:, :3, :3])
    moved[:, :3, 3] = positions - (moved[:, :3, :3] @ body.heads[..., None])[..., 0]
    return moved


def measure_distance(body: Body, actual: np.ndarray, wanted: np.ndarray) -> float:
    """Measure how far joints are off: the largest of distances by the body's size, and of sines of angles."""
    apart = np.linalg.norm(place_joints(body, actual) - place_joints(body, wanted), axis=-1).max()
    turned = np.abs(actual[:, :3, :3] - wanted[:, :3, :3]).max()
    return float(max(apart / np.ptp(body.heads, axis=0).max(), turned))


def place_joints(body: Body, moved: np.ndarray) -> np.ndarray:
    """Place the joints in the armature's space, (..., joints, 3)."""
    return np.einsum("...jab,jb->...ja", moved, add_one(body.heads))[..., :3]


def _correct(armature: bpy.types.Object, control: Control, actual: np.ndarray, wanted: np.ndarray) -> None:
    """Move a control as its joint still has to move."""
    bone = armature.pose.bones[control.bone]
    pose, basis = np.array(bone.matrix), np.array(bone.matrix_basis)
    carried = pose @ np.linalg.inv(basis)
    if control.carrier is not None:
        carried = wanted[control.carrier] @ np.linalg.inv(actual[control.carrier]) @ carried
    aim = np.linalg.inv(carried) @ wanted[control.joint] @ np.linalg.inv(actual[control.joint]) @ pose
    aim[:3, :3] = orthonormalise(aim[:3, :3])
    if not control.travels:
        aim[:3, 3] = 0.0
    bone.matrix_basis = Matrix(aim)


def list_channels(armature: bpy.types.Object, keys: list[Keys]) -> list[Channel]:
    """List the curves' values, rotations in each bone's own mode and without jumps."""
    channels = []
    for each in keys:
        mode = armature.pose.bones[each.bone].rotation_mode
        attribute, values = _convert_rotations(each.matrices[:, :3, :3], mode)
        channels.append(Channel(name_channel(each.bone, attribute), each.bone, values))
        if each.travels:
            channels.append(Channel(name_channel(each.bone, "location"), each.bone, each.matrices[:, :3, 3]))
    return channels


def _convert_rotations(matrices: np.ndarray, mode: str) -> tuple[str, np.ndarray]:
    """Convert rotations to the property that a rotation mode uses, and its values."""
    quaternions = join_signs(np.roll(to_quaternions(orthonormalise(matrices)), 1, axis=-1))  # wxyz from here on
    if mode == "QUATERNION":
        return "rotation_quaternion", quaternions
    if mode == "AXIS_ANGLE":  # axes do not turn over, angles go through 0 instead
        vectors = quaternions[:, 1:]
        lengths = np.linalg.norm(vectors, axis=1)
        known = lengths > _NO_ANGLE  # where there is no angle the axis stays
        last = np.maximum.accumulate(np.where(known, np.arange(len(known)), known.argmax()))
        axes = vectors[last] / np.maximum(lengths[last, None], 1e-9)
        turns = np.where((axes[1:] * axes[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        axes *= np.cumprod(np.r_[1.0, turns])[:, None]
        halves = np.arctan2((vectors * axes).sum(axis=1), quaternions[:, 0])
        return "rotation_axis_angle", np.column_stack([np.unwrap(2 * halves, period=4 * np.pi), axes])
    angles = [Quaternion(quaternions[0]).to_euler(mode)]
    for quaternion in quaternions[1:]:
        angles.append(Quaternion(quaternion).to_euler(mode, angles[-1]))
    return "rotation_euler", np.array(angles)
