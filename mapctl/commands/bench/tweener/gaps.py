"""Long gaps between two whole poses of a clip: errors and liveliness, and the frequencies of what is made."""

from collections.abc import Iterator, Mapping, Sequence

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.long_gaps import benchmark_long_gaps
from controllers.benchmarks.tweener.spectrum import benchmark_spectrum
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.tweener.methods import list_methods
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion


def measure(table: Tweener) -> dict[str, list[Row]]:
    """Measure gaps of each of the lengths."""
    rows: list[Row] = []
    for seconds, kinds in _list_lengths(table):
        with show_progress(f"gaps of {seconds:g} s") as progress:
            methods = list(list_methods(table, auto=True))
            found = benchmark_long_gaps(kinds, methods, frames=round(seconds * PRIOR_FPS), progress=progress)
        rows += [{"seconds": seconds, **row} for row in found]
    return {"gaps": rows}


def measure_spectrum(table: Tweener) -> dict[str, list[Row]]:
    """Measure the speed by frequency in gaps of each of the lengths."""
    rows: list[Row] = []
    for seconds, kinds in _list_lengths(table):
        with show_progress(f"spectrum of {seconds:g} s") as progress:
            methods = list(list_methods(table))
            found = benchmark_spectrum(kinds, methods, frames=round(seconds * PRIOR_FPS), progress=progress)
        rows += [{"seconds": seconds, **row} for row in found]
    return {"spectrum": rows}


def _list_lengths(table: Tweener) -> Iterator[tuple[float, Mapping[str, Sequence[Motion]]]]:
    """Pair each length, seconds, with the clips that were kept from the tweener's training."""
    lengths = _parse_seconds(table.seconds)
    card = priors.load_tweener(table.tweener, table.path).card
    kinds = load_canonical(table.data, card.data.get("held_out", {}), table.count, fps=PRIOR_FPS)
    for seconds in lengths:
        yield seconds, kinds


def _parse_seconds(text: str) -> list[float]:
    try:
        seconds = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise RequestError(f"--seconds takes numbers, as in 2,4,6.4; got {text!r}") from error
    if not all(0.2 <= each <= 60 for each in seconds):
        raise RequestError(f"gaps must last 0.2 to 60 seconds, got {text}")
    return seconds
