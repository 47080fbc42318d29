"""Noise of a known size on a clean motion."""

import math
from dataclasses import replace

import torch
from scipy.signal import butter, sosfiltfilt
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.motion import Motion


def add_noise(
    motion: Motion, generator: torch.Generator, *, degrees: float, centimetres: float, spikes: float = 0.01
) -> Motion:
    """Add normal noise to every angle of the joints that move and to the root position; spikes of 40 degrees."""
    angles = math.radians(degrees) * _sample_angle_noise(motion, generator)
    hit = torch.rand(angles.shape, generator=generator, dtype=torch.float64) < spikes
    angles = angles + hit * math.radians(40) * torch.sign(_sample_angle_noise(motion, generator))
    offset = torch.randn(motion.num_frames, 3, generator=generator, dtype=torch.float64) * centimetres / 100
    return _translate_body(_turn_moving_joints(motion, angles), offset)


def add_video_noise(motion: Motion, generator: torch.Generator) -> Motion:
    """Add what estimates from video have: hips that drift by 5 cm in depth, 2 cm across and 3 cm in height, and joints
    that tremble by 1.5 degrees an axis between 2 and 8 Hz."""
    fps = float(motion.fps)

    def sample(columns: int, lowest: float, highest: float) -> Tensor:
        passed = butter(2, [lowest, min(highest, 0.45 * fps)], "band", fs=fps, output="sos")
        white = torch.randn(columns, motion.num_frames + 200, generator=generator, dtype=torch.float64)
        noise = torch.from_numpy(sosfiltfilt(passed, white.numpy())[:, 100:-100].T.copy())
        return noise / noise.std(dim=0)

    tremor = math.radians(1.5) * sample(3 * motion.num_joints, 2.0, 8.0).unflatten(1, (-1, 3))
    across, height, depth = sample(1, 0.2, 3.0), sample(1, 0.05, 0.3), sample(1, 0.2, 3.0)
    offset = torch.cat([0.02 * across, 0.03 * height, 0.05 * depth], dim=1)
    return _translate_body(_turn_moving_joints(motion, tremor), offset)


def _sample_angle_noise(motion: Motion, generator: torch.Generator) -> Tensor:
    return torch.randn(motion.num_frames, motion.num_joints, 3, generator=generator, dtype=torch.float64)


def _turn_moving_joints(motion: Motion, angles: Tensor) -> Motion:
    """Turn the joints that move at all by rotation vectors, radians."""
    moves = (motion.local_quat_xyzw != motion.local_quat_xyzw[:1]).any(dim=-1).any(dim=0)
    turns = rotations.from_rotation_vector(angles * moves[None, :, None])
    return replace(motion, local_quat_xyzw=rotations.multiply(motion.local_quat_xyzw, turns))


def _translate_body(motion: Motion, offset: Tensor) -> Motion:
    """Translate the travelling joint: the hips or the root."""
    hips = retarget.identify_rig(motion.skeleton).joint_of[0]
    if hips not in motion.moving_offsets:
        return replace(motion, root_position=motion.root_position + offset)
    return replace(motion, moving_offsets={**motion.moving_offsets, hips: motion.moving_offsets[hips] + offset})
