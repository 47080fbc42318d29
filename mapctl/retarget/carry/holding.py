"""Values over time that are held while something touches, and smooth between; and how far limbs are let reach."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals

Spans = list[tuple[int, int]]
"""First frames of contacts and one past their last, in order."""

_MERGE_SECONDS = 0.2  # seconds between two contacts at one position that are one
_MERGE_METRES = 0.06  # metres that such contacts are apart at most


def merge_contacts(
    touching: Bool[Tensor, "frames points"], places: Float[Tensor, "frames points 3"], fps: float
) -> list[Spans]:
    """Return by point the spans in which it touches, merged where noise alone parts them: soon after each other, and
    at one place over the ground, metres."""
    found: list[Spans] = [[] for _ in range(touching.shape[1])]
    for point, start, stop in true_intervals(touching):
        spans = found[point]
        near = bool(spans) and start - spans[-1][1] < _MERGE_SECONDS * fps
        if near and float((places[start, point] - places[spans[-1][1] - 1, point])[::2].norm()) < _MERGE_METRES:
            spans[-1] = (spans[-1][0], stop)
        else:
            spans.append((start, stop))
    return found


def hold_through(spans: Spans, values: Float[Tensor, "spans width"], frames: int) -> Float[Tensor, "frames width"]:
    """Hold one value throughout each span, and go smoothly from one to the next between; there is a span at least."""
    held = values.new_empty(frames, values.shape[1])
    held[: spans[0][0]], held[spans[-1][0] :] = values[0], values[-1]
    for (start, stop), value in zip(spans, values, strict=True):
        held[start:stop] = value
    for (_, stop), (start, _), before, after in zip(spans[:-1], spans[1:], values[:-1], values[1:], strict=True):
        share = torch.arange(1, start - stop + 1, dtype=values.dtype)[:, None] / (start - stop + 1)
        held[stop:start] = before + (after - before) * smootherstep(share)
    return held


def mean_by_span(values: Float[Tensor, "frames width"], spans: Spans) -> Float[Tensor, "spans width"]:
    """Return the mean over each span."""
    return torch.stack([values[start:stop].mean(0) for start, stop in spans])


def low_pass(values: Float[Tensor, "frames columns"], sigma: float) -> Float[Tensor, "frames columns"]:
    """Low-pass values over time by a Gaussian of `sigma` frames; ends are held."""
    taps = gaussian.kernel(max(sigma, 1e-6), side=max(1, round(3 * sigma)))
    return gaussian.convolve(values, taps, "repeated")


def envelope(values: Float[Tensor, "frames columns"], seconds: float, fps: float) -> Float[Tensor, "frames columns"]:
    """Return smooth values that are about as high as the highest within so many seconds before and after."""
    frames = max(1, round(seconds * fps))
    padded = torch.nn.functional.pad(values.T[None], (frames, frames), mode="replicate")
    highest = torch.nn.functional.max_pool1d(padded, 2 * frames + 1, stride=1)[0].T
    return low_pass(highest, frames / 2)


def soft_clamp(
    far: Float[Tensor, "*frames limbs"], most: Float[Tensor, "*#frames limbs"], margin: float
) -> Float[Tensor, "*frames limbs"]:
    """Return how far the end of a limb may be: as far as it is, and ever less beyond what is nearly the most; `margin`
    is the share of the most over which it gives in."""
    soft = margin * most
    over = (far - (most - soft)).clamp_min(0)
    return torch.minimum(far, most - soft) + soft * (1 - torch.exp(-over / soft))
