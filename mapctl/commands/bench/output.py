"""A table of `mapctl bench` on standard output."""

from collections.abc import Sequence

from controllers.benchmarks.shared.tables import Row
from mapctl import report
from mapctl.commands.bench import TABLES, Table
from mapctl.commands.shared.tables import print_records


def print_rows(table: Table, rows: Sequence[Row]) -> int:
    """Print them as lines or JSON, as asked for; returns the exit status."""
    name = next(name for name, kind in TABLES.items() if kind is type(table))
    if table.json:
        print(report.to_json({"bench": name, "versions": report.package_versions(), "rows": list(rows)}), end="")
    else:
        print_records(rows, title=f"{name}, one thread")
    return 0
