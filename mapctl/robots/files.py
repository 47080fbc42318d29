"""Files of robots' motion.

CSV, a row for each frame: position of the base, metres, Z up; its orientation as a quaternion (xyzw); joint angles in
the model's order, radians. The header is optional, and nothing states the frame rate.

NPZ (frames T, joints J, links B), orientations as quaternions (wxyz), velocities in m/s and rad/s:

- `fps`; `joint_names` (J,); `joint_pos`, `joint_vel` (T, J)
- `body_names` (B,); `body_pos_w`, `body_lin_vel_w`, `body_ang_vel_w` (T, B, 3); `body_quat_w` (T, B, 4)
- `contacts` (T, 2): whether the left and the right foot stand
"""

import io
from fractions import Fraction
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.formats.text import LARGEST_VALUE, read_bytes
from mapctl.robots.model import Robot
from mapctl.robots.retarget import RobotMotion

_BASE = ("x", "y", "z", "qx", "qy", "qz", "qw")
ENDINGS = (".csv", ".npz")
"""Endings of files that are written."""


def save(motion: RobotMotion, path: str | PathLike[str], *, header: bool = False) -> None:
    """Save as CSV or NPZ, by the ending; RequestError for another one."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise RequestError(f"{path}: the motion of a robot is written as {' or '.join(ENDINGS)}")
    written = io.BytesIO()
    if ending == ".npz":
        np.savez_compressed(written, allow_pickle=False, **_collect_arrays(motion))
    else:
        rows = build_rows(motion)
        names = ",".join((*_BASE, *motion.robot.joints)) if header else ""
        np.savetxt(written, rows.numpy(), fmt="%.6f", delimiter=",", header=names, comments="")
    write_bytes(path, written.getvalue())


def build_rows(motion: RobotMotion) -> Float[Tensor, "frames columns"]:
    """Return the numbers of each frame's row: base and angles."""
    quats = rotations.from_matrix(motion.orientation @ motion.robot.zero[0])
    return torch.cat([motion.position, rotations.make_sign_continuous(quats), motion.angles], dim=1)


def _collect_arrays(motion: RobotMotion) -> dict[str, np.ndarray]:
    bodies = motion.robot.bodies
    at, world = (values[:, bodies] for values in motion.chain_links())
    frames = torch.arange(len(at))
    before, after = (frames - 1).clamp_min(0), (frames + 1).clamp_max(len(at) - 1)
    rate = float(motion.fps) / (after - before).clamp_min(1)[:, None].double()  # central differences
    turned = rotations.to_rotation_vector(rotations.from_matrix(world[after] @ world[before].mT))
    quats = rotations.make_sign_continuous(rotations.from_matrix(world @ motion.robot.zero[bodies]))
    return {
        "fps": np.array([float(motion.fps)]),
        "joint_names": np.array(motion.robot.joints),
        "joint_pos": motion.angles.numpy(),
        "joint_vel": (rate * (motion.angles[after] - motion.angles[before])).numpy(),
        "body_names": np.array([motion.robot.skeleton.names[body] for body in bodies]),
        "body_pos_w": at.numpy(),
        "body_quat_w": quats.roll(1, dims=-1).numpy(),
        "body_lin_vel_w": (rate[..., None] * (at[after] - at[before])).numpy(),
        "body_ang_vel_w": (rate[..., None] * turned).numpy(),
        "contacts": motion.contacts.numpy(),
    }


def load_csv(path: str | PathLike[str], robot: Robot, fps: Fraction) -> RobotMotion:
    """Load a CSV; feet stand where the tips of their soles are low and slow. FileFormatError for one that is not of
    this robot."""
    lines = read_bytes(path).decode("utf-8", errors="replace").strip().splitlines()
    named = any(word in lines[0] for word in ("x", "joint"))
    if len(lines) == named:
        raise FileFormatError(path, "has no frames")
    try:
        rows = np.loadtxt(lines[named:], delimiter=",", ndmin=2, dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(path, "is no table of numbers with commas between them") from error
    width = len(_BASE) + len(robot.joints)
    if rows.shape[1] != width:
        raise FileFormatError(path, f"has {rows.shape[1]} columns, expected 7 of the base and {width - 7} joints")
    if named and (joints := tuple(lines[0].strip().split(",")[7:])) != robot.joints:
        strange = next((name for name in joints if name not in robot.joints), "their order")
        raise FileFormatError(path, f"its header is not that of the robot's joints: {strange}")
    norms = np.linalg.norm(rows[:, 3:7], axis=1)
    if not np.isfinite(rows).all() or np.abs(rows).max() >= LARGEST_VALUE or (np.abs(norms - 1) > 0.01).any():
        raise FileFormatError(path, "holds numbers that are no pose: columns 4 to 7 are a unit quaternion, xyzw")
    values = torch.from_numpy(rows)
    orientation = rotations.to_matrix(torch.nn.functional.normalize(values[:, 3:7], dim=1)) @ robot.zero[0].mT
    stand = torch.zeros(len(values), 2, dtype=torch.bool)
    return RobotMotion(robot, fps, values[:, :3], orientation, values[:, 7:], stand).detect_contacts()
