"""Clips that a model made, in a folder of training data: told by the list that `mapctl make` wrote beside them."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.text import read_table

TABLE_NAME = "made.csv"
"""Of the list."""
COLUMNS = ("file", "kept", "model", "licence", "seed", "script", "why not")
"""Its first columns; measures follow."""


@dataclass(frozen=True)
class Made:
    """What of a data folder is no mocap."""

    clips: frozenset[str] = frozenset()
    """Paths below the folder of the clips that a model made."""
    told: tuple[str, ...] = ()
    """For each list and each model in it how many clips it made, as `made/made.csv: 3 of 8 clips, by locomotion (its
    licence)`."""
    licences: frozenset[str] = frozenset()
    """Licences of the models that made them."""


def require_made(made: Made, folder: Path) -> None:
    """RequestError for a folder that was to hold made clips and holds none."""
    if not made.clips:
        raise RequestError(f"{folder} holds no clips that mapctl make has listed as made")


def find_made(data: Path, names: Sequence[str]) -> Made:
    """Find which of the clips (paths below the folder) a model made, by the lists below the folder. FileFormatError for
    a list that is none."""
    told: list[str] = []
    clips, made, licences = set(names), set[str](), set[str]()
    for folder, folders, files in os.walk(data, onerror=lambda error: None):
        folders.sort()
        if TABLE_NAME in files:
            file = Path(folder) / TABLE_NAME
            below = file.parent.relative_to(data)
            makers = {(below / name).as_posix(): by for name, *by in _read_makers(file)}
            listed = {name: by for name, by in makers.items() if name in clips}
            counts = Counter((model, licence) for model, licence in listed.values())
            made |= listed.keys()
            licences |= {licence for _, licence in listed.values()}
            shown = (below / TABLE_NAME).as_posix()
            told += [
                f"{shown}: {count} of {len(names)} clips, by {model} ({licence})"
                for (model, licence), count in counts.items()
            ]
    return Made(frozenset(made), tuple(told), frozenset(licences))


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
