"""`mapctl bench all`."""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mapctl
from mapctl.commands.bench import AllTables
from mapctl.commands.bench.every.plan import list_tables, list_words
from mapctl.commands.bench.every.record import TableRecord, find_commit, list_moved
from mapctl.errors import RequestError
from mapctl.formats.atomic import check_folder


def run(command: AllTables) -> int:
    """Make the tables that are not up to date, and print what moved; a table that fails ends it."""
    tables, commit = list_tables(command.only), find_commit(Path(mapctl.__file__).parent)
    if not command.data.is_dir():
        raise RequestError(f"{command.data} is no folder of clips")
    check_folder(command.out)
    weights = () if command.weights is None else ("--weights", command.weights)
    for number, table in enumerate(tables, start=1):
        path, line = command.out / f"{table}.json", " ".join(["mapctl", *list_words(table), *weights])
        known = TableRecord.read(path)
        if known and not command.again and (known.command, known.commit) == (line, commit):
            print(f"{number}/{len(tables)} {table}: up to date")
            continue
        began = time.monotonic()
        rows = _make(table, [*list_words(table, command.data), *weights])
        made = TableRecord.of(line, commit, (time.monotonic() - began) / 60, rows)
        command.out.mkdir(parents=True, exist_ok=True)
        made.write(path)
        moved = [] if known is None else list(list_moved(known, made))
        told = "new" if known is None else f"{len(moved)} figures moved" if moved else "as before"
        print(f"{number}/{len(tables)} {table}: {told}, {made.minutes:.1f} minutes", flush=True)
        for figure in moved:
            print(f"  {figure}")
    return 0


def _make(table: str, words: Sequence[str]) -> list[dict[str, Any]]:
    """Run a table in a process of its own; RequestError with its last line where it fails."""
    done = subprocess.run([sys.executable, "-m", "mapctl", *words, "--json"], capture_output=True, text=True)
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"]
        raise RequestError(f"{table}: {said[-1].removeprefix('mapctl: ')}")
    return json.loads(done.stdout)["rows"]
