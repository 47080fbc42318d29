"""Fusion of a capture and a model's proposal by Stein's unbiased risk estimate.

The residual between capture and proposal is noise of known power and the proposal's error. Candidates for the true
motion are the proposal itself, the proposal with its residual smoothed (where its error is slow), and the capture
alone, smoothed (outside its training data). Stein's unbiased estimate of the risk (Stein 1981) weighs them, joint by
joint and moment by moment, without any knowledge of the truth. The smoother minimises the squared distance to what was
observed and squared third differences (Whittaker 1923; Eilers 2003): for a stationary signal a Butterworth filter of
third order run forwards and backwards, but with ends and gaps of its own.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.recording.noise_estimation import choose_continuous_signs

_ORDER = 3  # of the differences that the smoother penalises
_HERTZ = (0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 6.5, 10.0, 15.0, 22.0, 33.0)  # half-power frequencies of the smoothers
_SCALES = ((1.33, 1.5), (0.25, 3.0))
"""Seconds (sigma) over which a risk is averaged, for slow errors first and then for transients, and the number of the
risk's standard errors that a candidate beside the proposal must gain: short averages are wrong more often."""
_SELECTION = 1.0  # of the leverage of such a candidate, counted once more, since it is the best of many
_TEMPERATURE = 0.06  # of the noise's power: candidates of about equal risk are averaged
_LEAST_SEEN = 0.1  # of the frames that a smoother averages
_LEAST_WEIGHT = 1e-9  # of an unobserved frame, so that the system of a column without any has a solution


@dataclass(frozen=True, eq=False)
class Fused:
    """Estimate of the true motion of some columns: joints' rotations, or positions."""

    values: Float[Tensor, "frames columns width"]
    """Quaternions (xyzw), or positions in metres."""
    share: Float[Tensor, "frames columns"]
    """Weight of the proposal itself: 1 where the capture supports it, 0 where the capture corrects or replaces it."""
    error: Float[Tensor, "frames columns"]
    """Estimated error: standard deviation of each of the three numbers, radians or metres."""


def fuse_rotations(
    proposal: Float[Tensor, "frames joints 4"] | None,
    capture: Float[Tensor, "frames joints 4"],
    seen: Bool[Tensor, "frames joints"],
    sigma: Float[Tensor, " joints"],
    fps: float,
    noise_rate: float = math.inf,
) -> Fused:
    """Estimate rotations (xyzw) from a capture with noise `sigma` of each angle, radians, and a proposal at its rate,
    if there is one. Joints without noise keep what was observed. The noise is white up to `noise_rate` samples a
    second, if that is less than the frames."""

    def turn(start: Tensor, vector: Tensor) -> Tensor:
        return rotations.multiply(start, rotations.from_rotation_vector(vector))

    capture, normalize = choose_continuous_signs(capture), partial(torch.nn.functional.normalize, dim=-1)
    return _fuse(proposal, capture, seen, sigma, fps, rotations.turns_between, turn, normalize, noise_rate)


def fuse_positions(
    proposal: Float[Tensor, "frames 3"] | None,
    capture: Float[Tensor, "frames 3"],
    seen: Bool[Tensor, " frames"],
    sigma: float,
    fps: float,
    noise_rate: float = math.inf,
) -> Fused:
    """Estimate positions, metres, from a capture with noise `sigma` of each coordinate, as `fuse_rotations`."""
    level, difference = torch.tensor([sigma], dtype=torch.float64), lambda start, stop: stop - start
    columns = None if proposal is None else proposal[:, None]
    return _fuse(columns, capture[:, None], seen[:, None], level, fps, difference, torch.add, torch.clone, noise_rate)


def _fuse(
    proposal: Tensor | None,
    capture: Float[Tensor, "frames columns width"],
    seen: Bool[Tensor, "frames columns"],
    sigma: Float[Tensor, " columns"],
    fps: float,
    difference: Callable[[Tensor, Tensor], Tensor],
    add: Callable[[Tensor, Tensor], Tensor],
    normalize: Callable[[Tensor], Tensor],
    noise_rate: float,
) -> Fused:
    """Fuse over seconds first, then over moments about that result, which keeps transients of the capture alone. The
    error is that of the first: near a result that follows the capture, the noise is underestimated."""
    weights, holds_proposal = seen.double(), proposal is not None
    smooth = [normalize(smooth_columns(capture, weights, hertz, fps)) for hertz in _list_cutoffs(fps)]
    about, found = smooth[0] if proposal is None else proposal, []
    for scale in _SCALES:
        residual, others = difference(about, capture), [difference(about, each) for each in smooth]
        vector, share, error = _estimate(
            residual, others, weights, sigma, fps, scale, noise_rate, holds_proposal=holds_proposal
        )
        about, holds_proposal = add(about, vector), True
        found.append((share, error))
    return Fused(about, found[0][0] * found[1][0], found[0][1])


def smooth_columns(
    values: Float[Tensor, "frames columns width"], weights: Float[Tensor, "frames columns"], hertz: float, fps: float
) -> Float[Tensor, "frames columns width"]:
    """Smooth columns of numbers with a half-power frequency; frames of weight 0 are filled in."""
    frames = len(values)
    if frames <= _ORDER:
        return values
    stiffness = (2 * math.sin(math.pi * hertz / fps)) ** (-2 * _ORDER) * _difference_bands(frames)
    out, columns = np.empty(values.shape), weights.numpy()
    for column, given in enumerate(values.double().numpy().swapaxes(0, 1)):
        weight = columns[:, column]
        system = stiffness.copy()
        system[-1] += np.maximum(weight, _LEAST_WEIGHT)
        out[:, column] = solveh_banded(system, weight[:, None] * given)
    return torch.from_numpy(out)


def measure_kept_noise(hertz: float, fps: float) -> float:
    """Measure the share of white noise's power that a smoother leaves, far from the ends: its mean squared response."""
    turn = torch.linspace(0, math.pi, 2001, dtype=torch.float64)
    response = 1 / (1 + (torch.sin(turn / 2) / math.sin(math.pi * hertz / fps)) ** (2 * _ORDER))
    return float(response.square().mean())


def _estimate(
    residual: Float[Tensor, "frames columns 3"],
    smoothed: list[Float[Tensor, "frames columns 3"]],
    weights: Float[Tensor, "frames columns"],
    sigma: Float[Tensor, " columns"],
    fps: float,
    scale: tuple[float, float],
    noise_rate: float,
    *,
    holds_proposal: bool,
) -> tuple[Float[Tensor, "frames columns 3"], Float[Tensor, "frames columns"], Float[Tensor, "frames columns"]]:
    """Estimate the truth beside the proposal; also the weight of the proposal itself, and the estimated error.
    `residual` is the capture beside the proposal, `smoothed` the smoothed capture beside it; risks are averaged over a
    time that `scale` gives."""
    seconds, caution = scale
    power = (3 * sigma.square()).clamp_min(1e-12)
    ones = torch.ones_like(weights)
    near = _average(weights, ones, fps, seconds).clamp_min(_LEAST_WEIGHT)
    # The last is the capture itself: a transient that no smoother can follow is no noise.
    candidates, leverages = [residual], [_require_seen(ones, weights, holds_proposal)]
    for hertz, smooth in zip(_list_cutoffs(fps), smoothed, strict=True):
        # Of noise that is slower than the frames a smoother keeps a larger share. Averaged like the changes, or the
        # outermost frame, where leverage is largest, would be the proposal's alone.
        leverage = (_compute_leverage(len(residual), hertz, fps) * max(1.0, fps / noise_rate)).clamp(max=1)
        leverage = _average(leverage[:, None], ones[:, :1], fps, seconds)
        # In a gap a smoother has little evidence: of the frames that it sees, how many are observed.
        shown = _average(weights, ones, fps, 1 / (4 * math.pi * hertz))
        leverage = _require_seen(leverage, shown, holds_proposal)
        back = [smooth_columns(residual * weights[..., None], weights, hertz, fps)] if holds_proposal else []
        candidates, leverages = [*back, smooth, *candidates], [*[leverage] * len(back), leverage, *leverages]
    # Risks differ by what is slower than the prior's rate alone: a faster camera has more frames of the same.
    finer = max(1.0, fps / PRIOR_FPS)
    frames = min(len(residual), 2 * math.sqrt(math.pi) * seconds * fps) / finer
    doubt = caution * math.sqrt(2 / (3 * frames)) / finer
    penalties = [(_SELECTION * leverage + doubt) * holds_proposal for leverage in leverages]
    if holds_proposal:
        nothing = torch.zeros_like(ones)
        candidates.insert(0, torch.zeros_like(residual))
        leverages.insert(0, nothing)
        penalties.insert(0, nothing)
    changes = [(candidate - residual).square().sum(dim=-1) * weights for candidate in candidates]
    risks = torch.stack([_average(change, near, fps, seconds) for change in changes]) / power
    risks = risks + 2 * torch.stack(leverages) - 1
    share = torch.softmax(-(risks + torch.stack(penalties)) * finer / _TEMPERATURE, dim=0)
    vector = (share[..., None] * torch.stack(candidates)).sum(dim=0)
    error = sigma * torch.where(share > 0, share * risks, 0.0).sum(dim=0).clamp(0.0, 1.0).sqrt()
    # Without noise the capture is the truth where it was observed.
    exact = (sigma == 0) & (weights > 0)
    held = share[0] * (holds_proposal & ~exact)
    return torch.where(exact[..., None], residual, vector), held, error


def _list_cutoffs(fps: float) -> list[float]:
    """List the half-power frequencies that a rate can hold, Hz."""
    return [hertz for hertz in _HERTZ if hertz < 0.45 * fps]


def _average(
    values: Float[Tensor, "frames columns"], weight: Float[Tensor, "frames columns"], fps: float, seconds: float
) -> Float[Tensor, "frames columns"]:
    """Average values over so many seconds (sigma), over an average weight."""
    return gaussian.average(values, seconds=seconds, fps=fps) / weight


def _require_seen(leverage: Tensor, seen: Float[Tensor, "frames columns"], holds_proposal: bool) -> Tensor:
    """Raise the leverage of a smoother where it sees few frames; where it sees hardly any, in a long gap, only a
    proposal remains, if there is one."""
    raised = leverage / seen.clamp_min(_LEAST_SEEN)
    return raised.masked_fill(seen < _LEAST_SEEN, math.inf) if holds_proposal else raised


@lru_cache(maxsize=8)
def _difference_bands(frames: int) -> Float[np.ndarray, "bands frames"]:
    """Return the upper bands of the quadratic form of summed squared differences of `_ORDER`."""
    signs = [math.comb(_ORDER, index) * (-1) ** index for index in range(_ORDER + 1)]
    bands = np.zeros((_ORDER + 1, frames))
    for one in range(_ORDER + 1):
        for other in range(one + 1):
            bands[_ORDER - (one - other), one : frames - _ORDER + one] += signs[one] * signs[other]
    return bands


@lru_cache(maxsize=64)
def _compute_leverage(frames: int, hertz: float, fps: float) -> Float[Tensor, " frames"]:
    """Compute the leverage of each frame, its weight in its own smoothed value, largest at the ends: the diagonal of
    the smoother's matrix, whose middle is the same in all long captures."""
    side = min(frames, math.ceil(3 * fps / hertz))
    every = torch.eye(side, dtype=torch.float64)[:, None]
    diagonal = smooth_columns(every, torch.ones(side, 1, dtype=torch.float64), hertz, fps)[:, 0].diagonal()
    if side == frames:
        return diagonal
    half = side // 2
    leverage = diagonal[half].repeat(frames)
    leverage[:half], leverage[frames - half :] = diagonal[:half], diagonal[side - half :]
    return leverage


def upsample(
    values: Float[Tensor, "shown *width"], seconds: Float[Tensor, " shown"], *, fps: float, frames: int
) -> Float[Tensor, "frames *width"]:
    """Interpolate values at rising times, for so many frames a second, by a cubic spline; hold beyond the last."""
    if len(values) < 2:
        return values.expand(frames, *values.shape[1:])
    times = seconds.numpy()
    wanted = np.clip(np.arange(frames) / fps, times[0], times[-1])
    return torch.as_tensor(scipy.interpolate.CubicSpline(times, values.double().numpy(), axis=0)(wanted))


def resample_by_splines(motion: Motion, seconds: Float[Tensor, " shown"], *, fps: Fraction, frames: int) -> Motion:
    """Resample a motion whose frames are at rising times to so many frames at a rate; straight lines would be kinks."""
    quats = rotations.make_sign_continuous(motion.local_quat_xyzw.double())
    quats = upsample(quats, seconds, fps=float(fps), frames=frames)
    root = upsample(motion.root_position.double(), seconds, fps=float(fps), frames=frames)
    return replace(motion, fps=fps, root_position=root, local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1))


def transfer_change(motion: Motion, before: Motion, after: Motion, seconds: Float[Tensor, " shown"]) -> Motion:
    """Change a motion as another, whose frames are at rising times, was changed: what did not change stays as it was
    at the motion's own rate."""
    turned = rotations.turns_between(before.local_quat_xyzw, after.local_quat_xyzw)
    angles, moved = (
        upsample(change, seconds, fps=float(motion.fps), frames=motion.num_frames)
        for change in (turned, after.root_position - before.root_position)
    )
    quats = rotations.multiply(motion.local_quat_xyzw, rotations.from_rotation_vector(angles))
    return replace(motion, root_position=motion.root_position + moved, local_quat_xyzw=quats)
