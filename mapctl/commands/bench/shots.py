"""`mapctl bench shots`: random wishes that are to hold at once, or walks round corners."""

import priors
from controllers.benchmarks.shared.held_out import load_held_out
from controllers.benchmarks.shots.corners import benchmark_corners
from controllers.benchmarks.shots.fulfilment import benchmark_shots
from mapctl.commands.bench import Shots
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress


def run(table: Shots) -> int:
    """Measure and print."""
    prior, inbetweener = priors.load(table.prior), priors.load_inbetweener(table.inbetweener)
    prior.warm_up()
    with show_progress("corners" if table.corners else "shots") as progress:
        if table.corners:
            return print_rows(table, benchmark_corners(prior, inbetweener, seeds=table.seeds, progress=progress))
        mocap = [] if table.data is None else load_held_out(table.data, prior.card.data.get("held_out", {}))
        rows = benchmark_shots(prior, inbetweener, count=table.count, seed=table.seed, mocap=mocap, progress=progress)
    return print_rows(table, rows)
