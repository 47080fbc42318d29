"""`mapctl bench tweener`: the hips' trajectory told by the body, long gaps, or motion DNA."""

from collections.abc import Iterator

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.dna import benchmark_dna, choose_examples, choose_keys, load_style_clips
from controllers.benchmarks.tweener.long_gaps import Method, benchmark_long_gaps
from controllers.benchmarks.tweener.root_prediction import benchmark_root_prediction
from controllers.benchmarks.tweener.walked_in_place import benchmark_walked_in_place
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS


def run(table: Tweener) -> int:
    """Measure and print."""
    if table.dna:
        return print_rows(table, _measure_dna(table, table.tweener or "tweener"))
    if table.tweener is not None:
        return print_rows(table, _measure_long_gaps(table, table.tweener))
    path = priors.load_path(table.path)
    kinds = load_canonical(table.data, path.card.data.get("held_out", {}), table.count)
    return print_rows(table, [*benchmark_root_prediction(kinds, path), *benchmark_walked_in_place(kinds, path)])


def _measure_long_gaps(table: Tweener, name: str) -> list[Row]:
    tweener, rows = priors.load_tweener(name, table.path), []
    kinds = load_canonical(table.data, tweener.card.data.get("held_out", {}), table.count, fps=PRIOR_FPS)
    for seconds in _parse_seconds(table.seconds):
        with show_progress(f"gaps of {seconds:g} s") as progress:
            found = benchmark_long_gaps(
                kinds, list(_list_methods(table, name)), frames=round(seconds * PRIOR_FPS), progress=progress
            )
        rows += [{"seconds": seconds, **row} for row in found]
    return rows


def _measure_dna(table: Tweener, name: str) -> list[Row]:
    tweener = priors.load_tweener(name, table.path)
    clips = load_style_clips(table.data, tweener.card.data.get("held_out", {}))
    with show_progress("keys") as progress:
        return benchmark_dna(
            choose_keys(clips),
            choose_examples(clips, table.dna),
            clips,
            lambda dna: tweener if dna is None else tweener.styled(dna),
            priors.load_inbetweener(),
            settings=InfillSettings(finish=not table.raw),
            progress=progress,
        )


def _parse_seconds(text: str) -> list[float]:
    try:
        seconds = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise RequestError(f"--seconds takes numbers, as in 2,4,6.4; got {text!r}") from error
    if not all(0.2 <= each <= 60 for each in seconds):
        raise RequestError(f"gaps must last 0.2 to 60 seconds, got {text}")
    return seconds


def _list_methods(table: Tweener, name: str) -> Iterator[Method]:
    """List the tweener and the in-betweeners beside it, each as proposed and finished by MAP; and what auto does."""
    for each in (name, *filter(None, table.baselines.split(","))):
        inbetweener = priors.load_inbetweener(each, table.path)
        yield Method(each, inbetweener, InfillSettings(finish=False))
        if not table.raw:
            yield Method(f"{each}, and MAP", inbetweener)
    if not table.raw and table.baselines:
        tweener, network = priors.load_tweener(name, table.path), priors.load_inbetweener()
        yield Method("auto", AutoInbetweener(network, priors.load_choice("auto"), tweener=tweener))
