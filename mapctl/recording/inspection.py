"""Inspection of a recording: joints that leap, are held or are exchanged, and the noise of the rest.

Spikes: single frames, or two in a row, that the frames around them do not explain. A local polynomial that leaves a
frame out predicts it; how well it fits the neighbours scales the error (externally studentised residuals, Cook and
Weisberg 1982, section 2.2.1). The scale of one window has few degrees of freedom, so it is shrunk to that of the whole
track as far as windows differ no more than by chance (Smyth 2004, section 4). At the ends of a track and beside frames
that are left out the leverage of the prediction is larger, and its likelihood wider.

Held values: a joint, or the whole body, that keeps its value or is replaced by zeros while the motion goes on. What
rests comes to rest and leaves it again; what was held or replaced does not.

Exchanged limbs: runs of frames in which left and right are exchanged, as by a tracker that mistakes its labels. A run
is exchanged back where the frames beside it predict the exchanged rotations better, by the Bayes factor of all joints
of both limbs together, with an outlier component (Kass and Raftery 1995).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed, true_intervals
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks
from mapctl.recording.noise_estimation import (
    RESOLUTION,
    choose_continuous_signs,
    estimate_angle_noise,
    estimate_position_noise,
)
from mapctl.retarget import RigMap

# Neighbours on either side and degree. Narrow windows follow quick motion, wide ones average noise; of these the one
# that predicts a track best by its likelihood is used (Geisser 1975).
_MODELS = ((2, 1), (3, 3), (4, 3), (6, 3), (6, 2))
_AXES = 3  # degrees of freedom of a rotation and of a position
_LEAST_SPREAD = 1e-3  # variance of the logarithm of windows' scales, below which all have one: 2,000 degrees of freedom


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions of every frame from its neighbours."""

    mean: Float[Tensor, "frames tracks width"]
    """Predicted values."""
    error: Float[Tensor, "frames tracks"]
    """Distance of the value from the prediction."""
    spread: Float[Tensor, "frames tracks"]
    """Standard deviation of each coordinate about a polynomial, from the neighbours."""
    scale: Float[Tensor, "frames tracks"]
    """Standard error of each coordinate of the prediction: spread and leverage together."""
    freedom: Float[Tensor, "frames tracks"]
    """Degrees of freedom of the scale; 0 where too few neighbours are seen."""

    def log_density(self) -> Float[Tensor, "frames tracks"]:
        """Return the logarithm of the density of each error, Student's t of three coordinates; 0 where unknown."""
        freedom = self.freedom.clamp_min(1e-3)
        square = self.scale.square()
        density = torch.lgamma((freedom + _AXES) / 2) - torch.lgamma(freedom / 2)
        density = density - _AXES / 2 * (math.pi * freedom * square).log()
        density = density - (freedom + _AXES) / 2 * torch.log1p(self.error.square() / (freedom * square))
        return torch.where(self.freedom > 0, density, 0.0)


def predict_frames(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    models: Sequence[tuple[int, int]] = _MODELS,
) -> Prediction:
    """Predict each frame of each track from those of its neighbours that are seen; `least` is the smallest scale that
    a track can have, its resolution."""
    found = [_predict(values, seen, least, side, degree) for side, degree in models]
    scores = torch.stack([_score(prediction, seen) for prediction in found])
    ranks = scores.argsort(dim=0)  # the best comes last, and overrides the others where it has enough neighbours
    best = found[0]
    for rank in ranks:
        for model, prediction in enumerate(found):
            chosen = (rank == model) & (prediction.freedom > 0)
            if chosen.any():
                best = Prediction(
                    torch.where(chosen[..., None], prediction.mean, best.mean),
                    torch.where(chosen, prediction.error, best.error),
                    torch.where(chosen, prediction.spread, best.spread),
                    torch.where(chosen, prediction.scale, best.scale),
                    torch.where(chosen, prediction.freedom, best.freedom),
                )
    return best


def _score(prediction: Prediction, seen: Bool[Tensor, "frames tracks"]) -> Float[Tensor, " tracks"]:
    """Return the mean logarithm of the density of the frames that are seen."""
    counted = seen & (prediction.freedom > 0)
    total = torch.where(counted, prediction.log_density(), 0.0).sum(dim=0)
    return torch.where(counted.any(dim=0), total / counted.sum(dim=0).clamp_min(1), -math.inf)


def _predict(
    values: Float[Tensor, "frames tracks width"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    side: int,
    degree: int,
) -> Prediction:
    """Predict by polynomials of one degree over so many neighbours on either side."""
    lags = torch.arange(-side, side + 1, dtype=values.dtype) / side
    powers = lags ** torch.arange(2 * degree + 1)[:, None]
    powers[:, side] = 0  # the frame itself is left out
    centre, known = values.mean(dim=0), seen.to(values)
    values = values - centre
    moments = _sum_over_lags(known, powers)
    shown = values * known[..., None]
    sums = torch.stack([_sum_over_lags(shown[..., axis], powers[: degree + 1]) for axis in range(shown.shape[-1])], -1)
    squares = _sum_over_lags(shown.square().sum(dim=-1), powers[:1])[..., 0]
    inverse = _invert(moments, degree)
    mean = torch.einsum("ftp,ftpw->ftw", inverse[..., 0, :], sums)
    residual = (squares - torch.einsum("ftpw,ftpq,ftqw->ft", sums, inverse, sums)).clamp_min(0)
    freedom = _AXES * (moments[..., 0].round() - (degree + 1)).clamp_min(0)
    shrunk, shared = _shrink_scale(residual, freedom, seen, least.square())
    total = torch.where(freedom > 0, freedom + shared, 0.0)
    # A moment of rest is no reason to expect none of the motion that the track has otherwise.
    usual = torch.where(seen & (total > 0), shrunk, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    scale = (torch.maximum(shrunk, usual) * (1 + inverse[..., 0, 0].clamp_min(0))).sqrt()
    return Prediction(mean + centre, (values - mean).norm(dim=-1), shrunk.sqrt(), scale, total)


def _sum_over_lags(
    values: Float[Tensor, "frames tracks"], weights: Float[Tensor, "sums lags"]
) -> Float[Tensor, "frames tracks sums"]:
    """Sum neighbours with weights by lag; beyond the ends there is nothing."""
    side = weights.shape[1] // 2
    return torch.nn.functional.conv1d(values.T[:, None], weights[:, None], padding=side).permute(2, 0, 1)


def _invert(moments: Float[Tensor, "frames tracks sums"], degree: int) -> Float[Tensor, "frames tracks terms terms"]:
    """Invert the normal equations of polynomials; windows of which all frames are seen have one inverse."""
    order = torch.arange(degree + 1)
    normal = moments[..., order[:, None] + order]
    ridge = 1e-9 * torch.eye(degree + 1, dtype=moments.dtype)
    full = moments[..., 0] > moments[..., 0].amax() - 0.5
    inverse = torch.linalg.inv(normal[full][0] + ridge).expand_as(normal).clone()
    inverse[~full] = torch.linalg.inv(normal[~full] + ridge)
    return inverse


def _shrink_scale(
    residual: Float[Tensor, "frames tracks"],
    freedom: Float[Tensor, "frames tracks"],
    seen: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
) -> tuple[Float[Tensor, "frames tracks"], Float[Tensor, " tracks"]]:
    """Return the windows' mean squares, shrunk to their track's (Smyth 2004, section 6.2: the moments of their
    logarithms), and the degrees of freedom of that."""
    counted, half = seen & (freedom > 0), freedom.clamp_min(1) / 2
    square = torch.maximum(residual / freedom.clamp_min(1), least)
    logarithm = square.log() - torch.digamma(half) + half.log()
    count = counted.sum(dim=0).clamp_min(1)
    mean = torch.where(counted, logarithm, 0.0).sum(dim=0) / count
    spread = torch.where(counted, (logarithm - mean).square(), 0.0).sum(dim=0) / (count - 1).clamp_min(1)
    spread -= torch.where(counted, torch.special.polygamma(1, half), 0.0).sum(dim=0) / count
    shared = _invert_trigamma(spread.clamp_min(_LEAST_SPREAD))
    usual = (mean + torch.digamma(shared) - shared.log()).exp()
    shrunk = (2 * shared * usual + residual) / (2 * shared + freedom)
    return torch.maximum(shrunk, least), 2 * shared


def _invert_trigamma(value: Tensor) -> Tensor:
    """Return x with trigamma(x) = value, by Newton's method (Smyth 2004, appendix)."""
    x = 0.5 + 1 / value
    for _ in range(10):
        trigamma = torch.special.polygamma(1, x)
        x = x + trigamma * (1 - trigamma / value) / torch.special.polygamma(2, x)
    return x


_MEDIAN_FRAMES = 5  # frames of the running median: bursts of up to two are detected
_CANDIDATE_RATIO, _CANDIDATE_FRAMES = 3.0, 13  # distance from the median, by its median over so many frames
SHARE = 0.01
"""Share of a track's frames expected to spike."""
ROTATIONS = 4 / 3 * math.pi * math.pi**3
"""Volume of all rotation vectors, among which a false rotation may be any."""
BODY = 4 / 3 * math.pi * 2.0**3
"""Volume about a body, cubic metres, within which its false position lies."""
_FIT_ROUNDS = 5


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
    for _ in range(_FIT_ROUNDS):
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


_QUIET = 0.01  # chance of a window that is as quiet as those beside a rest
_WHITE = 100.0  # degrees of freedom from which the windows of a track have one scale: noise, which never rests


@dataclass(frozen=True)
class _Run:
    """Frames `start` to `stop`, in which some tracks have one value."""

    start: int
    stop: int
    tracks: slice


def find_held_frames(
    values: Float[Tensor, "frames tracks width"],
    ignored: Bool[Tensor, "frames tracks"],
    zero: Bool[Tensor, " frames"],
    least: float,
    volumes: Float[Tensor, " tracks"],
) -> tuple[Bool[Tensor, "frames tracks"], Bool[Tensor, " frames"]]:
    """Find the frames in which a track is held or replaced, and those in which all are.

    `ignored` are frames that are known to be false, `zero` those that hold nothing but zeros; `least` is the finest
    resolution, `volumes` those in which a false value may be anywhere. What all tracks hold to the end is a rest.
    """
    held = torch.zeros(values.shape[:2], dtype=torch.bool)
    equal = torch.zeros_like(held)
    equal[1:] = (values[1:] == values[:-1]).all(dim=-1)
    moving = ((values - values[0]).norm(dim=-1) > least).any(dim=0).nonzero()[:, 0]
    frozen = torch.zeros(len(values), dtype=torch.bool)
    if len(moving) == 0:
        return held, frozen
    values, ignored, volumes = values[:, moving], ignored[:, moving], volumes[moving]
    steps = torch.diff(values, dim=0).norm(dim=-1)
    finest = torch.where(steps > 0, steps, math.inf).amin(dim=0).clamp_min(least)
    whole = equal[:, moving].all(dim=1)
    runs = [_Run(start - 1, stop, slice(None)) for _, start, stop in true_intervals(whole[:, None])]
    alone = zero & ~whole & ~torch.roll(whole, -1)
    runs += [_Run(start, stop, slice(None)) for _, start, stop in true_intervals(alone[:, None])]
    inner = [run for run in runs if run.start > 0 and run.stop < len(values)]
    for run in _find_faults(inner, values, ignored, finest, volumes):
        frozen[run.start : run.stop] = True
    own = equal[:, moving] & ~whole[:, None]
    runs = [_Run(start - 1, stop, slice(track, track + 1)) for track, start, stop in true_intervals(own)]
    for run in _find_faults(runs, values, ignored | frozen[:, None], finest, volumes):
        held[run.start : run.stop, moving[run.tracks]] = True
    return held, frozen


def _find_faults(
    runs: Sequence[_Run],
    values: Float[Tensor, "frames tracks width"],
    ignored: Bool[Tensor, "frames tracks"],
    least: Float[Tensor, " tracks"],
    volumes: Float[Tensor, " tracks"],
) -> list[_Run]:
    """Return the frames of the runs that are no motion, without their first where it still is."""
    if not runs:
        return []
    equal = torch.zeros_like(ignored)
    for run in runs:
        equal[run.start + 1 : run.stop, run.tracks] = True
    seen = ~(ignored | equal)
    free = seen.clone()
    for run in runs:
        free[run.start, run.tracks] = False
    ahead, behind = _measure_leaps(values), _measure_leaps(values.flip(0)).flip(0)
    usual = torch.where(free[2:] & free[1:-1] & free[:-2], ahead[2:], 0.0).amax(dim=0)
    density = predict_frames(values, seen, least).log_density() + volumes.log()
    replaced = [_is_replaced(run, density, ahead > usual) for run in runs]
    for run, wrong in zip(runs, replaced, strict=True):
        seen[run.start, run.tracks] &= not wrong
    prediction = predict_frames(values, seen, least)
    judge = _Judge(values, prediction, equal, least, (ahead > usual, behind > usual))
    faults = []
    for run, wrong in zip(runs, replaced, strict=True):
        if wrong or (run.stop - run.start > 1 and judge.is_held(run)):
            faults.append(run if wrong else _Run(run.start + 1, run.stop, run.tracks))
    return faults


def _measure_leaps(values: Float[Tensor, "frames tracks width"]) -> Float[Tensor, "frames tracks"]:
    """Return how far each frame lies from the line through the two before it."""
    leaps = values.new_zeros(values.shape[:2])
    leaps[2:] = torch.diff(values, n=2, dim=0).norm(dim=-1)
    return leaps


def _is_replaced(run: _Run, density: Tensor, leaps: Bool[Tensor, "frames tracks"]) -> bool:
    """Return whether the first value of a run is already false: likelier anywhere than where the motion leads, and
    further from that than any other frame."""
    return bool(((density[run.start] < -math.log(len(density))) & leaps[run.start])[run.tracks].any())


@dataclass(frozen=True, eq=False)
class _Judge:
    """Judge of runs by what their neighbours predict."""

    values: Float[Tensor, "frames tracks width"]
    prediction: Prediction
    equal: Bool[Tensor, "frames tracks"]
    least: Float[Tensor, " tracks"]
    """Smallest step of each track."""
    leaps: tuple[Bool[Tensor, "frames tracks"], Bool[Tensor, "frames tracks"]]
    """Whether a frame lies further from the line through the two before it, and after it, than any that is seen."""

    def is_held(self, run: _Run) -> bool:
        """Return whether the motion is likelier to have gone on unseen than to have rested."""
        return self._lags(run) or self._is_noisy(run)

    def _lags(self, run: _Run) -> bool:
        """Return whether the motion goes on elsewhere: the last value lags behind it, by a step to the next. Where no
        frame is known after the run its beginning counts."""
        tracks, leaps, last, other = run.tracks, self.leaps[1], run.stop - 1, run.stop
        if run.stop == len(self.values) or not bool((self.prediction.freedom[last, tracks] > 0).any()):
            leaps, last, other = self.leaps[0], run.start + 1, run.start - 1
        if other < 0:
            return False
        step = (self.values[other, tracks] - self.values[last, tracks]).norm(dim=-1)
        scale, error = self.prediction.scale[last, tracks], self.prediction.error[last, tracks]
        square = scale.square() + step.square() / 3
        lagging = -1.5 * (2 * math.pi * square).log() - error.square() / (2 * square)
        known = self.prediction.freedom[last, tracks] > 0
        evidence = torch.where(known, lagging - self.density[last, tracks], 0.0)
        return float(evidence.sum()) > math.log(len(self.values)) and bool(leaps[last, tracks].any())

    def _is_noisy(self, run: _Run) -> bool:
        """Return whether most tracks are noise, beside the run as ever."""
        beside = [frame for frame in (run.start, run.stop) if 0 < frame < len(self.values)]
        length, freedom = run.stop - run.start - 1, self.prediction.freedom[beside][:, run.tracks]
        loud = self.loud[beside][:, run.tracks] & (freedom > _WHITE)
        # Frames of noise are equal by chance if all three numbers are within the resolution.
        ratio = self.prediction.spread[beside][:, run.tracks].amin(dim=0) / self.least[run.tracks]
        chance = 3 * length * float(torch.where(loud.all(dim=0), ratio.log(), 0.0).sum())
        return float(loud.all(dim=0).double().mean()) > 0.5 and chance > math.log(len(self.values))

    @cached_property
    def density(self) -> Float[Tensor, "frames tracks"]:
        """Logarithm of the density of each frame where the motion leads."""
        return self.prediction.log_density()

    @cached_property
    def loud(self) -> Bool[Tensor, "frames tracks"]:
        """Whether the frames about each are no more quiet than chance has them."""
        spread, freedom = self.prediction.spread, self.prediction.freedom
        usual = torch.where((freedom > 0) & ~self.equal, spread, math.nan).nanmedian(dim=0).values
        # Quantile of chi-squared by its cube root (Wilson and Hilferty 1931).
        part = 2 / (9 * freedom.clamp_min(1))
        least = (1 - part + scipy.stats.norm.ppf(_QUIET) * part.sqrt()).clamp_min(0) ** 3
        return (freedom > 0) & (spread.square() > least * usual.square())


NOISE_DEG, NOISE_CM = 0.5, 0.2
"""Least noise that is listed, degrees and centimetres: optical capture has as much."""
_SKATE_SPEED = 0.2  # m/s that a planted toe moves by, over some frames, before it is said to slide
_FLOAT_HEIGHT = 0.03  # metres that it is above its support
_MIN_FRAMES = 3  # frames of either


@dataclass(frozen=True)
class Artefact:
    """One artefact of a recording."""

    joint: str
    """Name of the joint on the recording's rig."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last frame."""
    kind: str
    """noise, spike, dropout, frozen, slide, float, swap: left and right limb exchanged, or stretch: an offset of a bone
    that varies only by noise."""
    amount: float
    """Noise's sigma, height of a spike or of a floating toe, distance of a slide, largest error of an offset, largest
    turn of a swap; 0 for a dropout and frozen frames."""
    unit: str
    """Unit of the amount."""


def list_noise(
    names: Sequence[str], angles: Float[Tensor, " joints"], root: float, *, travels: int, frames: int
) -> list[Artefact]:
    """List joints whose angles are noisy (radians), and the position of the travelling joint (metres)."""
    degrees = torch.rad2deg(angles).tolist()
    found = [
        Artefact(name, 0, frames, "noise", amount, "deg")
        for name, amount in zip(names, degrees, strict=True)
        if amount >= NOISE_DEG
    ]
    if 100 * root >= NOISE_CM:
        found.append(Artefact(names[travels], 0, frames, "noise", 100 * root, "cm"))
    return found


def list_spikes(
    names: Sequence[str], spikes: Bool[Tensor, "frames joints"], away: Float[Tensor, "frames joints"], unit: str
) -> list[Artefact]:
    """List spikes, and how far each is from what replaced it."""
    return [
        Artefact(names[joint], start, stop, "spike", float(away[start:stop, joint].max()), unit)
        for joint, start, stop in true_intervals(spikes)
    ]


def list_dropouts(names: Sequence[str], dropouts: Bool[Tensor, "frames joints"]) -> list[Artefact]:
    """List where joints were not observed."""
    return [Artefact(names[joint], start, stop, "dropout", 0.0, "") for joint, start, stop in true_intervals(dropouts)]


def list_foot_artefacts(
    names: Sequence[str],
    toes: Float[Tensor, "frames 2 3"],
    planted: Bool[Tensor, "frames 2"],
    *,
    rest_height: Float[Tensor, "frames 2"],
    fps: float,
) -> list[Artefact]:
    """List planted toes that slide, and planted toes over the height that they rest at; world positions, metres, at any
    rate."""
    steps = torch.diff(toes[..., ::2], dim=0, prepend=toes[:1, :, ::2]).norm(dim=-1)
    slides = planted & (steps * fps > _SKATE_SPEED)
    height = toes[..., 1] - rest_height
    floats = planted & (height > _FLOAT_HEIGHT)
    found = [
        Artefact(names[foot], start, stop, "slide", 100 * float(steps[start:stop, foot].sum()), "cm")
        for foot, start, stop in true_intervals(slides)
        if stop - start >= _MIN_FRAMES
    ]
    return found + [
        Artefact(names[foot], start, stop, "float", 100 * float(height[start:stop, foot].max()), "cm")
        for foot, start, stop in true_intervals(floats)
        if stop - start >= _MIN_FRAMES
    ]


_LOCKED_CHANGE = 1e-6  # of a quaternion, that rounding leaves of a joint which never moves


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording on its own rig, with masks of its artefacts."""

    motion: Motion
    """The recording, unchanged."""
    spikes: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation is a spike."""
    dropouts: Bool[Tensor, "frames joints"]
    """Whether a joint is masked, or stands perfectly still though it moves otherwise."""
    spikes_root: Bool[Tensor, " frames"]
    """Whether the root's position is a spike."""
    dropouts_root: Bool[Tensor, " frames"]
    """Whether the root's position is masked."""
    noise: Float[Tensor, " joints"]
    """Noise sigma of each of a joint's three angles, radians."""
    noise_root: float
    """Noise sigma of each coordinate of the root, metres."""
    travels: int
    """Index of the joint that travels: the root, or the one below it that is moved instead."""
    frozen: Bool[Tensor, " frames"]
    """Whether the whole body is held, or zero, while it moves; all joints are dropouts there."""
    faults: tuple[Artefact, ...] = ()
    """Faults of the whole body, with their kinds."""

    @property
    def seen(self) -> Bool[Tensor, "frames joints"]:
        """Observation mask of rotations: neither spike nor missing."""
        return ~(self.spikes | self.dropouts)

    @cached_property
    def locked(self) -> Bool[Tensor, " joints"]:
        """Whether a joint's rotation is the same wherever it is observed: it is known where it is not, too."""
        quats = self.motion.local_quat_xyzw
        held = _hold_last_observed(quats, self.seen)
        still = (quats - held[:1]).norm(dim=-1) < _LOCKED_CHANGE
        return (still | ~self.seen).all(dim=0) & self.seen.any(dim=0)

    @property
    def known(self) -> Bool[Tensor, "frames joints"]:
        """Mask of rotations that are observed, or need not be, since the joint is locked."""
        return self.seen | self.locked

    @property
    def lost(self) -> Bool[Tensor, "frames joints"]:
        """Mask of rotations that are missing, of joints that move."""
        return self.dropouts & ~self.locked

    @property
    def seen_root(self) -> Bool[Tensor, " frames"]:
        """Observation mask of the root's position: neither spike nor missing."""
        return ~(self.spikes_root | self.dropouts_root)

    def place(self, motion: Motion) -> Float[Tensor, "frames 3"]:
        """Return the position of the travelling joint in a motion of this rig, metres."""
        return motion.moving_offsets[self.travels] if self.travels else motion.root_position

    def slice(self, start: int, stop: int) -> "Inspection":
        """Return frames start to stop; the noise stays that of the whole."""
        part = slice(start, stop)
        return replace(
            self,
            motion=self.motion.slice(start, stop),
            spikes=self.spikes[part],
            dropouts=self.dropouts[part],
            spikes_root=self.spikes_root[part],
            dropouts_root=self.dropouts_root[part],
            frozen=self.frozen[part],
        )

    def repaired(self) -> Motion:
        """Return the recording with artefacts filled in, interpolated from the frames around them."""
        motion, seen = self.motion, self.seen
        quats = choose_continuous_signs(_hold_last_observed(motion.local_quat_xyzw, seen))
        steps = fill_missing(quats.transpose(0, 1), seen.T).transpose(0, 1)
        root = fill_missing(motion.root_position[None], self.seen_root[None])[0]
        moving = {
            joint: fill_missing(values[None], self.seen_root[None])[0] if joint == self.travels else values
            for joint, values in motion.moving_offsets.items()
        }
        return replace(
            motion,
            root_position=root,
            moving_offsets=moving,
            local_quat_xyzw=torch.nn.functional.normalize(steps, dim=-1),
        )


def inspect_recording(motion: Motion, masks: Sequence[Mask] = ()) -> Inspection:
    """Look over a recording on any rig; RequestError for masks that name joints or frames it has not."""
    quats = choose_continuous_signs(motion.local_quat_xyzw)
    hidden, hidden_root = expand_valid_masks(motion, masks)
    travels = motion.travelling_joint
    place = motion.moving_offsets[travels] if travels else motion.root_position
    spikes, spikes_root = find_angle_spikes(quats, ~hidden), find_position_spikes(place, ~hidden_root)
    held, frozen = _find_held_frames(quats, place, hidden | spikes, hidden_root | spikes_root)
    dropouts, dropouts_root = hidden | held[:, :-1] | frozen[:, None], hidden_root | frozen
    # What is found to be false explains no other frame.
    spikes, spikes_root = find_angle_spikes(quats, ~dropouts), find_position_spikes(place, ~dropouts_root)
    # Each spike corrupts the differences of the frames around it.
    noise = estimate_angle_noise(quats, ~(dropouts | spikes))
    noise_root = estimate_position_noise(place, ~(dropouts_root | spikes_root))
    faults = tuple(Artefact(ALL, start, stop, "frozen", 0.0, "") for _, start, stop in true_intervals(frozen[:, None]))
    return Inspection(motion, spikes, dropouts, spikes_root, dropouts_root, noise, noise_root, travels, frozen, faults)


def _find_held_frames(
    quats: Float[Tensor, "frames joints 4"],
    place: Float[Tensor, "frames 3"],
    hidden: Bool[Tensor, "frames joints"],
    hidden_root: Bool[Tensor, " frames"],
) -> tuple[Bool[Tensor, "frames tracks"], Bool[Tensor, " frames"]]:
    """Find held and zero frames of the joints, and of the position as the last track."""
    position = torch.nn.functional.pad(place, (0, 1))[:, None]
    values = torch.cat([2 * quats, position], dim=1)
    volumes = quats.new_tensor([ROTATIONS] * quats.shape[1] + [BODY])
    moving = (quats != quats[:1]).any(dim=-1).any(dim=0)
    zero = (quats[:, moving, :3] == 0).all(dim=-1).all(dim=-1) & moving.any()
    return find_held_frames(values, torch.cat([hidden, hidden_root[:, None]], dim=1), zero, RESOLUTION, volumes)


def _hold_last_observed(quats: Tensor, seen: Tensor) -> Tensor:
    """Hold the last observed rotation where nothing is observed: signs are then chosen between frames that count."""
    nearest = last_observed(seen.T).T
    return torch.take_along_dim(quats, nearest[..., None], dim=0)


def find_gaps(motion: Motion) -> tuple[Mask, ...]:
    """Find the gaps of a motion that no mask gives; RequestError if there are none."""
    examined = inspect_recording(motion)
    frozen, names = examined.frozen, motion.skeleton.names
    masks = [Mask(ALL, start, stop) for _, start, stop in true_intervals(frozen[:, None])]
    wrong = ~examined.seen & ~frozen[:, None]
    masks += [Mask(names[joint], start, stop) for joint, start, stop in true_intervals(wrong)]
    lost = ~examined.seen_root & ~frozen
    masks += [Mask(ROOT, start, stop) for _, start, stop in true_intervals(lost[:, None])]
    if not masks:
        raise RequestError(
            "no frame is frozen and none leaps: say which frames are missing (--gap A:B) or which joints"
        )
    return tuple(masks)


_MOST_FRAMES = 4  # of a run: what differs for longer may be a turn of the body
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LIMBS = ((("UpperLeg", "LowerLeg", "Foot", "Toes"),), (_ARM, _ARM[1:]))  # a tracker may know no shoulders
_OUTLIER = math.log(SHARE / ROTATIONS)
_ROUNDS = 2


def exchange_swapped_limbs(
    motion: Motion, rigmap: RigMap, hidden: Bool[Tensor, "frames joints"]
) -> tuple[Motion, tuple[Artefact, ...]]:
    """Return the motion with limbs exchanged back where left and right were swapped, and these frames as faults.

    Rotations are exchanged as those from the T-pose, or as they are in the file, whichever is likelier.
    """
    quats, faults = motion.local_quat_xyzw.clone(), []
    rests = (rigmap.rest_quat_xyzw.to(quats), quats.new_tensor([0, 0, 0, 1]).expand(quats.shape[1], 4))
    for limb in _LIMBS:
        found = []
        for joints, partners in _list_pairs(rigmap, limb):
            for rest in rests:
                exchanged = _exchange(motion, rest, joints, partners)
                runs = _find_swaps(motion.local_quat_xyzw[:, joints], exchanged, ~hidden[:, joints])
                found += [(gain, start, stop, joints, exchanged) for gain, start, stop in runs]
        free = torch.ones(motion.num_frames, dtype=torch.bool)
        for _, start, stop, joints, exchanged in sorted(found, key=lambda run: -run[0]):
            if free[start:stop].all():
                free[start:stop] = False
                turn = rotations.multiply(rotations.inverse(quats[start:stop, joints]), exchanged[start:stop])
                degrees = math.degrees(float(rotations.to_rotation_vector(turn).norm(dim=-1).max()))
                quats[start:stop, joints] = exchanged[start:stop]
                faults.append(Artefact(motion.skeleton.names[joints[0]], start, stop, "swap", degrees, "deg"))
    return (replace(motion, local_quat_xyzw=quats) if faults else motion), tuple(faults)


def _list_pairs(rigmap: RigMap, limb: Sequence[Sequence[str]]) -> Iterator[tuple[list[int], list[int]]]:
    """List a limb's joints on the rig, left and right, and the partner of each."""
    rigged = rigmap.joints
    for parts in limb:
        pairs = [(rigged.get(f"left{part}"), rigged.get(f"right{part}")) for part in parts]
        known = [(left, right) for left, right in pairs if left is not None and right is not None]
        if known:
            left, right = (list(side) for side in zip(*known, strict=True))
            yield left + right, right + left


def _exchange(
    motion: Motion, rest: Float[Tensor, "joints 4"], joints: list[int], partners: list[int]
) -> Float[Tensor, "frames limb 4"]:
    """Return the partners' rotations from the rest pose, in the joints' own frames: with rest R, a parent's P, a
    partner's rotation q' is P^-1 P' q' R'^-1 R."""
    parents = torch.tensor(motion.skeleton.parents)
    quats = motion.local_quat_xyzw[:, partners]
    before = rotations.multiply(rotations.inverse(rest[parents[joints]]), rest[parents[partners]])
    after = rotations.multiply(rotations.inverse(rest[partners]), rest[joints])
    return rotations.multiply(rotations.multiply(before.expand_as(quats), quats), after.expand_as(quats))


def _find_swaps(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
) -> list[tuple[float, int, int]]:
    """Find runs of frames that are likelier exchanged, with the logarithm of how much likelier.

    Candidates lie between two frames from which on the exchanged rotations are nearer to the frame before.
    """
    same, other = ((1 - (each[1:] * captured[:-1]).sum(dim=-1).abs()).sum(dim=-1) for each in (captured, exchanged))
    turns = (other < same).nonzero()[:, 0].add(1).tolist()
    found = [(0.0, start, stop) for start in turns for stop in turns if 0 < stop - start <= _MOST_FRAMES]
    prior = math.log(SHARE / len(captured))  # one clip in a hundred has one
    for _ in range(_ROUNDS):  # what is likelier as captured is evidence for the rest
        if not found:
            break
        swapped = torch.zeros_like(seen[:, 0])
        for _, start, stop in found:
            swapped[start:stop] = True
        gains = _measure_gain(captured, exchanged, seen, swapped)
        gains = [(float(gains[start:stop].sum()) + prior, start, stop) for _, start, stop in found]
        found = [run for run in gains if run[0] > 0]
    return found


def _measure_gain(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
    swapped: Bool[Tensor, " frames"],
) -> Float[Tensor, " frames"]:
    """Return by how much the logarithm of the density of exchanged rotations is larger, given frames not swapped."""
    values = 2 * choose_continuous_signs(torch.where(swapped[:, None, None], exchanged, captured))
    values, centre = values - values.mean(dim=0), values.mean(dim=0)
    least = values.new_full((values.shape[1],), RESOLUTION)
    prediction = predict_frames(values, seen & ~swapped[:, None], least)
    densities = []
    for each in (exchanged, captured):
        errors = [(sign * 2 * each - centre - prediction.mean).norm(dim=-1) for sign in (1, -1)]
        likely = replace(prediction, error=torch.minimum(*errors)).log_density()
        densities.append(torch.logaddexp(likely, likely.new_tensor(_OUTLIER)))
    return (densities[0] - densities[1]).where(seen, 0.0).sum(dim=-1)
