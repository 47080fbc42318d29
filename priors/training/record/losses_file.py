"""The losses of a run as a table on disk, RUN/losses.csv: a row for each mean of the losses and each validation."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapctl.errors import WriteError
from mapctl.formats.atomic import write_text
from priors.training.record.watching import Row, Watcher

NAME = "losses.csv"
"""Of the file in the run folder."""
TRAINING, VALIDATION = "training", "validation"
"""What the column `part` holds."""


@dataclass(frozen=True)
class LossRow:
    """One row of the table."""

    step: int
    """Steps that were done."""
    part: str
    """TRAINING: means over the steps since the last such row; VALIDATION: measures of held-out clips."""
    values: Mapping[str, float]
    """By name; what was not finite is left out."""


class LossesFile(Watcher):
    """Appends to RUN/losses.csv what a run tells. A resumed run's file is that of an uninterrupted one."""

    def __init__(self, run: Path, counter: str):
        self.path, self._counter = run / NAME, counter
        self._columns: list[str] = []
        self._heads: list[LossRow] = []  # rows that brought in a name of their part

    def cut(self, step: int, curve: Sequence[Row]) -> None:
        """Before training: keep what was told up to the checkpoint of this step, whose validations `curve` holds; the
        rest comes again. At step 0 the table is empty.

        A table that is gone or damaged begins with the curve.
        """
        last = max((int(row[self._counter] or 0) for row in curve), default=0)
        rows = [row for row in read_losses(self.path) if row.step <= (step if row.part == TRAINING else last)]
        told = {row.step for row in rows if row.part == VALIDATION}
        lacking = [row for row in curve if int(row[self._counter] or 0) not in told]
        rows += [LossRow(int(row[self._counter] or 0), VALIDATION, self._select_values(row)) for row in lacking]
        self._write_all(sorted((row for row in rows if row.values), key=lambda row: row.step))

    def see_losses(self, step: int, means: Row) -> None:
        """Append a row."""
        self._append(LossRow(step, TRAINING, self._select_values(means)))

    def see_validation(self, step: int, measures: Row) -> None:
        """Append a row."""
        self._append(LossRow(step, VALIDATION, self._select_values(measures)))

    def _select_values(self, row: Row) -> dict[str, float]:
        numbers = {name: value for name, value in row.items() if isinstance(value, int | float)}
        return {name: float(value) for name, value in numbers.items() if name != self._counter and math.isfinite(value)}

    def _append(self, row: LossRow) -> None:
        if not row.values:
            return
        if not set(row.values) <= {name for head in self._heads if head.part == row.part for name in head.values}:
            self._heads.append(row)
        if _name_columns(self._heads) != self._columns:
            self._write_all([*read_losses(self.path), row])
            return
        try:
            with self.path.open("a", encoding="utf-8", newline="") as file:
                file.write(_format_rows([row], self._columns))
        except OSError as error:
            raise WriteError(f"cannot write {self.path}: {error.strerror or error}") from error

    def _write_all(self, rows: Sequence[LossRow]) -> None:
        self._heads = list(rows)
        self._columns = _name_columns(rows)
        head = ",".join([self._counter, "part", *self._columns]) + "\n"
        write_text(self.path, head + _format_rows(rows, self._columns) if rows else "")


def read_losses(path: Path) -> list[LossRow]:
    """The rows of a table; those that are no rows are left out, as half a line of a process that was killed."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return []
    whole = text[: text.rfind("\n") + 1]
    try:
        lines = list(csv.reader(io.StringIO(whole)))
    except csv.Error:
        return []
    if not lines or lines[0][1:2] != ["part"]:
        return []
    found = (_read_row(lines[0][2:], line) for line in lines[1:])
    return [row for row in found if row is not None]


def _read_row(columns: Sequence[str], cells: Sequence[str]) -> LossRow | None:
    if len(cells) != len(columns) + 2 or cells[1] not in (TRAINING, VALIDATION):
        return None
    try:
        values = {name: float(cell) for name, cell in zip(columns, cells[2:], strict=True) if cell}
        return LossRow(int(cells[0]), cells[1], values)
    except ValueError:
        return None


def _name_columns(rows: Iterable[LossRow]) -> list[str]:
    """Losses first, then measures, each in the order in which they come."""
    rows = list(rows)
    names = [name for part in (TRAINING, VALIDATION) for row in rows if row.part == part for name in row.values]
    return list(dict.fromkeys(names))


def _format_rows(rows: Sequence[LossRow], columns: Sequence[str]) -> str:
    """Numbers with nine digits, which tell any float32."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    for row in rows:
        cells = [f"{row.values[name]:.9g}" if name in row.values else "" for name in columns]
        writer.writerow([row.step, row.part, *cells])
    return written.getvalue()
