"""`mapctl bench shots`: random wishes that are to hold at once, or walks round corners."""

import priors
from controllers.benchmarks.shared.held_out import load_held_out
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.shots.corners import benchmark_corners
from controllers.benchmarks.shots.fulfilment import benchmark_shots
from mapctl.commands.bench import Shots
from mapctl.commands.bench.baselines import find_held_out, list_models, measure_each
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress


def run(table: Shots) -> int:
    """Measure and print."""
    densities = {name: priors.load(name) for name in list_models(table.prior, table.baselines)}
    inbetweener, mocap = priors.load_inbetweener(table.inbetweener), []
    if table.data is not None and not table.corners:
        mocap = load_held_out(table.data, find_held_out({name: each.card for name, each in densities.items()}))

    def measure(name: str) -> list[Row]:
        prior = densities[name]
        prior.warm_up()
        with show_progress("corners" if table.corners else "shots") as progress:
            if table.corners:
                return benchmark_corners(prior, inbetweener, seeds=table.seeds, progress=progress)
            return benchmark_shots(
                prior, inbetweener, count=table.count, seed=table.seed, mocap=mocap, progress=progress
            )

    return print_rows(table, measure_each(list(densities), measure))
