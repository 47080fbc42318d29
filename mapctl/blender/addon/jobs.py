"""The four jobs, step by step: they read the scene, run mapctl, and make a new action of what it wrote."""

import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from . import exchange
from .exchange import WorldMotion
from .problem import AddonError, Step
from .process import run_command
from .scene import actions, rigify
from .scene.body import Body, take_bones
from .scene.drawn_curve import measure_height, sample_curve, write_curve
from .scene.making import Result, Scene, make_action, restored_scene
from .scene.sampling import measure_fps, sample_motion, sample_worlds, take_rest, to_armature


@dataclass(frozen=True)
class Outcome:
    """What there is to tell of a job that was done."""

    lines: tuple[str, ...]
    """What mapctl said."""
    warnings: tuple[str, ...] = ()
    """What is not as it should be."""


Job = Generator[Step, None, Outcome]
"""Steps of a job, and what to tell of it."""


@dataclass(frozen=True)
class WalkOptions:
    """How a character walks along a curve."""

    speed: float = 0.0
    """Metres a second; 0 for mapctl's own, which is slower in sharp corners."""
    seconds: float = 0.0
    """Duration; 0 for once along the curve."""
    gait: str = ""
    """Gait that the prior knows; nothing for any."""
    style: str = ""
    """Style that the prior knows; nothing for any."""
    seed: int = 0
    """Seed of everything random."""

    def list_words(self, fps: float) -> list[str]:
        """List the words of `mapctl follow`."""
        words = ["--seed", str(self.seed)]
        for name, value in (("--speed", self.speed), ("--seconds", self.seconds)):
            words += [name, f"{value:.6g}"] if value > 0 else []
        for name, value in (("--gait", self.gait), ("--style", self.style)):
            words += [name, value] if value else []
        return words + (["--fps", f"{fps:.9g}"] if self.gait or self.style else [])


def walk_along(at: Scene, drawn: bpy.types.Object, options: WalkOptions) -> Job:
    """Let the character walk along a curve, from the scene's first frame on."""
    body, points = take_body(at), sample_curve(drawn, at.scene)
    height, level = measure_height(points)
    made, travelling, lines = yield from _ask_for_walk(at, body, points, options)
    made = replace(made, positions=made.positions + np.array([0.0, height, 0.0]))
    first = at.scene.frame_preview_start if at.scene.use_preview_range else at.scene.frame_start
    frames = range(first, first + len(made.positions))
    with restored_scene(at):
        worlds = yield from sample_worlds(at.armature, at.scene, frames)
        moved = to_armature(made, body, worlds)
        plain = np.zeros(len(frames), dtype=bool)
        name = f"{at.armature.name} along {drawn.name}"
        warnings = yield from make_action(at, Result(body, frames, moved, travelling, plain, name, fresh=True))
    at.scene.frame_end = max(at.scene.frame_end, frames.stop - 1)
    if not level:
        warnings = (*warnings, f"{drawn.name} is not level: the character walks at its median height")
    return Outcome(_shorten(lines), warnings)


def _ask_for_walk(
    at: Scene, body: Body, points: np.ndarray, options: WalkOptions
) -> Generator[Step, None, tuple[WorldMotion, frozenset[int], list[str]]]:
    """Ask mapctl for the walk, at the scene's frame rate; also return which joints travel, and what it said."""
    fps = measure_fps(at.scene)
    with _temporary_folder() as folder:
        exchange.write(take_rest(body, fps), folder / "character.npz", _place_ends(body), frozenset())
        write_curve(points, folder / "curve.csv")
        words = ["follow", "curve.csv", "--rig", "character.npz", "-o", "walk.npz", *options.list_words(float(fps))]
        lines = yield from run_command([*at.command, *words], folder, "walking")
        made, travelling = exchange.read(folder / "walk.npz")
        if made.fps != fps:  # resampling takes a moment, solving at another rate than the priors' takes long
            words = ["convert", "walk.npz", "resampled.npz", "--fps", str(fps)]
            yield from run_command([*at.command, *words], folder, "resampling")
            made, travelling = exchange.read(folder / "resampled.npz")
    return made, travelling, lines


def clean_up(at: Scene, frames: range, *, anchor: bool) -> Job:
    """Denoise the action in these frames."""
    words = ["denoise", "IN", "-o", "OUT", *(["--anchor"] if anchor else [])]
    made = np.zeros(len(frames), dtype=bool)
    return (yield from _edit(at, frames, words, made, "clean", "cleaning up"))


def fill_gap(at: Scene, frames: range, gap: range, joints: Sequence[str]) -> Job:
    """Fill a gap in these frames, of some joints or of all."""
    if not (gap and frames.start <= gap.start and gap.stop <= frames.stop):
        asked, own = (f"{each.start} to {each.stop - 1}" for each in (gap, frames))
        raise AddonError(f"the gap {asked} is not within the action's frames {own}")
    words = ["infill", "IN", "-o", "OUT", "--gap", f"{gap.start - frames.start}:{gap.stop - frames.start}"]
    words += ["--joints", ",".join(joints)] if joints else []
    made = np.array([frame in gap for frame in frames])
    return (yield from _edit(at, frames, words, made, "filled", "filling the gap"))


def fill_between_keys(at: Scene, keyed: Sequence[int]) -> Job:
    """Make the motion between the frames that have keys, in order."""
    if len(keyed) < 2:
        raise AddonError("the action has keys in fewer than two frames: key at least a first and a last pose")
    if len(keyed) == keyed[-1] - keyed[0] + 1:
        raise AddonError(f"every frame from {keyed[0]} to {keyed[-1]} has keys: there is nothing in between")
    frames = range(keyed[0], keyed[-1] + 1)
    words = ["tween", "IN", "-o", "OUT", "--keyframes", ",".join(str(frame - frames.start) for frame in keyed)]
    made = np.array([frame not in keyed for frame in frames])
    return (yield from _edit(at, frames, words, made, "in-between", "in-betweening"))


def take_body(at: Scene) -> Body:
    """Take the joints of the character: of a rig that Rigify made by its controls, else by its bones. AddonError where
    it cannot be read or keyed."""
    if at.armature.library is not None:
        raise AddonError(f"{at.armature.name} is linked from another file: make a library override of it")
    if at.armature.data.pose_position == "REST":
        raise AddonError(f"{at.armature.name} shows its rest position: set it to Pose Position (Armature properties)")
    if rigify.is_generated(at.armature):
        return rigify.take_controls(at.armature, at.scene)
    body = take_bones(at.armature, at.scene)
    return replace(body, rig_toml=rigify.describe_names(body.names))


def name_joints(at: Scene, bones: Sequence[str]) -> list[str]:
    """Name the joints of selected bones; AddonError where none of them is one."""
    body = take_body(at)
    joint_of = {control.bone: body.names[control.joint] for control in body.controls}
    joint_of |= dict(zip((*body.bones, *body.names), (*body.names, *body.names), strict=True))
    found = list(dict.fromkeys(joint_of[bone] for bone in bones if bone in joint_of))
    if not found:
        raise AddonError("no selected bone is a joint of the body: select some in Pose Mode, or leave the choice out")
    return found


def _edit(at: Scene, frames: range, words: Sequence[str], made: np.ndarray, suffix: str, label: str) -> Job:
    """Send the action to a command of mapctl, and make a new one of what comes back."""
    body, old = take_body(at), actions.find_action(at.armature)
    with restored_scene(at), _temporary_folder() as folder:
        with rigify.keep_lengths(at.armature):
            motion, worlds = yield from sample_motion(at.armature, body, at.scene, frames)
        exchange.write(motion, folder / "given.npz", _place_ends(body), body.movable)
        names = {"IN": "given.npz", "OUT": "made.npz"}
        rig = []
        if body.rig_toml:
            (folder / "rigify.toml").write_text(body.rig_toml, encoding="utf-8")
            rig = ["--rig", "rigify.toml"]
        lines = yield from run_command([*at.command, *(names.get(word, word) for word in words), *rig], folder, label)
        answer, travelling = exchange.read(folder / "made.npz")
        _check_length(answer, frames)
        moved = to_armature(answer, body, worlds)
        name = f"{old.name} {suffix}"
        warnings = yield from make_action(at, Result(body, frames, moved, travelling, made, name, fresh=False))
    counted = f"frame 0 of what mapctl says is frame {frames.start} of the scene"
    return Outcome((counted, *_shorten(lines)), warnings)


def _shorten(lines: Sequence[str]) -> tuple[str, ...]:
    """Leave the names of temporary files out of what mapctl said."""
    return tuple(line.removeprefix("made.npz: ") for line in lines if not line.startswith("wrote "))


def _check_length(motion: WorldMotion, frames: range) -> None:
    if len(motion.positions) != len(frames):
        raise AddonError(f"mapctl answered with {len(motion.positions)} frames where {len(frames)} were asked for")


def _place_ends(body: Body) -> dict[str, np.ndarray]:
    return {name: body.to_world(tail) for name, tail in body.ends.items()}


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mapctl-") as folder:
        yield Path(folder)
