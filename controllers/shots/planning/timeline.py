"""What a character does when: the frames in which it stands, those in which it walks, and the transitions between."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.intent.path import SpeedProfile
from mapctl.numerics.intervals import true_intervals

_STANDING_SPEED = 0.05  # m/s
_WALKING_SHARE = 0.7  # of the fastest speed beside a standing, at which the density walks already
_SHORTEST_WALK = 15  # frames: what is shorter is a step that the in-betweener makes alone


@dataclass(frozen=True)
class Span:
    """Frames start to stop in which a character stands or walks."""

    what: Literal["stand", "walk"]
    """What it does."""
    start: int
    """First frame."""
    stop: int
    """One past the last frame."""


def lay_timeline(speeds: Float[Tensor, " frames"], *, slowest: float) -> list[Span]:
    """Lay out the spans of a shot by its speeds, m/s a frame; between spans, from one to the next, lie transitions.

    A character that never stands walks throughout. A walk beside a standing begins and ends where the wanted speed is
    most of the fastest, and no lower than `slowest`, which the density can walk.
    """
    frames = len(speeds)
    standing = [(start, stop) for _, start, stop in true_intervals((speeds < _STANDING_SPEED)[:, None])]
    if not standing:
        return [Span("walk", 0, frames)]
    spans, before = [], 0
    for start, stop in [*standing, (frames, frames)]:
        if start > before:
            spans += _lay_walk(speeds, before, start, slowest)
        if stop > start:
            spans.append(Span("stand", start, stop))
        before = stop
    return spans


def _lay_walk(speeds: Tensor, start: int, stop: int, slowest: float) -> list[Span]:
    """Lay the walk between two standings, or a shot's end."""
    enough = max(slowest, _WALKING_SHARE * float(speeds[start:stop].max()))
    fast = (speeds[start:stop] >= enough).nonzero()[:, 0]
    if not len(fast):
        return []
    first = start + int(fast[0]) if start > 0 else start
    last = start + int(fast[-1]) + 1 if stop < len(speeds) else stop
    return [Span("walk", first, last)] if last - first >= _SHORTEST_WALK else []


@dataclass(frozen=True)
class StandingEnds:
    """Which ends of a shot stand, and how speeds rise and fall there."""

    start: bool
    """Whether it begins standing."""
    end: bool
    """Whether it ends standing."""
    acceleration: float = 1.2
    """Rise and fall of the speed, m/s^2."""
    still: float = 0.5
    """Seconds of standing at the start."""
    settled: float = 1.0
    """Seconds of standing at the end."""


def limit_timed_speeds(speeds: Float[Tensor, " frames"], fps: float, ends: StandingEnds) -> Float[Tensor, " frames"]:
    """Let speeds by time, m/s, rise from standing and fall to it at the ends that stand, where they do not already."""
    seconds, found = torch.arange(len(speeds), dtype=speeds.dtype) / fps, speeds
    if ends.start and float(speeds[0]) >= _STANDING_SPEED:
        found = torch.minimum(found, ends.acceleration * (seconds - ends.still).clamp_min(0))
    if ends.end and float(speeds[-1]) >= _STANDING_SPEED:
        found = torch.minimum(found, ends.acceleration * (seconds[-1] - seconds - ends.settled).clamp_min(0))
    return found


def plan_speeds(
    profile: SpeedProfile, length: float, fps: float, ends: StandingEnds, *, seconds: float | None, most: int
) -> Float[Tensor, " frames"]:
    """Plan speeds along an open curve of some length, m/s a frame: from standing, to standing at its end, or both.

    Without `seconds` it lasts until the curve ends, and the standing beyond; RequestError for more than `most` frames.
    """
    speeds, arc, step = [], 0.0, 1 / fps
    last = math.inf if seconds is None else seconds - step
    while len(speeds) <= most:
        time = len(speeds) * step
        speed = profile.at(arc)
        if ends.start:
            speed = min(speed, ends.acceleration * max(0.0, time - ends.still))
        if ends.end:
            braking = min(length - arc, _braking_distance(last - ends.settled - time, ends.acceleration))
            speed = min(speed, math.sqrt(2 * ends.acceleration * max(0.0, braking)))
        stopped = ends.end and length - arc < 0.004
        if (seconds is None and (stopped or arc >= length)) or time > last + 1e-9:
            break
        speeds.append(0.0 if stopped else speed)
        arc += speed * step
    if len(speeds) > most:
        raise RequestError(f"more than the {most} frames allowed; ask for fewer seconds or more speed")
    if seconds is None and ends.end:
        speeds += [0.0] * round(ends.settled * fps)
    return torch.tensor(speeds, dtype=torch.float64)


def _braking_distance(seconds: float, acceleration: float) -> float:
    """Return the distance in which one stops within a time, metres."""
    return 0.5 * acceleration * max(0.0, seconds) ** 2
