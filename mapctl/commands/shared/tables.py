"""Tables on standard output: with lines on a terminal, plain in a pipe."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

NUMBER_FORMAT = "{:.4g}"


def print_table(columns: Sequence[str], rows: Sequence[Sequence[object]], *, title: str | None = None) -> None:
    """Numbers to the right with four digits, the rest as text; None and NaN as a dash."""
    console = Console(width=None if Console().is_terminal else 200, highlight=False)
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for number, column in enumerate(columns):
        numeric = any(isinstance(row[number], int | float) for row in rows)
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(format_cell(value) for value in row))
    console.print(table)


def format_cell(value: object) -> str:
    """One value as a table shows it."""
    if value is None or value != value:
        return "-"
    return NUMBER_FORMAT.format(value) if isinstance(value, float) else str(value)
