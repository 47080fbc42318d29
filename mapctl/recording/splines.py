"""Motion and its changes at other rates, by splines: straight lines between the prior's frames would be kinks."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion


def upsample(
    values: Float[Tensor, "shown *width"], seconds: Float[Tensor, " shown"], *, fps: float, frames: int
) -> Float[Tensor, "frames *width"]:
    """Interpolate values at rising times, for so many frames a second, by a cubic spline; hold beyond the last."""
    if len(values) < 2:
        return values.expand(frames, *values.shape[1:])
    times = seconds.numpy()
    wanted = np.clip(np.arange(frames) / fps, times[0], times[-1])
    return torch.as_tensor(scipy.interpolate.CubicSpline(times, values.double().numpy(), axis=0)(wanted))


def resample_by_splines(motion: Motion, seconds: Float[Tensor, " shown"], *, fps: Fraction, frames: int) -> Motion:
    """Resample a motion whose frames are at rising times to so many frames at a rate; straight lines would be kinks."""
    quats = rotations.make_sign_continuous(motion.local_quat_xyzw.double())
    quats = upsample(quats, seconds, fps=float(fps), frames=frames)
    root = upsample(motion.root_position.double(), seconds, fps=float(fps), frames=frames)
    return replace(motion, fps=fps, root_position=root, local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1))


def transfer_change(motion: Motion, before: Motion, after: Motion, seconds: Float[Tensor, " shown"]) -> Motion:
    """Change a motion as another, whose frames are at rising times, was changed: what did not change stays as it was
    at the motion's own rate."""
    turned = rotations.multiply(rotations.inverse(before.local_quat_xyzw), after.local_quat_xyzw)
    angles, moved = (
        upsample(change, seconds, fps=float(motion.fps), frames=motion.num_frames)
        for change in (rotations.to_rotation_vector(turned), after.root_position - before.root_position)
    )
    quats = rotations.multiply(motion.local_quat_xyzw, rotations.from_rotation_vector(angles))
    return replace(motion, root_position=motion.root_position + moved, local_quat_xyzw=quats)
