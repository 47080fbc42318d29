"""Fixed-lag smoothing of the poses that a tracker sends, at whatever rate and with whatever losses.

The last second is smoothed again whenever a frame comes, and what is shown lies a fixed delay before its end. Smoothers
of several cutoffs, which minimise the squared distance to what was observed and squared third differences (Whittaker
1923; Eilers 2003), are weighted by Stein's unbiased estimate of their risk (Stein 1981), joint by joint and moment by
moment: fast motion is followed, noise is averaged, and its level is measured all the time. Lost frames, missing joints
and spikes are unobserved, and interpolated. Beyond the last observation a joint comes to rest from its last velocity;
when it is observed again, it is crossfaded back.
"""

import math
from collections import deque
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.interpolate import CubicSpline
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.numerics.gaussian import averaging_matrix
from mapctl.recording.inspection import ROTATIONS, SHARE, find_spikes
from mapctl.recording.noise_estimation import choose_continuous_signs, estimate_angle_noise, estimate_position_noise

_ROWS, _WINDOW = 8 * PRIOR_FPS, PRIOR_FPS  # rows by which noise is measured, and of them those that are smoothed
_MEASURED_ROWS = 15  # fewest by which it is measured, and rows from one measurement to the next
_HERTZ = (0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 6.5, 10.0, 14.0)  # half-power frequencies of the smoothers, at PRIOR_FPS
_HIGHEST = 0.47  # of a rate: the highest cutoff that it can hold
_RISK_SECONDS = 1.0  # sigma over which risks are averaged
_TEMPERATURE = 0.06  # of risks: smoothers of about equal risk count alike
_LEAST_WEIGHT = 1e-6  # of an unobserved row, so that the system of a column without any has a solution
_SPIKE_SIGMAS, _LEAST_SPIKE = 6.0, 0.1  # of noise, and radians or metres, that a spike stands out
_TIMED_FRAMES = 60  # by whose median interval the tracker's rate is measured
_PULL = 0.1  # share of a frame's jitter by which the steady times of frames follow it
_BRIDGED_SECONDS = 0.25  # longest gap that is interpolated
_REST_SECONDS, _RETURN_SECONDS = 0.1, 0.2  # decay of the velocity of what is lost, and the crossfade of its return
_SECANT_SECONDS = 0.05  # over which that velocity is taken


class PoseSmoother:
    """Smoother of one character: of the rotations of its joints, and of the first joints' positions."""

    def __init__(self, joints: int, moving: int, delay: float):
        """Begin without poses. Columns are the rotations (xyzw) of all joints, then positions (x, y, z, 0) of the first
        `moving`; a pose is shown `delay` seconds after it came."""
        self._joints, self._moving, self._delay = joints, moving, delay
        nothing = torch.zeros(joints + moving, 4, dtype=torch.float64)
        nothing[:joints, 3] = 1
        # Rows are frames at about PRIOR_FPS: of a faster tracker, the means of two or more.
        self._values = nothing.expand(_ROWS, -1, -1).numpy().copy()
        self._seen = np.zeros((_ROWS, joints + moving), dtype=bool)
        self._samples = np.zeros(joints + moving)  # of the last row
        self._sigma = torch.zeros(joints + moving, dtype=torch.float64)
        self._unmeasured = self._unsmoothed = 0  # rows since noise was measured, samples since the last pass
        self._came, self._came_at = set[int](), -math.inf  # joints of the newest frame, and when it came
        self._intervals, self._period = deque[float](maxlen=_TIMED_FRAMES), 1 / PRIOR_FPS
        self._frame_time, self._frame_in_row, self._row_frames = 0.0, 0, 1
        self._path: CubicSpline | None = None
        self._seconds = 0.0  # of the last sample; what it showed, and of columns that are lost where they come to rest
        self._shown, self._resting, self._share = nothing, nothing, torch.zeros(joints + moving, 1, dtype=torch.float64)
        self._velocity = self._rest_velocity = torch.zeros(joints + moving, 3, dtype=torch.float64)
        self._known = torch.zeros(joints + moving, 1, dtype=torch.bool)

    def push(self, seconds: float, joint: int, transform: Float[ndarray, "7"]) -> None:
        """Take the position and the rotation (xyzw) of a joint that came at `seconds`. A frame ends where a joint comes
        again, or half a frame after its first."""
        if joint in self._came or seconds > self._came_at + self._period / 2:
            self._begin_frame(seconds)
        self._came.add(joint)
        self._unsmoothed += 1
        self._take(joint, transform[3:])
        if joint < self._moving:
            self._take(self._joints + joint, np.append(transform[:3], 0.0))

    def _take(self, column: int, value: Float[ndarray, "4"]) -> None:
        last, samples = self._values[-1, column], self._samples[column]
        if column < self._joints:
            value = value * math.copysign(1 / np.linalg.norm(value), float(value @ last))
        mean = (samples * last + value) / (samples + 1)
        self._values[-1, column] = mean / np.linalg.norm(mean) if column < self._joints else mean
        self._seen[-1, column] = True
        self._samples[column] += 1

    def _begin_frame(self, seconds: float) -> None:
        """Begin a frame, and before it those that were lost since the last, at times without the network's jitter."""
        self._came.clear()
        last, self._came_at = self._came_at, seconds
        if last == -math.inf:
            self._frame_time = seconds
            return
        self._intervals.append(seconds - last)
        self._period = max(float(np.median(self._intervals)), 1e-3)
        steps = max(1, round((seconds - self._frame_time) / self._period))
        expected = min(self._frame_time + steps * self._period, seconds + self._period)  # several may come at once
        self._frame_time = expected + _PULL * (seconds - expected)
        self._row_frames = max(1, round(1 / (PRIOR_FPS * self._period)))
        rows, self._frame_in_row = divmod(self._frame_in_row + steps, self._row_frames)
        if rows:
            rows = min(rows, _ROWS)
            self._values = np.concatenate([self._values[rows:], np.repeat(self._values[-1:], rows, axis=0)])
            self._seen = np.concatenate([self._seen[rows:], np.zeros_like(self._seen[:rows])])
            self._samples[:] = 0
            self._unmeasured += rows

    def _time_rows(self) -> Float[ndarray, " rows"]:
        """Return the times of the rows, seconds; that of a row of several frames is their mean."""
        last = self._frame_time - (self._frame_in_row - (self._row_frames - 1) / 2) * self._period
        return last + self._row_frames * self._period * np.arange(1 - _ROWS, 1)

    def smooth(self) -> None:
        """Smooth the last second, if anything came since that was done, and the last row has all of its frames."""
        if not self._unsmoothed or self._frame_in_row < self._row_frames - 1:
            return
        self._unsmoothed = 0
        if self._unmeasured >= _MEASURED_ROWS:
            self._measure_noise()
        values, seen = torch.from_numpy(self._values[-_WINDOW:]), torch.from_numpy(self._seen[-_WINDOW:])
        seen = seen & ~self._find_spikes(values, seen)
        stiffness = _compute_stiffness(max(1, round(1 / (self._row_frames * self._period))))
        smoothed = values.new_empty(len(stiffness), *values.shape)
        leverage = values.new_empty(smoothed.shape[:-1])
        patterns, pattern_of = torch.unique(seen, dim=1, return_inverse=True)
        for index, pattern in enumerate(patterns.T):  # columns that were observed in the same rows
            weight, columns = pattern.double().clamp_min(_LEAST_WEIGHT), pattern_of == index
            smoothers = torch.linalg.inv(stiffness + weight.diag()) * weight
            smoothed[:, :, columns] = torch.einsum("krs,scw->krcw", smoothers, values[:, columns])
            leverage[:, :, columns] = smoothers.diagonal(dim1=1, dim2=2)[..., None]
        power = (3 * self._sigma.square()).clamp_min(_LEAST_WEIGHT)
        change = self._difference(self._normalize(smoothed), values).square().sum(dim=-1) / power
        near = averaging_matrix(_WINDOW, _RISK_SECONDS * PRIOR_FPS, values.dtype)
        risk = near @ (seen * (change + 2 * leverage)) / (near @ seen.double()).clamp_min(_LEAST_WEIGHT)
        share = torch.softmax(-risk / _TEMPERATURE, dim=0)
        self._path = CubicSpline(self._time_rows()[-_WINDOW:], (share[..., None] * smoothed).sum(dim=0).numpy())

    def _find_spikes(self, values: Tensor, seen: Tensor) -> Bool[Tensor, "rows columns"]:
        """Find the spikes; only columns that leave the line between two frames by far are looked at closely."""
        scaled = torch.cat([2 * values[:, : self._joints], values[:, self._joints :]], dim=1)
        away = (scaled[1:-1] - (scaled[:-2] + scaled[2:]) / 2).norm(dim=-1)
        suspects = (away > _SPIKE_SIGMAS * self._sigma + _LEAST_SPIKE).any(dim=0)
        spikes = torch.zeros_like(seen)
        if suspects.any():
            spikes[:, suspects] = find_spikes(scaled[:, suspects], seen[:, suspects], math.log(SHARE / ROTATIONS))
        return spikes

    def _measure_noise(self) -> None:
        self._unmeasured = 0
        values, seen = torch.from_numpy(self._values), torch.from_numpy(self._seen)
        found = estimate_angle_noise(choose_continuous_signs(values[:, : self._joints]), seen[:, : self._joints])
        positions = [
            estimate_position_noise(values[:, column, :3], seen[:, column])
            for column in range(self._joints, self._joints + self._moving)
        ]
        found = torch.cat([found, found.new_tensor(positions)])
        self._sigma = torch.where(seen.sum(dim=0) >= _MEASURED_ROWS, found, self._sigma)

    def sample(self, seconds: float) -> tuple[Float[ndarray, "columns 4"], Bool[ndarray, " columns"]]:
        """Return the pose to be shown at `seconds`, that of the delay before, and which columns have one. Times must
        rise."""
        if self._path is None:
            return self._shown.numpy(), self._known[:, 0].numpy()
        step, now, self._seconds = seconds - self._seconds, seconds - self._delay, seconds
        times = np.clip([now - _SECANT_SECONDS, now], *self._path.x[[0, -1]])
        before, target = self._normalize(torch.from_numpy(self._path(times)))
        lost = self._find_lost(now)
        ended = lost & (self._share > 0)
        self._resting = torch.where(ended, self._shown, self._resting)
        slower = math.exp(-step / _REST_SECONDS)
        self._rest_velocity = torch.where(ended, self._velocity, slower * self._rest_velocity)
        self._resting = self._add(self._resting, step * self._rest_velocity)
        back = torch.where(self._known, self._share + step / _RETURN_SECONDS, 1.0).clamp(max=1.0)
        self._share = torch.where(lost, 0.0, back)
        self._known = self._known | ~lost
        weight = self._share**2 * (3 - 2 * self._share)
        self._shown = self._add(self._resting, weight * self._difference(self._resting, target))
        self._velocity = torch.lerp(self._rest_velocity, self._difference(before, target) / _SECANT_SECONDS, weight)
        return self._shown.numpy(), self._known[:, 0].numpy()

    def _find_lost(self, now: float) -> Bool[Tensor, "columns 1"]:
        """Find the columns that were not observed until and from `now` on, or between for longer than is bridged."""
        times = self._time_rows()[:, None]
        before = np.where(self._seen & (times <= now), times, -math.inf).max(axis=0)
        after = np.where(self._seen & (times > now), times, math.inf).min(axis=0)
        return torch.from_numpy(after - before > max(_BRIDGED_SECONDS, 2 * self._period))[:, None]

    def _difference(self, start: Tensor, stop: Tensor) -> Tensor:
        """Return the rotation vectors, and the distances, from columns to others."""
        turns = rotations.turns_between(start[..., : self._joints, :], stop[..., : self._joints, :])
        return torch.cat([turns, (stop - start)[..., self._joints :, :3]], dim=-2)

    def _add(self, start: Tensor, vector: Tensor) -> Tensor:
        turns = rotations.from_rotation_vector(vector[..., : self._joints, :])
        moved = start[..., self._joints :, :] + torch.nn.functional.pad(vector[..., self._joints :, :], (0, 1))
        return torch.cat([rotations.multiply(start[..., : self._joints, :], turns), moved], dim=-2)

    def _normalize(self, values: Tensor) -> Tensor:
        turned = torch.nn.functional.normalize(values[..., : self._joints, :], dim=-1)
        return torch.cat([turned, values[..., self._joints :, :]], dim=-2)


@lru_cache(maxsize=8)
def _compute_stiffness(fps: int) -> Float[Tensor, "smoothers rows rows"]:
    """Compute the quadratic form of each smoother: squared third differences."""
    third = torch.diff(torch.eye(_WINDOW, dtype=torch.float64), n=3, dim=0)
    scales = [(2 * math.sin(math.pi * min(hertz / fps, _HIGHEST))) ** -6 for hertz in _HERTZ]
    return torch.tensor(scales, dtype=torch.float64)[:, None, None] * (third.T @ third)
