"""Recordings of motion: their masks, artefacts, noise, spikes and gaps, and their fusion with a proposal."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, fill_missing_angle
from mapctl.pose import BodyPose


@dataclass(frozen=True, eq=False)
class Capture:
    """A batch of recordings of one length, at one frame rate, on canonical joints. Joint 0 is the hips."""

    root: Float[Tensor, "batch frames 3"]
    """Hips position, world, metres."""
    hips: Float[Tensor, "batch frames 4"]
    """Rotation of the hips, world, xyzw."""
    joints: Float[Tensor, "batch frames others 3"]
    """Rotation vectors of all other joints in their parents' frames."""
    seen_root: Bool[Tensor, "batch frames"]
    """Whether the root's position was observed."""
    seen: Bool[Tensor, "batch frames joints"]
    """Whether a joint's rotation was observed."""
    sigma_root: Float[Tensor, " batch"]
    """Noise sigma of each coordinate, metres."""
    sigma: Float[Tensor, "batch joints"]
    """Noise sigma of each of a joint's three angles, radians."""

    @property
    def frames(self) -> int:
        return self.root.shape[1]

    @staticmethod
    def of_motion(
        motion: Motion,
        *,
        seen: Bool[Tensor, "frames joints"],
        seen_root: Bool[Tensor, " frames"],
        sigma: Float[Tensor, " joints"],
        sigma_root: float,
    ) -> "Capture":
        """Make a batch of one from a motion on canonical joints, single precision: what was observed, and the noise,
        `sigma` in radians and `sigma_root` in metres. The signs of its quaternions must not jump between observed
        frames."""
        quats = motion.local_quat_xyzw[:, 1:]
        # Rotation vectors without a jump at a half turn, short ones in most frames.
        sign = torch.where(quats[..., 3].mean(dim=0, keepdim=True) < 0, -1.0, 1.0)
        joints = rotations.to_long_rotation_vector(quats * sign[..., None])
        return Capture(
            motion.root_position.float()[None],
            motion.local_quat_xyzw[:, 0].float()[None],
            joints.float()[None],
            seen_root[None],
            seen[None],
            torch.tensor([sigma_root]),
            sigma.float()[None],
        )

    def slice(self, start: int, stop: int) -> "Capture":
        """Return frames start to stop."""
        by_frame = ("root", "hips", "joints", "seen_root", "seen")
        return replace(self, **{name: getattr(self, name)[:, start:stop] for name in by_frame})

    @cached_property
    def heading(self) -> Float[Tensor, "batch frames"]:
        """Heading of the hips about +Y, radians, not wrapped; filled in across frames that were not observed."""
        return fill_missing_angle(rotations.split_heading(self.hips)[0], self.seen[..., 0])

    @cached_property
    def tilt(self) -> Float[Tensor, "batch frames 2"]:
        """Tilt of the hips, their rotation without the heading (rotation vector, x and z), radians, filled in."""
        vector = rotations.to_rotation_vector(rotations.split_heading(self.hips)[1])
        return fill_missing(vector[..., ::2], self.seen[..., 0])


@dataclass(frozen=True, eq=False)
class CaptureProposal:
    """The motion behind a batch of captures, as a denoiser sees it, and its contacts."""

    pose: BodyPose
    """Poses of every frame, batched."""
    contact_logits: Float[Tensor, "batch frames 2"]
    """Log odds that the left and the right toe are planted."""
    log_spread: Float[Tensor, "batch frames columns"]
    """Logarithm of the standard deviation of the proposal's error: of each coordinate of the hips' position, metres,
    then of each of a joint's three angles, radians, the hips' first."""


__all__ = ["Capture", "CaptureProposal"]
