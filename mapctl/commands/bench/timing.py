"""`mapctl bench timing`: suggested times between poses beside the true ones."""

import priors
from controllers.benchmarks.keyframe_timing import benchmark_keyframe_timing
from controllers.benchmarks.shared.held_out import load_canonical
from mapctl.commands.bench import Timing
from mapctl.commands.bench.baselines import find_held_out
from mapctl.commands.bench.output import print_rows


def run(table: Timing) -> int:
    """Measure and print."""
    held_out = find_held_out({table.inbetweener: priors.load_inbetweener(table.inbetweener).card}, table.clips)
    kinds = load_canonical(table.data, held_out, table.count)
    clips = [clip for found in kinds.values() for clip in found]
    return print_rows(table, benchmark_keyframe_timing(clips, priors.load_keyframe_timing()))
