"""From a motion of mapctl's to a new action of the armature, or no trace of one."""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..problem import Step
from . import actions
from .body import Body
from .posing import Keys, list_channels, place_joints, pose_bones, solve_controls
from .sampling import read_poses

_PROBES = 24  # frames in which the result is compared with what was wanted
_OFF = 0.001  # metres from which on bones that do not follow are told
_NEEDLESS = ("hips", "chest", "spine_fk.001")  # controls of a generated rig that a new action leaves alone


@dataclass(frozen=True, eq=False)
class Scene:
    """What a job works on."""

    scene: bpy.types.Scene
    """The scene, whose frame rate and frames count."""
    armature: bpy.types.Object
    """The character."""
    command: tuple[str, ...]
    """Words that start mapctl."""


@dataclass(frozen=True, eq=False)
class Result:
    """A motion that an action is to be made of."""

    body: Body
    """The character's joints."""
    frames: range
    """Frames of the scene."""
    moved: np.ndarray
    """What moves the joints from their rest in the armature's space, (frames, joints, 4, 4)."""
    travelling: frozenset[int]
    """Joints that travel within their parent."""
    made: np.ndarray
    """Which frames have generated keys, (frames,)."""
    name: str
    """Name of the new action."""
    fresh: bool
    """Whether the action is empty at first, not a copy of the one before."""


def make_action(at: Scene, result: Result) -> Generator[Step, None, tuple[str, ...]]:
    """Make an action of a result; the one before is kept by a fake user. Ended early it leaves no trace."""
    with _restored_pose(at, result.body.switches):
        if result.fresh:
            actions.add_action(at.armature, result.name)
        else:
            actions.copy_action(at.armature, result.name)
        keys = yield from _find_keys(at, result)
        for channel in list_channels(at.armature, keys):
            actions.write_channel(at.armature, channel, result.frames, result.made)
        _reset_unkeyed(at.armature, keys)
        return (yield from _compare(at, result))


def _find_keys(at: Scene, result: Result) -> Generator[Step, None, list[Keys]]:
    """Find what bones or controls are keyed with, and take their keys of before out of the action."""
    body = result.body
    if not body.controls:
        actions.clear_bones(at.armature, body.bones)
        return pose_bones(at.armature, body, result.moved, result.travelling)
    actions.clear_bones(at.armature, [control.bone for control in body.controls])
    for bone, name in body.switches.items():
        path = f'pose.bones["{bpy.utils.escape_identifier(bone)}"]["{name}"]'
        actions.set_constant(at.armature, path, 1.0, result.frames.start)
    if result.fresh:
        _reset_needless(at.armature)
    return (yield from solve_controls(at.armature, body, at.scene, result.frames, result.moved))


def _compare(at: Scene, result: Result) -> Generator[Step, None, tuple[str, ...]]:
    """Compare what Blender makes of the action with what was wanted; return what is wrong with it."""
    body, scale = result.body, np.linalg.norm(result.body.frame[:3, 0])
    worst, where = 0.0, ""
    for number in np.unique(np.linspace(0, len(result.frames) - 1, _PROBES).astype(int)):
        at.scene.frame_set(result.frames[number])
        actual = read_poses(at.armature, body.bones) @ np.linalg.inv(body.rests)
        apart = np.linalg.norm(place_joints(body, actual) - place_joints(body, result.moved[number]), axis=-1) * scale
        if apart.max() > worst:
            worst, where = float(apart.max()), body.names[int(apart.argmax())]
        yield Step("checking")
    if worst < _OFF:
        return ()
    return (f"{where} is up to {100 * worst:.1f} cm off: constraints or drivers keep bones from where they should be",)


def _reset_unkeyed(armature: bpy.types.Object, keys: Sequence[Keys]) -> None:
    """Reset what else a keyed bone's place and scale were set to."""
    for each in keys:
        bone = armature.pose.bones[each.bone]
        bone.scale = (1.0, 1.0, 1.0)
        if not each.travels:
            bone.location = (0.0, 0.0, 0.0)


def _reset_needless(armature: bpy.types.Object) -> None:
    """Reset the controls that would bend a generated rig beside those that are keyed."""
    for bone in armature.pose.bones:
        if bone.name in _NEEDLESS or "tweak" in bone.name:
            bone.matrix_basis.identity()


@contextmanager
def restored_scene(at: Scene) -> Iterator[None]:
    """Go back to the frame of before at the end."""
    frame, subframe = at.scene.frame_current, at.scene.frame_subframe
    try:
        yield
    finally:
        at.scene.frame_set(frame, subframe=subframe)


@contextmanager
def _restored_pose(at: Scene, switches: Mapping[str, str]) -> Iterator[None]:
    """Keep the old action by a fake user at the end; go back to it, and to the pose, if the block ends early."""
    armature = at.armature
    bones = armature.pose.bones
    before = {bone.name: bone.matrix_basis.copy() for bone in bones}
    switched = {bone: bones[bone][name] for bone, name in switches.items()}
    data = armature.animation_data
    old, slot = (data.action, actions.name_slot(armature)) if data else (None, "")
    known = set(bpy.data.actions)
    try:
        yield
    except BaseException:
        actions.assign_action(armature, old, slot)
        for made in set(bpy.data.actions) - known:
            bpy.data.actions.remove(made)
        for name, basis in before.items():
            bones[name].matrix_basis = basis
        for bone, value in switched.items():
            bones[bone][switches[bone]] = value
        raise
    if old is not None:
        old.use_fake_user = True
