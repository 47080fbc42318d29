"""Drawings of poses: CSV files of joint,x,y, as a pose is seen from one side."""

from os import PathLike

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.text import finite_number, read_table, shorten
from mapctl.intent.keyframes import Drawing

_COLUMNS = ("joint", "x", "y")


def read_drawing(path: str | PathLike[str], view_deg: float = 0.0) -> Drawing:
    """Read a drawing, x to the viewer's right and y up, in any unit. FileFormatError names file and line."""
    lines = read_table(path, f"a CSV of the columns {','.join(_COLUMNS)}")
    header, names = (lines[0][0], [word.lower() for word in lines[0][1]]) if lines else (1, [])
    if sorted(names) != sorted(_COLUMNS):
        found = shorten(",".join(names))
        raise FileFormatError(path, f"found the columns {found}, expected {','.join(_COLUMNS)}, each once", header)
    places: dict[str, tuple[float, float]] = {}
    for number, words in lines[1:]:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
        told = dict(zip(names, words, strict=True))
        if not told["joint"] or told["joint"] in places:
            raise FileFormatError(path, f"each line names a joint, each once, got {shorten(told['joint'])}", number)
        x, y = (_read_number(path, number, axis, told[axis]) for axis in ("x", "y"))
        places[told["joint"]] = (x, y)
    try:
        return Drawing(places, view_deg)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error


def _read_number(path: str | PathLike[str], line: int, axis: str, word: str) -> float:
    value = finite_number(word)
    if value is None:
        raise FileFormatError(path, f"{axis} must be a finite number, got {shorten(word)}", line)
    return value
