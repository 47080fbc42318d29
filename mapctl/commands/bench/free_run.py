"""`mapctl bench free-run`: long random motions."""

import priors
from controllers.benchmarks.free_run import benchmark_free_run
from mapctl.commands.bench import FreeRun
from mapctl.commands.bench.output import print_rows


def run(table: FreeRun) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    return print_rows(table, benchmark_free_run(prior, prior.card.quality["data"]))
