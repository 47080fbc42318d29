"""Tables on standard output: with lines on a terminal, plain in a pipe."""

from collections.abc import Mapping, Sequence

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


def print_records(records: Sequence[Mapping[str, object]], *, title: str | None = None) -> None:
    """A table of rows by column name; the first row's names are the columns."""
    columns = list(dict.fromkeys(name for record in records for name in record))
    print_table(columns, [[record.get(name) for name in columns] for record in records], title=title)


def print_markdown(records: Sequence[Mapping[str, object]]) -> None:
    """Print a table of rows by column name as Markdown has it, with three digits; what a row lacks is left empty."""
    columns = list(dict.fromkeys(name for record in records for name in record))
    rows = [[_format_short(record.get(name)) for name in columns] for record in records]
    head, *body = (f"| {' | '.join(line)} |" for line in [columns, *rows])
    print(head, "|" + "---|" * len(columns), *body, sep="\n")


def _format_short(value: object) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def format_cell(value: object) -> str:
    """One value as a table shows it."""
    if value is None or value != value:
        return "-"
    return NUMBER_FORMAT.format(value) if isinstance(value, float) else str(value)
