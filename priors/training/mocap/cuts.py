"""Tables that say which frames of which files are motion, and which are a T-pose or a walk to the marks."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from mapctl.errors import FileFormatError, MapctlError
from mapctl.formats.text import finite_number, read_table
from mapctl.motion import Motion

TABLE_NAME = "Frame_Cuts.csv"
"""Tables of this name are found in a data folder and below it; each holds for the files beside and below it."""
CMU = Path("cmu")
"""The name of the table for takes of the CMU database that comes with mapctl, in place of a file of one's own."""
_CMU_TABLE = Path(__file__).with_name("cmu_cuts.csv")
_EXPECTED = "a table of file, first, last, or of STYLE_NAME and a _START and a _STOP column for each kind of clip"
_STYLE = "style_name"
_COLUMNS = ("file", "first", "last")
_NONE = ("", "n/a", "na", "nan", "-")


@dataclass(frozen=True)
class Cut:
    """The frames of a file that are motion, as the file counts them, from 0 on."""

    first: int = 0
    """First of them."""
    stop: int | None = None
    """The one after the last of them; None where the file ends."""
    where: str = ""
    """Table and line, for messages."""

    def apply(self, motion: Motion) -> Motion:
        """Only these frames; MapctlError where the file has no such frames."""
        stop = motion.num_frames if self.stop is None else self.stop
        if stop > motion.num_frames or stop - self.first < 2:
            last = "the end" if self.stop is None else f"{stop - 1}"
            raise MapctlError(f"{self.where} takes frames {self.first} to {last}, but the file has {motion.num_frames}")
        return motion.slice(self.first, stop)


@dataclass(frozen=True)
class CutTable:
    """One table."""

    file: Path
    """Where it was read."""
    named: Mapping[str, Cut]
    """By the name of the file, without its ending; it may begin with folders."""
    patterns: tuple[tuple[str, Cut], ...] = ()
    """Names with *, ? or [...], in the table's order."""

    def find(self, name: str) -> Cut | None:
        """The cut of a file, told by its path below the folder that the table is for; None where it has none.

        A row that names the file counts before rows with patterns; of those the first that fits. What a row names is
        the path or the end of it.
        """
        path = PurePosixPath(_strip_ending(name))
        ends = ["/".join(path.parts[start:]) for start in range(len(path.parts))]
        named = next((self.named[end] for end in ends if end in self.named), None)
        if named is not None:
            return named
        return next((cut for pattern, cut in self.patterns if any(fnmatchcase(end, pattern) for end in ends)), None)


@dataclass(frozen=True)
class FrameCuts:
    """All tables of a data folder."""

    tables: tuple[tuple[str, CutTable], ...] = ()
    """The folder that each is for, as a path below the data folder, `` for all of it; the first that fits counts."""

    def find(self, name: str) -> Cut | None:
        """The cut of the file of this path below the data folder, or None."""
        return self._find_with_table(name)[1]

    def describe(self, names: Sequence[str]) -> tuple[str, ...]:
        """For each table that names some of these files its path and how many, as `Frame_Cuts.csv: 3 of 4 clips`."""
        counts = Counter(table for table, _ in map(self._find_with_table, names) if table)
        return tuple(f"{table}: {count} of {len(names)} clips" for table, count in counts.items())

    def _find_with_table(self, name: str) -> tuple[str, Cut | None]:
        """The cut, and the path of its table below the data folder; an empty path without one."""
        for folder, table in self.tables:
            cut = table.find(name.removeprefix(folder)) if name.startswith(folder) else None
            if cut is not None:
                return f"{folder}{table.file.name}", cut
        return "", None


def find_cuts(data: Path, given: Path | None) -> FrameCuts:
    """The table that was given, for all files, before every `Frame_Cuts.csv` in the data folder and below it.

    `cmu` is the table that comes with mapctl, unless a file is called so. FileFormatError names the row that makes no
    sense.
    """
    if given is not None and given == CMU and not given.exists():
        given = _CMU_TABLE
    tables = [] if given is None else [("", read_cuts(given))]
    own = None if given is None else given.resolve()
    for folder, folders, files in os.walk(data, onerror=lambda error: None):
        folders.sort()
        for name in sorted(files):
            file = Path(folder) / name
            if name.lower() == TABLE_NAME.lower() and file.resolve() != own:
                below = file.parent.relative_to(data).as_posix()
                tables.append(("" if below == "." else f"{below}/", read_cuts(file)))
    return FrameCuts(tuple(tables))


def read_cuts(path: Path) -> CutTable:
    """A table of file, first and last frame (from 0, the last included), or that of 100STYLE (Mason et al. 2022).

    The latter has a row a style, STYLE_NAME, and by kind of clip, as FW for the file STYLE_FW.bvh, the columns FW_START
    and FW_STOP; the frame at STOP is not taken. FileFormatError names file and line.
    """
    rows = read_table(path, _EXPECTED)
    if not rows:
        raise FileFormatError(path, f"holds no row, expected {_EXPECTED}")
    (line, head), *rows = rows
    columns = [word.lower() for word in head]
    if columns[0] == _STYLE:
        found = _read_styles(path, head, rows)
    elif tuple(columns) == _COLUMNS:
        found = _read_files(path, rows)
    else:
        raise FileFormatError(path, f"has the columns {', '.join(head)}, expected {_EXPECTED}", line)
    named: dict[str, Cut] = {}
    patterns = []
    for number, name, cut in found:
        if any(sign in name for sign in "*?["):
            patterns.append((name, cut))
        elif name in named:
            raise FileFormatError(path, f"{name} has a row already: {named[name].where}", number)
        else:
            named[name] = cut
    return CutTable(path, named, tuple(patterns))


def _read_files(path: Path, rows: list[tuple[int, list[str]]]) -> list[tuple[int, str, Cut]]:
    found = []
    for line, words in rows:
        if len(words) != len(_COLUMNS) or not words[0]:
            raise FileFormatError(path, f"a row is file, first, last, got {', '.join(words)}", line)
        name = _strip_ending(words[0].replace("\\", "/"))
        last = _parse_frame(path, line, words[2])
        found.append((line, name, _make_cut(path, line, name, words[1], None if last is None else last + 1)))
    return found


def _read_styles(path: Path, head: list[str], rows: list[tuple[int, list[str]]]) -> list[tuple[int, str, Cut]]:
    place = {word.upper(): column for column, word in enumerate(head)}
    kinds = [word.removesuffix("_START") for word in place if word.endswith("_START")]
    lacking = [f"{kind}_STOP" for kind in kinds if f"{kind}_STOP" not in place]
    if lacking or not kinds:
        raise FileFormatError(
            path, f"lacks the column {lacking[0] if lacking else 'FW_START'}, expected {_EXPECTED}", 1
        )
    found = []
    for line, words in rows:
        if len(words) != len(head) or not words[0]:
            raise FileFormatError(path, f"has {len(words)} columns, but {len(head)} in its head", line)
        for kind in kinds:
            start, stop = words[place[f"{kind}_START"]], words[place[f"{kind}_STOP"]]
            if start.lower() in _NONE and stop.lower() in _NONE:
                continue  # there is no such clip
            name = f"{words[0]}_{kind}"
            found.append((line, name, _make_cut(path, line, name, start, _parse_frame(path, line, stop))))
    return found


def _make_cut(path: Path, line: int, name: str, first: str, stop: int | None) -> Cut:
    begin = _parse_frame(path, line, first) or 0
    if stop is not None and stop <= begin:
        raise FileFormatError(path, f"{name} ends at frame {stop - 1}, before it begins, at {begin}", line)
    return Cut(begin, stop, f"{path.name}, line {line},")


def _parse_frame(path: Path, line: int, word: str) -> int | None:
    """A frame, or None where the cell is empty."""
    if word.lower() in _NONE:
        return None
    value = finite_number(word)
    if value is None or value < 0 or value != int(value):
        raise FileFormatError(path, f"a frame is a whole number from 0, got {word!r}", line)
    return int(value)


def _strip_ending(name: str) -> str:
    return name[:-4] if name.lower().endswith(".bvh") else name
