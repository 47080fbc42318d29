"""Contact detection: when a toe is planted.

Heel contacts, derived from those of the toes and the poses.

A heel stands where its toe is planted and the foot is flat, and for a moment between its strike and the toe's.
Detection on heels finds hardly more, so features hold the contacts of toes alone.

Local phases: how far each toe is in its own step, by when it is planted (Starke et al. 2020).

Starke et al. fit a sinusoid to the filtered contacts of each bone around each frame. Here their analytic signal is
computed: contacts are smoothed, standardised among the frames around, and turned into amplitude and phase by a Hilbert
transform. Their five bones are the two toes here, of which alone features hold contacts.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.numerics.intervals import last_observed, next_observed, true_intervals

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
    """Remove runs of true shorter than `shortest` frames."""
    return torch.from_numpy(scipy.ndimage.binary_opening(mask.numpy(), np.ones((shortest, 1))))


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


_HEEL_REACH = 0.02  # metres over its rest height beside the toe within which a planted heel is
_STRIKE_SECONDS = 1 / 30  # longest time before a toe's contact in which its heel may be planted already
_HEEL_SLOW = 0.35  # m/s over the ground since the frame before, below which a heel that has struck is, as toes are


def derive_heel_contacts(
    toe_contacts: Bool[Tensor, "*batch frames 2"],
    toes: Float[Tensor, "*batch frames 2 3"],
    heels: Float[Tensor, "*batch frames 2 3"],
    drops: Float[Tensor, "2"],
    fps: float,
) -> Bool[Tensor, "*batch frames 2"]:
    """Derive whether the left and the right heel are planted; world positions in metres, `drops` from
    `find_heel_drops`.

    The floor is that of the toe: a planted toe joint is at its rest height, and the heel's is `drops` below. In the
    frames before a toe's contact the floor is the one on which that contact begins.
    """
    planted = toe_contacts & (heels[..., 1] - toes[..., 1] + drops < _HEEL_REACH)
    floors, ahead = toes[..., 1], toe_contacts
    moved = torch.diff(heels[..., ::2], dim=-3).norm(dim=-1)
    slow = torch.cat([torch.zeros_like(planted[..., :1, :]), moved * fps < _HEEL_SLOW], dim=-2)
    for _ in range(max(1, round(_STRIKE_SECONDS * fps))):
        floors, ahead = torch.where(ahead, floors, _next_frames(floors)), ahead | _next_frames(ahead)
        low = heels[..., 1] - floors + drops < _HEEL_REACH
        planted = planted | (ahead & low & slow & _next_frames(planted))
    return planted


def _next_frames(values: Tensor) -> Tensor:
    """Return the next frame's values; the last frame's own at the end."""
    return torch.cat([values[..., 1:, :], values[..., -1:, :]], dim=-2)


SMOOTHING = 3.0
"""Standard deviation of the Gaussian over contacts, frames at the prior's rate."""
REACH = 30
"""Contacts are standardised among so many frames before and after, a second at the prior's rate."""
_LEAST_SPREAD = 0.1  # of smoothed contacts: a step within REACH has more, and below it the amplitude fades
_NO_SPREAD = 1e-6  # what rounding leaves where nothing changes


def compute_phases(planted: Bool[Tensor, "frames 2"] | Float[Tensor, "frames 2"]) -> Float[Tensor, "frames 4"]:
    """Compute amplitude times cosine and sine of the left toe's phase, then of the right toe's (float64, no unit).

    `planted` is a clip's contacts, left and right, 0 to 1, at the prior's 30 frames a second. The phase is 0 amid the
    stance, 180 degrees amid the swing, and grows by 360 degrees from step to step, though not evenly: by up to 20
    degrees it runs ahead of and behind the share of the period. The amplitude, 1 to 2 in a steady gait, is 0 where
    neither the frame nor REACH frames on either side see the toe put down or lifted, and fades towards there. Beyond
    its ends a clip is taken to swing back, which leaves the phases of its outermost five frames uncertain by some 30
    degrees and more; so compute them of whole clips and cut windows afterwards. RequestError for no frames, and for
    contacts that are not finite.
    """
    values = planted.detach().cpu().double().numpy()
    if len(values) == 0 or not np.isfinite(values).all():
        raise RequestError("phases need at least one frame of finite contacts")
    smooth = scipy.ndimage.gaussian_filter1d(values, SMOOTHING, axis=0, mode="nearest")
    mean = _average_around(smooth)
    variance = _average_around(np.square(smooth)) - np.square(mean)
    spread = np.sqrt(np.where(variance > _NO_SPREAD**2, variance, 0))
    standard = (smooth - mean) / np.maximum(spread, _LEAST_SPREAD)
    around = np.pad(standard, ((REACH, REACH), (0, 0)), mode="reflect")
    whole: Any = scipy.signal.hilbert(around, axis=0)
    analytic = whole[REACH:-REACH] * np.minimum(spread / _LEAST_SPREAD, 1)
    return torch.from_numpy(np.stack([analytic.real, analytic.imag], axis=-1)).flatten(1)


def mirror_phases(phases: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the phases of motion mirrored left to right, as `mirror_features` mirrors it: the toes change places."""
    return phases.unflatten(-1, (2, 2)).flip(-2).flatten(-2)


def reversed_phases(phases: Float[Tensor, "*batch frames 4"]) -> Float[Tensor, "*batch frames 4"]:
    """Return the phases of motion run backwards, frame by frame beside `reversed_features`: phases run the other way,
    each is that of the frame after, as contacts are, and the first frame repeats the second's."""
    back = phases.flip(-2) * phases.new_tensor([1.0, -1.0, 1.0, -1.0])
    return torch.cat([back[..., :1, :], back[..., :-1, :]], dim=-2)


def _average_around(values: Float[ndarray, "frames 2"]) -> Float[ndarray, "frames 2"]:
    """Average over the frames that there are up to REACH before and after each."""
    count = scipy.ndimage.uniform_filter1d(np.ones(len(values)), 2 * REACH + 1, mode="constant")
    return scipy.ndimage.uniform_filter1d(values, 2 * REACH + 1, axis=0, mode="constant") / count[:, None]


REST_SPEED, _SWING_SPEED = 0.07, 1.7
"""Standard deviation of the velocity of planted toes and of others along an axis, m/s: held-out walks, runs and
gestures of the training sets."""
_LEAN = 0.26
"""Standard deviation, radians, of the angle between the vertical and the line from a planted toe to the hips: the same
clips."""
TOE_LEVEL = 0.02
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
    rest, swing = (speed_noise.square() + speed**2 for speed in (REST_SPEED, _SWING_SPEED))
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
    heights = _fit_local_planes(torch.stack(points), toes.new_tensor(variances) + TOE_LEVEL**2, torch.tensor(counted))
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
