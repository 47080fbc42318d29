"""Fills the tables of the pages from what `mapctl bench all` measured, so that no figure is written by hand.

`mapctl bench all --data DATA -o docs/tables` keeps each table as JSON. A page shows columns of it between two comments,
so that its source reads well, too:

    <!-- table: follow
    curve: curve
    path_error_mean_cm / path_error_max_cm: path error mean / max, cm | .1
    told_apart: told apart | %
    @where method: locomotion|free/locomotion
    @part: walks
    -->
    (rows, and a line that says where they are from)
    <!-- end of table -->

A line names a column and its heading. After `|` stands how its numbers are written: `.2` with two decimals, `%` as a
share; without it they have three digits. Columns with ` / ` or ` to ` between them share a
cell. `@where` keeps the rows whose text fits a regular expression as a whole, `@part` those of one part. `@sources: no`
leaves out the line of the source, for a page that shows several tables of one record.

`python docs/extensions/measured_tables.py` fills every page; the build fails where a page is not up to date.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

DOCS = Path(__file__).resolve().parent.parent
_COMMAND = "python docs/extensions/measured_tables.py"
_REGION = re.compile(r"^<!-- table: (?P<name>[\w-]+)\n(?P<spec>.*?)-->\n.*?^<!-- end of table -->$", re.M | re.S)
_BEGIN = re.compile(r"^<!-- table:", re.M)
_RULE = re.compile(r"^@(?P<rule>where|part|sources)(?: (?P<column>\w+))?: (?P<value>.+)$")


class Column(NamedTuple):
    """A column of a page's table."""

    names: Sequence[str]
    """Columns of the record that share its cells."""
    between: str
    """What stands between their values."""
    heading: str
    """What stands above it."""
    style: str
    """How numbers are written; empty for three digits."""


class Spec(NamedTuple):
    """What a page shows of a record."""

    columns: Sequence[Column]
    """Its columns, in order."""
    where: Mapping[str, str]
    """Regular expressions that texts of a row must fit, by column."""
    sourced: bool
    """Whether a line says where the figures are from."""


def fill(text: str, tables: Path) -> str:
    """Fill the tables of a page's text from the records in a folder; ValueError names what a record lacks."""
    if len(_BEGIN.findall(text)) != len(_REGION.findall(text)):
        raise ValueError("a table has no end, or no columns")
    return _REGION.sub(lambda found: _fill_region(found, tables), text)


def list_pages(docs: Path) -> Iterator[Path]:
    """List the pages that show a record."""
    built = {"_build", "auto_gallery"}
    for page in sorted(docs.rglob("*.md")):
        if not built & set(page.relative_to(docs).parts) and _BEGIN.search(page.read_text("utf-8")):
            yield page


def _fill_region(found: re.Match[str], tables: Path) -> str:
    path = tables / f"{found['name']}.json"
    if not path.exists():
        raise ValueError(f"there is no record {path.name}; mapctl bench all makes it")
    record, spec = json.loads(path.read_text("utf-8")), read_spec(found["spec"])
    rows = [row for row in record["rows"] if all(_fits(row.get(name), rule) for name, rule in spec.where.items())]
    if not rows:
        raise ValueError(f"no row of {path.name} fits {dict(spec.where)}")
    lines = [_line(each.heading for each in spec.columns), "|" + "---|" * len(spec.columns)]
    lines += [_line(_format_cell(each, row, rows, path.name) for each in spec.columns) for row in rows]
    if spec.sourced:
        lines += ["", describe_source(record)]
    head = f"<!-- table: {found['name']}\n{found['spec']}-->"
    return "\n".join([head, *lines, "<!-- end of table -->"])


def read_spec(text: str) -> Spec:
    """Read the lines between the name of a record and the end of the comment; ValueError names a line that is none."""
    columns: list[Column] = []
    where: dict[str, str] = {}
    sourced = True
    for line in text.strip().splitlines():
        if rule := _RULE.match(line):
            if rule["rule"] == "sources":
                sourced = rule["value"] != "no"
            else:
                where["part" if rule["rule"] == "part" else rule["column"]] = rule["value"]
            continue
        names, colon, rest = line.partition(": ")
        if not colon:
            raise ValueError(f"a line of a table is 'column: heading', got {line!r}")
        heading, _, style = rest.partition(" | ")
        between = next((each for each in (" / ", " to ") if each in names), " ")
        columns.append(Column(names.split(between), between, heading.strip(), style.strip()))
    return Spec(columns, where, sourced)


def describe_source(record: Mapping[str, Any]) -> str:
    """Say in a line by what command, when, from what commit and on what machine a record was made."""
    return f"*`{record['command']}`, {record['date']}, commit {record['commit']}, {record['machine']}.*"


def _fits(value: object, rule: str) -> bool:
    return re.fullmatch(rule, "" if value is None else str(value)) is not None


def _line(cells: Iterator[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _format_cell(column: Column, row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], record: str) -> str:
    for name in column.names:
        if not any(name in each for each in rows):
            known = ", ".join(dict.fromkeys(key for each in rows for key in each))
            raise ValueError(f"{record} has no column {name!r}; it has {known}")
    cells = [format_value(row.get(name), column.style) for name in column.names]
    while cells and not cells[-1]:
        cells.pop()
    return column.between.join(cell or "–" for cell in cells)  # or the second figure would be read as the first


def format_value(value: object, style: str) -> str:
    """Write a value as a style says; nothing where there is none."""
    if value is None or value != value:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float):
        return str(value)
    if style == "%":
        return f"{100 * value:.0f} %"
    if style.startswith("."):
        return f"{value:.{int(style[1:])}f}"
    if style:
        raise ValueError(f"numbers are not written as {style!r}")
    if isinstance(value, int):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def check_all(app: Sphinx) -> None:
    """Check before the site is built that every page shows what was measured."""
    docs = Path(app.srcdir)
    for page in list_pages(docs):
        text = page.read_text("utf-8")
        try:
            filled = fill(text, docs / "tables")
        except ValueError as error:
            raise ExtensionError(f"{page.relative_to(docs)}: {error}") from error
        if filled != text:
            raise ExtensionError(f"{page.relative_to(docs)} does not show what was measured; {_COMMAND} fills it")


def setup(app: Sphinx) -> dict[str, bool]:
    """Check pages before they are read."""
    app.connect("builder-inited", check_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def main() -> int:
    """Fill the pages."""
    for page in list_pages(DOCS):
        try:
            filled = fill(page.read_text("utf-8"), DOCS / "tables")
        except ValueError as error:
            print(f"{page.relative_to(DOCS)}: {error}", file=sys.stderr)
            return 1
        if filled != page.read_text("utf-8"):
            page.write_text(filled, "utf-8")
            print(f"filled {page.relative_to(DOCS)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
