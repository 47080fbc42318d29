"""Latents under which a stitched motion does what is told between its two poses.

Ren et al. 2024 speak of a pair of latent codes that minimises the stitching loss, and give no procedure. Here both
sides share their codes, and what is minimised is the energy of a MAP problem: residuals of the wishes, each with its
sigma, and the distance of the codes from the prior's mean, or from a draw (then what comes of it is a draw given the
wishes: Bardsley et al. 2014, randomise then optimise). Gauss-Newton takes few steps, since the codes are few:
derivatives are differences of motions that are made in one batch, which also serves the search along a step.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from priors.stitching.joining import Joined

_ROUNDS, _DIFFERENCE = 2, 0.25  # the second in standard deviations of the prior
_SHARES = (0.25, 0.5, 0.75, 1.0, 1.25)  # of a step


def fit_shared(
    make: Callable[[Float[Tensor, "batch shared"]], Joined],
    measure: Callable[[Joined], Float[Tensor, "batch residuals"]],
    centre: Float[Tensor, " shared"],
    spread: float,
) -> Joined:
    """Fit what both sides share, in standard deviations of the network's prior, to residuals in theirs.

    The energy counts distances from the `centre` in units of `spread`. Returns the motion with the least energy of all
    that were made, as a batch of one: that of the centre where no step helps, or where nothing finite is near it.
    """
    best, fitted = centre, make(centre[None])
    for _ in range(_ROUNDS):
        residuals = measure(make(torch.cat([best[None], best + _DIFFERENCE * torch.eye(len(best))])))
        here = residuals[0]
        jacobian = spread * ((residuals[1:] - here) / _DIFFERENCE).T
        away = (best - centre) / spread
        system = jacobian @ jacobian.T + torch.eye(len(here))
        # Of  |r + J d|^2 + |a + d|^2  the least is at  d = -a - J' (J J' + 1)^-1 (r - J a).
        step = -away - jacobian.T @ torch.linalg.solve(system, here - jacobian @ away)
        tried = best + spread * torch.tensor((0.0, *_SHARES))[:, None] * step
        if not bool(tried.isfinite().all()):
            break
        made = make(tried)
        energy = measure(made).square().sum(dim=1) + ((tried - centre) / spread).square().sum(dim=1)
        least = int(torch.where(energy.isfinite() & made.finite, energy, torch.inf).argmin())
        best, fitted = tried[least], made.row(least)
    return fitted
