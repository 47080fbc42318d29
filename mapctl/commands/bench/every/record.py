"""A table on disk: rows with the command, date, commit and machine that they are from, and which figures moved."""

import json
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeGuard

from mapctl import report
from mapctl.errors import FileFormatError
from mapctl.formats.atomic import write_text
from mapctl.version import __version__

_NOISE, _COST_NOISE = 0.03, 0.5  # shares by which figures, and times and memory, may differ without a cause
_COSTS = ("ms", "seconds", "times_faster", "memory", "late", "evaluations", "mb")


@dataclass(frozen=True)
class TableRecord:
    """A table as it was made."""

    command: str
    """What is typed, with DATA for the folder of clips."""
    date: str
    """Day on which it was made, UTC."""
    commit: str
    """Commit of the checkout, with `+` where files differed from it, or the version where there is no checkout."""
    machine: str
    """Processor, cores and platform."""
    minutes: float
    """Time that it took."""
    rows: Sequence[Mapping[str, Any]]
    """Figures by column."""

    @staticmethod
    def of(command: str, commit: str, minutes: float, rows: Sequence[Mapping[str, Any]]) -> "TableRecord":
        """Record rows that were made now, on this machine."""
        return TableRecord(command, f"{datetime.now(UTC):%Y-%m-%d}", commit, describe_machine(), minutes, rows)

    @staticmethod
    def read(path: Path) -> "TableRecord | None":
        """Read it, or None where there is none; FileFormatError where the file is something else."""
        if not path.exists():
            return None
        try:
            return TableRecord(**json.loads(path.read_text("utf-8")))
        except (TypeError, ValueError) as error:
            raise FileFormatError(path, f"not a table of mapctl bench all: {error}") from error

    def write(self, path: Path) -> None:
        """Write it as JSON, whole or not at all."""
        write_text(path, report.to_json(asdict(self)))


def list_moved(old: TableRecord, new: TableRecord) -> Iterator[str]:
    """List the figures of rows with the same texts that differ by more than noise, and rows that came or went."""
    before = _name_rows(old.rows)
    for name, row in _name_rows(new.rows).items():
        if name not in before:
            yield f"{name}: new"
            continue
        known = before.pop(name)
        for column, value in row.items():
            was = known.get(column)
            if _is_number(value) and _is_number(was) and _differ(column, was, value):
                yield f"{name}: {column} {was:.4g} to {value:.4g}"
    for name in before:
        yield f"{name}: gone"


def find_commit(folder: Path) -> str:
    """Find the commit of a checkout, short, with `+` where tracked files differ from it; the version elsewhere."""
    words = ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        found = subprocess.run(words, capture_output=True, text=True)
    except OSError:
        return __version__
    return found.stdout.strip() if found.returncode == 0 and found.stdout.strip() else __version__


def describe_machine() -> str:
    """Describe the processor, its cores and the platform."""
    return f"{_find_processor()}, {os.cpu_count()} cores, {platform.system()}"


def _find_processor() -> str:
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _name_rows(rows: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Name rows by their texts, which tell what they are about; those with the same texts by their order, too."""
    named: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        name = ", ".join(value for value in row.values() if isinstance(value, str)) or "row"
        same = sum(1 for each in named if each == name or each.startswith(f"{name} #"))
        named[f"{name} #{same + 1}" if same else name] = row
    return named


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _differ(column: str, was: float, value: float) -> bool:
    cost = any(word in column.split("_") for word in _COSTS)
    return abs(value - was) > (_COST_NOISE if cost else _NOISE) * max(abs(was), abs(value), 1e-9)
