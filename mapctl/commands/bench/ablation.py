"""`mapctl bench ablation`: the solver's choices compared."""

import priors
from controllers.benchmarks.ablation import benchmark_ablation
from controllers.benchmarks.shots.choices import benchmark_shot_choices
from mapctl.commands.bench import Ablation
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress


def run(table: Ablation) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    if not table.shots:
        return print_rows(table, benchmark_ablation(prior))
    prior.warm_up()
    with show_progress("shots") as progress:
        rows = benchmark_shot_choices(prior, priors.load_inbetweener(), count=table.shots, progress=progress)
    return print_rows(table, rows)
