"""Detection of values that are held, or replaced by zeros, while the motion goes on: of joints, or of the whole body.

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
from mapctl.recording.local_regression import Prediction, predict_frames

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
