"""`mapctl bench live`: random commands against the wall clock."""

import functools

import priors
from controllers.benchmarks.live import benchmark_live, find_most
from controllers.benchmarks.live_orders import benchmark_orders
from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import Live
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError

_MAX_MINUTES, _MAX_CHARACTERS = 24 * 60, 64
_LEAST_ORDERS = 2.5  # seconds: the longest way to a place, and a little after it


def run(table: Live) -> int:
    """Measure and print."""
    if not 0 < table.minutes <= _MAX_MINUTES:
        raise RequestError(f"--minutes must be more than 0 and at most a day, got {table.minutes:g}")
    if table.orders is not None:
        return _run_orders(table, table.orders)
    load = functools.partial(priors.load, priors.add_set(table.prior))

    def measure(count: int) -> Row:
        with show_progress(f"{count} at once") as progress:
            return benchmark_live(load, characters=count, minutes=table.minutes, progress=progress)

    counts = _parse_counts(table.characters)
    return print_rows(table, find_most(measure, _MAX_CHARACTERS) if table.find_most else [*map(measure, counts)])


def _run_orders(table: Live, orders: float) -> int:
    if not _LEAST_ORDERS <= orders < 20 * table.minutes:
        least = f"{_LEAST_ORDERS:g} seconds or more, and less than a third of --minutes"
        raise RequestError(f"--orders must be {least}, got {orders:g}")
    load = functools.partial(priors.load, priors.add_set(table.prior))
    with show_progress("orders") as progress:
        row = benchmark_orders(
            load,
            functools.partial(priors.load_stitcher, priors.add_set(table.stitcher)),
            minutes=table.minutes,
            every=orders,
            progress=progress,
        )
    return print_rows(table, [row])


def _parse_counts(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() and 1 <= int(word) <= _MAX_CHARACTERS for word in words):
        raise RequestError(f"--characters must be numbers from 1 to {_MAX_CHARACTERS}, as 1,2,4; got {text!r}")
    return [int(word) for word in words]
