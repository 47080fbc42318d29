"""`mapctl bench follow`: curves walked by densities, and by motion matching over their training clips."""

from pathlib import Path
from tempfile import TemporaryDirectory

import priors
from controllers.benchmarks.following import FollowBenchmarkSettings, benchmark_follow
from controllers.benchmarks.following.motion_matching import MotionDatabase
from mapctl.commands.bench import Follow
from mapctl.commands.bench.baselines import list_models
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from priors.lstm_gmm.density import LstmGmmDensity
from priors.training.corpus import read_corpus
from priors.training.mocap.cuts import CMU


def run(table: Follow) -> int:
    """Measure and print."""
    densities = {name: priors.load(name) for name in list_models(table.prior, table.baselines)}
    database = None if table.data is None else _read_database(table.data, densities[table.prior])
    return print_rows(table, benchmark_follow(densities, database, FollowBenchmarkSettings(seeds=table.count)))


def _read_database(data: Path, density: LstmGmmDensity) -> MotionDatabase:
    """Read the clips that the density was trained on, as its training read them."""
    card, kept_out = density.card.data, {name for names in density.card.data["held_out"].values() for name in names}
    with TemporaryDirectory() as cache, show_progress("reading") as progress:
        corpus = read_corpus(
            data,
            match=str(card.get("match") or ""),
            cache=Path(cache),
            cuts=CMU,
            level="--level" in density.card.training.get("command", ""),
            progress=progress,
        )
    seen = corpus.subset(number for number, name in enumerate(corpus.names) if name not in kept_out)
    return MotionDatabase.of(seen.clips())
