"""L-BFGS on textbook functions: minima, cost beside scipy's, independence, walls, budgets."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import EnergyAndGradient, LbfgsResult, LbfgsSettings, LbfgsStatus, minimise

Energy = Callable[[Tensor], Tensor]
TIGHT = LbfgsSettings(max_iterations=1000, gradient_tolerance=1e-9, relative_energy_tolerance=1e-15)


def with_gradient(energy: Energy) -> EnergyAndGradient:
    """An energy of rows, and its gradient by autograd."""

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        x = x.clone().requires_grad_()
        value = energy(x)
        value.sum().backward()
        assert x.grad is not None
        return value, x.grad

    return function


def rosenbrock(x: Tensor) -> Tensor:
    return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(-1)


def beale(x: Tensor) -> Tensor:
    a, b = x.unbind(-1)
    return (1.5 - a + a * b) ** 2 + (2.25 - a + a * b**2) ** 2 + (2.625 - a + a * b**3) ** 2


def powell(x: Tensor) -> Tensor:
    a, b, c, d = x.unbind(-1)
    return (a + 10 * b) ** 2 + 5 * (c - d) ** 2 + (b - 2 * c) ** 4 + 10 * (a - d) ** 4


def wood(x: Tensor) -> Tensor:
    a, b, c, d = x.unbind(-1)
    return (
        100 * (a**2 - b) ** 2
        + (a - 1) ** 2
        + (c - 1) ** 2
        + 90 * (c**2 - d) ** 2
        + 10.1 * ((b - 1) ** 2 + (d - 1) ** 2)
        + 19.8 * (b - 1) * (d - 1)
    )


def himmelblau(x: Tensor) -> Tensor:
    a, b = x.unbind(-1)
    return (a**2 + b - 11) ** 2 + (a + b**2 - 7) ** 2


def quadratic(condition: float, size: int = 50) -> Energy:
    scale = torch.logspace(0, math.log10(condition), size, dtype=torch.float64)
    return lambda x: 0.5 * (scale.to(x) * x * x).sum(-1)


def rows(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def alternating(size: int) -> Tensor:
    return rows(*([-1.2, 1.0] * size)[:size])


PROBLEMS: dict[str, tuple[Energy, Tensor]] = {
    **{f"rosenbrock-{n}": (rosenbrock, alternating(n)) for n in (2, 3, 5, 10, 20)},
    "beale": (beale, rows(1, 1)),
    "powell": (powell, rows(3, -1, 0, 1)),
    "wood": (wood, rows(-3, -1, -3, -1)),
    "himmelblau": (himmelblau, rows(0, 0)),
    "quadratic-1e2": (quadratic(1e2), torch.linspace(-1, 2, 50, dtype=torch.float64)[None]),
    "quadratic-1e4": (quadratic(1e4), torch.linspace(-1, 2, 50, dtype=torch.float64)[None]),
}  # every one of them has its least energy 0


def curve_of(function: EnergyAndGradient, start: Tensor, options: LbfgsSettings) -> tuple[list[float], LbfgsResult]:
    """Best energies of a single problem after each evaluation, and the result."""
    energies: list[float] = []
    result = minimise(function, start, settings=options, callback=lambda _, best: energies.append(float(best[0])))
    return energies, result


@pytest.mark.parametrize("name", PROBLEMS)
def test_minimum_is_found_at_no_more_than_scipys_cost(name: str):
    energy, start = PROBLEMS[name]
    function, theirs = with_gradient(energy), []

    def of_scipy(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = function(torch.from_numpy(x)[None])
        theirs.append(float(value[0].detach()))
        return theirs[-1], gradient[0].numpy()

    options = {"maxcor": 10, "ftol": 1e-15, "gtol": 1e-9, "maxfun": 5000, "maxiter": 5000}
    scipy.optimize.minimize(of_scipy, start[0].numpy(), jac=True, method="L-BFGS-B", options=options)
    ours, result = curve_of(function, start, TIGHT)
    assert result.energy[0] < 1e-8
    assert result.status == (LbfgsStatus.CONVERGED,)
    for level in (1e-3, 1e-8):
        count, bar = (next(i for i, e in enumerate(curve, 1) if e <= level) for curve in (ours, theirs))
        assert count <= 1.5 * bar


@pytest.mark.parametrize("name", ["beale", "powell", "himmelblau", "quadratic-1e2", "quadratic-1e4"])
def test_single_precision_reaches_its_resolution_and_ends_there(name: str):
    energy, start = PROBLEMS[name]
    shifted = with_gradient(lambda x: energy(x) + 3000.0)  # resolution 2e-4, as of many frames
    options = LbfgsSettings(max_iterations=1000, gradient_tolerance=0.0, relative_energy_tolerance=0.0)
    curve, result = curve_of(shifted, start.float(), options)
    assert result.x.dtype == result.energy.dtype == torch.float32
    assert result.energy[0] <= 3000.0 * (1 + 3e-5)
    assert result.status[0] is not LbfgsStatus.OUT_OF_BUDGET
    assert len(curve) - curve.index(curve[-1]) <= 6  # no long search for a gain that cannot be seen


@pytest.mark.parametrize("name", sorted(set(PROBLEMS) - {"wood"}))  # whose saddle may pass for its end
def test_first_step_far_too_short_costs_little_and_is_not_taken_for_the_end(name: str):
    energy, start = PROBLEMS[name]
    function = with_gradient(lambda x: energy(x) + 1.0)
    usual = minimise(function, start, settings=replace(TIGHT, relative_energy_tolerance=1e-9))
    for length, extra in ((1e-4, 20), (1e-12, 60)):
        options = replace(TIGHT, relative_energy_tolerance=1e-9, initial_step=length)
        result = minimise(function, start, settings=options)
        assert result.energy[0] < 1.0001
        assert result.status == (LbfgsStatus.CONVERGED,)
        assert result.evaluations[0] <= usual.evaluations[0] * 1.25 + extra


def test_little_won_by_a_guessed_step_is_not_the_end():
    options = LbfgsSettings(initial_step=1e-9, max_trials=1)
    result = minimise(with_gradient(quadratic(10, 3)), rows(1, 1, 1), settings=options)
    assert result.energy[0] < 1e-4


def test_where_the_curvature_model_misleads_the_gradient_is_tried_again():
    """Finite only along the gradient of the best point so far: steps by curvature pairs all fail."""
    scales = torch.tensor([1.0, 3.0], dtype=torch.float64)
    best = {"x": torch.tensor([[2.0, 1.0]], dtype=torch.float64), "energy": torch.tensor([math.inf])}

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        energy, gradient = with_gradient(lambda x: 0.5 * (scales * x**2).sum(-1))(x)
        step, downhill = (x - best["x"])[0], (scales * best["x"])[0]
        if abs(step[0] * downhill[1] - step[1] * downhill[0]) > 1e-9 * step.norm():
            return torch.full_like(energy, math.inf), gradient
        if energy < best["energy"]:
            best.update(x=x.clone(), energy=energy)
        return energy, gradient

    found = minimise(function, best["x"].clone(), settings=replace(TIGHT, gradient_tolerance=1e-3))
    assert found.status == (LbfgsStatus.CONVERGED,)
    assert float(found.energy) < 1e-5


def test_problems_in_a_batch_are_those_alone_to_the_bit():
    # Of very different size, starts and lengths; one ends at once, one is never finite.
    scales = torch.tensor([1.0, 1e-4, 1e6, 1.0, 1.0], dtype=torch.float64)
    near, never = torch.ones(1, 6), torch.full((1, 6), math.nan)
    starts = torch.cat([alternating(6), alternating(6) * 3, alternating(6) / 5, near, never])

    def of(chosen: list[int]) -> EnergyAndGradient:
        single = with_gradient(rosenbrock)

        def function(x: Tensor) -> tuple[Tensor, Tensor]:  # by rows, so that its own sums know no batch
            each = [single(row[None]) for row in x]
            factor = scales[chosen]
            return torch.cat([e for e, _ in each]) * factor, torch.cat([g for _, g in each]) * factor[:, None]

        return function

    together = minimise(of([0, 1, 2, 3, 4]), starts, settings=TIGHT)
    assert len(set(together.iterations.tolist())) > 3
    for i in range(5):
        alone = minimise(of([i]), starts[i : i + 1], settings=TIGHT)
        assert torch.equal(alone.x.nan_to_num(7), together.x[i : i + 1].nan_to_num(7))
        assert torch.equal(alone.energy, together.energy[i : i + 1])
        assert torch.equal(alone.evaluations, together.evaluations[i : i + 1])
        assert torch.equal(alone.iterations, together.iterations[i : i + 1])
        assert alone.status == together.status[i : i + 1]


@pytest.mark.parametrize("beyond", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("spoilt", ["energy", "gradient"])
def test_walls_are_backed_away_from(beyond: float, spoilt: str):
    def function(x: Tensor) -> tuple[Tensor, Tensor]:  # least at 0.01, close to a wall at 0
        inside = (x > 0).all(-1)
        safe = x.clamp_min(1e-12)
        energy, gradient = (safe - 0.01 * safe.log()).sum(-1), 1 - 0.01 / safe
        wall = torch.full_like(x, beyond)
        if spoilt == "energy":
            return torch.where(inside, energy, beyond), gradient
        return torch.where(inside, energy, -1e9), torch.where(inside[:, None], gradient, wall)

    result = minimise(function, torch.full((1, 4), 3.0, dtype=torch.float64), settings=TIGHT)
    assert (result.x - 0.01).abs().max() < 1e-6
    assert result.status == (LbfgsStatus.CONVERGED,)


def test_start_that_is_not_finite_is_said_and_handed_back():
    start = rows(2, 3)
    for energy, slope in ((math.nan, 1.0), (1.0, math.inf)):
        result = minimise(lambda x, e=energy, s=slope: (x.new_tensor([e]), x.new_tensor([[s, s]])), start)
        assert result.status == (LbfgsStatus.NOT_FINITE,)
        assert result.evaluations.tolist() == [1]
        assert torch.equal(result.x, start)
        assert result.energy.isinf().all()
        assert result.start_energy.isinf().all()


@settings(max_examples=40)
@given(seed=st.integers(0, 2**16), limit=st.integers(1, 40), single=st.booleans())
def test_rugged_ground_never_ends_worse_and_names_the_energy_of_its_point(seed: int, limit: int, single: bool):
    dtype = torch.float32 if single else torch.float64
    function = with_gradient(lambda x: (x**2 + 3 * torch.sin(20 * x)).sum(-1) + torch.log(30 - x.abs().sum(-1)))
    start = 2 * torch.randn(3, 5, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    result = minimise(function, start, meter=Meter(Budget(evaluations=3 * limit)))
    energy, gradient = function(result.x)
    assert torch.equal(energy, result.energy)
    assert torch.equal(gradient.abs().amax(-1), result.gradient_norm)
    assert torch.equal(function(start)[0], result.start_energy)
    assert (result.energy <= result.start_energy).all()


@pytest.mark.parametrize("batch", [1, 3])
def test_evaluations_are_kept_to_exactly_and_the_best_is_returned(batch: int):
    single = with_gradient(rosenbrock)
    for limit in range(0, 40, 3):
        seen: list[Tensor] = []

        def function(x: Tensor, seen: list[Tensor] = seen) -> tuple[Tensor, Tensor]:
            energy, gradient = single(x)
            seen.append(energy.detach())
            return energy, gradient

        meter = Meter(Budget(evaluations=limit))
        start = alternating(10).expand(batch, -1)
        result = minimise(function, start, settings=TIGHT, meter=meter)
        assert len(seen) == limit // batch
        assert meter.evaluations == batch * len(seen)
        assert result.status == (LbfgsStatus.OUT_OF_BUDGET,) * batch
        best = torch.stack(seen).amin(0) if seen else torch.full((batch,), math.inf, dtype=torch.float64)
        assert torch.equal(result.energy, best)
        assert bool(seen) or torch.equal(result.x, start)


def test_deadline_is_checked_before_every_evaluation():
    now = [0.0]
    meter, single = Meter(Budget(seconds=0.5), clock=lambda: now[0]), with_gradient(rosenbrock)

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        assert now[0] < 0.5
        now[0] += 0.125
        return single(x)

    result = minimise(function, alternating(10), settings=TIGHT, meter=meter)
    assert result.evaluations.tolist() == [4]
    assert result.status == (LbfgsStatus.OUT_OF_BUDGET,)


def test_first_step_and_longest_step_have_the_lengths_asked_for():
    points: list[Tensor] = []

    def function(x: Tensor) -> tuple[Tensor, Tensor]:
        points.append(x[0].clone())
        return 0.5 * (x**2).sum(-1), x

    minimise(function, rows(30, 40), settings=LbfgsSettings(initial_step=0.5, max_step=2.0))
    lengths = torch.stack(points).diff(dim=0).norm(dim=-1)
    assert lengths[0].item() == pytest.approx(0.5)
    assert lengths.max() <= 2.0 + 1e-9
    assert lengths.sum().item() == pytest.approx(50, abs=2.0)
