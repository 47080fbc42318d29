"""How fast joints move by frequency: motion that trembles, or floats, shows there where a mean speed does not."""

import numpy
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

BANDS_HZ = ((0.0, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 15.0))
"""Bands, Hz, each up to but not with its upper end; the last one ends at half the rate of priors."""


def measure_speed_by_band(places: Float[Tensor, "frames joints 3"], fps: float) -> Float[Tensor, " bands"]:
    """Return the joints' speed, root mean square over frames and joints, cm/s, in each of BANDS_HZ.

    The power spectrum of the joints' velocities, of the whole motion under a Hann window and with their mean: squares
    of all bands add up to the square of the speed, of which the window counts the middle most. ValueError for fewer
    than 3 frames.
    """
    if len(places) < 3:
        raise ValueError(f"a spectrum takes 3 frames at least, got {len(places)}")
    velocities = 100 * fps * numpy.diff(places.detach().double().numpy(), axis=0)
    density = scipy.signal.periodogram(velocities, fps, "hann", detrend=False, axis=0)  # pyright: ignore[reportArgumentType]
    frequencies, power = density  # (cm/s)^2 a Hz
    by_frequency = power.sum(axis=-1).mean(axis=-1) * (frequencies[1] - frequencies[0])
    edges = numpy.array([low for low, _ in BANDS_HZ])
    bands = numpy.searchsorted(edges, frequencies, side="right") - 1
    return torch.from_numpy(numpy.sqrt(numpy.bincount(bands, by_frequency, minlength=len(edges))))
