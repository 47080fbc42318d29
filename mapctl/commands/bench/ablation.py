"""`mapctl bench ablation`: the solver's choices compared."""

import priors
from controllers.benchmarks.ablation import benchmark_ablation
from mapctl.commands.bench import Ablation
from mapctl.commands.bench.output import print_rows


def run(table: Ablation) -> int:
    """Measure and print."""
    return print_rows(table, benchmark_ablation(priors.load(table.prior)))
