"""`mapctl bench free-run`: long random motions."""

import priors
from controllers.benchmarks.free_run import benchmark_free_run, summarise_held_changes
from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import FreeRun
from mapctl.commands.bench.baselines import list_models, measure_each
from mapctl.commands.bench.output import print_rows


def run(table: FreeRun) -> int:
    """Measure and print."""

    def measure(name: str) -> list[Row]:
        prior = priors.load(name)
        held = summarise_held_changes(prior.card.data.get("holds", {}))
        return benchmark_free_run(prior, prior.card.quality["data"] | held)

    return print_rows(table, measure_each(list_models(table.prior, table.baselines), measure))
