"""`mapctl bench steer`: random commands, curves walked live, and places reached and discs walked round."""

import priors
from controllers.benchmarks.live_targets import LiveTargetSettings, benchmark_live_targets
from controllers.benchmarks.steering import SteeringBenchmarkSettings, benchmark_pursuit, benchmark_steering
from mapctl.commands.bench import Steer
from mapctl.commands.bench.output import print_rows


def run(table: Steer) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    if table.targets:
        return print_rows(table, benchmark_live_targets(prior, LiveTargetSettings(table.count)))
    rows = benchmark_steering(prior, SteeringBenchmarkSettings(commands=table.count))
    return print_rows(table, [*rows, *benchmark_pursuit(prior)])
