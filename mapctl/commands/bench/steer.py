"""`mapctl bench steer`: random commands, starts from a stand, curves walked live; or places and discs."""

import priors
from controllers.benchmarks.live_targets import LiveTargetSettings, benchmark_live_targets
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.steering import (
    SteeringBenchmarkSettings,
    benchmark_pursuit,
    benchmark_starts,
    benchmark_steering,
)
from mapctl.commands.bench import Steer
from mapctl.commands.bench.baselines import list_models, measure_each
from mapctl.commands.bench.output import print_rows

_COMMANDS_A_CHARACTER = 6  # that starts from a stand as often


def run(table: Steer) -> int:
    """Measure and print."""

    def measure(name: str) -> list[Row]:
        prior = priors.load(name)
        if table.targets:
            return benchmark_live_targets(prior, LiveTargetSettings(table.count))
        commands = SteeringBenchmarkSettings(commands=table.count)
        starts = benchmark_starts(prior, max(1, table.count // _COMMANDS_A_CHARACTER))
        return [*benchmark_steering(prior, commands), *starts, *benchmark_pursuit(prior)]

    return print_rows(table, measure_each(list_models(table.prior, table.baselines), measure))
