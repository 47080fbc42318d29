"""`mapctl bench denoise`: corrupted clips, beside filters tuned on the truth."""

import priors
from controllers.benchmarks.denoising import benchmark_denoising
from controllers.benchmarks.shared.held_out import load_clean_clips
from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import Denoise
from mapctl.commands.bench.baselines import find_held_out, list_models, measure_each
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress


def run(table: Denoise) -> int:
    """Measure and print."""
    denoisers = {name: priors.load_denoiser(name) for name in list_models(table.denoiser, table.baselines)}
    held_out = find_held_out({name: each.card for name, each in denoisers.items()}, table.clips)
    inbetweener, densities = priors.load_inbetweener(table.inbetweener), priors.load_choice(table.prior)
    clips = load_clean_clips(table.data, held_out, table.count)

    def measure(name: str) -> list[Row]:
        with show_progress("denoising") as progress:
            return benchmark_denoising(
                clips, denoisers[name], inbetweener=inbetweener, densities=densities, progress=progress
            )

    return print_rows(table, measure_each(list(denoisers), measure))
