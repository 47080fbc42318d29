"""One-second windows of motion for the realism measures: joint positions and velocities relative to their start."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

HIPS = CANONICAL.index("hips")
_UPPER_LEGS = CANONICAL.index("leftUpperLeg"), CANONICAL.index("rightUpperLeg")


@dataclass(frozen=True)
class WindowSettings:
    """Settings of the windows that clips are cut into."""

    frames: int = 30
    """Frames a window, at 30 a second; one more is needed before it for the velocities."""
    step: int = 10
    """Stride from one window to the next, frames."""

    def __post_init__(self):
        for name in ("frames", "step"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} of a window must be at least 1, got {getattr(self, name)}")


def canonical_positions(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Return the world positions (metres) of the canonical joints at 30 frames a second; RequestError for rigs not
    known."""
    return retarget.to_canonical(motion)[0].resample(PRIOR_FPS).joint_positions()


def facing_angle(positions: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames"]:
    """Return the facing of canonical joints, radians, from positions alone, so that every rig has the same."""
    left, right = _UPPER_LEGS
    return body.facing(positions[:, left], positions[:, right])


def transform_to_ground_frame(
    positions: Float[Tensor, "*batch frames joints 3"],
    ground_xz: Float[Tensor, "*batch #frames 2"],
    angle: Float[Tensor, "*batch #frames"],
) -> Float[Tensor, "*batch frames joints 3"]:
    """Transform world positions into frames on the ground that face by `angle` radians; height stays."""
    return rotations.rotate_about_y(positions - rotations.lift_ground(ground_xz).unsqueeze(-2), -angle.unsqueeze(-1))


def cut_windows(
    positions: Float[Tensor, "clip_frames joints 3"], settings: WindowSettings = WindowSettings()
) -> Float[Tensor, "windows frames channels"]:
    """Cut one clip into windows, float32: joint positions (m), then velocities (m/s) from the frame before each.

    `positions` are those of `canonical_positions`. A window is relative to the hips' ground projection and facing in
    the frame before its first. RequestError for a clip shorter than one window.
    """
    frames, ground, angle = find_window_frames(positions, settings)
    relative = transform_to_ground_frame(positions[frames], ground, angle)
    velocity = relative.diff(dim=1) * PRIOR_FPS
    return torch.cat([relative[:, 1:].flatten(2), velocity.flatten(2)], dim=-1).float()


def find_window_frames(
    positions: Float[Tensor, "clip_frames joints 3"], settings: WindowSettings
) -> tuple[Int[Tensor, "windows frames_and_one"], Float[Tensor, "windows 1 2"], Float[Tensor, "windows 1"]]:
    """Find the frames of each window of a clip, the one before it first, with the hips' ground projection (m) and
    facing (radians) in that one. RequestError for a clip shorter than one window."""
    needed = settings.frames + 1
    if len(positions) < needed:
        raise RequestError(f"{len(positions)} frames at {PRIOR_FPS} fps; a window needs at least {needed}")
    starts = torch.arange(0, len(positions) - settings.frames, settings.step)
    ground, angle = positions[starts, HIPS, ::2], facing_angle(positions)[starts]
    return starts[:, None] + torch.arange(needed), ground.unsqueeze(1), angle.unsqueeze(1)
