"""Detection of spikes: single frames, or two in a row, that the frames around them do not explain.

Likelihood of each frame of a track given the frames around it, by local polynomials that leave the frame out.

A polynomial over the neighbours predicts a frame that it has not seen; how well it fits the neighbours themselves
scales the error: externally studentised residuals (Cook and Weisberg 1982, section 2.2.1). The scale of one window has
few degrees of freedom, so it is shrunk to that of the whole track, as far as windows differ no more than chance has
them differ (Smyth 2004, section 4). White noise is thus judged by Gaussian tails, motion that is now quick and now
slow by heavy ones. At the ends of a track and beside frames that are left out the prediction is less certain (its
leverage), and the likelihood with it.

Detection of values that are held, or replaced by zeros, while the motion goes on: of joints, or of the whole body.

What rests comes to rest and leaves it again, so that the motion beside it leads into the value that it has there. What
was held goes on elsewhere, and what was replaced lies elsewhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import true_intervals
from mapctl.recording.noise_estimation import RESOLUTION, choose_continuous_signs

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
