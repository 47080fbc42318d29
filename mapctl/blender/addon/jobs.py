"""The four jobs, step by step: they read the scene, run mapctl, and make a new action of what it wrote."""

import tempfile
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from . import actions, exchange, rigify
from .body import (
    Y_UP,
    Body,
    Keys,
    list_channels,
    measure_fps,
    place_joints,
    pose_bones,
    read_poses,
    sample_motion,
    sample_worlds,
    solve_controls,
    take_bones,
    take_rest,
    to_armature,
)
from .exchange import WorldMotion
from .process import AddonError, Step, run_command

_GIVEN, _RESULT = "given.npz", "result.npz"  # files of a command
_LEVEL = 0.05  # metres that a level curve may rise and fall


def sample_curve(drawn: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Sample a curve in the world at its own resolution, without bevel, extrusion and modifiers: (points, 3) in metres,
    Y up, the first point again at the end of a cyclic one. AddonError for curves that are not one line."""
    splines = drawn.data.splines
    if len(splines) != 1:
        raise AddonError(f"{drawn.name} has {len(splines)} splines; a character follows a curve of one")
    plain = drawn.data.copy()
    holder = bpy.data.objects.new(drawn.name, plain)
    try:
        plain.bevel_depth = plain.extrude = plain.offset = 0.0
        plain.bevel_object = plain.taper_object = None
        plain.use_fill_caps = False
        if plain.dimensions == "2D":
            plain.fill_mode = "NONE"
        local = np.array([vertex.co for vertex in holder.to_mesh().vertices], dtype=np.float64).reshape(-1, 3)
        holder.to_mesh_clear()
    finally:
        bpy.data.objects.remove(holder)
        bpy.data.curves.remove(plain)
    if len(local) < 2:
        raise AddonError(f"{drawn.name} has no length")
    matrix = np.array(drawn.matrix_world, dtype=np.float64)
    world = (local @ matrix[:3, :3].T + matrix[:3, 3]) @ Y_UP.T * scene.unit_settings.scale_length
    return np.concatenate([world, world[:1]]) if splines[0].use_cyclic_u else world


_PROBES = 24  # frames in which the result is compared with what was wanted
_OFF = 0.001  # metres from which on bones that do not follow are named
_NEEDLESS = ("hips", "chest", "spine_fk.001")  # controls of a generated rig that a new action leaves alone


@dataclass(frozen=True, eq=False)
class Scene:
    """Scene data that a job works on."""

    scene: bpy.types.Scene
    """The scene, whose frame rate and frames count."""
    armature: bpy.types.Object
    """The character."""
    command: tuple[str, ...]
    """Words that start mapctl."""


@dataclass(frozen=True, eq=False)
class Result:
    """A motion to write as an action."""

    body: Body
    frames: range
    moved: np.ndarray
    """Matrices that move joints from their rest pose in the armature's space, (frames, joints, 4, 4)."""
    travelling: frozenset[int]
    generated: np.ndarray
    """Which frames have generated keys, (frames,)."""
    name: str
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
            actions.write_channel(at.armature, channel, result.frames, result.generated)
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
    """Reset what else a keyed bone's position and scale were set to."""
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

    def restore() -> None:
        actions.assign_action(armature, old, slot)
        for action in set(bpy.data.actions) - known:
            bpy.data.actions.remove(action)
        for name, basis in before.items():
            bones[name].matrix_basis = basis
        for bone, value in switched.items():
            bones[bone][switches[bone]] = value

    with ExitStack() as failing:
        failing.callback(restore)
        yield
        failing.pop_all()
    if old is not None:
        old.use_fake_user = True


Job = Generator[Step, None, tuple[tuple[str, ...], tuple[str, ...]]]
"""Steps of a job; it returns mapctl's lines, and what is not as it should be."""


def walk_along(at: Scene, drawn: bpy.types.Object, options: Sequence[str]) -> Job:
    """Let the character walk along a curve, from the scene's first frame on; `options` are those of `mapctl follow`."""
    body, points = take_body(at), sample_curve(drawn, at.scene)
    height = float(np.median(points[:, 1]))
    walk, travelling, lines = yield from _ask_for_walk(at, body, points, options)
    walk = replace(walk, positions=walk.positions + np.array([0.0, height, 0.0]))
    first = at.scene.frame_preview_start if at.scene.use_preview_range else at.scene.frame_start
    frames = range(first, first + len(walk.positions))
    with restored_scene(at):
        worlds = yield from sample_worlds(at.armature, at.scene, frames)
        moved = to_armature(walk, body, worlds)
        plain = np.zeros(len(frames), dtype=bool)
        name = f"{at.armature.name} along {drawn.name}"
        warnings = yield from make_action(at, Result(body, frames, moved, travelling, plain, name, fresh=True))
    at.scene.frame_end = max(at.scene.frame_end, frames.stop - 1)
    if np.ptp(points[:, 1]) > _LEVEL:
        warnings = (*warnings, f"{drawn.name} is not level: the character walks at its median height")
    return _shorten(lines), warnings


def _ask_for_walk(
    at: Scene, body: Body, points: np.ndarray, options: Sequence[str]
) -> Generator[Step, None, tuple[WorldMotion, frozenset[int], list[str]]]:
    """Ask mapctl for the walk, at the scene's frame rate; also return which joints travel, and its lines."""
    fps = measure_fps(at.scene)
    with tempfile.TemporaryDirectory(prefix="mapctl-") as name:
        folder = Path(name)
        exchange.write(take_rest(body, fps), folder / "character.npz", _place_ends(body), frozenset())
        np.savetxt(folder / "curve.csv", points[:, ::2], fmt="%.6f", delimiter=",", header="x,z", comments="")
        words = ["follow", "curve.csv", "--rig", "character.npz", "-o", "walk.npz"]
        words += ["--fps", f"{float(fps):.15g}", *options]
        lines = yield from run_command([*at.command, *words], folder, "walking")
        return *exchange.read(folder / "walk.npz"), lines


def clean_up(at: Scene, frames: range, *, anchor: bool) -> Job:
    """Denoise the action in these frames."""
    words = ["denoise", _GIVEN, "-o", _RESULT, *(["--capture", "video"] if anchor else [])]
    generated = np.zeros(len(frames), dtype=bool)
    return (yield from _edit(at, frames, words, generated, "clean", "cleaning up"))


def fill_gap(at: Scene, frames: range, gap: range, joints: Sequence[str]) -> Job:
    """Fill a gap in these frames, of some joints or of all."""
    if not (gap and frames.start <= gap.start and gap.stop <= frames.stop):
        asked, own = (f"{each.start} to {each.stop - 1}" for each in (gap, frames))
        raise AddonError(f"the gap {asked} is not within the action's frames {own}")
    words = ["infill", _GIVEN, "-o", _RESULT, "--gap", f"{gap.start - frames.start}:{gap.stop - frames.start}"]
    words += ["--joints", ",".join(joints)] if joints else []
    generated = np.array([frame in gap for frame in frames])
    return (yield from _edit(at, frames, words, generated, "filled", "filling the gap"))


def fill_between_keys(at: Scene, keyed: Sequence[int]) -> Job:
    """Make the motion between the frames that have keys, in order."""
    if len(keyed) < 2:
        raise AddonError("the action has keys in fewer than two frames: key at least a first and a last pose")
    if len(keyed) == keyed[-1] - keyed[0] + 1:
        raise AddonError(f"every frame from {keyed[0]} to {keyed[-1]} has keys: there is nothing in between")
    frames = range(keyed[0], keyed[-1] + 1)
    words = ["tween", _GIVEN, "-o", _RESULT, "--keyframes", ",".join(str(frame - frames.start) for frame in keyed)]
    generated = np.array([frame not in keyed for frame in frames])
    return (yield from _edit(at, frames, words, generated, "in-between", "in-betweening"))


def take_body(at: Scene) -> Body:
    """Take the joints of the character: of a rig generated by Rigify by its controls, else by its bones. AddonError
    where it cannot be read or keyed."""
    if at.armature.library is not None:
        raise AddonError(f"{at.armature.name} is linked from another file: make a library override of it")
    if at.armature.data.pose_position == "REST":
        raise AddonError(f"{at.armature.name} shows its rest position: set it to Pose Position (Armature properties)")
    if rigify.is_generated(at.armature):
        return rigify.take_controls(at.armature, at.scene)
    return take_bones(at.armature, at.scene)


def name_joints(at: Scene, bones: Sequence[str]) -> list[str]:
    """Name the joints of selected bones; AddonError where none of them is one."""
    body = take_body(at)
    joint_of = {control.bone: body.names[control.joint] for control in body.controls}
    joint_of |= dict(zip((*body.bones, *body.names), (*body.names, *body.names), strict=True))
    found = list(dict.fromkeys(joint_of[bone] for bone in bones if bone in joint_of))
    if not found:
        raise AddonError("no selected bone is a joint of the body: select some in Pose Mode, or leave the choice out")
    return found


def _edit(at: Scene, frames: range, words: Sequence[str], generated: np.ndarray, suffix: str, label: str) -> Job:
    """Send the action to a command of mapctl, and make a new one of what comes back."""
    body, old = take_body(at), actions.find_action(at.armature)
    with restored_scene(at), tempfile.TemporaryDirectory(prefix="mapctl-") as temporary:
        folder = Path(temporary)
        with rigify.keep_lengths(at.armature):
            motion, worlds = yield from sample_motion(at.armature, body, at.scene, frames)
        exchange.write(motion, folder / _GIVEN, _place_ends(body), body.movable)
        lines = yield from run_command([*at.command, *words], folder, label)
        answer, travelling = exchange.read(folder / _RESULT)
        if len(answer.positions) != len(frames):
            raise AddonError(f"mapctl answered with {len(answer.positions)} frames where {len(frames)} were requested")
        moved = to_armature(answer, body, worlds)
        name = f"{old.name} {suffix}"
        warnings = yield from make_action(at, Result(body, frames, moved, travelling, generated, name, fresh=False))
    counted = f"frame 0 in mapctl's lines is frame {frames.start} of the scene"
    return (counted, *_shorten(lines)), warnings


def _shorten(lines: Sequence[str]) -> tuple[str, ...]:
    """Leave the names of temporary files out of mapctl's lines."""
    return tuple(line.removeprefix(f"{_RESULT}: ") for line in lines if not line.startswith("wrote "))


def _place_ends(body: Body) -> dict[str, np.ndarray]:
    return {name: body.to_world(tail) for name, tail in body.ends.items()}
