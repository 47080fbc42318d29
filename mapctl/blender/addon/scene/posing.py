"""From where joints go to what bones are keyed with: their places and rotations relative to their parents."""

from collections.abc import Generator
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix, Quaternion

from ..problem import Step
from ..rotations import join_signs, orthonormalise, to_axis_angles, to_quaternions
from .actions import Channel, name_channel
from .body import Body, Control
from .sampling import add_one, read_poses

_MOST_PASSES = 8
_CLOSE = 1e-6  # of the body's size, and radians: where controls are as they should be


@dataclass(frozen=True, eq=False)
class Keys:
    """What a bone is keyed with."""

    bone: str
    """Name of the bone."""
    matrices: np.ndarray
    """Matrices relative to the bone's rest and its parent, (frames, 4, 4)."""
    travels: bool
    """Whether its location is keyed."""


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
    says where the joints are, until they are right. So whatever lies between the controls is accounted for.
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
    places = np.einsum("jab,jb->ja", moved, add_one(body.heads))[:, :3]
    moved[:, :3, :3] = orthonormalise(moved[:, :3, :3])
    moved[:, :3, 3] = places - (moved[:, :3, :3] @ body.heads[..., None])[..., 0]
    return moved


def measure_distance(body: Body, actual: np.ndarray, wanted: np.ndarray) -> float:
    """Measure how far joints are from where they should be: the largest of distances by the body's size, and of sines
    of angles."""
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
    if mode == "AXIS_ANGLE":
        return "rotation_axis_angle", to_axis_angles(quaternions)
    angles = [Quaternion(quaternions[0]).to_euler(mode)]
    for quaternion in quaternions[1:]:
        angles.append(Quaternion(quaternion).to_euler(mode, angles[-1]))
    return "rotation_euler", np.array(angles)
