"""Clips that a model made, in a folder of training data: told by the list that `mapctl make` wrote beside them."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mapctl.errors import FileFormatError
from mapctl.formats.text import read_table

TABLE_NAME = "made.csv"
"""Of the list."""
COLUMNS = ("file", "kept", "model", "licence", "seed", "script", "why not")
"""Its first columns; measures follow."""


def find_made(data: Path, names: Sequence[str]) -> tuple[str, ...]:
    """For each list below a data folder and each model in it how many of the clips (paths below the folder) it made, as
    `made/made.csv: 3 of 8 clips, by locomotion (its licence)`. FileFormatError for a list that is none."""
    found: list[str] = []
    clips = set(names)
    for folder, folders, files in os.walk(data, onerror=lambda error: None):
        folders.sort()
        if TABLE_NAME in files:
            file = Path(folder) / TABLE_NAME
            below = file.parent.relative_to(data)
            counts = Counter(
                (model, licence) for name, model, licence in _read_makers(file) if (below / name).as_posix() in clips
            )
            shown = (below / TABLE_NAME).as_posix()
            found += [
                f"{shown}: {count} of {len(names)} clips, by {model} ({licence})"
                for (model, licence), count in counts.items()
            ]
    return tuple(found)


def _read_makers(file: Path) -> list[tuple[str, str, str]]:
    """File, model and licence of each row."""
    rows = read_table(file, "a list of made clips")
    head = tuple(rows[0][1][: len(COLUMNS)]) if rows else ()
    if head != COLUMNS:
        raise FileFormatError(file, f"is no list of made clips, whose columns are {', '.join(COLUMNS)}", 1)
    for line, words in rows[1:]:
        if len(words) < len(COLUMNS):
            raise FileFormatError(file, f"has {len(words)} columns, expected {len(COLUMNS)} and more", line)
    return [(words[0], words[2], words[3]) for _, words in rows[1:]]
