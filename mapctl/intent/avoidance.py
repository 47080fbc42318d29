"""Ways round obstacles for who is steered: the direction nearest to the commanded one in which nothing is in the way.

One step at a time, without a plan: for curves and times that are known in advance, `mapctl.curves.detour` finds the
shortest way round.
"""

import math

import torch

from mapctl import rotations
from mapctl.curves.obstacles import Obstacle, measure_clearance

_BODY = 0.4  # metres from an obstacle's edge to the hips of who walks past
_LOOK_AHEAD, _LOOK_SECONDS = 0.6, 1.2  # metres, and seconds of walking, in which the way must be clear
_HEADINGS, _WIDEST = 65, math.radians(140.0)  # directions that are tried, and how far off the commanded one
_PLACES = 16  # along each
_GET_OUT = 0.3  # metres of clearance gained by metre, for who is too near already
_STAY = 0.5  # share of a change of direction that counts beside the deviation: who goes left keeps to the left


def lead_around(
    obstacles: tuple[Obstacle, ...], *, place: tuple[float, float], heading: float, wanted: float, speed: float
) -> float:
    """Return the direction of travel, radians, nearest to the `wanted` one that leads clear of obstacles.

    `place` is where one is (x and z, metres), `heading` the direction in which one goes now, `speed` in m/s. Where
    every direction is blocked, the clearest.
    """
    if not obstacles or speed <= 0:
        return wanted
    offsets = torch.linspace(-_WIDEST, _WIDEST, _HEADINGS, dtype=torch.float64)
    angles = wanted + offsets
    along = torch.linspace(0, _LOOK_AHEAD + _LOOK_SECONDS * speed, _PLACES, dtype=torch.float64)
    start = torch.tensor(place, dtype=torch.float64)
    rays = start + along[:, None] * torch.stack([angles.sin(), angles.cos()], dim=-1)[:, None]
    near = float(measure_clearance(obstacles, start))
    lacking = (torch.clamp(near + _GET_OUT * along, max=_BODY) - measure_clearance(obstacles, rays)).amax(dim=1)
    if bool((lacking > 1e-6).all()):
        return float(angles[lacking.argmin()])
    cost = offsets.abs() + _STAY * rotations.wrap_angle(angles - heading).abs()
    return float(angles[torch.where(lacking > 1e-6, torch.inf, cost).argmin()])
