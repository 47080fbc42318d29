"""Particle swarm (Kennedy and Eberhart 1995; Wang et al. 2019, section 5.2) by pyswarms, and a baseline of samples.

pyswarms' own optimisers keep every iterate, draw first velocities from [0, 1] whatever the unit, and cannot stop at a
budget; so its swarm, topologies and update rules are used, and the loop is here. pyswarms also sets up the process's
logging (and a report.log in the working folder) at import and with every object made, which is suppressed here.
"""

import logging.config
import math
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.solver.budget import Meter

Cost = Callable[[Tensor], Tensor]
"""Points (particles, n) to energies (particles,); what is not finite counts as infinity."""
Bounds = tuple[Tensor, Tensor]
"""Least and greatest value of every unknown, (n,) each; particles that leave stop at the border."""


@dataclass(frozen=True)
class SwarmSettings:
    """Size and weights of a swarm; the default weights are the constriction of Clerc and Kennedy 2002."""

    particles: int = 16
    """Number of points evaluated at once; fewer where the budget has fewer left."""
    iterations: int = 6
    """Number of evaluations of the whole swarm."""
    inertia: float = 0.7298
    """Share of its velocity a particle keeps."""
    cognitive: float = 1.4962
    """Pull toward the particle's own best point: largest factor of the way there, each iteration."""
    social: float = 1.4962
    """Pull toward the best point among its neighbours: largest factor of the way there, each iteration."""
    neighbours: int | None = None
    """Number of nearest particles that share their best point, itself among them; None: all."""

    def __post_init__(self):
        if self.particles < 1 or self.iterations < 1:
            raise RequestError(
                f"particles and iterations must be 1 or more, got {self.particles} and {self.iterations}"
            )
        if self.neighbours is not None and self.neighbours < 2:
            raise RequestError(f"a particle's neighbours must be 2 or more (or None for all), got {self.neighbours}")


@dataclass(frozen=True, eq=False)
class SwarmResult:
    """The best point found."""

    x: Float[Tensor, " n"]
    """Best point (n,), never worse than the start."""
    energy: float
    """Energy at x; infinity where nothing finite was seen, or no evaluation was allowed (then x is the start)."""
    evaluations: int
    """Number of points evaluated."""
    history: tuple[float, ...]
    """Best energy so far after every evaluation of the swarm."""


def run_swarm(
    cost: Cost,
    *,
    start: Float[Tensor, " n"],
    spread: Float[Tensor, " n"] | float,
    settings: SwarmSettings = SwarmSettings(),
    bounds: Bounds | None = None,
    meter: Meter | None = None,
    generator: torch.Generator,
) -> SwarmResult:
    """Search from `start`, which is the first particle; the others begin at samples around it, all at rest.

    `spread` is the standard deviation of the samples, `bounds` the least and greatest value of each, in units of the
    unknowns. The swarm stops before an iteration
    that the meter cannot pay in full. The same generator state gives the same bits. Raises RequestError where the start
    is no vector or out of bounds, or the cost answers in another shape.
    """
    meter = Meter() if meter is None else meter
    track = _BestTracker(cost, start, meter)
    points = _sample_points(start, spread, bounds, min(settings.particles, meter.remaining), generator)
    if not len(points):
        return track.result()
    seed = torch.randint(2**32, (8,), generator=generator, device=generator.device).cpu().numpy()
    limits = None if bounds is None else (_to_numpy(bounds[0]), _to_numpy(bounds[1]))
    swarm = _make_swarm(_to_numpy(points), settings, limits, np.random.RandomState(seed))
    for iteration in range(settings.iterations):
        if iteration:
            swarm.move()
        energies = track.evaluate(torch.as_tensor(swarm.positions).to(start))
        if energies is None:
            break
        swarm.learn(energies)
    return track.result()


def run_best_of_samples(
    cost: Cost,
    *,
    start: Float[Tensor, " n"],
    spread: Float[Tensor, " n"] | float,
    count: int,
    bounds: Bounds | None = None,
    meter: Meter | None = None,
    generator: torch.Generator,
) -> SwarmResult:
    """Find the best of `count` points, evaluated at once: the start and samples around it; fewer on a short budget.

    `spread` is the standard deviation of the samples, `bounds` the least and greatest value of each, in units of the
    unknowns. Errors as of `run_swarm`, which it is held against.
    """
    if count < 1:
        raise RequestError(f"the best of how many? at least 1, got {count}")
    meter = Meter() if meter is None else meter
    track = _BestTracker(cost, start, meter)
    points = _sample_points(start, spread, bounds, min(count, meter.remaining), generator)
    if len(points):
        track.evaluate(points)
    return track.result()


class _BestTracker:
    """Evaluates points within the budget and keeps the best."""

    def __init__(self, cost: Cost, start: Tensor, meter: Meter):
        self._cost, self._meter = cost, meter
        self._x, self._energy = start.detach().clone(), math.inf
        self._evaluations = 0
        self._history: list[float] = []

    def evaluate(self, points: Float[Tensor, "particles n"]) -> np.ndarray | None:
        """Evaluate energies, infinite where they are not finite; None where the budget does not pay for them."""
        if not self._meter.take(len(points)):
            return None
        energies = self._cost(points.clone()).detach()
        if energies.shape != (len(points),):
            raise RequestError(f"a cost must answer energies ({len(points)},), got {tuple(energies.shape)}")
        energies = torch.where(energies.isfinite(), energies, math.inf)
        best = int(energies.argmin())
        if energies[best] < self._energy:
            self._x, self._energy = points[best].clone(), float(energies[best])
        self._evaluations += len(points)
        self._history.append(self._energy)
        return _to_numpy(energies)

    def result(self) -> SwarmResult:
        """Return the result so far."""
        return SwarmResult(self._x, self._energy, self._evaluations, tuple(self._history))


def _sample_points(
    start: Tensor, spread: Tensor | float, bounds: Bounds | None, count: float, generator: torch.Generator
) -> Float[Tensor, "count n"]:
    """Return the start and normal samples around it, inside the bounds."""
    if start.ndim != 1 or not start.is_floating_point():
        raise RequestError(f"a swarm starts from a vector of real numbers, got {tuple(start.shape)} {start.dtype}")
    noise = torch.randn(int(count), len(start), dtype=start.dtype, device=generator.device, generator=generator)
    points = start + noise.to(start.device) * spread
    points[:1] = start
    if bounds is None:
        return points
    low, high = bounds
    if not ((low <= start) & (start <= high)).all():
        raise RequestError("a swarm's start must lie within its bounds")
    return points.clamp(low, high)


def _to_numpy(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float64).numpy()


def _make_swarm(
    points: np.ndarray,
    settings: SwarmSettings,
    limits: tuple[np.ndarray, np.ndarray] | None,
    random: np.random.RandomState,
):
    with _suppress_logging_config():
        from mapctl.solver.particle_swarm import ParticleSwarm  # slow

        weights = {"w": settings.inertia, "c1": settings.cognitive, "c2": settings.social}
        return ParticleSwarm(points, weights, settings.neighbours, limits, random)


_LOGGING_LOCK = threading.Lock()


@contextmanager
def _suppress_logging_config() -> Generator[None, None, None]:
    """Suppress what pyswarms configures while it is imported or its objects are made."""
    with _LOGGING_LOCK:
        configure = logging.config.dictConfig
        logging.config.dictConfig = lambda config: None
        try:
            yield
        finally:
            logging.config.dictConfig = configure
