"""Heel contacts, derived from those of the toes and the poses.

A heel stands where its toe is planted and the foot is flat, and for a moment between its strike and the toe's.
Detection on heels finds hardly more, so features hold the contacts of toes alone.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class HeelContactSettings:
    """Thresholds of a planted heel."""

    reach: float = 0.02
    """A planted heel is within this height over its rest height beside the toe, metres."""
    strike: float = 1 / 30
    """Longest time before a toe's contact in which its heel may be planted already, seconds; at least one frame."""
    slow: float = 0.35
    """A heel that has struck is slower than this over the ground since the frame before, m/s, as toes are."""


def derive_heel_contacts(
    toe_contacts: Bool[Tensor, "*batch frames 2"],
    toes: Float[Tensor, "*batch frames 2 3"],
    heels: Float[Tensor, "*batch frames 2 3"],
    drops: Float[Tensor, "2"],
    fps: float,
    settings: HeelContactSettings = HeelContactSettings(),
) -> Bool[Tensor, "*batch frames 2"]:
    """Derive whether the left and the right heel are planted; world positions in metres, `drops` from
    `find_heel_drops`.

    The floor is that of the toe: a planted toe joint is at its rest height, and the heel's is `drops` below. In the
    frames before a toe's contact the floor is the one on which that contact begins.
    """
    strike = max(1, round(settings.strike * fps)) if settings.strike > 0 else 0
    planted = toe_contacts & (heels[..., 1] - toes[..., 1] + drops < settings.reach)
    floors, ahead = toes[..., 1], toe_contacts
    moved = torch.diff(heels[..., ::2], dim=-3).norm(dim=-1)
    slow = torch.cat([torch.zeros_like(planted[..., :1, :]), moved * fps < settings.slow], dim=-2)
    for _ in range(strike):
        floors, ahead = torch.where(ahead, floors, _next_frames(floors)), ahead | _next_frames(ahead)
        low = heels[..., 1] - floors + drops < settings.reach
        planted = planted | (ahead & low & slow & _next_frames(planted))
    return planted


def _next_frames(values: Tensor) -> Tensor:
    """Return the next frame's values; the last frame's own at the end."""
    return torch.cat([values[..., 1:, :], values[..., -1:, :]], dim=-2)
