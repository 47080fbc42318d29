"""A table of `mapctl bench` on standard output."""

from collections.abc import Mapping, Sequence

from controllers.benchmarks.shared.tables import Row
from mapctl import report
from mapctl.commands.bench import TABLES, Table
from mapctl.commands.shared.tables import print_markdown, print_records


def print_rows(table: Table, rows: Sequence[Row]) -> int:
    """Print them as lines or JSON, as asked for; returns the exit status."""
    name = _find_name(table)
    if table.json:
        _print_json(name, rows)
    else:
        print_records(rows, title=f"{name}, one thread")
    return 0


def print_parts(table: Table, parts: Mapping[str, Sequence[Row]], *, markdown: bool = False) -> int:
    """Print a table for each part, or JSON of all rows, which name their part; returns the exit status."""
    name = _find_name(table)
    if table.json:
        _print_json(name, [{"part": part, **row} for part, rows in parts.items() for row in rows])
        return 0
    for part, rows in parts.items():
        if markdown:
            print(f"{name}: {part}\n")
            print_markdown(rows)
            print()
        else:
            print_records(rows, title=f"{name}: {part}, one thread")
    return 0


def _find_name(table: Table) -> str:
    return next(name for name, kind in TABLES.items() if kind is type(table))


def _print_json(name: str, rows: Sequence[Row]) -> None:
    print(report.to_json({"bench": name, "versions": report.package_versions(), "rows": list(rows)}), end="")
