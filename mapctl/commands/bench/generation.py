"""`mapctl bench generation`: raw, refined and finished motion beside mocap."""

import priors
from controllers.benchmarks.generation import GenerationBenchmarkSettings, benchmark_generation
from controllers.benchmarks.shared.held_out import load_held_out
from mapctl.commands.bench import Generation
from mapctl.commands.bench.baselines import check_unseen, list_models
from mapctl.commands.bench.output import print_rows


def run(table: Generation) -> int:
    """Measure and print."""
    prior, baselines = priors.load(table.prior), list_models(table.prior, table.baselines)[1:]
    held_out = prior.card.data.get("held_out", {})
    refiners = [name for name in baselines if priors.find_kind(name) == "refiner"]
    densities = {name: priors.load(name) for name in baselines if name not in refiners}
    for name, density in densities.items():
        check_unseen(name, density.card, held_out)
    rows = benchmark_generation(
        prior,
        priors.refiner_of(table.prior, table.refiner),
        load_held_out(table.data, held_out),
        GenerationBenchmarkSettings(count=table.count),
        densities=densities,
        refiners={name: priors.load_refiner(name) for name in refiners},
    )
    return print_rows(table, rows)
