"""`mapctl bench generation`: raw, refined and finished motion beside mocap."""

import priors
from controllers.benchmarks.generation import GenerationBenchmarkSettings, benchmark_generation
from controllers.benchmarks.shared.held_out import load_held_out
from mapctl.commands.bench import Generation
from mapctl.commands.bench.baselines import load_generators
from mapctl.commands.bench.output import print_rows


def run(table: Generation) -> int:
    """Measure and print."""
    prior, held_out, densities, refiners = load_generators(table.prior, table.baselines)
    rows = benchmark_generation(
        prior,
        priors.refiner_of(table.prior, table.refiner),
        load_held_out(table.data, held_out),
        GenerationBenchmarkSettings(count=table.count),
        densities=densities,
        refiners=refiners,
    )
    return print_rows(table, rows)
