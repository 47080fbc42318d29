"""Heads that look at something for a time: they turn toward it and back."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.request import Look, Reach
from mapctl.features import PRIOR_FPS
from mapctl.kinematics.head_turning import measure_look_angle, turn_head
from mapctl.motion import Motion
from mapctl.numerics.intervals import widen

_EASE_SECONDS = 0.5  # in which the head turns there, and back
_GLANCE_SHARE = 0.7  # of the way that the head goes toward what a hand reaches for: eyes do the rest
_EYES_LEAD_SECONDS, _APART_SECONDS = 0.25, 1.0


def turn_heads(motion: Motion, looks: Sequence[Look]) -> Motion:
    """Turn neck and head toward what is looked at, in half a second and back in another."""
    for look in looks:
        motion = turn_head(motion, _place(look), _ease(motion.num_frames, look))
    return motion


def look_where_hands_reach(motion: Motion, reaches: Sequence[Reach], looks: Sequence[Look], posed: Tensor) -> Motion:
    """Turn the head part of the way toward what hands reach for, as people do who see what they take; not within a
    second of what is looked at anyway, nor of frames that are `posed`."""
    busy = posed.clone()
    for look in looks:
        first, last = (round(second * PRIOR_FPS) for second in (look.seconds, look.seconds + look.hold_seconds))
        busy[max(0, first) : last + 1] = True
    busy = widen(busy, round(_APART_SECONDS * PRIOR_FPS))
    for reach in reaches:
        hands = [place for name, place in reach.places.items() if name.endswith("Hand")]
        first = max(0.0, reach.seconds - _EYES_LEAD_SECONDS)
        last = reach.seconds + reach.hold_seconds
        if not hands or bool(busy[round(first * PRIOR_FPS) : round(last * PRIOR_FPS) + 1].any()):
            continue
        middle = torch.tensor(hands, dtype=torch.float64).mean(dim=0)
        weight = _GLANCE_SHARE * _ease(motion.num_frames, Look(first, (0.0, 0.0, 0.0), last - first))
        motion = turn_head(motion, middle[None], weight)
    return motion


def measure_look_errors(motion: Motion, look: Look) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and what it is to look at, degrees, while it is to look."""
    first = round(look.seconds * PRIOR_FPS)
    held = slice(first, first + round(look.hold_seconds * PRIOR_FPS) + 1)
    return torch.rad2deg(measure_look_angle(motion, _place(look)))[held]


def _place(look: Look) -> Float[Tensor, "1 3"]:
    return torch.tensor([look.place], dtype=torch.float64)


def _ease(frames: int, look: Look) -> Float[Tensor, " frames"]:
    """Return how far the head is turned in each frame, 0 to 1."""
    seconds = torch.arange(frames, dtype=torch.float64) / PRIOR_FPS
    before = (look.seconds - seconds).clamp_min(0) + (seconds - look.seconds - look.hold_seconds).clamp_min(0)
    share = (1 - before / _EASE_SECONDS).clamp_min(0)
    return share * share * (3 - 2 * share)
