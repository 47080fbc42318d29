"""Speed by time, which may be zero: to start, to pause, to stop."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError


@dataclass(frozen=True)
class TimedSpeed:
    """Speed along a curve by time, m/s, linear between the given times and constant beyond them."""

    seconds: tuple[float, ...]
    """Times, seconds since the first frame, rising."""
    speeds: tuple[float, ...]
    """Speeds at those times, m/s; zero is to stand."""

    def __post_init__(self):
        if len(self.seconds) != len(self.speeds) or not self.seconds:
            raise RequestError("speeds by time need one speed for each time")
        rises = all(a < b for a, b in zip(self.seconds, self.seconds[1:], strict=False))
        if not rises or not all(math.isfinite(time) for time in self.seconds):
            raise RequestError(f"the times of speeds must rise, got {self.seconds}")
        for speed in self.speeds:
            if not 0 <= speed < float("inf"):
                raise RequestError(f"speed must be zero or positive, got {speed:g} m/s")

    @staticmethod
    def parse(pairs: tuple[tuple[float, float], ...]) -> "TimedSpeed":
        """Return the speeds of pairs (seconds, m/s)."""
        return TimedSpeed(tuple(float(time) for time, _ in pairs), tuple(float(speed) for _, speed in pairs))

    def at(self, frames: int, fps: float) -> Float[Tensor, " frames"]:
        """Return the speed at each frame, m/s."""
        return torch.from_numpy(np.interp(np.arange(frames) / fps, self.seconds, self.speeds))

    def arcs(self, frames: int, fps: float) -> Float[Tensor, " frames"]:
        """Return the arc at each frame, metres, the first 0: the integral of speed."""
        return integrate_speeds(self.at(frames, fps), fps)


def integrate_speeds(speeds: Float[Tensor, " frames"], fps: float) -> Float[Tensor, " frames"]:
    """Return the arc at each frame, metres, the first 0, by the trapezoidal rule."""
    steps = (speeds[1:] + speeds[:-1]) / (2 * fps)
    return torch.cat([speeds.new_zeros(1), steps.cumsum(0)])
