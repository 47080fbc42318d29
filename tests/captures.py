"""Made-up captures: joints that sway smoothly, and white noise on them."""

import math
from dataclasses import replace

import torch
from helpers import bandai_skeleton, cmu_skeleton, generator, quat_xyzw, walk
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.motion import Motion

DEGREE = math.pi / 180


def vectors(frames: int = 300, joints: int = 6, *, fps: float = 30.0, seed: int = 0, highest: float = 1.0) -> Tensor:
    """Rotation vectors of joints that swing by up to half a radian, with sines of up to `highest` Hz."""
    draw = generator(seed)
    seconds = torch.arange(frames, dtype=torch.float64)[:, None, None] / fps
    total = torch.zeros(frames, joints, 3, dtype=torch.float64)
    for share in (0.25, 0.6, 1.0):
        phase, size = 6.3 * torch.rand(joints, 3, generator=draw), 0.15 * torch.rand(joints, 3, generator=draw)
        total = total + size * torch.sin(2 * math.pi * share * highest * seconds + phase)
    return total


def swaying(frames: int = 300, joints: int = 6, *, fps: float = 30.0, seed: int = 0, highest: float = 1.0) -> Tensor:
    """The same as quaternions (frames, joints, 4)."""
    return quat_xyzw(vectors(frames, joints, fps=fps, seed=seed, highest=highest))


def shaken(quats: Tensor, sigma: float | Tensor, *, seed: int = 0, axes: int = 3) -> Tensor:
    """With white noise of this many radians about the first axes of each joint."""
    size = torch.as_tensor(sigma, dtype=torch.float64)
    noise = torch.randn(*quats.shape[:2], 3, generator=generator(seed), dtype=torch.float64)
    noise = noise * (size[None, :, None] if size.ndim else size)
    noise[..., axes:] = 0
    return rotations.multiply(quats, rotations.from_rotation_vector(noise))


def trembling(motion: Motion, sigma: float | Tensor, *, seed: int = 0) -> Motion:
    """A motion with white noise of this many radians on all joints, the hips' place left alone."""
    return replace(motion, local_quat_xyzw=shaken(motion.local_quat_xyzw, sigma, seed=seed))


def noisy(motion: Motion, degrees: float = 4.0, centimetres: float = 1.5, seed: int = 0) -> Motion:
    """White noise on all joints and on the place of the hips."""
    quats = shaken(motion.local_quat_xyzw, degrees * DEGREE, seed=seed)
    shift = centimetres / 100 * torch.randn(motion.num_frames, 3, generator=generator(seed + 1), dtype=torch.float64)
    if motion.moving_offsets:
        moving = {joint: values + shift for joint, values in motion.moving_offsets.items()}
        # The static root is static.
        quats[:, 0] = motion.local_quat_xyzw[:, 0]
        return replace(motion, local_quat_xyzw=quats, moving_offsets=moving)
    return replace(motion, local_quat_xyzw=quats, root_position=motion.root_position + shift)


def apart_deg(first: Tensor, second: Tensor) -> Tensor:
    """Angles between rotations, degrees."""
    turn = rotations.multiply(rotations.inverse(first), second)
    return torch.rad2deg(rotations.to_rotation_vector(turn).norm(dim=-1))


def on_rig(rig: str, frames: int = 90, *, fps: int = 30, seed: int = 0, turn_rate: float = 0.3) -> Motion:
    """A walk on a rig: `canonical`, `bandai` (hips move below a static root) or `daz` (a thumb, and no toes)."""
    motion = walk(frames, fps=fps, seed=seed, turn_rate=turn_rate)
    if rig == "canonical":
        return motion
    skeleton = bandai_skeleton() if rig == "bandai" else cmu_skeleton()
    rigged = retarget.from_canonical(motion, retarget.identify_rig(skeleton))
    if rig == "bandai":
        return rigged
    quats = rigged.local_quat_xyzw.clone()
    quats[:, -1] = swaying(frames, 1, fps=fps, seed=seed + 1)[:, 0]  # the thumb moves too
    return replace(rigged, local_quat_xyzw=quats)


def error_cm(truth: Motion, other: Motion) -> float:
    """Mean distance of the joints."""
    return 100 * float((truth.joint_positions() - other.joint_positions()).norm(dim=-1).mean())
