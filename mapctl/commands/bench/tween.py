"""`mapctl bench tween`: motion through a few keys, and ends extended."""

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.tweening import benchmark_tweening
from mapctl.commands.bench import Tween
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.features import PRIOR_FPS


def run(table: Tween) -> int:
    """Measure and print."""
    inbetweener = priors.load_inbetweener(table.inbetweener)
    kinds = load_canonical(table.data, inbetweener.card.data.get("held_out", {}), table.count, fps=PRIOR_FPS)
    with show_progress("tween") as progress:
        rows = benchmark_tweening(kinds, inbetweener, priors.load_choice(table.prior), progress=progress)
    return print_rows(table, rows)
