"""`mapctl bench generation`: raw, refined and finished motion beside mocap."""

import priors
from controllers.benchmarks.generation import GenerationBenchmarkSettings, benchmark_generation
from controllers.benchmarks.shared.held_out import find_held_out
from mapctl import formats, retarget
from mapctl.commands.bench import Generation
from mapctl.commands.bench.output import print_rows
from mapctl.features import PRIOR_FPS


def run(table: Generation) -> int:
    """Measure and print."""
    prior = priors.load(table.prior)
    paths = find_held_out(table.data, prior.card.data.get("held_out", {}))
    mocap = [retarget.to_canonical(formats.load(path))[0].resample(PRIOR_FPS) for path in paths]
    mocap = [clip for clip in mocap if clip.num_frames > PRIOR_FPS]
    refiner, settings = priors.refiner_of(table.prior, table.refiner), GenerationBenchmarkSettings(count=table.count)
    return print_rows(table, benchmark_generation(prior, refiner, mocap, settings))
