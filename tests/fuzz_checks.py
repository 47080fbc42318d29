"""What is read of a file must be sound, kind by kind, counted by patterns that share nothing with the readers."""

import io
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

import priors
from mapctl import curves, formats, report
from mapctl.commands.info.run import read_prior_card
from mapctl.commands.shared.inputs import read_rig_clip
from mapctl.errors import FileFormatError, RequestError
from mapctl.intent.steering_csv import read_commands
from mapctl.motion import Motion


class Broken(Exception):
    """A reader that breaks the contract."""


def require(holds: object, otherwise: str) -> None:
    """Raise Broken unless it holds."""
    if not holds:
        raise Broken(otherwise)


def check_motion(motion: Motion) -> None:
    """Require finite positions, unit quaternions, and tracks of one length."""
    frames = motion.num_frames
    require(motion.joint_positions().isfinite().all(), "a joint position is not finite")
    require(((motion.local_quat_xyzw.norm(dim=-1) - 1).abs() < 2e-3).all(), "a rotation is no unit quaternion")
    require(all(track.shape == (frames, 3) for track in motion.moving_offsets.values()), "a track of another length")
    require(0 < motion.fps < 1e6, f"{motion.fps} frames a second")


def check_motion_file(path: Path) -> None:
    """Require a sound motion, rest pose and mesh, and the same motion from the file that is written of it."""
    motion = formats.load(path)
    check_motion(motion)
    with suppress(FileFormatError):
        formats.load_with_missing(path)
    if path.suffix in formats.CHARACTERS:
        with suppress(FileFormatError):
            rest = formats.load_rest(path)
            require(rest is not None and rest.num_joints == motion.num_joints, "other joints at rest")
        with suppress(FileFormatError):
            mesh = formats.load_mesh(path)
            require(np.isfinite(mesh.vertices).all() and np.isfinite(mesh.rgba).all(), "a vertex is not finite")
            require(len(mesh.faces) == 0 or mesh.faces.max() < len(mesh.vertices), "a face without vertices")
            require(mesh.joints.max() < motion.num_joints, "a vertex without a joint")
    again = path.with_name(f"again{path.suffix}")
    if path.suffix in formats.WRITERS:
        again.unlink(missing_ok=True)
        with suppress(RequestError):
            motion.save(again)
    if again.exists():
        other = formats.load(again)
        require(other.num_frames == motion.num_frames, "written, it is another motion")
        if other.num_joints == motion.num_joints and path.suffix != ".vrma":  # which faces +Z
            far = float((other.joint_positions() - motion.joint_positions()).abs().max())
            size = max(float(motion.joint_positions().abs().max()), 1.0)
            require(far < 2e-4 * size, f"written, joints are {far:g} m elsewhere")


def check_npz(path: Path) -> None:
    """Require every array of the archive in the motion."""
    check_motion_file(path)
    motion = formats.load(path)
    with np.load(path, allow_pickle=False) as arrays:
        require(np.array_equal(arrays["root_position_world"], motion.root_position.numpy()), "another trajectory")
        require(np.array_equal(arrays["local_quat_xyzw"], motion.local_quat_xyzw.numpy()), "other rotations")
        require(arrays["names"].tolist() == list(motion.skeleton.names), "other names")


def check_rows(read: Callable[[Path], Sequence], path: Path) -> None:
    """Require an entry a row of the table; no sample quotes a line end."""
    found = len(read(path))
    text = io.StringIO(path.read_bytes().decode("utf-8-sig"), newline=None)
    rows = sum(bool(line.replace(",", "").replace('"', "").strip()) for line in text)
    require(found == rows - 1, f"{rows} rows, {found} read")


def check_commands(path: Path) -> None:
    """Require rising times and finite commands."""
    track = read_commands(path)
    check_rows(lambda _: track.times, path)
    require(np.isfinite(track.times).all() and (np.diff(track.times) > 0).all(), "times do not rise")
    for command in track.commands:
        numbers = [value for value in vars(command).values() if isinstance(value, float)]
        require(np.isfinite(numbers).all(), "a command is not finite")


def check_curve(path: Path) -> None:
    """Require finite points."""
    points = curves.read(path).points
    require(points.ndim == 2 and points.isfinite().all(), "points are not finite")


def check_rig(path: Path) -> None:
    """Require a sound T-pose on the rig's joints."""
    check_motion(read_rig_clip(str(path))[0])


LOADERS = {
    "denoiser": priors.load_denoiser,
    "infiller": priors.load_infiller,
    "keyframe-timing": priors.load_keyframe_timing,
    "locomotion": priors.load,
    "locomotion-refiner": priors.load_refiner,
    "path": priors.load_path,
    "stitcher": priors.load_stitcher,
    "transformer": priors.load_transformer,
    "tweener": priors.load_tweener,
}
"""By name of a model in a set."""


def check_model(path: Path) -> None:
    """Require a model of finite weights, and a card that can be printed."""
    path = path.with_suffix(".safetensors")
    report.to_json(read_prior_card(str(path)))
    name = (path.parent / "name").read_text()
    if name == "tweener":
        priors.load_tweener(str(path), str(path.with_name("path.safetensors")))
        return
    model = LOADERS[name](str(path))
    if name == "locomotion":
        model.conditioned_like_start(0)
        require(isinstance(model.reference_log_density, float) and model.pace_rates is not None, "no figures")
        require(all(map(np.isfinite, vars(model.limits).values())), "limits are not finite")
        require(torch.isfinite(model.reference.mean).all(), "statistics are not finite")
