"""Frames of a character that is steered live, as they pass between processes."""

from dataclasses import dataclass
from fractions import Fraction

import torch
from jaxtyping import Float
from numpy import ndarray

from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class FrameChunk:
    """Frames of one step, as plain arrays, so that they pass between processes."""

    due: float
    """Value of time.perf_counter, seconds, at which the first of them is to be seen."""
    seconds: float
    """Time of the stream at that moment, seconds."""
    root: Float[ndarray, "frames 3"]
    """Position of joint 0 in the world, metres."""
    quats: Float[ndarray, "frames joints 4"]
    """Local rotations, xyzw."""
    contacts: Float[ndarray, "frames 2"]
    """Left and right toe planted, 1 or 0."""
    forecast: Float[ndarray, "ahead joints 3"]
    """World joint positions of the forecast frames, metres."""
    target_velocity: tuple[float, float]
    """Target velocity of the last frame, x and z, m/s."""
    target_facing: float
    """Target facing of the hips in the last frame, radians from +Z toward +X."""
    spare: float
    """Lateness, seconds from when the first frame was due to its delivery; negative where it came early. Frames that
    came very late are due anew, as soon as they are there."""
    compute_seconds: float
    """Compute time of the step, seconds."""
    root_velocity: Float[ndarray, "frames 2"]
    """Velocity of the hips over the ground, x and z, m/s."""
    trajectory: Float[ndarray, "points 3"]
    """Ground trajectory of the forecast frames: x and z of the hips, metres, and their heading, radians."""
    notes: tuple[str, ...] = ()
    """Notes on commands since the last step that could not be obeyed, or not as given."""

    def due_of(self, frame: int) -> float:
        """Return the value of time.perf_counter, seconds, at which a frame is to be seen."""
        return self.due + frame / PRIOR_FPS

    @property
    def late_frames(self) -> int:
        """Number of frames that came after they were due."""
        return sum(self.spare + k / PRIOR_FPS < 0 for k in range(len(self.root)))

    def motion(self, skeleton: Skeleton) -> Motion:
        """Return the frames as a motion of that skeleton."""
        return Motion(skeleton, Fraction(PRIOR_FPS), torch.from_numpy(self.root), torch.from_numpy(self.quats))
