"""Slowing down before corners: speeds along a curve that leave time to turn."""

import math
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.curves import Curve
from mapctl.intent.path import USUAL_SPEED, SpeedProfile
from mapctl.numerics.intervals import true_intervals

_STEP = 0.05  # metres between the arcs that are looked at
_AHEAD = 0.35  # metres before and after an arc over which the direction changes: half a step
_TURN_RATE = 1.55  # rad/s at which one turns a corner without leaving it by more than a few centimetres
_SLOWEST = 0.7  # m/s, to which corners slow one down at most: who is slower hardly walks
_REVERSAL_STEP = 0.02  # metres before and after an arc, over which a reversal turns
_REVERSAL_ANGLE = math.radians(110.0)  # from which on a corner is turned on the spot
_BRAKING = 0.9  # m/s^2, before a corner and after it


def slow_for_corners(curve: Curve, profile: SpeedProfile) -> SpeedProfile:
    """Return a speed profile that is lower before and in corners that turn faster than people who walk do; the same
    one where none does."""
    count = max(2, round(curve.length / _STEP) + 1)
    arcs = torch.linspace(0, curve.length, count, dtype=torch.float64)
    wanted = torch.tensor([profile.at(arc) for arc in arcs.tolist()], dtype=torch.float64)
    limit = _limit_speeds(curve, arcs)
    if bool((wanted <= limit).all()):
        return profile
    speeds, step = torch.minimum(wanted, limit).tolist(), float(arcs[1])
    for _ in range(2 if curve.closed else 1):  # what is before a loop's first corner is its end
        braked = _limit_rise(speeds[::-1], step)[::-1]
        speeds = _limit_rise(braked, step)
        if curve.closed:
            speeds[0] = speeds[-1] = min(speeds[0], speeds[-1])
    return SpeedProfile(tuple(arcs.tolist()), tuple(speeds))


def turns_sharply(curve: Curve) -> bool:
    """Return whether a curve has corners, at the usual speed, or reverses."""
    usual = SpeedProfile.constant(USUAL_SPEED)
    return slow_for_corners(curve, usual) is not usual or bool(find_reversals(curve))


def find_reversals(curve: Curve) -> list[float]:
    """Find the arcs, metres, at which a curve goes back the way it came: who walks it turns on the spot there."""
    count = max(2, round(curve.length / _REVERSAL_STEP) + 1)
    arcs = torch.linspace(0, curve.length, count, dtype=torch.float64)[2:-2]
    turned = rotations.wrap_angle(_heading(curve, arcs + _REVERSAL_STEP) - _heading(curve, arcs - _REVERSAL_STEP)).abs()
    runs = true_intervals((turned > _REVERSAL_ANGLE)[:, None])
    return [float(arcs[start:stop].mean()) for _, start, stop in runs]


def _limit_rise(speeds: list[float], step: float) -> list[float]:
    """Lower speeds, m/s, at arcs `step` metres apart, so that none rises faster than one brakes."""
    gained = 2 * _BRAKING * step
    return list(accumulate(speeds, lambda before, speed: min(speed, math.sqrt(before**2 + gained))))


def _heading(curve: Curve, arcs: Float[Tensor, " arcs"]) -> Float[Tensor, " arcs"]:
    """Return the heading at arcs, radians; beyond the ends of an open curve that of the ends."""
    return curve.heading(arcs if curve.closed else arcs.clamp(0, curve.length))


def _limit_speeds(curve: Curve, arcs: Float[Tensor, " arcs"]) -> Float[Tensor, " arcs"]:
    """Return the speed, m/s, at which the curve turns no faster than people do."""

    # Two halves, so that a hairpin's half turn is not taken for none.
    turned = rotations.wrap_angle(_heading(curve, arcs) - _heading(curve, arcs - _AHEAD)).abs()
    turned = turned + rotations.wrap_angle(_heading(curve, arcs + _AHEAD) - _heading(curve, arcs)).abs()
    return (2 * _AHEAD * _TURN_RATE / turned.clamp_min(1e-6)).clamp_min(_SLOWEST)
