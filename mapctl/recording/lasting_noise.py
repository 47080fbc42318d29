"""Noise that lasts beyond a frame, found in the residual that a proposal leaves of a capture.

An estimate from frame to frame takes noise of a capture that was filtered before, or whose markers shift on the skin,
for a fraction of what it is, and the rest for motion. Beside a model's proposal it shows: motion that the model missed
is of some joints in some moments, such noise of all joints at all times.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics import gaussian

_FRAMES = 45  # fewest frames that tell noise from motion
_LOCAL_FRAMES = 12.0  # frames, sigma, over which the residual's power is averaged
_QUIET = 0.3  # share of a joint's moments whose power counts as no more than noise
_FEW = 0.25  # share of the joints that may be quieter than what follows asks
_CLEAR = 1.1  # times the estimate from frame to frame, in the quiet moments, from which on noise lasts
_MISSED = 0.022  # radians of motion that a model may miss everywhere, which do not count for that
_UNEVEN = 1.5  # times the estimate of loud joints over that of quiet ones, from which on it is motion
_LEAST = 0.004  # radians of noise: captures that pass for clean keep what they have
# A weak model misses as much as little noise is, in all joints at all times. It has to be clearer and more alike.
_LITTLE = 0.045  # radians below which noise is little
_CLEAR_OF_LITTLE = 1.45  # in place of _CLEAR
_MIXED = 0.25  # by which joints differ at most in the correlation from one frame to the next: a filter is one for all
_UNEVEN_LITTLE = 1.35  # in place of _UNEVEN, but for the two cases that follow
_FAINT = 0.0056  # radians from frame to frame up to which a capture has been filtered
_PLAIN = 2.6  # times the estimate from which on no more is asked of joints than of much noise
_UNSTEADY = 2.0  # times the residual in a joint's loud moments over that in its quiet ones, from which on it is motion
_SPREAD = 2.0  # times, at most, that a joint's noise is over its estimate more or less than that of most
_LAGS = 18  # frames


@dataclass(frozen=True, eq=False)
class LastingNoise:
    """How much more noise there is than an estimate from frame to frame tells, and how long it lasts."""

    factor: Float[Tensor, " joints"]
    """Noise over that estimate."""
    correlation: Float[Tensor, " lags"]
    """Correlation of the noise with itself so many frames later, from 0 on."""


def find_lasting_noise(
    rest: Float[Tensor, "frames joints 3"],
    seen: Bool[Tensor, "frames joints"],
    sigma: Float[Tensor, " joints"],
    *,
    again: bool = False,
) -> LastingNoise | None:
    """Find noise that lasts in a residual. None where noise of `sigma` from frame to frame explains the quiet moments
    of more than a few joints, where it differs among joints or comes and goes, and where there are too few frames to
    tell. Joints without noise keep a factor of 1. `again` looks for more where some was found, `sigma` being with it:
    nothing is then taken for motion that the model missed.
    """
    noisy, factor = (sigma > 0) & (seen.sum(dim=0) >= _FRAMES), torch.ones_like(sigma)
    if len(rest) < _FRAMES or int(noisy.sum()) < 2:
        return None
    rest, seen, sigma = rest[:, noisy], seen[:, noisy], sigma[noisy]
    known = seen.to(rest)[..., None]
    kernel = gaussian.kernel(_LOCAL_FRAMES, round(2 * _LOCAL_FRAMES))
    weight = gaussian.convolve(known, kernel, "nothing")
    squares = gaussian.convolve(rest.square().mean(dim=-1, keepdim=True) * known, kernel, "nothing")
    power = (squares / weight.clamp_min(1e-6))[..., 0]
    levels = torch.tensor([0.1, _QUIET, 0.5, 0.9]).to(power)
    least, quiet, usual, most = torch.where(seen, power, torch.nan).nanquantile(levels, dim=0).sqrt()
    low, high = (quiet / sigma).quantile(torch.tensor([_FEW, 1 - _FEW]).to(power)).tolist()
    level = float(quiet.quantile(_FEW))
    bounds = _choose_bounds(level, low, float(sigma.median()), again)
    if low < bounds.clear or high > bounds.uneven * low or level < _LEAST:
        return None
    if float((most / least.clamp_min(1e-12)).median()) > _UNSTEADY:
        return None
    even, over = rest * known / power.clamp_min(1e-12).sqrt()[..., None], usual / sigma
    own = even.square().sum(dim=(0, 2))
    lags = torch.stack([(even[lag:] * even[: len(even) - lag]).sum(dim=(0, 2)) / own for lag in range(_LAGS)])
    shortest, longest = lags[1].quantile(torch.tensor([0.1, 0.9]).to(lags)).tolist()
    if longest - shortest > bounds.mixed:
        return None
    factor[noisy] = over.clamp(min=over.median() / _SPREAD, max=over.median() * _SPREAD).clamp(min=1.0)
    return LastingNoise(factor, lags.median(dim=-1).values.clamp(min=0.0))


class _Bounds(NamedTuple):
    """What a residual has to hold to be noise that lasts."""

    clear: float
    """Least of its quiet moments over the estimate from frame to frame."""
    uneven: float
    """Most of loud joints' such ratio over that of quiet ones."""
    mixed: float = math.inf
    """Most by which joints differ in the correlation from one frame to the next."""


def _choose_bounds(level: float, low: float, estimate: float, again: bool) -> _Bounds:
    """Choose by the residual's level and the estimate, radians, and by their ratio `low` in quiet joints."""
    if again:
        return _Bounds(_CLEAR, _UNEVEN)
    if level >= _LITTLE:
        return _Bounds(_CLEAR / math.sqrt(1 - (_MISSED / level) ** 2), _UNEVEN)
    doubtful = estimate > _FAINT and low < _PLAIN
    return _Bounds(_CLEAR_OF_LITTLE, _UNEVEN_LITTLE if doubtful else _UNEVEN, _MIXED)
