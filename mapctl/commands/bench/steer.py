"""`mapctl bench steer`: random commands, curves walked live, and places reached and discs walked round."""

import priors
from controllers.benchmarks.live_targets import LiveTargetSettings, benchmark_live_targets
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.steering import SteeringBenchmarkSettings, benchmark_pursuit, benchmark_steering
from mapctl.commands.bench import Steer
from mapctl.commands.bench.baselines import list_models, measure_each
from mapctl.commands.bench.output import print_rows


def run(table: Steer) -> int:
    """Measure and print."""

    def measure(name: str) -> list[Row]:
        prior = priors.load(name)
        if table.targets:
            return benchmark_live_targets(prior, LiveTargetSettings(table.count))
        return [*benchmark_steering(prior, SteeringBenchmarkSettings(commands=table.count)), *benchmark_pursuit(prior)]

    return print_rows(table, measure_each(list_models(table.prior, table.baselines), measure))
