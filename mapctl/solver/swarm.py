"""Particle swarm (Kennedy and Eberhart 1995; Wang et al. 2019, section 5.2) by pyswarms, and a baseline of samples.

pyswarms' own optimisers keep every iterate, draw first velocities from [0, 1] whatever the unit, and cannot stop at a
budget; so its swarm, topologies and update rules are used, and the loop is here. Two more habits are contained: it sets
up the process's logging (and a report.log in the working folder) at import and at every object made, and it draws from
numpy's global random state.
"""

import logging.config
import math
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

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
    """Pull toward the particle's own best point."""
    social: float = 1.4962
    """Pull toward the best point among its neighbours."""
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

    `spread` is the standard deviation of the samples, in units of the unknowns. The swarm stops before an iteration
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
    flight = _ParticleSwarm(_to_numpy(points), settings, limits, np.random.RandomState(seed))
    for iteration in range(settings.iterations):
        if iteration:
            flight.move()
        energies = track.evaluate(torch.as_tensor(flight.positions).to(start))
        if energies is None:
            break
        flight.learn(energies)
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

    Arguments and errors as in `swarm`, which it is held against.
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


class _ParticleSwarm:
    """pyswarms' swarm and topology."""

    def __init__(self, points: np.ndarray, settings: SwarmSettings, bounds: Any, random: np.random.RandomState):
        self._random, self._bounds = random, bounds
        with _suppress_logging_config():
            from pyswarms.backend.handlers import BoundaryHandler, VelocityHandler  # pyright: ignore[reportMissingTypeStubs]
            from pyswarms.backend.swarms import Swarm  # pyright: ignore[reportMissingTypeStubs]
            from pyswarms.backend.topology import Ring, Star  # pyright: ignore[reportMissingTypeStubs]

            self._boundary_handler, self._velocity_handler = BoundaryHandler("nearest"), VelocityHandler("unmodified")
            self._topology: Any = Star() if settings.neighbours is None else Ring(static=False)
        self._topology_options = (
            {} if settings.neighbours is None else {"p": 2, "k": min(settings.neighbours, len(points))}
        )
        weights = {"w": settings.inertia, "c1": settings.cognitive, "c2": settings.social}
        self._swarm: Any = Swarm(points, np.zeros_like(points), options=weights)  # pyright: ignore[reportCallIssue]
        self._swarm.pbest_cost = np.full(len(points), np.inf)
        self._swarm.best_pos = points[0]  # until a finite energy is seen, which may be never

    @property
    def positions(self) -> np.ndarray:
        """(particles, n)"""
        return self._swarm.position

    def learn(self, energies: np.ndarray):
        """Take the energies at the positions in."""
        from pyswarms.backend import operators  # pyright: ignore[reportMissingTypeStubs]

        self._swarm.current_cost = energies
        self._swarm.pbest_pos, self._swarm.pbest_cost = operators.compute_pbest(self._swarm)  # pyright: ignore[reportUnknownMemberType]
        self._swarm.best_pos, self._swarm.best_cost = self._topology.compute_gbest(
            self._swarm, **self._topology_options
        )

    def move(self):
        """Move the particles; return new velocities and positions."""
        with _use_numpy_state(self._random):
            self._swarm.velocity = self._topology.compute_velocity(
                self._swarm, None, self._velocity_handler, self._bounds
            )
        self._swarm.position = self._topology.compute_position(self._swarm, self._bounds, self._boundary_handler)


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


@contextmanager
def _use_numpy_state(random: np.random.RandomState) -> Generator[None, None, None]:
    """Use `random` for numpy's global draws within, and move it on; afterwards the global state is as it was."""
    before = np.random.get_state()
    np.random.set_state(random.get_state())
    try:
        yield
    finally:
        random.set_state(np.random.get_state())
        np.random.set_state(before)
