"""`mapctl bench denoise`: corrupted clips, beside filters tuned on the truth."""

import priors
from controllers.benchmarks.denoising import benchmark_denoising
from controllers.benchmarks.shared.held_out import load_clean_clips
from mapctl.commands.bench import Denoise
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress


def run(table: Denoise) -> int:
    """Measure and print."""
    denoiser, inbetweener = priors.load_denoiser(table.denoiser), priors.load_inbetweener(table.inbetweener)
    clips = load_clean_clips(table.data, denoiser.card.data.get("held_out", {}), table.count)
    densities = priors.load_choice(table.prior)
    with show_progress("denoising") as progress:
        rows = benchmark_denoising(clips, denoiser, inbetweener=inbetweener, densities=densities, progress=progress)
    return print_rows(table, rows)
