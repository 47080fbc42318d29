"""Detection of spikes: single frames, or two in a row, that the frames around them do not explain."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import true_intervals
from mapctl.recording.local_regression import predict_frames
from mapctl.recording.noise_estimation import RESOLUTION
from mapctl.recording.quaternion_signs import choose_continuous_signs

_MEDIAN_FRAMES = 5  # frames of the running median: bursts of up to two are detected
_CANDIDATE_RATIO, _CANDIDATE_FRAMES = 3.0, 13  # distance from the median, by its median over so many frames
SHARE = 0.01
"""Share of a track's frames expected to spike."""
ROTATIONS = 4 / 3 * math.pi * math.pi**3
"""Volume of all rotation vectors, among which a false rotation may be any."""
BODY = 4 / 3 * math.pi * 2.0**3
"""Volume about a body, cubic metres, within which its false position lies."""
_ROUNDS = 5


def find_angle_spikes(
    quats: Float[Tensor, "frames joints 4"],
    seen: Bool[Tensor, "frames joints"],
    resolution: Float[Tensor, " joints"] | None = None,
) -> Bool[Tensor, "frames joints"]:
    """Find which joints spike in which frames that are seen; `resolution` is the least noise of each angle, radians."""
    vectors = 2 * choose_continuous_signs(quats)
    return _find_spikes(vectors, seen, resolution, math.log(SHARE / ROTATIONS))


def find_position_spikes(
    positions: Float[Tensor, "frames 3"], seen: Bool[Tensor, " frames"]
) -> Bool[Tensor, " frames"]:
    """Find the frames in which the position spikes; metres."""
    return _find_spikes(positions[:, None], seen[:, None], None, math.log(SHARE / BODY))[:, 0]


def _find_spikes(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    resolution: Float[Tensor, " tracks"] | None,
    log_density: float,
) -> Bool[Tensor, "frames tracks"]:
    """Find the candidates that are likelier anywhere at all, `log_density`, than where their neighbours lead.

    Neighbours that spike explain nothing: first no candidate counts as a neighbour, then all that were none.
    """
    least = values.new_full((values.shape[1],), RESOLUTION)
    least = least if resolution is None else torch.maximum(least, resolution)
    candidates = _find_candidates(values) & seen
    spikes = candidates.clone()
    changed = candidates.any(dim=0)
    for _ in range(_ROUNDS):
        if not changed.any():
            break
        open_ = changed.nonzero()[:, 0]
        prediction = predict_frames(values[:, open_], (seen & ~spikes)[:, open_], least[open_])
        found = candidates[:, open_] & (prediction.log_density() < log_density)
        changed[open_] = (found != spikes[:, open_]).any(dim=0) & found.any(dim=0)
        spikes[:, open_] = found
    for track, start, stop in true_intervals(spikes):
        if stop - start > _MEDIAN_FRAMES // 2 or not _is_rough(values[:, track], ~spikes[:, track], start, stop):
            spikes[start:stop, track] = False
    return spikes


def _is_rough(values: Float[Tensor, "frames width"], kept: Bool[Tensor, " frames"], start: int, stop: int) -> bool:
    """Return whether frames `start` to `stop` stand out further than what is left without them.

    Amid a track they lie further from the line between the kept frames beside them than these turn there. At an end,
    which is seen from one side, they lie further from the line through the next two than any other frame does.
    """
    before, after = kept[:start].nonzero()[-2:, 0], stop + kept[stop:].nonzero()[:2, 0]
    if len(before) == 2 and len(after) == 2:
        near = torch.stack([before[1], after[0]])
        slopes = [_slope(values, pair) for pair in (before, near, after)]
        away = torch.arange(start, stop)[:, None] - near[0]
        leap = (values[start:stop] - values[near[0]] - away * slopes[1]).norm(dim=-1).amax()
        return bool(leap > max((slopes[1] - slopes[0]).norm(), (slopes[2] - slopes[1]).norm()))
    rest = values[kept]
    if len(rest) < _MEDIAN_FRAMES:
        return False
    near, far, end = (rest[0], rest[1], values[start]) if start == 0 else (rest[-1], rest[-2], values[stop - 1])
    return bool((end - (2 * near - far)).norm() > torch.diff(rest, n=2, dim=0).norm(dim=-1).amax())


def _slope(values: Float[Tensor, "frames width"], pair: Tensor) -> Float[Tensor, " width"]:
    """Return the change a frame between two frames."""
    first, second = pair.tolist()
    return (values[second] - values[first]) / (second - first)


def _find_candidates(values: Float[Tensor, "frames tracks width"]) -> Bool[Tensor, "frames tracks"]:
    """Find frames further from the running median than most about them; more than can spike."""
    away = (values - _running_median(values.flatten(1)).unflatten(1, values.shape[1:])).norm(dim=-1)
    side = min(_CANDIDATE_FRAMES // 2, len(away) - 1)
    usual = torch.nn.functional.pad(away.T, (side, side), mode="reflect").unfold(-1, 2 * side + 1, 1).median(dim=-1)
    return away > _CANDIDATE_RATIO * usual.values.T + RESOLUTION


def _running_median(values: Float[Tensor, "frames width"]) -> Float[Tensor, "frames width"]:
    """Return the running median over `_MEDIAN_FRAMES`; the ends are mirrored, since repeated, an outermost frame that
    spikes would be its own median."""
    side, last = _MEDIAN_FRAMES // 2, len(values) - 1
    frame = last - (last - torch.arange(-side, len(values) + side).abs()).abs()
    return values[frame.clamp_min(0)].unfold(0, _MEDIAN_FRAMES, 1).median(dim=-1).values
