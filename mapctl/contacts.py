"""The one definition of "this foot is planted"."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds of a planted toe."""

    reach: float = 0.025
    """A planted toe is within this height over its floor, metres."""
    slow: float = 0.35
    """And slower than this over the ground, m/s."""
    floor_percentile: float = 5.0
    """The floor is this percentile of the toe's own height."""
    shortest: float = 0.1
    """Contacts shorter than this are dropped, seconds."""


def planted(
    toe_positions: Float[Tensor, "frames 2 3"], fps: float, settings: ContactSettings = ContactSettings()
) -> Bool[Tensor, "frames 2"]:
    """Whether each toe stands on its floor in each frame; positions in metres, Y up."""
    if len(toe_positions) < 2:
        return torch.zeros(len(toe_positions), 2, dtype=torch.bool)
    height = toe_positions[..., 1]
    floor = torch.quantile(height, settings.floor_percentile / 100, dim=0)
    speed = torch.diff(toe_positions[..., [0, 2]], dim=0).norm(dim=-1) * fps
    speed = torch.cat([speed[:1], speed])
    stands = (height < floor + settings.reach) & (speed < settings.slow)
    return _drop_short(stands, round(settings.shortest * fps))


def _drop_short(stands: Tensor, shortest: int) -> Tensor:
    """Runs of true shorter than `shortest` frames become false."""
    kept = stands.clone()
    for foot in range(stands.shape[1]):
        padded = torch.nn.functional.pad(stands[:, foot].int(), (1, 1))
        edges = torch.diff(padded).nonzero()[:, 0].tolist()
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if stop - start < shortest:
                kept[start:stop, foot] = False
    return kept
