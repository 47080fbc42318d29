"""A picture of steering: target and actual speed and direction over time."""

import math
from os import PathLike

import numpy as np

from mapctl.intent.steering import CommandTrack
from mapctl.metrics.travel import compute_low_pass_velocity, sample_commands
from mapctl.motion import Motion
from scenes.plots import open_plots


def plot(motion: Motion, track: CommandTrack, path: str | PathLike[str]) -> None:
    """Write a PNG. RequestError where matplotlib is not installed."""
    actual = compute_low_pass_velocity(motion)
    speed, heading = sample_commands(track, actual.seconds.tolist())
    centred = [math.remainder(math.degrees(angle), 360) if math.isfinite(angle) else angle for angle in heading]
    direction = np.where(actual.speed > 0.2, np.degrees(actual.direction), np.nan)
    with open_plots(path, 2, inches=(11, 5), dpi=110) as (above, below):
        above.plot(actual.seconds, speed, color="#999999", drawstyle="steps-post", label="wanted")
        above.plot(actual.seconds, actual.speed, color="#4c78a8", label="got (slow part)")
        above.set_ylabel("speed, m/s")
        above.legend(loc="upper right", frameon=False)
        below.plot(actual.seconds, centred, color="#999999", drawstyle="steps-post")
        below.plot(actual.seconds, direction, ".", color="#f58518", markersize=2)
        below.set(ylabel="direction, degrees", xlabel="seconds", ylim=(-185, 185), yticks=range(-180, 181, 90))
