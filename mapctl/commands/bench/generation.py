"""`mapctl bench generation`: raw, refined and finished motion beside mocap."""

import priors
from controllers.benchmarks.generation import GenerationBenchmarkSettings, benchmark_generation
from controllers.benchmarks.shared.held_out import load_held_out
from mapctl.commands.bench import Generation
from mapctl.commands.bench.output import print_rows


def run(table: Generation) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    mocap = load_held_out(table.data, prior.card.data.get("held_out", {}))
    refiner, settings = priors.refiner_of(table.prior, table.refiner), GenerationBenchmarkSettings(count=table.count)
    return print_rows(table, benchmark_generation(prior, refiner, mocap, settings))
