"""What passes between a character that is steered live and whoever shows it; neither knows the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from numpy import ndarray

from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class FrameChunk:
    """Frames of one step, as plain arrays, so that they pass between processes."""

    due: float
    """Value of time.perf_counter at which the first of them is to be seen."""
    seconds: float
    """Of the stream, at that moment."""
    root: Float[ndarray, "frames 3"]
    """Joint 0 in the world, metres."""
    quats: Float[ndarray, "frames joints 4"]
    """Local rotations, xyzw."""
    contacts: Float[ndarray, "frames 2"]
    """Left and right toe planted, 1 or 0."""
    forecast: Float[ndarray, "ahead joints 3"]
    """World joint positions of the frames that would come next, metres."""
    wish: tuple[float, float]
    """Wanted velocity of the last frame, x and z, m/s."""
    energies: Mapping[str, float]
    """Mean nats a frame by term, of the new frames."""
    spare: float
    """Seconds between delivery and when the first frame had to be there; negative where it came late. Frames that came
    very late are due anew, as soon as they are there."""
    compute_seconds: float
    """Seconds of the step."""
    evaluations: int
    """Of energy and gradient in the step."""
    notes: tuple[str, ...] = ()
    """What was ordered since the last step and could not be done, or not as it was asked; a sentence each."""

    @property
    def late_frames(self) -> int:
        """Frames that came after they were due."""
        return sum(self.spare + k / PRIOR_FPS < 0 for k in range(len(self.root)))

    def motion(self, skeleton: Skeleton) -> Motion:
        """The frames as a motion of that skeleton."""
        return Motion(skeleton, Fraction(PRIOR_FPS), torch.from_numpy(self.root), torch.from_numpy(self.quats))


@runtime_checkable
class LiveCharacter(Protocol):
    """A character that moves by itself in real time and takes orders at any moment."""

    skeleton: Skeleton
    """Its bones."""

    def command(self, command: Command) -> None:
        """Obey this from now on, and follow no path; as far as it can, which `FrameChunk.notes` tell."""
        ...

    def walk(self, points: Sequence[tuple[float, float]], speed: float) -> None:
        """Walk along a smooth curve through two or more points (x and z, metres) at a speed in m/s, then stand."""
        ...

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it go on."""
        ...

    def reset(self) -> None:
        """Begin anew where it first stood; also who is no more."""
        ...

    def poll(self) -> list[FrameChunk]:
        """What was delivered since the last call, oldest first. MapctlError if the character is no more."""
        ...

    def close(self) -> None:
        """End it; harmless the second time."""
        ...
