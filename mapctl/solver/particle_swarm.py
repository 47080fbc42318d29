"""The swarm of pyswarms, whose import is slow and sets up logging: `mapctl.solver.swarm` imports this module late.

pyswarms draws from numpy's global random state, which is left here as it was.
"""

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from pyswarms.backend import operators  # pyright: ignore[reportMissingTypeStubs]
from pyswarms.backend.handlers import BoundaryHandler, VelocityHandler  # pyright: ignore[reportMissingTypeStubs]
from pyswarms.backend.swarms import Swarm  # pyright: ignore[reportMissingTypeStubs]
from pyswarms.backend.topology import Ring, Star  # pyright: ignore[reportMissingTypeStubs]


class ParticleSwarm:
    """Swarm and topology of pyswarms, one step at a time."""

    def __init__(
        self,
        points: np.ndarray,
        weights: Mapping[str, float],
        neighbours: int | None,
        bounds: tuple[np.ndarray, np.ndarray] | None,
        random: np.random.RandomState,
    ):
        """Start at rest at the points (particles, n). `weights` are inertia `w` and the pulls `c1` and `c2` toward a
        particle's own best point and the best of its `neighbours` (None: of all); draws come from `random`."""
        self._random, self._bounds = random, bounds
        self._boundary_handler, self._velocity_handler = BoundaryHandler("nearest"), VelocityHandler("unmodified")
        self._topology: Any = Star() if neighbours is None else Ring(static=False)
        self._topology_options = {} if neighbours is None else {"p": 2, "k": min(neighbours, len(points))}
        self._swarm: Any = Swarm(points, np.zeros_like(points), options=weights)  # pyright: ignore[reportCallIssue]
        self._swarm.pbest_cost = np.full(len(points), np.inf)
        self._swarm.best_pos = points[0]  # until a finite energy is seen, which may be never

    @property
    def positions(self) -> np.ndarray:
        """Points of the particles, (particles, n)."""
        return self._swarm.position

    def learn(self, energies: np.ndarray):
        """Update the best points, of each particle and of its neighbours, by the energies (particles,)."""
        self._swarm.current_cost = energies
        self._swarm.pbest_pos, self._swarm.pbest_cost = operators.compute_pbest(self._swarm)  # pyright: ignore[reportUnknownMemberType]
        self._swarm.best_pos, self._swarm.best_cost = self._topology.compute_gbest(
            self._swarm, **self._topology_options
        )

    def move(self):
        """Move the particles by new velocities."""
        with _use_numpy_state(self._random):
            self._swarm.velocity = self._topology.compute_velocity(
                self._swarm, None, self._velocity_handler, self._bounds
            )
        self._swarm.position = self._topology.compute_position(self._swarm, self._bounds, self._boundary_handler)


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
