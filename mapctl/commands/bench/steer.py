"""`mapctl bench steer`: random commands, and curves walked live."""

import priors
from controllers.benchmarks.steering import SteeringBenchmarkSettings, benchmark_pursuit, benchmark_steering
from mapctl.commands.bench import Steer
from mapctl.commands.bench.output import print_rows


def run(table: Steer) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    rows = benchmark_steering(prior, SteeringBenchmarkSettings(commands=table.count))
    return print_rows(table, [*rows, *benchmark_pursuit(prior)])
