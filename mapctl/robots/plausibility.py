"""Plausibility of a robot's motion, second by second: limits, speeds and accelerations of joints, bodies that run into
each other, the centre of mass over its support, and feet that slide, float or sink."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull
from torch import Tensor

from mapctl.robots.model import import_mujoco
from mapctl.robots.retarget import RobotMotion

_TOUCH = 0.001  # metres by which two links are in each other before it counts


@dataclass(frozen=True)
class Second:
    """The worst of a second."""

    start: float
    """Seconds."""
    limit_excess_deg: float
    """Largest angle beyond a joint's limit."""
    speed_rad_s: float
    """Largest speed of a joint."""
    speed_share: float
    """The same as a share of what the joint can; 0 where the model states no speeds."""
    acceleration_rad_s2: float
    """Largest acceleration of a joint."""
    self_contact_cm: float
    """Depth by which two links are in each other, of the shapes that the model has."""
    balance_cm: float
    """Distance of the centre of mass, over the ground, from what the standing soles span; 0 within, or in flight."""
    slide_cm_s: float
    """Largest speed of the tip of a standing sole."""
    sole_low_cm: float
    """Lowest corner of a sole."""
    sole_high_cm: float
    """Highest tip of a standing sole."""


def assess(motion: RobotMotion) -> list[Second]:
    """Assess each second of a motion."""
    robot, fps = motion.robot, float(motion.fps)
    tips, corners = motion.find_tips(), motion.find_points(robot.corner_links, torch.cat(robot.soles))
    speed, acceleration = (_pad(motion.angles.diff(n=n, dim=0).abs() * fps**n, n) for n in (1, 2))
    stays = motion.contacts[1:] & motion.contacts[:-1]
    slide = _pad(torch.where(stays, tips.diff(dim=0).norm(dim=-1) * fps, 0.0), 1)
    excess = torch.maximum(robot.low - motion.angles, motion.angles - robot.high).clamp_min(0)
    depth, centre = _measure_bodies(motion)
    by_frame = {
        "limit_excess_deg": torch.rad2deg(excess).amax(dim=1),
        "speed_rad_s": speed.amax(dim=1),
        "speed_share": (speed / robot.speed).amax(dim=1),
        "acceleration_rad_s2": acceleration.amax(dim=1),
        "self_contact_cm": 100 * depth,
        "balance_cm": 100 * _measure_balance(motion, corners, centre),
        "slide_cm_s": 100 * slide.amax(dim=1),
        "sole_low_cm": -100 * corners[..., 2].amin(dim=1),
        "sole_high_cm": 100 * torch.where(motion.contacts, tips[..., 2], 0.0).amax(dim=1),
    }
    found, size = [], max(1, round(fps))
    for start in range(0, len(motion.angles), size):
        worst = {name: float(values[start : start + size].max()) for name, values in by_frame.items()}
        found.append(Second(start / fps, **worst | {"sole_low_cm": -worst["sole_low_cm"]}))
    return found


def find_worst(seconds: list[Second]) -> Second:
    """Return the worst of all seconds, each measure by itself."""
    rows = [asdict(second) for second in seconds]
    worst = {name: (min if name in ("start", "sole_low_cm") else max)(row[name] for row in rows) for name in rows[0]}
    return Second(**worst)


def _pad(values: Float[Tensor, "fewer columns"], lost: int) -> Float[Tensor, "frames columns"]:
    """Put zeros before differences, so that there is one for each frame."""
    return torch.cat([values.new_zeros(lost, values.shape[1]), values])


def _measure_bodies(motion: RobotMotion) -> tuple[Float[Tensor, " frames"], Float[Tensor, "frames 3"]]:
    """Measure how deep links are in each other, and the centre of mass, metres."""
    mujoco, model = import_mujoco(), motion.robot.model
    data: Any = mujoco.MjData(model)
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    addresses = model.jnt_qposadr[hinges][: len(motion.robot.joints)]  # those of objects come after
    base = int(next(body for body in range(1, model.nbody) if model.body_parentid[body] == 0))
    depth, centre = torch.zeros(len(motion.angles)).double(), torch.zeros(len(motion.angles), 3).double()
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    for frame, angles in enumerate(motion.angles.numpy()):
        data.qpos[addresses] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        own = [c.dist for c in data.contact if model.geom_bodyid[c.geom1] > 0 and model.geom_bodyid[c.geom2] > 0]
        depth[frame] = max(0.0, -min(own, default=0.0) - _TOUCH)
        axes = data.xmat[base].reshape(3, 3) @ motion.robot.zero[0].numpy().T
        centre[frame] = torch.from_numpy(axes.T @ (data.subtree_com[base] - data.xpos[base]))
    return depth, motion.position + (motion.orientation @ centre[..., None])[..., 0]


def _measure_balance(
    motion: RobotMotion, corners: Float[Tensor, "frames corners 3"], centre: Float[Tensor, "frames 3"]
) -> Float[Tensor, " frames"]:
    """Measure how far the centre of mass is outside what standing soles span, metres."""
    found = torch.zeros(len(centre), dtype=torch.float64)
    left, right = (len(sole) for sole in motion.robot.soles)
    standing = motion.contacts.repeat_interleave(torch.tensor([left, right]), dim=1)
    for frame, stands in enumerate(standing):
        if stands.any():
            points = corners[frame, stands, :2].numpy()
            hull, at = ConvexHull(points, qhull_options="QJ"), centre[frame, :2].numpy()
            if (hull.equations[:, :2] @ at + hull.equations[:, 2]).max() > 0:
                start, along = points[hull.simplices[:, 0]], np.diff(points[hull.simplices], axis=1)[:, 0]
                share = ((at - start) * along).sum(axis=1) / np.square(along).sum(axis=1)
                found[frame] = np.linalg.norm(start + share.clip(0, 1)[:, None] * along - at, axis=1).min()
    return found
