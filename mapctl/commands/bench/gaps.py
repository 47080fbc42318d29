"""`mapctl bench gaps`: how far answers for gaps are from the truth."""

import priors
from controllers.benchmarks.gaps import benchmark_gaps
from controllers.benchmarks.shared.held_out import load_canonical
from mapctl.commands.bench import Gaps
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.features import PRIOR_FPS


def run(table: Gaps) -> int:
    """Measure and print."""
    inbetweener = priors.load_inbetweener(table.inbetweener)
    kinds = load_canonical(table.data, inbetweener.card.data.get("held_out", {}), table.count, fps=PRIOR_FPS)
    with show_progress("gaps") as progress:
        rows = benchmark_gaps(kinds, inbetweener, priors.load_choice(table.prior), progress=progress)
    return print_rows(table, rows)
