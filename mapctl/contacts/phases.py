"""Local phases: how far each toe is in its own step, told by when it is planted (Starke et al. 2020).

Starke et al. fit a sinusoid to the filtered contacts of each bone around each frame. Here the same signal is made
analytic: contacts are smoothed, standardised among the frames around, and turned into amplitude and phase by a Hilbert
transform. Their five bones are the two toes here, of which alone features hold contacts.
"""

from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl.errors import RequestError

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
    each is told by the frame after, as contacts are, and the first frame repeats the second's."""
    back = phases.flip(-2) * phases.new_tensor([1.0, -1.0, 1.0, -1.0])
    return torch.cat([back[..., :1, :], back[..., :-1, :]], dim=-2)


def _average_around(values: Float[ndarray, "frames 2"]) -> Float[ndarray, "frames 2"]:
    """Average over the frames that there are up to REACH before and after each."""
    count = scipy.ndimage.uniform_filter1d(np.ones(len(values)), 2 * REACH + 1, mode="constant")
    return scipy.ndimage.uniform_filter1d(values, 2 * REACH + 1, axis=0, mode="constant") / count[:, None]
