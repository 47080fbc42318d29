"""Intervals of a mask over frames: runs of true, the nearest frames that are true, and interpolation between them."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations


def true_intervals(mask: Bool[Tensor, "frames columns"]) -> Iterator[tuple[int, int, int]]:
    """Yield column, first frame and one past the last of each run of true, column by column."""
    edge = torch.zeros(1, mask.shape[1], dtype=torch.int8)
    change = torch.diff(mask.to(torch.int8), dim=0, prepend=edge, append=edge).T
    starts, stops = (change == 1).nonzero(), (change == -1).nonzero()
    for (column, start), (_, stop) in zip(starts.tolist(), stops.tolist(), strict=True):
        yield column, start, stop


def widen(mask: Bool[Tensor, " frames"], frames: int) -> Bool[Tensor, " frames"]:
    """Return a mask that is also true for some frames before and after each run of true."""
    kernel = torch.ones(1, 1, 2 * frames + 1)
    return torch.nn.functional.conv1d(mask.float()[None, None], kernel, padding=frames)[0, 0] > 0


def fill_missing(values: Float[Tensor, "batch frames width"], observed: Bool[Tensor, "batch frames"]) -> Tensor:
    """Fill frames that were not observed linearly between those around them; hold first and last beyond."""
    before, after = last_observed(observed), next_observed(observed)
    start = torch.take_along_dim(values, before[..., None], dim=1)
    stop = torch.take_along_dim(values, after[..., None], dim=1)
    frame = torch.arange(values.shape[1], device=values.device)
    weight = ((frame - before).to(values) / (after - before).clamp_min(1)).clamp(0, 1)
    return torch.lerp(start, stop, weight[..., None])


def fill_missing_angle(angle: Float[Tensor, "batch frames"], observed: Bool[Tensor, "batch frames"]) -> Tensor:
    """Fill angles, radians, not wrapped, as `fill_missing` does, along the shorter arc."""
    # Frames that were not observed may hold anything: whole turns are counted from one observed frame to the next.
    held = torch.take_along_dim(angle, last_observed(observed), dim=1)
    return fill_missing(rotations.unwrap_angle(held)[..., None], observed)[..., 0]


def last_observed(observed: Bool[Tensor, "batch frames"]) -> Int[Tensor, "batch frames"]:
    """Return for each frame the last observed one at or before it; before the first of them, that one."""
    frame = torch.arange(observed.shape[1], device=observed.device)
    last = torch.where(observed, frame, -1).cummax(dim=1).values
    first = torch.where(observed.any(dim=1), observed.to(torch.uint8).argmax(dim=1), 0)
    return torch.where(last < 0, first[:, None], last)


def next_observed(observed: Bool[Tensor, "batch frames"]) -> Int[Tensor, "batch frames"]:
    """Return for each frame the first observed one at or after it; after the last of them, that one."""
    return observed.shape[1] - 1 - last_observed(observed.flip(1)).flip(1)


def count_frames_to_observed(observed: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames 2"]:
    """Count for each frame those since an observed one and those until the next; infinite where there is none."""
    frame = torch.arange(observed.shape[1], device=observed.device)
    away = torch.stack([frame - last_observed(observed), next_observed(observed) - frame], dim=-1).float()
    none = ~observed.any(dim=1)
    # Before the first observed frame the last one is none, and vice versa.
    return torch.where(none[:, None, None] | (away < 0), torch.inf, away)
