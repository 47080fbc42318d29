"""Curves in CSV tables and SVG drawings, read as plain points."""

import math
import warnings
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from numpy import ndarray

from mapctl.curves.curve import MAX_LENGTH, MAX_POINTS
from mapctl.errors import FileFormatError
from mapctl.formats.text import finite_number, one_line, read_bytes, shorten

_MAX_CSV_BYTES = 64 * 2**20
_COLUMNS = (("x", "z"), ("x", "y", "z"))
_EXPECTED = "columns x,z or x,y,z in metres"


def _read_text(path: str | PathLike[str], limit: int, expected: str) -> str:
    """Read the file's text, of `limit` bytes at most; FileFormatError for what is no text, with what was expected."""
    if Path(path).is_file() and Path(path).stat().st_size > limit:
        raise FileFormatError(path, f"is larger than {limit // 2**20} MiB, too large for a curve")
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise FileFormatError(path, f"is not a text file; expected {expected}")
    return text


def read_csv(path: str | PathLike[str]) -> ndarray:
    """Read points (n, 2) as x, z or (n, 3) as x, y, z from a table, metres.

    Delimiters: comma, semicolon (then a decimal comma is understood), tab or blanks. A header is optional and may order
    the columns; blank lines and lines from `#` on are skipped. FileFormatError names file and line.
    """
    rows, order = [], None
    for number, line in enumerate(_read_text(path, _MAX_CSV_BYTES, _EXPECTED).splitlines(), start=1):
        words = _split_line(line)
        if not words:
            continue
        if order is None:
            names = [word.lower() for word in words]
            columns = next((columns for columns in _COLUMNS if sorted(names) == list(columns)), None)
            if columns is not None:
                order = [names.index(column) for column in columns]
                continue
            order = list(range(len(words)))
            if len(words) not in (2, 3) or all(finite_number(word) is None for word in words):
                raise FileFormatError(path, f"found {shorten(','.join(words))}, expected {_EXPECTED}", number)
        values = [finite_number(word) for word in words]
        if len(words) != len(order) or not all(value is not None and abs(value) <= MAX_LENGTH for value in values):
            expected = f"expected {len(order)} numbers up to {MAX_LENGTH:g} (metres)"
            raise FileFormatError(path, f"{expected}, got {shorten(','.join(words))}", number)
        if len(rows) == MAX_POINTS:
            raise FileFormatError(path, f"more than {MAX_POINTS} points", number)
        rows.append(values)
    if not rows:
        raise FileFormatError(path, f"holds no points; expected {_EXPECTED}")
    return np.array(rows)[:, order]


def _split_line(line: str) -> list[str]:
    line = line.partition("#")[0].strip()
    if ";" in line:
        words = line.replace(",", ".").split(";")
    elif "," in line:
        words = line.split(",")
    else:
        words = line.split("\t") if "\t" in line else line.split()
    return [word.strip().strip('"') for word in words] if line else []


_MAX_SVG_BYTES, _MAX_SVG_SEGMENTS = 2 * 2**20, 30_000  # its parser takes seconds for a megabyte
SVG_METRES_PER_UNIT = 0.01
"""Scale of a drawing unless asked otherwise: 100 SVG units are a metre."""
_INKSCAPE_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"


def read_svg(
    path: str | PathLike[str], metres_per_unit: float = SVG_METRES_PER_UNIT, name: str | None = None
) -> ndarray:
    """Read points (n, 2) along a drawing, metres.

    SVG x is world x and SVG y, which points down the page, is world z: the page is the ground from above. The curve is
    the drawing's paths, which must touch end to start; without any <path>, its lines, polylines, circles and the like.
    `name` selects among them: an id, else Inkscape's label, else a number from 1. Transforms are applied.
    FileFormatError for a file that is no such drawing.
    """
    segments = _read_segments(path, metres_per_unit, name)
    pieces = [_sample_segment(path, segment, metres_per_unit) for segment in segments]
    points = np.concatenate(pieces)
    if len(points) > MAX_POINTS:
        raise FileFormatError(path, f"needs more than {MAX_POINTS} points; is --metres-per-unit right?")
    return points


def _read_segments(path: str | PathLike[str], metres_per_unit: float, name: str | None) -> list:
    """Read the path segments in drawing order, each of which starts where the one before ended."""
    paths = _read_svg_paths(path)
    if not paths:
        raise FileFormatError(path, "holds no drawn path")
    keys = [(each.element.get("id"), each.element.get(_INKSCAPE_LABEL), str(n)) for n, each in enumerate(paths, 1)]
    listed = one_line(", ".join(f"#{i or n}" + (f" ({label})" if label else "") for i, label, n in keys), 300)
    found = ([each for each, key in zip(paths, keys, strict=True) if key[kind] == name] for kind in range(3))
    chosen = paths if name is None else next(filter(None, found), None)
    if chosen is None:
        raise FileFormatError(path, f"holds no path {shorten(name or '')}; choose one: {listed}")
    segments = [segment for drawn in chosen for segment in drawn]
    if len(segments) > _MAX_SVG_SEGMENTS:
        raise FileFormatError(path, f"holds {len(segments)} path segments, allowed are {_MAX_SVG_SEGMENTS}")
    for before, after in pairwise(segments):
        gap = abs(after.start - before.end) * metres_per_unit
        if gap > 1e-3:
            choice = f", or add one of them to the file's name: {listed}" if len(chosen) > 1 else ""
            raise FileFormatError(path, f"holds paths that do not touch ({gap:.3g} m apart); join them{choice}")
    return segments


def _read_svg_paths(path: str | PathLike[str]) -> list:
    """Read the drawing's paths that are not empty, in its order."""
    from svgpathtools.document import CONVERSIONS, CONVERT_ONLY_PATHS, Document  # slow to import

    text = _read_text(path, _MAX_SVG_BYTES, "an SVG drawing")
    try:
        document = Document.from_svg_string(text)
        for element in document.tree.iter():
            # A drawing without its xmlns is common and plain enough.
            if not element.tag.startswith("{"):
                element.tag = "{http://www.w3.org/2000/svg}" + element.tag
        with warnings.catch_warnings(action="ignore"):
            paths = document.paths(path_conversions=CONVERT_ONLY_PATHS)
            paths = paths or document.paths(path_conversions=CONVERSIONS)
        order = {element: number for number, element in enumerate(document.tree.iter())}
        return sorted(filter(len, paths), key=lambda drawn: order[drawn.element])
    except Exception as error:  # the parsers raise whatever a malformed drawing leads them to
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise FileFormatError(path, f"cannot be read as an SVG drawing ({reason})") from error


def _sample_segment(path: str | PathLike[str], segment, metres_per_unit: float) -> ndarray:
    """Sample a straight segment's ends; points at most about 5 mm apart, and 8 at least, along any other."""

    def positions(count: int) -> ndarray:
        with np.errstate(all="ignore"):
            at = np.array([segment.point(t) for t in np.linspace(0, 1, count + 1)])
        return np.stack([np.real(at), np.imag(at)], axis=1) * metres_per_unit

    rough = positions(1 if type(segment).__name__ == "Line" else 8)
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.diff(rough, axis=0), axis=1).sum()
    if not (math.isfinite(length) and length <= MAX_LENGTH):
        raise FileFormatError(path, f"a path is {length:.3g} m long, allowed are {MAX_LENGTH:g}")
    wanted = min(math.ceil(length / 0.005), 100_000)
    return rough if len(rough) == 2 or wanted <= 8 else positions(wanted)
