"""L-BFGS of scipy over torch objectives, within a budget (Nocedal and Wright 2006, chapter 7)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy import optimize  # pyright: ignore[reportMissingTypeStubs]
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.solver.budget import Meter

_minimize: Any = optimize.minimize  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
_MEMORY, _TRIALS = 10, 12  # curvature pairs that are kept, and trial steps in one line search
_LARGEST_SLOPE = 1e-3  # entry of a gradient from which on a point is no minimum, energy per unit of the unknowns
_REFUSED = 1e3  # energy of a point that is not finite, over that of the start: the line search turns back there
EnergyAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Points (batch, n) to energies (batch,) and gradients (batch, n)."""


class LbfgsStatus(Enum):
    """Why a search ended; the value is text."""

    CONVERGED = "converged"
    STALLED = "stalled"
    OUT_OF_BUDGET = "out of budget"
    NOT_FINITE = "not finite"


_ENDS = (LbfgsStatus.CONVERGED, LbfgsStatus.OUT_OF_BUDGET, LbfgsStatus.STALLED)
"""What scipy's statuses mean."""


@dataclass(frozen=True)
class LbfgsSettings:
    """When a search ends."""

    max_iterations: int = 100
    """Largest number of accepted steps; beyond them it is out of budget."""
    relative_energy_tolerance: float = 1e-6
    """Energy tolerance: converged where a step wins less than this share of `max(|energy|, 1)`."""


@dataclass(frozen=True, eq=False)
class LbfgsResult:
    """The best finite point; the start where nothing was finite."""

    x: Float[Tensor, "batch n"]
    """Best point, never worse than the start."""
    energy: float
    """Energy at x; infinity where no evaluation was finite, or none was allowed."""
    start_energy: float
    """Energy at the start; infinity where it was not finite, or not evaluated."""
    status: LbfgsStatus
    """Reason why it ended."""


class _Ended(Exception):
    """End of a search before scipy ends it."""

    def __init__(self, status: LbfgsStatus):
        super().__init__(status.value)
        self.status = status


class _Search:
    """Evaluates points of one search within the budget, keeps the best, and ends it where little is won."""

    def __init__(self, function: EnergyAndGradient, x: Float[Tensor, "batch n"], tolerance: float, meter: Meter):
        self._function, self._tolerance, self._meter = function, tolerance, meter
        self.x, self.energy, self.start_energy = x, math.inf, math.inf
        self._last: float | None = None

    def evaluate(self, unknowns: Float[ndarray, " all"]) -> tuple[float, Float[ndarray, " all"]]:
        """Evaluate a point, rounded to the precision of the start."""
        if not self._meter.take(len(self.x)):
            raise _Ended(LbfgsStatus.OUT_OF_BUDGET)
        point = torch.as_tensor(unknowns).to(self.x).view_as(self.x)
        energies, gradient = self._function(point)
        if energies.shape != point.shape[:1] or gradient.shape != point.shape:
            raise RequestError(
                f"an objective returned {tuple(energies.shape)} and {tuple(gradient.shape)} for {tuple(point.shape)}"
            )
        energy, slope = float(energies.double().sum()), gradient.detach().to("cpu", torch.float64).flatten().numpy()
        if not (math.isfinite(energy) and bool(np.isfinite(slope).all())):
            if math.isinf(self.start_energy):
                raise _Ended(LbfgsStatus.NOT_FINITE)
            return self.start_energy + _REFUSED * max(abs(self.start_energy), 1.0), np.zeros_like(slope)
        if math.isinf(self.start_energy):
            self.start_energy = energy
        if energy < self.energy:
            self.x, self.energy = point.detach(), energy
        return energy, slope

    def accept(self, intermediate_result: Any) -> None:
        """End the search where an accepted step wins too little, but for the first, whose length is a guess."""
        last, now = self._last, float(intermediate_result.fun)
        self._last = now
        if last is not None and last - now <= self._tolerance * max(abs(last), abs(now), 1.0):
            raise _Ended(LbfgsStatus.CONVERGED)


def minimise(
    function: EnergyAndGradient,
    x: Float[Tensor, "batch n"],
    *,
    settings: LbfgsSettings = LbfgsSettings(),
    meter: Meter | None = None,
) -> LbfgsResult:
    """Minimise the summed energy of a batch of points from `x`.

    The meter is asked before every evaluation; each counts the batch. RequestError where `x` is not a float32 or
    float64 matrix, or the function returns other shapes.
    """
    if x.ndim != 2 or x.dtype not in (torch.float32, torch.float64):
        raise RequestError(f"L-BFGS starts from (batch, n) float32 or float64, got {tuple(x.shape)} {x.dtype}")
    search = _Search(function, x.detach(), settings.relative_energy_tolerance, meter or Meter())
    options = {
        "maxiter": settings.max_iterations,
        "maxcor": _MEMORY,
        "maxls": _TRIALS,
        "gtol": _LARGEST_SLOPE,
        "ftol": 0,
    }
    start = x.detach().to("cpu", torch.float64).flatten().numpy()
    try:
        found = _minimize(search.evaluate, start, jac=True, method="L-BFGS-B", callback=search.accept, options=options)
        status = LbfgsStatus(_ENDS[found.status])
    except _Ended as ended:
        status = ended.status
    return LbfgsResult(search.x, search.energy, search.start_energy, status)


def differentiate(
    energy: Callable[[Float[Tensor, "batch n"]], Float[Tensor, " batch"]],
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return a function that gives the energies of a batch of points and their gradients (batch, n) by reverse-mode
    differentiation, both detached; the points are independent of each other.
    """

    def evaluate(points: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_(True)
        energies = energy(points)
        (gradient,) = torch.autograd.grad(energies.sum(), points)
        return energies.detach(), gradient

    return evaluate
