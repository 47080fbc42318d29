"""The particle swarm on textbook functions, and that pyswarms' habits stay inside the adapter."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from mapctl.solver.budget import Budget, Meter
from mapctl.solver.swarm import SwarmSettings, run_best_of_samples, run_swarm


def sphere(x: Tensor) -> Tensor:
    return (x**2).sum(-1)


def rastrigin(x: Tensor) -> Tensor:
    return (x**2 - 10 * torch.cos(2 * math.pi * x) + 10).sum(-1)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_sphere_is_descended():
    options = SwarmSettings(particles=20, iterations=60)
    start = torch.full((6,), 2.0, dtype=torch.float64)
    found = run_swarm(sphere, start=start, spread=1.0, settings=options, generator=seeded())
    assert found.energy < 0.05
    assert found.evaluations == 1200
    assert len(found.history) == 60
    assert list(found.history) == sorted(found.history, reverse=True)
    assert found.history[-1] == found.energy
    assert sphere(found.x).item() == found.energy


def test_many_basins_are_searched_better_than_by_as_many_draws():
    options, start = SwarmSettings(particles=30, iterations=40), torch.full((4,), 3.3)
    flown, drawn = [], []
    for seed in range(8):
        flown.append(run_swarm(rastrigin, start=start, spread=1.5, settings=options, generator=seeded(seed)))
        drawn.append(run_best_of_samples(rastrigin, start=start, spread=1.5, count=1200, generator=seeded(seed)))
    assert {f.evaluations for f in flown} == {d.evaluations for d in drawn} == {1200}
    assert np.median([f.energy for f in flown]) < 0.6 * np.median([d.energy for d in drawn])


def test_start_is_the_first_particle_so_the_result_is_never_worse():
    start, asked = torch.zeros(5), []

    def cost(x: Tensor) -> Tensor:  # least at the start
        asked.append(x)
        return sphere(x)

    for found in (
        run_swarm(cost, start=start, spread=2.0, generator=seeded()),
        run_best_of_samples(cost, start=start, spread=2.0, count=16, generator=seeded()),
    ):
        assert torch.equal(found.x, start)
        assert found.energy == 0.0
    for points in (asked[0], asked[-1]):
        assert torch.equal(points[0], start)
        assert points.unique(dim=0).shape == (16, 5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_costs_that_are_not_finite_count_as_infinity(bad: float):
    options = SwarmSettings(particles=12, iterations=15)

    def half(x: Tensor) -> Tensor:
        return torch.where(x[:, 0] > 0, sphere(x), bad)

    start = torch.tensor([-0.1, 1.0, 1.0])
    found = run_swarm(half, start=start, spread=1.0, settings=options, generator=seeded())
    assert math.isfinite(found.energy)
    assert found.x[0] > 0
    assert found.energy == half(found.x[None]).item()
    never = run_swarm(
        lambda x: x.new_full((len(x),), bad), start=start, spread=1.0, settings=options, generator=seeded()
    )
    assert torch.equal(never.x, start)
    assert never.energy == math.inf


def test_budget_is_kept_to_exactly():
    for limit, wanted in ((0, 0), (1, 1), (7, 7), (16, 16), (40, 32), (96, 96), (500, 96)):
        seen: list[int] = []

        def cost(x: Tensor, seen: list[int] = seen) -> Tensor:
            seen.append(len(x))
            return sphere(x)

        meter = Meter(Budget(evaluations=limit))
        options = SwarmSettings(particles=16, iterations=6 if limit >= 16 else 1)
        found = run_swarm(cost, start=torch.ones(3), spread=1.0, settings=options, meter=meter, generator=seeded())
        assert sum(seen) == found.evaluations == meter.evaluations == wanted
        assert found.energy <= 3.0 if limit else found.energy == math.inf
    meter = Meter(Budget(evaluations=10))
    assert (
        run_best_of_samples(
            sphere, start=torch.ones(3), spread=1.0, count=99, meter=meter, generator=seeded()
        ).evaluations
        == 10
    )
    late = Meter(Budget(seconds=0.0))
    for found in (
        run_swarm(sphere, start=torch.ones(3), spread=1.0, meter=late, generator=seeded()),
        run_best_of_samples(sphere, start=torch.ones(3), spread=1.0, count=4, meter=late, generator=seeded()),
    ):
        assert torch.equal(found.x, torch.ones(3))
        assert found.evaluations == 0
        assert found.history == ()
