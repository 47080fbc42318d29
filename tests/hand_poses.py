"""People whose hands are at places: arms by trigonometry, without the code under test."""

import math
from dataclasses import replace

import torch
from helpers import quat_xyzw
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

HANDS = [CANONICAL.index(side + "Hand") for side in ("left", "right")]
UPPER = [CANONICAL.index(side + "UpperArm") for side in ("left", "right")]
LOWER = [CANONICAL.index(side + "LowerArm") for side in ("left", "right")]
PALM = 0.08
"""From wrist to palm of the canonical body, metres."""


def palms(motion: Motion, size: float = 1.0) -> Float[Tensor, "frames 2 3"]:
    """Where palms are."""
    positions, turns = motion.joint_positions(), motion.joint_rotations()
    found = []
    for hand, sign in zip(HANDS, (1, -1), strict=True):
        along = Rotation.from_quat(turns[:, hand].numpy()).apply([sign * size * PALM, 0.0, 0.0])
        found.append(positions[:, hand] + torch.from_numpy(along))
    return torch.stack(found, dim=1)


def put_palm(
    motion: Motion,
    side: int,
    position: Float[Tensor, "frames 3"],
    *,
    points: tuple[float, float, float],
    elbow: tuple[float, float, float],
    size: float = 1.0,
) -> Motion:
    """The motion with the palm of a side at a place in the world: fingers point along `points`, the elbow is out along
    `elbow`. The trunk is upright, and the place in reach."""
    sign, at = (1, -1)[side], motion.joint_positions()[:, UPPER[side]]
    ahead = torch.tensor(points, dtype=torch.float64)
    ahead = ahead / ahead.norm()
    wrist = position - size * PALM * ahead
    upper, lower = (float(motion.skeleton.offsets[j].norm()) for j in (LOWER[side], HANDS[side]))
    way = wrist - at
    far = way.norm(dim=-1, keepdim=True)
    assert float(far.max()) < upper + lower, "out of reach"
    axis = way / far
    out = torch.tensor(elbow, dtype=torch.float64).expand_as(axis)
    out = out - (out * axis).sum(-1, keepdim=True) * axis
    out = out / out.norm(dim=-1, keepdim=True)
    along = (upper**2 - lower**2 + far**2) / (2 * far)
    middle = at + along * axis + (upper**2 - along**2).clamp_min(0).sqrt() * out
    world = [_point(bone, sign) for bone in (middle - at, wrist - middle, ahead.expand_as(way))]
    parent = Rotation.from_quat(motion.joint_rotations()[:, CANONICAL.parents[UPPER[side]]].numpy())
    local = motion.local_quat_xyzw.clone()
    for joint, turn in zip((UPPER[side], LOWER[side], HANDS[side]), world, strict=True):
        local[:, joint] = torch.from_numpy((parent.inv() * turn).as_quat())
        parent = turn
    return replace(motion, local_quat_xyzw=local)


def arms_down(motion: Motion, degrees: float = 75.0) -> Motion:
    """With arms that hang straight at the sides."""
    local = motion.local_quat_xyzw.clone()
    for joint, sign in zip(UPPER, (-1.0, 1.0), strict=True):
        local[:, joint] = quat_xyzw(torch.tensor([[0.0, 0.0, sign * math.radians(degrees)]], dtype=torch.float64))
    return replace(motion, local_quat_xyzw=local)


def ease(frames: int, start: int, stop: int) -> Float[Tensor, "frames 1"]:
    """From 0 before a frame to 1 from another on."""
    share = ((torch.arange(frames, dtype=torch.float64) - start) / (stop - start)).clamp(0, 1)
    return (share**3 * (10 + share * (6 * share - 15)))[:, None]


def _point(bone: Float[Tensor, "frames 3"], sign: int) -> Rotation:
    """The least turns of the x axis, or of the opposite one, to directions."""
    start = torch.tensor([float(sign), 0.0, 0.0], dtype=torch.float64).expand_as(bone)
    unit = bone / bone.norm(dim=-1, keepdim=True)
    quat = torch.cat([torch.linalg.cross(start, unit), 1 + (start * unit).sum(-1, keepdim=True)], dim=-1)
    return Rotation.from_quat(quat.numpy())
