"""How `mapctl train` tells of a run: a live table on a terminal, lines in a pipe, and a plot beside the run."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from priors.training.record.watching import LineWatcher, PacedWatcher, Row, RunStart, Watcher, format_duration
from priors.training.record.watching import format_number as number

_REFRESH_SECONDS = 0.25
_AVERAGED_STEPS = 100  # of which the table shows the mean


@contextmanager
def watch(*, quiet: bool, plot: Path | None) -> Iterator[Sequence[Watcher]]:
    """Yield who is told: a table on a terminal, lines elsewhere, nobody with `quiet`; and who draws, if that is asked
    for."""
    from mapctl.commands.train.curves import CurvePlotter

    drawers = [CurvePlotter(plot)] if plot is not None else []
    if quiet:
        yield drawers
    elif not sys.stdout.isatty():
        yield [LineWatcher(print_line, log=True), *drawers]
    else:
        with LiveTable(Console()) as table:
            yield [table, *drawers]


def print_line(line: str) -> None:
    """Print a line at once, so that a log file shows how far a run of hours has come."""
    print(line, flush=True)


def warn(line: str) -> None:
    """Say it where --quiet and redirected output do not hide it."""
    print(f"mapctl: {line}", file=sys.stderr, flush=True)


class LiveTable(PacedWatcher):
    """A bar with rate and remaining time, the losses of the last steps beside the first ones, and the validations."""

    def __init__(self, console: Console):
        super().__init__()
        # Drawn from here, not from a thread: processes are forked beside it.
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._recent: list[Row] = []
        self._first: Row = {}
        self._validations: list[tuple[int, Row]] = []
        self._drawn = 0.0

    def __enter__(self) -> "LiveTable":
        self._live.start()
        return self

    def __exit__(self, *reason: object) -> None:
        if self.start is not None:
            self._draw()
        self._live.stop()

    def begin(self, start: RunStart) -> None:
        """Before the first step of this process."""
        super().begin(start)
        self._draw()

    def see_step(self, step: int, losses: Row) -> None:
        """After each step."""
        super().see_step(step, losses)
        self._recent = [*self._recent[1 - _AVERAGED_STEPS :], losses]
        self._first = self._first or losses
        assert self.start is not None
        if time.monotonic() - self._drawn > _REFRESH_SECONDS or step >= self.start.steps:
            self._draw()

    def see_validation(self, step: int, measures: Row) -> None:
        """After each validation."""
        super().see_validation(step, measures)
        self._validations = [*self._validations[:1], *self._validations[1:][-1:], (step, measures)]
        self._draw()

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        self._live.update(self.render(), refresh=True)

    def render(self) -> RenderableType:
        """What the terminal shows."""
        assert self.start is not None
        tables: list[RenderableType] = []
        if self._recent:
            means = {name: _average(self._recent, name) for name in self._recent[-1]}
            title = f"losses, mean of the last {len(self._recent)} {self.start.counter}s"
            tables.append(_make_table(title, "now", [("first", self._first), ("now", means)]))
        if self._validations:
            columns = [(f"{self.start.counter} {step}", row) for step, row in self._validations]
            tables.append(_make_table("validation", "measure", columns))
        beside = Table.grid(padding=(0, 4))
        if tables:
            beside.add_row(*tables)
        return Group(self._make_bar(self.start), beside)

    def _make_bar(self, start: RunStart) -> RenderableType:
        grid = Table.grid(padding=(0, 1))
        done = ProgressBar(total=max(1, start.steps), completed=self.step, width=30)
        share = 100 * self.step / max(1, start.steps)
        told = f"{self.step}/{start.steps} {start.counter}s ({share:.1f} %)"
        grid.add_row(start.kind, done, told, self.format_pace(), f"{format_duration(self.pace.elapsed)} gone")
        return grid


def _make_table(title: str, first: str, columns: Sequence[tuple[str, Row]]) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("loss" if first == "now" else first)
    for name, _ in columns:
        table.add_column(name, justify="right")
    for name in dict.fromkeys(name for _, row in columns for name in row):
        table.add_row(name, *(number(row.get(name)) for _, row in columns))
    return table


def _average(rows: Sequence[Row], name: str) -> float | None:
    values = [value for row in rows if (value := row.get(name)) is not None and value == value]
    return sum(values) / len(values) if values else None
