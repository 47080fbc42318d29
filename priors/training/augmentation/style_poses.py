"""Poses that tell a sequence's style in training: of itself, or of another clip."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.key_layouts import KeySequences
from priors.training.augmentation.pose_windows import PoseWindows

_STYLE_POSES = 2, 8


def draw_style_poses(
    windows: PoseWindows, sequences: KeySequences, foreign: float, generator: torch.Generator
) -> Float[Tensor, "batch poses joints 3"]:
    """Draw poses anywhere in each sequence, or, of this share of them, in another clip: places from the hips, metres,
    without the hips' rotation."""
    batch, frames = sequences.clip.shape
    few, many = _STYLE_POSES
    count = int(torch.randint(few, many + 1, (), generator=generator))
    at = torch.randint(frames, (batch, count), generator=generator)
    own = torch.take_along_dim(sequences.motion.quats, at[..., None, None], dim=1)
    one = torch.ones(batch, dtype=torch.long)
    clip = windows.picker.pick(one, generator)[0][:, None].expand(-1, count)
    time = (torch.rand(batch, count, generator=generator) * windows.lengths[clip]).floor().double()
    other = torch.rand(batch, generator=generator) < foreign
    local = rotations.to_matrix(torch.where(other[:, None, None, None], windows.gather(clip, time).quats, own))
    local[..., 0, :, :] = torch.eye(3)
    return kinematics.positions_from_matrices(CANONICAL, local)
