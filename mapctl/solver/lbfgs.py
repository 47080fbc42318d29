"""Limited-memory BFGS for a batch of independent problems (Nocedal and Wright 2006, chapter 7).

Every problem is a coroutine of its own: it yields a point and is sent the energy and gradient there. The driver stacks
the points, evaluates the batch once and hands the rows out. Problems so share evaluations and nothing else: a problem
walks the same path, to the bit, whatever it is stacked with. Vectors live on the CPU in double precision (they are
small beside an evaluation); points are rounded to the caller's precision, so that steps are differences of evaluated
points.
"""

import math
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.solver.budget import Meter

_ARMIJO, _CURVATURE = 1e-4, 0.9
"""Share of the slope's predicted decrease that a step must keep, and of the starting slope that may be left at its end
(the weak Wolfe conditions of Nocedal and Wright 2006, section 3.1)."""
Vector = NDArray[np.float64]
Point = NDArray[np.floating[Any]]
"""In the caller's precision."""
EnergyAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Points (batch, n) to energies (batch,) and gradients (batch, n); row i of a call is always problem i."""


class LbfgsStatus(Enum):
    """Why a problem ended; the value is text."""

    CONVERGED = "converged"
    STALLED = "stalled"
    OUT_OF_BUDGET = "out of budget"
    NOT_FINITE = "not finite"


@dataclass(frozen=True)
class LbfgsSettings:
    """How the search goes and when it ends."""

    memory: int = 10
    """Number of curvature pairs kept."""
    max_iterations: int = 100
    """Largest number of accepted steps; beyond them a problem is out of budget."""
    gradient_tolerance: float = 1e-3
    """Converged where no entry of the gradient is larger, energy per unit of the unknowns."""
    relative_energy_tolerance: float = 1e-6
    """Energy tolerance: converged where a step wins less than this share of `max(|energy|, 1)`."""
    max_trials: int = 12
    """Largest number of trial steps in one line search."""


@dataclass(frozen=True, eq=False)
class LbfgsResult:
    """The best finite point of each problem; the start where nothing was finite."""

    x: Float[Tensor, "batch n"]
    """Best points (batch, n), never worse than the start."""
    energy: Float[Tensor, " batch"]
    """Energies at x; infinity where no evaluation was finite, or none was allowed."""
    start_energy: Float[Tensor, " batch"]
    """Energies at the start; infinity where it was not finite, or not evaluated."""
    evaluations: Int[Tensor, " batch"]
    """Evaluations while the problem was running; the meter also counts the idle rows of finished problems."""
    status: tuple[LbfgsStatus, ...]
    """Reason why each problem ended."""


def minimise(
    function: EnergyAndGradient,
    x: Float[Tensor, "batch n"],
    *,
    settings: LbfgsSettings = LbfgsSettings(),
    meter: Meter | None = None,
) -> LbfgsResult:
    """Minimise a batch of independent problems from `x`, evaluating the whole batch at once.

    The meter is asked before every evaluation; each counts the batch. A trial with an energy or gradient that is not
    finite has failed. RequestError where `x` is not a float32 or float64 matrix, or the function returns other shapes.
    """
    if x.ndim != 2 or x.dtype not in (torch.float32, torch.float64):
        raise RequestError(f"L-BFGS starts from (batch, n) float32 or float64, got {tuple(x.shape)} {x.dtype}")
    meter = Meter() if meter is None else meter
    problems = [_Problem(row, settings) for row in x.detach().cpu().numpy().copy()]
    while any(problem.running for problem in problems) and meter.take(len(problems)):
        energy, gradient = function(torch.as_tensor(np.stack([problem.ask for problem in problems])).to(x.device))
        if energy.shape != x.shape[:1] or gradient.shape != x.shape:
            raise RequestError(f"an objective returned {tuple(energy.shape)} and {tuple(gradient.shape)} for {x.shape}")
        energies, gradients = (
            [float(each) for each in energy.detach()],
            gradient.detach().to("cpu", torch.float64).numpy(),
        )
        for problem, value, row in zip(problems, energies, gradients, strict=True):
            problem.receive(value, row)
    return LbfgsResult(
        x=torch.as_tensor(np.stack([problem.best.x for problem in problems])).to(x.device) if problems else x.clone(),
        energy=x.new_tensor([problem.best.energy for problem in problems]),
        start_energy=x.new_tensor([problem.start_energy for problem in problems]),
        evaluations=torch.tensor([problem.evaluations for problem in problems], dtype=torch.int64),
        status=tuple(problem.status for problem in problems),
    )


@dataclass(slots=True)
class _EvaluatedPoint:
    """An evaluated point; of a line search, how far along it lies and the slope there."""

    x: Point
    energy: float
    gradient: Vector
    step: float = 0.0
    slope: float = 0.0
    gradient_norm: float = field(init=False)

    def __post_init__(self):
        self.gradient_norm = float(np.abs(self.gradient).max(initial=0.0))

    @property
    def finite(self) -> bool:
        return math.isfinite(self.energy) and math.isfinite(self.gradient_norm)


class _Problem:
    """One problem's search, its best point and its count."""

    def __init__(self, start: Point, settings: LbfgsSettings):
        self.settings = settings
        self.evaluations = self.iterations = 0
        self.start_energy = math.inf
        self.status = LbfgsStatus.OUT_OF_BUDGET  # what it is until the search itself comes to an end
        self.best = _EvaluatedPoint(start, math.inf, np.full(start.shape, math.inf))
        self.running = True
        self._search = self._descend(start)
        self.ask = next(self._search)

    def receive(self, energy: float, gradient: Vector):
        """Take the evaluation of `ask`; a finished problem ignores it."""
        if not self.running:
            return
        self.evaluations += 1
        point = _EvaluatedPoint(self.ask, energy, gradient)
        if energy < self.best.energy and point.finite:
            self.best = point
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is seen to be not finite, and refused
                self.ask = self._search.send(point)
        except StopIteration as stop:
            self.running, self.status, self.ask = False, stop.value, self.best.x

    def _descend(self, start: Point) -> Generator[Point, _EvaluatedPoint, LbfgsStatus]:
        settings, pairs = self.settings, _CurvaturePairs(self.settings.memory)
        here = yield start
        if not here.finite:
            return LbfgsStatus.NOT_FINITE
        self.start_energy = here.energy
        length = min(1.0, float(np.linalg.norm(here.gradient)))
        while here.gradient_norm > settings.gradient_tolerance:
            if self.iterations == settings.max_iterations:
                return LbfgsStatus.OUT_OF_BUDGET
            direction, first = _descent_direction(here, pairs, length)
            found = yield from _line_search(here, direction, first, settings)
            if found is None:
                if not pairs:
                    return LbfgsStatus.STALLED
                pairs.clear()  # the model misleads: one more try along the gradient
                continue
            guessed = not pairs  # a first step's length is a guess, so how little it wins does not count
            won, scale = here.energy - found.energy, max(abs(here.energy), abs(found.energy), 1.0)
            step = found.x.astype(np.float64) - here.x
            length = float(np.linalg.norm(step))
            pairs.learn(step, found.gradient - here.gradient)
            here, self.iterations = found, self.iterations + 1
            if won <= settings.relative_energy_tolerance * scale and not guessed:
                return LbfgsStatus.CONVERGED
        return LbfgsStatus.CONVERGED


class _CurvaturePairs:
    """Curvature pairs and the inverse Hessian they stand for."""

    def __init__(self, memory: int):
        self._pairs: deque[tuple[Vector, Vector, float]] = deque(maxlen=memory)

    def __len__(self) -> int:
        return len(self._pairs)

    def clear(self):
        """Forget all."""
        self._pairs.clear()

    def learn(self, step: Vector, change: Vector):
        """Keep a pair, unless its curvature is too small to divide by."""
        product, size = float(step @ change), float(change @ change)
        if np.finfo(np.float64).eps * size < product < math.inf:
            self._pairs.append((step, change, product))

    def apply(self, gradient: Vector) -> Vector:
        """Apply the inverse Hessian to the gradient: two-loop recursion (Nocedal and Wright 2006, algorithm 7.4)."""
        result = gradient.copy()
        weights: list[float] = []
        for step, change, product in reversed(self._pairs):
            weights.append(float(step @ result) / product)
            result -= weights[-1] * change
        _, change, product = self._pairs[-1]
        result *= product / float(change @ change)  # size of the newest curvature (their equation 7.20)
        for (step, change, product), weight in zip(self._pairs, reversed(weights), strict=True):
            result += (weight - float(change @ result) / product) * step
        return result


def _descent_direction(here: _EvaluatedPoint, pairs: _CurvaturePairs, length: float) -> tuple[Vector, float]:
    """Return a descent direction and the first step along it; without a model, one of the given length."""
    if pairs:
        direction = -pairs.apply(here.gradient)
        if -math.inf < direction @ here.gradient < 0:
            return direction, 1.0
        pairs.clear()
    return -here.gradient, length / float(np.linalg.norm(here.gradient))


def _line_search(
    origin: _EvaluatedPoint, direction: Vector, first: float, settings: LbfgsSettings
) -> Generator[Point, _EvaluatedPoint, _EvaluatedPoint | None]:
    """Find a point with enough decrease and enough curvature for a pair (weak Wolfe); None where no trial gains.


    `low` is the best step so far that decreases enough, `high` the shortest known to be too long.
    """
    slope = float(direction @ origin.gradient)
    # Energies are rounded to the caller's precision: a rise within that does not count.
    noise = 2.0 * float(np.finfo(origin.x.dtype).eps) * abs(origin.energy)
    low = base = _EvaluatedPoint(origin.x, origin.energy, origin.gradient, 0.0, slope)
    high: _EvaluatedPoint | None = None
    step = first
    for _ in range(settings.max_trials):
        x = (origin.x + step * direction).astype(origin.x.dtype)
        if np.array_equal(x, low.x):
            break  # the bracket is below the precision of the unknowns
        trial = yield x
        trial.step, trial.slope = step, float(direction @ trial.gradient)
        if not trial.finite or trial.energy > base.energy + _ARMIJO * step * slope + noise:
            high = trial
        elif trial.slope >= _CURVATURE * slope:
            return trial
        else:
            low = trial
        step = _next_step(low, high)
    return low if low is not base else None


def _next_step(low: _EvaluatedPoint, high: _EvaluatedPoint | None) -> float:
    """Choose a step within the bracket by cubic interpolation, kept off its ends; beyond `low` if none is too long."""
    if high is None:
        return 4.0 * low.step
    width = high.step - low.step
    if not high.finite:
        return low.step + 0.2 * width
    return low.step + min(max(_cubic_minimum(low, high), 0.1 * width), 0.8 * width)


def _cubic_minimum(a: _EvaluatedPoint, b: _EvaluatedPoint) -> float:
    """Return the minimum, from a, of the cubic with the energies and slopes of both (Nocedal and Wright 2006, Eq.
    3.59)."""
    width = b.step - a.step
    bend = a.slope + b.slope - 3.0 * (b.energy - a.energy) / width
    square = bend * bend - a.slope * b.slope
    if not 0.0 <= square < math.inf:
        return 0.5 * width
    root = math.sqrt(square)
    denominator = b.slope - a.slope + 2.0 * root
    return width * (1.0 - (b.slope + root - bend) / denominator) if denominator else 0.5 * width


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
