"""`mapctl bench tween`: motion through a few keys, and ends extended."""

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweening import benchmark_tweening
from mapctl.commands.bench import Tween
from mapctl.commands.bench.baselines import find_held_out, list_models, measure_each
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.features import PRIOR_FPS


def run(table: Tween) -> int:
    """Measure the in-betweeners on the same clips, canonical and at the prior's rate, and print the rows."""
    inbetweeners = {name: priors.load_inbetweener(name) for name in list_models(table.inbetweener, table.baselines)}
    held_out = find_held_out({name: each.card for name, each in inbetweeners.items()}, table.clips)
    kinds, densities = load_canonical(table.data, held_out, table.count, fps=PRIOR_FPS), priors.load_choice(table.prior)

    def measure(name: str) -> list[Row]:
        with show_progress("tween") as progress:
            return benchmark_tweening(kinds, inbetweeners[name], densities, progress=progress)

    return print_rows(table, measure_each(list(inbetweeners), measure))
