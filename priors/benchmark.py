"""Time of one energy and gradient of a window: the fast path beside the torch reference, on one thread."""

import time
from collections.abc import Callable, Sequence

import torch

from priors.fast_rollout import FastRollout
from priors.lstm_gmm import LstmGmm

FAST_REPEATS, REFERENCE_REPEATS = 30, 5


def benchmark(
    model: LstmGmm, *, frames: int = 34, particles: Sequence[int] = (1, 8, 32)
) -> dict[int, dict[str, float]]:
    """By number of particles: `fast_ms`, `reference_ms`, their `ratio`, `plan_ms` (plan and rollout in one).

    Rollout and gradient on the noise; least wall time of several repeats, as others may share the machine.
    """
    threads, fast = torch.get_num_threads(), FastRollout(model)
    torch.set_num_threads(1)
    try:
        return {count: _times(model, fast, frames=frames, count=count) for count in particles}
    finally:
        torch.set_num_threads(threads)


def _times(model: LstmGmm, fast: FastRollout, *, frames: int, count: int) -> dict[str, float]:
    generator = torch.Generator().manual_seed(0)
    state = model.initial_state(model.mean.expand(1, -1)).repeat(count)
    noise = 0.5 * torch.randn(count, frames, model.layout.continuous, generator=generator)
    plan = fast.plan(state, noise)

    def energy_and_gradient(engine: LstmGmm | FastRollout) -> None:
        latent = noise.clone().requires_grad_()
        features, density = engine.rollout(state, latent, plan)
        torch.autograd.grad(features.square().sum() - density.sum(), latent)

    fast_ms = _least_ms(lambda: energy_and_gradient(fast), FAST_REPEATS)
    reference_ms = _least_ms(lambda: energy_and_gradient(model), REFERENCE_REPEATS)
    plan_ms = _least_ms(lambda: fast.plan_and_rollout(state, noise), FAST_REPEATS)
    return {
        "fast_ms": fast_ms,
        "reference_ms": reference_ms,
        "ratio": reference_ms / fast_ms,
        "plan_ms": plan_ms,
    }


def _least_ms(work: Callable[[], object], repeats: int) -> float:
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)
