"""L-BFGS, the swarm and samples, and their budgets."""

import math

import numpy as np
import pytest
import torch

from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings, LbfgsStatus, differentiate, minimise
from mapctl.solver.swarm import SwarmSettings, run_swarm

TIGHT = LbfgsSettings(max_iterations=1000, relative_energy_tolerance=1e-15)
SCALE = torch.logspace(0, 4, 50, dtype=torch.float64)


def rosenbrock(x):
    return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(-1)


def beale(x):
    a, b = x.unbind(-1)
    return (1.5 - a + a * b) ** 2 + (2.25 - a + a * b**2) ** 2 + (2.625 - a + a * b**3) ** 2


def powell(x):
    a, b, c, d = x.unbind(-1)
    return (a + 10 * b) ** 2 + 5 * (c - d) ** 2 + (b - 2 * c) ** 4 + 10 * (a - d) ** 4


def quadratic(x):
    return 0.5 * (SCALE.to(x) * x * x).sum(-1)


def pairs(x):
    return beale(x[:, :2]) + beale(x[:, 2:])


def rows(*values):
    return torch.tensor([values], dtype=torch.float64)


PROBLEMS = {
    "rosenbrock": (rosenbrock, rows(*[-1.2, 1.0] * 5)),
    "beale": (beale, rows(1, 1)),
    "powell": (powell, rows(3, -1, 0, 1)),
    "quadratic": (quadratic, torch.linspace(-1, 2, 50, dtype=torch.float64)[None]),
}  # every one of them has its least energy 0


def counted(energy):
    """The function of a search, and the energies of the first row that it returned."""
    energies = []

    def function(x):
        values, gradient = differentiate(energy)(x)
        energies.append(float(values[0]))
        return values, gradient

    return function, energies


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_minimum_is_found(name):
    energy, start = PROBLEMS[name]
    result = minimise(differentiate(energy), start, settings=TIGHT)
    assert result.energy < 1e-4
    assert result.status is LbfgsStatus.CONVERGED


@pytest.mark.parametrize("name", ["beale", "powell"])
def test_single_precision_reaches_its_resolution_and_ends_there(name):
    energy, start = PROBLEMS[name]
    function, energies = counted(lambda x: energy(x) + 3000.0)  # resolution 2e-4, as of many frames
    result = minimise(function, start.float(), settings=LbfgsSettings(max_iterations=500))
    assert result.x.dtype == torch.float32
    assert result.energy < 3000.0 + 5e-2
    assert len(energies) < 400


def test_a_batch_is_minimised_by_its_sum():
    starts = torch.randn(5, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = minimise(differentiate(pairs), starts, settings=TIGHT)
    assert result.energy == pytest.approx(float(pairs(result.x).sum()))
    assert float(pairs(result.x).sum()) < float(pairs(starts).sum())


@pytest.mark.parametrize("beyond", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("of", ["energy", "gradient"])
def test_walls_are_backed_away_from(beyond, of):
    def function(x):
        value, gradient = differentiate(lambda at: (at - 2).square().sum(-1))(x)
        wall = x[:, 0] > 2.5
        if of == "energy":
            return torch.where(wall, beyond, value), gradient
        return value, torch.where(wall[:, None], beyond, gradient)

    result = minimise(function, rows(-50.0, 3.0), settings=TIGHT)
    torch.testing.assert_close(result.x, rows(2.0, 2.0), atol=1e-3, rtol=0)


def test_a_start_that_is_not_finite_is_returned_with_its_status():
    result = minimise(lambda x: (x.sum(-1) * math.nan, x * 0), rows(1.0, 2.0))
    assert result.status is LbfgsStatus.NOT_FINITE
    assert torch.equal(result.x, rows(1.0, 2.0))
    assert math.isinf(result.energy)


@pytest.mark.parametrize("seed", range(6))
def test_rugged_ground_never_ends_worse_than_it_began(seed):
    def rugged(x):
        return (x.square() + 3 * torch.sin(9 * x)).sum(-1)

    start = 3 * torch.randn(1, 6, generator=torch.Generator().manual_seed(seed))
    function, energies = counted(rugged)
    result = minimise(function, start, meter=Meter(Budget(evaluations=2 + seed)))
    assert result.energy == min(energies)
    assert result.start_energy == energies[0]
    assert result.energy == pytest.approx(float(rugged(result.x).sum()), rel=1e-5)


@pytest.mark.parametrize("limit", [0, 1, 7])
def test_evaluations_of_every_search_are_kept_to(limit):
    function, energies = counted(rosenbrock)
    meter = Meter(Budget(evaluations=limit))
    result = minimise(function, rows(-1.2, 1.0), meter=meter)
    assert len(energies) == meter.evaluations == limit
    assert result.status is LbfgsStatus.OUT_OF_BUDGET
    for settings in (SwarmSettings(), SwarmSettings(particles=9, iterations=1)):
        meter = Meter(Budget(evaluations=limit))
        found = run_swarm(sphere, start=torch.ones(3), spread=1.0, settings=settings, meter=meter, generator=seeded())
        assert found.evaluations == meter.evaluations <= limit
        assert found.energy <= (math.inf if limit == 0 else 3.0)


def test_a_deadline_is_checked_before_every_evaluation():
    now = [0.0]

    def slow(x):
        now[0] += 0.2
        return differentiate(rosenbrock)(x)

    meter = Meter(Budget(seconds=0.5), clock=lambda: now[0])
    minimise(slow, rows(-1.2, 1.0), meter=meter)
    assert meter.evaluations == 3
    assert not meter.remaining


def test_an_evaluation_that_would_end_too_late_is_not_begun():
    now = [0.0]
    meter = Meter(Budget(seconds=1.0, evaluation_seconds=0.3), clock=lambda: now[0])
    assert not meter.take(4)
    assert meter.take(2)
    now[0] = 0.8
    assert not meter.take(), "0.4 s each by now"
    late = Meter(Budget(evaluations=5, seconds=0.0), clock=lambda: now[0])
    assert not late.take()
    assert late.remaining == 0
    assert Budget(seconds=2.0).within(1.0).seconds == 1.0


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def sphere(x):
    return x.square().sum(-1)


def rastrigin(x):
    return (x.square() - 10 * torch.cos(2 * math.pi * x) + 10).sum(-1)


def test_a_swarm_descends_and_beats_samples_on_many_basins():
    settings = SwarmSettings(particles=24, iterations=50)
    start = torch.full((4,), 3.0)
    assert run_swarm(sphere, start=start, spread=1.0, settings=settings, generator=seeded()).energy < 1e-2
    flown, drawn = [], []
    for seed in range(3):
        for energies, each in ((flown, settings), (drawn, SwarmSettings(particles=1200, iterations=1))):
            found = run_swarm(rastrigin, start=start, spread=1.5, settings=each, generator=seeded(seed))
            energies.append(found.energy)
    assert np.mean(flown) < np.mean(drawn)


def test_the_same_seed_gives_the_same_swarm_and_leaves_numpy_alone():
    before = np.random.get_state()[1].copy()
    found = [run_swarm(rastrigin, start=torch.ones(3), spread=1.0, generator=seeded(2)) for _ in range(2)]
    assert torch.equal(found[0].x, found[1].x)
    assert np.array_equal(before, np.random.get_state()[1])


def test_what_is_not_finite_is_never_the_best():
    def half(x):
        return torch.where(x[:, 0] > 0, sphere(x), math.nan)

    found = run_swarm(half, start=torch.full((2,), 1.0), spread=1.0, generator=seeded())
    assert 0 <= found.energy <= 2.0
    nowhere = run_swarm(lambda x: sphere(x) * math.nan, start=torch.ones(2), spread=1.0, generator=seeded())
    assert math.isinf(nowhere.energy)
