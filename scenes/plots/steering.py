"""A picture of steering: target and actual speed and direction over time."""

import math
from os import PathLike

import numpy as np

from mapctl.errors import RequestError
from mapctl.formats.atomic import atomic_path
from mapctl.intent.steering import CommandTrack
from mapctl.metrics.travel import compute_low_pass_velocity, sample_commands
from mapctl.motion import Motion


def plot(motion: Motion, track: CommandTrack, path: str | PathLike[str]) -> None:
    """Write a PNG. RequestError where matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(f"plots need matplotlib ({error}): pip install 'mapctl[render]'") from error
    way = compute_low_pass_velocity(motion)
    speed, heading = sample_commands(track, way.seconds.tolist())
    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(way.seconds, speed, color="#999999", drawstyle="steps-post", label="wanted")
    above.plot(way.seconds, way.speed, color="#4c78a8", label="got (slow part)")
    above.set_ylabel("speed, m/s")
    above.legend(loc="upper right", frameon=False)
    moving = way.speed > 0.2
    got = np.where(moving, np.degrees(way.direction), np.nan)
    centred = [math.remainder(math.degrees(angle), 360) if math.isfinite(angle) else angle for angle in heading]
    below.plot(way.seconds, centred, color="#999999", drawstyle="steps-post")
    below.plot(way.seconds, got, ".", color="#f58518", markersize=2)
    below.set(ylabel="direction, degrees", xlabel="seconds", ylim=(-185, 185), yticks=range(-180, 181, 90))
    with atomic_path(path) as scratch:
        figure.savefig(scratch, format="png", dpi=110)
