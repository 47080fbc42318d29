"""Low-pass filters over a motion's numbers, which know nothing of bodies."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.signal import butter, sosfiltfilt
from torch import Tensor

from mapctl.motion import Motion
from mapctl.recording.quaternion_signs import choose_continuous_signs

Smooth = Callable[[np.ndarray], Any]
"""Filter along the first axis."""


def design_butterworth(cutoff: float, fps: float) -> Smooth:
    """Design a Butterworth filter of fourth order, forward and backward; the cut-off, Hz, is below half of the rate."""
    sections = butter(2, cutoff / (fps / 2), output="sos")
    return lambda values: sosfiltfilt(sections, values, axis=0)


def apply_filter(motion: Motion, smooth: Smooth) -> Motion:
    """Filter the places and quaternions of a motion, each number by itself."""

    def smooth_tensor(values: Tensor) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(np.asarray(smooth(values.numpy()))))

    quats = smooth_tensor(choose_continuous_signs(motion.local_quat_xyzw))
    moving = {joint: smooth_tensor(values) for joint, values in motion.moving_offsets.items()}
    return replace(
        motion,
        root_position=smooth_tensor(motion.root_position),
        moving_offsets=moving,
        local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1),
    )
