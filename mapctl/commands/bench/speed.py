"""`mapctl bench speed`: what the solver costs."""

import priors
from controllers.benchmarks.solver import benchmark_speed
from mapctl.commands.bench import Speed
from mapctl.commands.bench.output import print_rows


def run(table: Speed) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    return print_rows(table, benchmark_speed(prior, prior.without_kernels()))
