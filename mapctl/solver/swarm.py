"""Particle swarm (Kennedy and Eberhart 1995; Wang et al. 2019, section 5.2) by pyswarms.

pyswarms' own optimisers keep every iterate, draw first velocities from [0, 1] whatever the unit, and cannot stop at a
budget; so its update rules are used, and the loop is here. Its import is slow and sets up the process's logging (and a
report.log in the working folder), which is suppressed here; its draws from numpy's global state leave that as it was.
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

from mapctl.solver.budget import Meter

_WEIGHTS = {"w": 0.7298, "c1": 1.4962, "c2": 1.4962}
"""Share of its velocity that a particle keeps, and its pull toward its own best point and the best of all: largest
factors of the difference in an iteration (the constriction of Clerc and Kennedy 2002)."""
Cost = Callable[[Tensor], Tensor]
"""Points (particles, n) to energies (particles,); what is not finite counts as infinity."""


@dataclass(frozen=True)
class SwarmSettings:
    """Size of a swarm."""

    particles: int = 16
    """Number of points evaluated at once; fewer where the budget has fewer left."""
    iterations: int = 6
    """Number of evaluations of the whole swarm; of one evaluation the best sample is the result."""


@dataclass(frozen=True, eq=False)
class SwarmResult:
    """The best point found."""

    x: Float[Tensor, " n"]
    """Best point (n,), never worse than the start."""
    energy: float
    """Energy at x; infinity where nothing finite was seen, or no evaluation was allowed (then x is the start)."""
    evaluations: int
    """Number of points evaluated."""


def run_swarm(
    cost: Cost,
    *,
    start: Float[Tensor, " n"],
    spread: Float[Tensor, " n"] | float,
    settings: SwarmSettings = SwarmSettings(),
    meter: Meter | None = None,
    generator: torch.Generator,
) -> SwarmResult:
    """Search from `start`, which is the first particle; the others begin at samples around it, all at rest.

    `spread` is the standard deviation of the samples, in units of the unknowns. The swarm stops before an iteration
    that the meter cannot pay in full. The same generator state gives the same bits.
    """
    meter = Meter() if meter is None else meter
    track = _BestTracker(cost, start, meter)
    points = _sample_points(start, spread, min(settings.particles, meter.remaining), generator)
    costs = track.evaluate(points) if len(points) else None
    if costs is None or settings.iterations < 2:
        return track.result()
    seed = torch.randint(2**32, (8,), generator=generator, device=generator.device).cpu().numpy()
    random, (operators, make_swarm) = np.random.RandomState(seed), _import_pyswarms()
    first = _to_numpy(points)
    swarm = make_swarm(first, np.zeros_like(first), options=_WEIGHTS)
    swarm.pbest_cost, swarm.best_pos, swarm.best_cost = np.full(len(first), np.inf), first[0], np.inf
    for _ in range(settings.iterations - 1):
        swarm.current_cost = costs
        swarm.pbest_pos, swarm.pbest_cost = operators.compute_pbest(swarm)
        best = int(swarm.pbest_cost.argmin())
        if swarm.pbest_cost[best] < swarm.best_cost:
            swarm.best_pos, swarm.best_cost = swarm.pbest_pos[best], swarm.pbest_cost[best]
        with _use_numpy_state(random):
            swarm.velocity = operators.compute_velocity(swarm, None, _keep_velocity)
        swarm.position = operators.compute_position(swarm, None, None)
        costs = track.evaluate(torch.as_tensor(swarm.position).to(start))
        if costs is None:
            break
    return track.result()


def _keep_velocity(velocity: np.ndarray, clamp: None, **_: object) -> np.ndarray:
    return velocity


class _BestTracker:
    """Evaluates points within the budget and keeps the best."""

    def __init__(self, cost: Cost, start: Tensor, meter: Meter):
        self._cost, self._meter = cost, meter
        self._x, self._energy = start.detach().clone(), math.inf
        self._evaluations = 0

    def evaluate(self, points: Float[Tensor, "particles n"]) -> np.ndarray | None:
        """Evaluate energies, infinite where they are not finite; None where the budget does not pay for them."""
        if not self._meter.take(len(points)):
            return None
        energies = self._cost(points.clone()).detach()
        energies = torch.where(energies.isfinite(), energies, math.inf)
        best = int(energies.argmin())
        if energies[best] < self._energy:
            self._x, self._energy = points[best].clone(), float(energies[best])
        self._evaluations += len(points)
        return _to_numpy(energies)

    def result(self) -> SwarmResult:
        """Return the result so far."""
        return SwarmResult(self._x, self._energy, self._evaluations)


def _sample_points(
    start: Tensor, spread: Tensor | float, count: float, generator: torch.Generator
) -> Float[Tensor, "count n"]:
    """Return the start and normal samples around it."""
    noise = torch.randn(int(count), len(start), dtype=start.dtype, device=generator.device, generator=generator)
    points = start + noise.to(start.device) * spread
    points[:1] = start
    return points


def _to_numpy(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float64).numpy()


_LOGGING_LOCK = threading.Lock()


def _import_pyswarms() -> tuple[Any, Any]:
    """Import pyswarms' update rules and its swarm, without what it configures at import."""
    with _LOGGING_LOCK:
        configure = logging.config.dictConfig
        logging.config.dictConfig = lambda config: None
        try:
            from pyswarms.backend import operators  # pyright: ignore[reportMissingTypeStubs]
            from pyswarms.backend.swarms import Swarm  # pyright: ignore[reportMissingTypeStubs]
        finally:
            logging.config.dictConfig = configure
    return operators, Swarm


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
