"""Supports of the toes: where a capture shows that a toe is at rest under the body, and the height that it rests at."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import last_observed, next_observed, true_intervals

_REST_SPEED, _SWING_SPEED = 0.07, 1.7
"""Standard deviation of the velocity of planted toes and of others along an axis, m/s: held-out walks, runs and
gestures of the training sets."""
_LEAN = 0.26
"""Standard deviation, radians, of the angle between the vertical and the line from a planted toe to the hips: the same
clips."""
_LEVEL = 0.02
"""Standard deviation of the height of a toe that rests on one level, metres: captured feet roll and shoes give."""
_GRADIENT = 0.1
"""Standard deviation of the gradient of a floor: ramps for wheelchairs have 1:12."""
_ITERATIONS = 20
_ROWS = 256  # intervals fitted at once, which bounds the memory


def compute_rest_log_probability(
    toes: Float[Tensor, "frames 2 3"],
    hips: Float[Tensor, "frames 3"],
    fps: float,
    speed_noise: Float[Tensor, "#frames #2"],
) -> Float[Tensor, "frames 2"]:
    """Compute the log probability that a toe rests and carries the body, at even odds of either.

    World positions, metres, at `fps`; `speed_noise` is the standard deviation of the toes' velocity along an axis that
    noise alone makes, m/s. Velocities are normal about zero whether a toe rests or swings; the direction of the hips is
    normal about the vertical where a toe carries them, uniform over the sphere elsewhere.
    """
    steps = toes.diff(dim=0, prepend=2 * toes[:1] - toes[1:2] if len(toes) > 1 else toes) * fps
    rest, swing = (speed_noise.square() + speed**2 for speed in (_REST_SPEED, _SWING_SPEED))
    resting = 1.5 * torch.log(swing / rest) - 0.5 * steps.square().sum(dim=-1) * (1 / rest - 1 / swing)
    up = hips[:, None] - toes
    lean = torch.atan2(up[..., ::2].norm(dim=-1), up[..., 1])
    carrying = math.log(2 / _LEAN**2) - 0.5 * (lean / _LEAN).square()
    return torch.nn.functional.logsigmoid(resting) + torch.nn.functional.logsigmoid(carrying)


def fit_supports(
    toes: Float[Tensor, "frames 2 3"], planted: Bool[Tensor, "frames 2"], noise: Float[Tensor, "frames 2"] | None = None
) -> Float[Tensor, "frames 2"]:
    """Fit the height at which each toe rests in each frame, metres, on levels and slopes that the contacts show.

    `noise` is the standard deviation of the error of the toes' heights, metres. The height of a contact is the median
    of its toe's, pooled with contacts of either foot on the same level by a redescending local plane fit from its own
    height (Welsch's weights, Holland and Welsch 1977). A toe that is not planted has below it the lowest
    of the supports before and after, and of that fitted to its own lowest point: it may hang below both.
    """
    points, counted, spans, variances = [], [], [], []
    for mask in (planted, ~planted):
        for foot, start, stop in true_intervals(mask):
            own = toes[start:stop, foot]
            points.append(own.median(dim=0).values if mask is planted else own[own[:, 1].argmin()])
            variances.append(0.0 if noise is None else float(noise[start:stop, foot].square().mean()))
            counted.append(mask is planted)
            spans.append((foot, start, stop))
    heights = _fit_local_planes(torch.stack(points), toes.new_tensor(variances) + _LEVEL**2, torch.tensor(counted))
    supports = torch.empty_like(toes[..., 1])
    for (foot, start, stop), height in zip(spans, heights, strict=True):
        supports[start:stop, foot] = height
    around = [supports.gather(0, nearest(planted.T).T) for nearest in (last_observed, next_observed)]
    return torch.where(planted, supports, torch.stack([supports, *around]).amin(dim=0))


def _fit_local_planes(
    points: Float[Tensor, "intervals 3"], variances: Float[Tensor, " intervals"], counted: Bool[Tensor, " intervals"]
) -> Float[Tensor, " intervals"]:
    """Fit a plane around each point to those that count and itself, and return its height there."""
    heights, ridge = [], torch.diag(points.new_tensor([0.0, _GRADIENT**-2, _GRADIENT**-2]))
    for rows in torch.arange(len(points)).split(_ROWS):
        axes = torch.nn.functional.pad((points[None] - points[rows, None])[..., ::2], (1, 0), value=1.0)
        base = (counted | (rows[:, None] == torch.arange(len(points)))) / variances
        plane = torch.stack([points[rows, 1], *torch.zeros(2, len(rows)).to(points)], dim=-1)
        for _ in range(_ITERATIONS):
            away = (points[:, 1] - (axes @ plane[..., None])[..., 0]).square()
            weighted = (base * torch.exp(-0.5 * away / (variances + variances[rows, None])))[..., None] * axes
            plane = torch.linalg.solve(weighted.mT @ axes + ridge, weighted.mT @ points[:, 1])
        heights.append(plane[:, 0])
    return torch.cat(heights)
