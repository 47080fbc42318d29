"""Recordings at other rates than the prior's, split into a band that is slow enough for it, and a fast one.

The prior is given the slow band at its own rate; its change is upsampled smoothly. The fast band is kept as far as it
is more than the noise, moment by moment and joint by joint, so that a true kick survives.
"""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics import gaussian

CROSSOVER_HZ = 10.0
"""Edge between the bands, Hz: two thirds of what the prior's rate can hold, so that a spline restores the slow one."""
_FILTER_ORDER = 6
_POWER_SECONDS = 0.15  # seconds over which the fast band is compared with the noise
_NOISE_FACTOR = 3.0  # times the noise's power that the fast band has before half of it is kept


@dataclass(frozen=True, eq=False)
class FrequencyBands:
    """A motion on canonical joints, split into bands."""

    slow: Motion
    """Motion at the recording's rate, without what is faster than `CROSSOVER_HZ`."""
    fast_angles: Float[Tensor, "frames joints 3"]
    """Rotation vectors, radians, from the slow band's joints to the recording's, in their own frames."""
    fast_root: Float[Tensor, "frames 3"]
    """Offset of the recording's hips from the slow band's, metres."""

    @property
    def whole(self) -> bool:
        """Whether all of the recording is slow."""
        return _is_slow(float(self.slow.fps))

    @property
    def exact(self) -> bool:
        """Whether the prior is given the recording's own frames: none is then blended with its neighbours."""
        return self.slow.fps == PRIOR_FPS

    def noise_at_prior_rate(self, sigma: Tensor) -> Tensor:
        """Return the sigma of white noise at the prior's rate that is as dense, below the crossover, as the
        recording's."""
        return sigma * min(1.0, PRIOR_FPS / float(self.slow.fps)) ** 0.5

    def at_prior_rate(self) -> Motion:
        """Resample the slow band to the prior's rate, to its very end: a last frame that falls between two is followed
        by one more, in which the motion holds. What is changed there is else only held, and noise that differs stays.
        """
        slow, last = self.slow, (self.slow.num_frames - 1) * PRIOR_FPS / self.slow.fps
        beyond = math.ceil((math.ceil(last) - last) * slow.fps / PRIOR_FPS)
        frame = torch.arange(slow.num_frames + beyond).clamp(max=slow.num_frames - 1)
        held = Motion(slow.skeleton, slow.fps, slow.root_position[frame], slow.local_quat_xyzw[frame])
        return held.resample(PRIOR_FPS).slice(0, math.ceil(last) + 1)

    @property
    def within(self) -> int:
        """Number of frames at the prior's rate that lie within the recording."""
        return int((self.slow.num_frames - 1) * PRIOR_FPS / self.slow.fps) + 1

    def recombine(self, shown: Motion, cleaned: Motion, sigma: Float[Tensor, " joints"], sigma_root: float) -> Motion:
        """Change the slow band as `shown` (see `at_prior_rate`) was to `cleaned`, and add what the fast band has of
        motion.

        Sigmas are the recording's own, at its own rate.
        """
        turned = rotations.multiply(rotations.inverse(shown.local_quat_xyzw), cleaned.local_quat_xyzw)
        angles = self._upsample_to_recording(rotations.to_rotation_vector(turned))
        moved = self._upsample_to_recording(cleaned.root_position - shown.root_position)
        base, fast_angles, fast_root = self._upsample_with_residual(shown)
        frames_a_moment = _POWER_SECONDS * float(self.slow.fps)
        high = 0.0 if self.whole else 1 - CROSSOVER_HZ / (float(self.slow.fps) / 2)  # share of the noise's power
        fast = _apply_wiener_gain(fast_angles, high * sigma.square()[None, :, None], frames_a_moment)
        root = _apply_wiener_gain(fast_root[:, None], torch.tensor(high * sigma_root**2), frames_a_moment)[:, 0]
        quats = rotations.multiply(base.local_quat_xyzw, rotations.from_rotation_vector(angles))
        quats = rotations.multiply(quats, rotations.from_rotation_vector(fast))
        return Motion(base.skeleton, base.fps, base.root_position + moved + root, rotations.make_sign_continuous(quats))

    def _upsample_with_residual(
        self, shown: Motion
    ) -> tuple[Motion, Float[Tensor, "frames joints 3"], Float[Tensor, "frames 3"]]:
        """Return `shown` at the recording's rate, and the recording's residual from it: not from the slow band, of
        whose noise near the crossover a spline through fewer frames would leave some."""
        if self.whole or shown.num_frames < 2:
            return self.slow, self.fast_angles, self.fast_root
        quats = torch.nn.functional.normalize(self._upsample_to_recording(shown.local_quat_xyzw), dim=-1)
        base = Motion(self.slow.skeleton, self.slow.fps, self._upsample_to_recording(shown.root_position), quats)
        whole = rotations.multiply(self.slow.local_quat_xyzw, rotations.from_rotation_vector(self.fast_angles))
        angles = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats), whole))
        return base, angles, self.slow.root_position + self.fast_root - base.root_position

    def _upsample_to_recording(self, change: Float[Tensor, "shown *width"]) -> Float[Tensor, "frames *width"]:
        """Upsample from the prior's rate to the recording's."""
        seconds = torch.arange(len(change), dtype=torch.float64) / PRIOR_FPS
        return upsample(change, seconds, fps=float(self.slow.fps), frames=self.slow.num_frames)


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


def split_bands(motion: Motion) -> FrequencyBands:
    """Split a motion with continuous quaternion signs into bands; at the prior's rate or less all of it is slow."""
    fps, quats = float(motion.fps), motion.local_quat_xyzw
    if _is_slow(fps) or motion.num_frames < 3 * _FILTER_ORDER:
        slow = Motion(motion.skeleton, motion.fps, motion.root_position, quats)
        return FrequencyBands(
            slow, torch.zeros(*quats.shape[:2], 3, dtype=quats.dtype), torch.zeros_like(motion.root_position)
        )
    sections = scipy.signal.butter(_FILTER_ORDER, CROSSOVER_HZ / (fps / 2), output="sos")

    def low(values: Tensor) -> Tensor:
        whole = _extend_ends(values.numpy(), round(fps / CROSSOVER_HZ))
        side = (len(whole) - len(values)) // 2
        return torch.as_tensor(scipy.signal.sosfiltfilt(sections, whole, axis=0, padlen=0)[side:-side].copy())

    slow = Motion(
        motion.skeleton, motion.fps, low(motion.root_position), torch.nn.functional.normalize(low(quats), dim=-1)
    )
    fast = rotations.multiply(rotations.inverse(slow.local_quat_xyzw), quats)
    return FrequencyBands(slow, rotations.to_rotation_vector(fast), motion.root_position - slow.root_position)


def _extend_ends(values: np.ndarray, about: int) -> np.ndarray:
    """Extend a signal by frames before and after, reflected about what the `about` outermost ones say of the ends: a
    filter that begins at the first frame itself would take its noise for motion."""
    about = min(about, len(values) - 1)
    side = min(3 * about, len(values) - 1)

    def reflected(ordered: np.ndarray) -> np.ndarray:
        flat = ordered[:about].reshape(about, -1)
        line = np.polynomial.polynomial.polyfit(np.arange(about), flat, min(1, about - 1))
        end = line[0].reshape(ordered.shape[1:])
        return 2 * end - ordered[1 : side + 1]

    return np.concatenate([reflected(values)[::-1], values, reflected(values[::-1])])


def _is_slow(fps: float) -> bool:
    """Return whether the prior's rate holds all that is in the recording."""
    return fps <= 1.05 * PRIOR_FPS


def _apply_wiener_gain(values: Float[Tensor, "frames joints 3"], noise: Tensor, moment: float) -> Tensor:
    """Scale values by the share of their power, about each frame, that noise of this variance does not explain."""
    power = values.square().mean(dim=-1, keepdim=True)
    side = max(1, round(moment / 2))
    near = gaussian.convolve(power, gaussian.kernel(side, 2 * side), "repeated")
    # Wiener's gain on what exceeds the noise by far: its own power varies within a moment too.
    excess = (near - _NOISE_FACTOR * noise).clamp_min(0)
    return values * torch.where(near > 0, excess / near.clamp_min(1e-30), 1.0)
