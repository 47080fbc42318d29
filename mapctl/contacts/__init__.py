"""Contact detection: when a toe is planted."""

from dataclasses import dataclass
from fractions import Fraction

import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl.errors import RequestError

CERTAIN_LOGIT = 4.0
"""Logit of a contact that is as good as certain."""


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds of a planted toe."""

    reach: float = 0.025
    """A planted toe is within this height over its floor, metres."""
    slow: float = 0.35
    """A planted toe is slower than this over the ground, m/s."""
    floor_percentile: float = 5.0
    """The floor is this percentile of the toe's own height in the clip."""
    shortest: float = 0.1
    """Contacts shorter than this are dropped, seconds: 3 frames at 30 fps."""
    speed_window: float = 1 / 30
    """Toe speed is the mean over about this time, seconds, or a fast camera's noise looks like motion."""


def to_logits(planted: Bool[Tensor, "*frames feet"]) -> Float[Tensor, "*frames feet"]:
    """Return the logits of contacts that are as good as certain."""
    return CERTAIN_LOGIT * (2 * planted.float() - 1)


def detect_contacts(
    toe_positions: Float[Tensor, "frames feet 3"] | Float[ndarray, "frames feet 3"],
    fps: float | Fraction,
    settings: ContactSettings = ContactSettings(),
) -> Bool[Tensor, "frames feet"]:
    """Detect whether each toe stands on its floor in each frame; positions in metres, Y up.

    A frame's speed is that from the frame before. The first frames, which have none, count as planted where they are
    low and the first frame with a speed is planted. RequestError for no frames or no frame rate.
    """
    toes, fps = torch.as_tensor(toe_positions), float(fps)
    if len(toes) == 0 or not fps > 0:
        raise RequestError(f"contacts need frames and a positive frame rate, got {len(toes)} at {fps:g} fps")
    step = max(1, round(settings.speed_window * fps))
    low = toes[..., 1] < estimate_floor_heights(toes, settings) + settings.reach
    slow = (toes[step:] - toes[:-step])[..., ::2].norm(dim=-1) * (fps / step) < settings.slow
    planted = remove_short_runs(low[step:] & slow, max(1, round(settings.shortest * fps)))
    return torch.cat([low[:step] & (planted[:1] if len(planted) else False), planted])


def estimate_floor_heights(
    toe_positions: Float[Tensor, "frames feet 3"], settings: ContactSettings = ContactSettings()
) -> Float[Tensor, "feet"]:
    """Estimate the floor height under each toe joint, metres: a low percentile of the toe's own height."""
    return torch.quantile(toe_positions[..., 1], settings.floor_percentile / 100, dim=0)


def remove_short_runs(mask: Bool[Tensor, "frames feet"], shortest: int) -> Bool[Tensor, "frames feet"]:
    """Remove runs of true shorter than `shortest` frames: a morphological opening."""
    if len(mask) < shortest:
        return torch.zeros_like(mask)
    whole = mask.T.unfold(-1, shortest, 1).all(dim=-1)  # windows that are true throughout
    spread = torch.nn.functional.pad(whole, (shortest - 1, shortest - 1))
    return spread.unfold(-1, shortest, 1).any(dim=-1).T


def support_speed(
    heights: Float[Tensor, "*batch feet"], speeds: Float[Tensor, "*batch feet"], near: float = 0.05
) -> Float[Tensor, "*batch"]:
    """Return the speed over the ground, m/s, of the slowest of the toes less than `near` metres over their rest height,
    which supports the body; 0 in flight, where none is near."""
    close = heights < near
    return torch.where(close.any(dim=-1), torch.where(close, speeds, torch.inf).amin(dim=-1), 0.0)


MIN_CONTACT_FRAMES = 3
"""Least duration of a contact, or of a gap in one, frames at the prior's rate: `ContactSettings.shortest`."""


def debounced(contacts: Bool[Tensor, "frames feet"]) -> Bool[Tensor, "frames feet"]:
    """Close gaps in contacts at the prior's rate, then remove contacts, of less than MIN_CONTACT_FRAMES frames."""
    return remove_short_runs(~remove_short_runs(~contacts, MIN_CONTACT_FRAMES), MIN_CONTACT_FRAMES)
