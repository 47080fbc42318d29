"""Captures: canonical motion as a recording shows it, with what was not seen and how noisy the rest is."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, fill_missing_angle


@dataclass(frozen=True, eq=False)
class Capture:
    """A batch of recordings of one length, at one frame rate, on canonical joints. Joint 0 is the hips."""

    root: Float[Tensor, "batch frames 3"]
    """Of the hips, world, metres."""
    hips: Float[Tensor, "batch frames 4"]
    """Rotation of the hips, world, xyzw."""
    joints: Float[Tensor, "batch frames others 3"]
    """Rotation vectors of all other joints in their parents' frames."""
    seen_root: Bool[Tensor, "batch frames"]
    """Whether the root's place was seen."""
    seen: Bool[Tensor, "batch frames joints"]
    """Whether a joint's rotation was seen."""
    sigma_root: Float[Tensor, " batch"]
    """Noise of each coordinate, metres."""
    sigma: Float[Tensor, "batch joints"]
    """Noise of each of a joint's three angles, radians."""

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return self.root.shape[1]

    @staticmethod
    def of_motion(motion: Motion, *, seen: Tensor, seen_root: Tensor, sigma: Tensor, sigma_root: float) -> "Capture":
        """A batch of one from a motion on canonical joints, single precision; `seen` is (frames, joints). The signs of
        its quaternions must not jump between frames that were seen.
        """
        joints = _continuous_vectors(motion.local_quat_xyzw[:, 1:])
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
        """Frames start to stop."""
        part = slice(start, stop)
        return Capture(
            self.root[:, part],
            self.hips[:, part],
            self.joints[:, part],
            self.seen_root[:, part],
            self.seen[:, part],
            self.sigma_root,
            self.sigma,
        )

    @cached_property
    def heading(self) -> Float[Tensor, "batch frames"]:
        """Of the hips about +Y, radians, not wrapped; across frames that were not seen it is filled in."""
        return fill_missing_angle(rotations.split_heading(self.hips)[0], self.seen[..., 0])

    @cached_property
    def tilt(self) -> Float[Tensor, "batch frames 2"]:
        """What remains of the hips' rotation without the heading (rotation vector, x and z), filled in."""
        vector = rotations.to_rotation_vector(rotations.split_heading(self.hips)[1])
        return fill_missing(vector[..., ::2], self.seen[..., 0])


def _continuous_vectors(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "frames joints 3"]:
    """Rotation vectors without the jump at a half turn, short ones in most frames, if the signs are continuous."""
    sign = torch.where(quats[..., 3].mean(dim=0, keepdim=True) < 0, -1.0, 1.0)
    return rotations.to_long_rotation_vector(quats * sign[..., None])
