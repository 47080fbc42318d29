"""Particle swarm (Kennedy and Eberhart 1995; Wang et al. 2019, section 5.2)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.solver.budget import Meter

_INERTIA, _PULL = 0.7298, 1.4962
"""Share of its velocity that a particle keeps, and largest factor of its pull toward its own best point and toward the
best of all (the constriction of Clerc and Kennedy 2002)."""


@dataclass(frozen=True)
class SwarmSettings:
    """Size of a swarm."""

    particles: int = 16
    """Number of points evaluated at once; fewer where the budget has fewer left."""
    iterations: int = 6
    """Number of evaluations of the whole swarm; of one evaluation the best sample is the result."""


def run_swarm(
    cost: Callable[[Float[Tensor, "particles n"]], Float[Tensor, " particles"]],
    *,
    start: Float[Tensor, " n"],
    spread: Float[Tensor, " n"] | float,
    settings: SwarmSettings = SwarmSettings(),
    meter: Meter | None = None,
    generator: torch.Generator,
) -> tuple[Float[Tensor, " n"], float]:
    """Search from `start`, which is the first particle; the others begin at samples around it, all at rest.

    `spread` is the standard deviation of the samples, in units of the unknowns. A cost that is not finite counts as
    infinity. The swarm stops before an iteration that the meter cannot pay in full. Returns the best point and its
    cost, which is infinite, at the start, where nothing finite was seen. The same generator state gives the same bits.
    """
    meter = Meter() if meter is None else meter
    count = max(1, int(min(settings.particles, meter.remaining)))
    noise = torch.randn(count, len(start), dtype=start.dtype, device=generator.device, generator=generator)
    points = start + noise.to(start.device) * spread
    points[0] = start
    seed = torch.randint(2**32, (8,), generator=generator, device=generator.device)
    draw = np.random.RandomState(seed.cpu().numpy()).uniform
    points = points.double()
    velocity, best, least = torch.zeros_like(points), points, points.new_full((count,), math.inf)
    for iteration in range(settings.iterations):
        if not meter.take(count):
            break
        if iteration:
            own, common = (torch.as_tensor(draw(size=points.shape)).to(points) for _ in range(2))
            to_own, to_common = best - points, best[least.argmin()] - points
            velocity = _INERTIA * velocity + _PULL * own * to_own + _PULL * common * to_common
            points = points + velocity
        costs = cost(points.to(start)).detach()
        costs = torch.where(costs.isfinite(), costs, math.inf).to(least)
        better = costs < least
        best, least = torch.where(better[:, None], points, best), torch.where(better, costs, least)
    leader = int(least.argmin())
    return best[leader].to(start), float(least[leader])
