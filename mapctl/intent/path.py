"""Requests to walk along a path, before they become terms."""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.numerics.intervals import true_intervals

USUAL_SPEED = 1.2
"""m/s, of walks that are requested without a speed."""
_SUBSTEPS = 10  # integration steps a frame
_SLOWEST_SHARE = 0.6  # of the requested speeds, to which they are lowered at most


def _check_speeds(name: str, at: tuple[float, ...], speeds: tuple[float, ...], *, may_stand: bool) -> None:
    rises = all(a < b for a, b in pairwise(at))
    if not at or len(at) != len(speeds) or not rises or not all(map(math.isfinite, at)):
        raise RequestError(f"speeds need as many {name}, which rise, got {at} and {speeds}")
    for speed in speeds:
        if not (0 < speed < math.inf or (may_stand and speed == 0)):
            raise RequestError(f"speed must be {'zero or ' if may_stand else ''}positive, got {speed:g} m/s")


@dataclass(frozen=True)
class SpeedProfile:
    """Speed along a curve, m/s, linear between the given arcs and constant beyond them."""

    arcs: tuple[float, ...]
    """Arcs, metres from the curve's start, rising."""
    speeds: tuple[float, ...]
    """Speeds at those arcs, m/s, positive."""

    def __post_init__(self):
        _check_speeds("arcs", self.arcs, self.speeds, may_stand=False)

    @staticmethod
    def constant(speed: float) -> "SpeedProfile":
        """Make a profile of one `speed`, m/s."""
        return SpeedProfile((0.0,), (float(speed),))

    @staticmethod
    def parse(text: str) -> "SpeedProfile":
        """Parse `1.2`, or `0:1.0,5:2.5` for 1 m/s at the start rising to 2.5 m/s at 5 m."""
        try:
            if ":" not in text:
                return SpeedProfile.constant(float(text))
            pairs = [part.split(":") for part in text.split(",")]
            return SpeedProfile(tuple(float(a) for a, _ in pairs), tuple(float(v) for _, v in pairs))
        except ValueError:
            raise RequestError(f"a speed is a number or ARC:SPEED,ARC:SPEED, got {text!r}") from None

    def at(self, arc: float) -> float:
        """Return the speed, m/s, at an `arc`, metres."""
        arcs, speeds = self.arcs, self.speeds
        after = bisect.bisect_left(arcs, arc)
        if after == 0:
            return speeds[0]
        if after == len(arcs):
            return speeds[-1]
        (a, b), (v, w) = arcs[after - 1 : after + 1], speeds[after - 1 : after + 1]
        return v + (w - v) * (arc - a) / (b - a)


@dataclass(frozen=True, eq=False)
class PathRequest:
    """Walk a curve from its first point at given speeds."""

    curve: Curve
    """Curve to follow, on the ground or in space."""
    profile: SpeedProfile
    """Speed along it."""
    seconds: float | None = None
    """Duration, seconds; None walks the curve once."""

    def __post_init__(self):
        if self.seconds is not None and not 0 < self.seconds < float("inf"):
            raise RequestError(f"seconds must be positive, got {self.seconds:g}")

    def frames(self, fps: float, *, most: int = 3_600_000) -> int:
        """Count the frames it takes, at least two; RequestError beyond `most`."""
        if self.seconds is not None:
            count = self.seconds * fps
        else:
            count = 1 + _count_frames(self.profile, self.curve.length, fps, most=most)
        if count > most:
            raise RequestError(
                f"{count:.3g} frames are more than the {most} allowed; ask for fewer seconds or more speed"
            )
        return max(2, round(count))

    def fitted(self, fps: float) -> tuple["PathRequest", str | None]:
        """Lower speeds so that an open curve lasts for the whole duration, to 60 % of the requested ones at most: what
        is then left goes on straight. Also return a note if any was lowered."""
        if self.seconds is None or self.curve.closed:
            return self, None
        wanted = float(self.arcs(self.frames(fps), fps)[-1])
        if wanted <= self.curve.length + 0.01:
            return self, None
        share = max(_SLOWEST_SHARE, self.curve.length / wanted)
        slower = SpeedProfile(self.profile.arcs, tuple(v * share for v in self.profile.speeds))
        note = (
            f"the wanted speed would go {wanted:.1f} m in {self.seconds:.1f} s but the curve is "
            f"{self.curve.length:.1f} m long, so the speed was lowered to {100 * share:.0f} % of it"
        )
        return PathRequest(self.curve, slower, self.seconds), note

    def arcs(self, frames: int, fps: float) -> Float[Tensor, " frames"]:
        """Return the target arc at each frame, metres, the first 0: the integral of speed."""
        arcs = [0.0]
        for _ in range(frames - 1):
            arcs.append(_advance_arc(self.profile, arcs[-1], 1 / fps))
        return torch.tensor(arcs, dtype=torch.float64)


def _advance_arc(profile: SpeedProfile, arc: float, seconds: float) -> float:
    for _ in range(_SUBSTEPS):
        arc += profile.at(arc) * seconds / _SUBSTEPS
    return arc


def _count_frames(profile: SpeedProfile, length: float, fps: float, *, most: int) -> float:
    """Count frames until the arc is the curve's length; counts to `most` at most where speeds differ."""
    if len(profile.speeds) == 1:
        return max(1, length / profile.speeds[0] * fps)
    if length / max(profile.speeds) * fps > most:
        return math.inf
    arc, steps = 0.0, 0
    while arc < length and steps <= most:
        arc, steps = _advance_arc(profile, arc, 1 / fps), steps + 1
    return steps


@dataclass(frozen=True)
class TimedSpeed:
    """Speed along a curve by time, m/s, linear between the given times and constant beyond them."""

    seconds: tuple[float, ...]
    """Times, seconds since the first frame, rising."""
    speeds: tuple[float, ...]
    """Speeds at those times, m/s; zero is to stand."""

    def __post_init__(self):
        _check_speeds("times", self.seconds, self.speeds, may_stand=True)

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


_STEP = 0.05  # metres between the arcs that are looked at
_AHEAD = 0.35  # metres before and after an arc over which the direction changes: half a step
_TURN_RATE = 1.55  # rad/s at which one turns a corner without leaving it by more than a few centimetres
_SLOWEST = 0.7  # m/s, to which corners slow a walk down at most: slower is hardly walking
_REVERSAL_STEP = 0.02  # metres before and after an arc, over which a reversal turns
_REVERSAL_ANGLE = math.radians(110.0)  # from which on a corner is turned on the spot
_BRAKING = 0.9  # m/s^2, before a corner and after it


def walk_at_ease(curve: Curve) -> SpeedProfile:
    """Return the speeds of a walk for which none is given: USUAL_SPEED, and lower before and in corners that turn
    faster than walking people do."""
    limit = _limit_speeds(curve, _sample_arcs(curve))
    if bool((limit >= USUAL_SPEED).all()):
        return SpeedProfile.constant(USUAL_SPEED)
    return _brake_before(curve, limit.clamp(max=USUAL_SPEED))


def limit_speeds(profile: SpeedProfile, curve: Curve, limits: Sequence[tuple[float, float, float]]) -> SpeedProfile:
    """Lower the speeds of a profile between arcs, metres, to a speed at most, m/s, (start, stop, speed) each; one
    brakes before them as before corners."""
    if not limits:
        return profile
    arcs = _sample_arcs(curve)
    speeds = torch.tensor([profile.at(arc) for arc in arcs.tolist()], dtype=torch.float64)
    for start, stop, speed in limits:
        speeds = torch.where((arcs >= start) & (arcs <= stop), speeds.clamp(max=speed), speeds)
    return _brake_before(curve, speeds)


def _sample_arcs(curve: Curve) -> Float[Tensor, " arcs"]:
    return torch.linspace(0, curve.length, max(2, round(curve.length / _STEP) + 1), dtype=torch.float64)


def _brake_before(curve: Curve, limit: Float[Tensor, " arcs"]) -> SpeedProfile:
    """Lower speeds, m/s, at arcs as sampled, so that none rises or falls faster than one brakes."""
    arcs, speeds = _sample_arcs(curve), limit.tolist()
    step = float(arcs[1])
    for _ in range(2 if curve.closed else 1):  # what is before a loop's first corner is its end
        braked = _limit_rise(speeds[::-1], step)[::-1]
        speeds = _limit_rise(braked, step)
        if curve.closed:
            speeds[0] = speeds[-1] = min(speeds[0], speeds[-1])
    return SpeedProfile(tuple(arcs.tolist()), tuple(speeds))


def find_reversals(curve: Curve) -> list[float]:
    """Find the arcs, metres, at which a curve reverses: a character turns on the spot there."""
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
