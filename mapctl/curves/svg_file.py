"""Curves in SVG drawings, read as plain points. Imported when a drawing is read: its parser is slow to import."""

import math
import warnings
from itertools import pairwise
from os import PathLike

import numpy as np
from numpy import ndarray
from svgpathtools import Line
from svgpathtools.document import CONVERSIONS, CONVERT_ONLY_PATHS, Document

from mapctl.curves.csv_file import read_text
from mapctl.curves.polyline import MAX_LENGTH, MAX_POINTS
from mapctl.errors import FileFormatError

MAX_SVG_BYTES, MAX_SVG_SEGMENTS = 2 * 2**20, 30_000
"""Largest drawing that is read: its parser takes seconds for a megabyte."""
SVG_METRES_PER_UNIT = 0.01
"""Scale of a drawing unless asked otherwise: 100 SVG units are a metre."""


def read_svg(path: str | PathLike[str], metres_per_unit: float = SVG_METRES_PER_UNIT) -> ndarray:
    """Read points (n, 2) along a drawing, metres.

    SVG x is world x and SVG y, which points down the page, is world z: the page is the ground from above. The curve is
    the drawing's paths, which must touch end to start; without any <path>, its lines, polylines, circles and the like.
    Transforms are applied. FileFormatError for a file that is no such drawing.
    """
    pieces = [_sample_segment(path, segment, metres_per_unit) for segment in _read_segments(path, metres_per_unit)]
    points = np.concatenate(pieces)
    if len(points) > MAX_POINTS:
        raise FileFormatError(path, f"needs more than {MAX_POINTS} points; is --metres-per-unit right?")
    return points


def _read_segments(path: str | PathLike[str], metres_per_unit: float) -> list:
    """Read the path segments in drawing order, each of which starts where the one before ended."""
    segments = [segment for drawn in _read_svg_paths(path) for segment in drawn]
    if not segments:
        raise FileFormatError(path, "holds no drawn path")
    if len(segments) > MAX_SVG_SEGMENTS:
        raise FileFormatError(path, f"holds {len(segments)} path segments, allowed are {MAX_SVG_SEGMENTS}")
    for before, after in pairwise(segments):
        gap = abs(after.start - before.end) * metres_per_unit
        if gap > 1e-3:
            raise FileFormatError(
                path, f"holds paths that do not touch ({gap:.3g} m apart); join them or keep only one"
            )
    return segments


def _read_svg_paths(path: str | PathLike[str]) -> list:
    text = read_text(path, MAX_SVG_BYTES, "an SVG drawing")
    try:
        document = Document.from_svg_string(text)
        for element in document.tree.iter():
            # A drawing without its xmlns is common and plain enough.
            if not element.tag.startswith("{"):
                element.tag = "{http://www.w3.org/2000/svg}" + element.tag
        with warnings.catch_warnings(action="ignore"):
            paths = document.paths(path_conversions=CONVERT_ONLY_PATHS)
            return paths or document.paths(path_conversions=CONVERSIONS)
    except Exception as error:  # the parsers raise whatever a malformed drawing leads them to
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise FileFormatError(path, f"cannot be read as an SVG drawing ({reason})") from error


def _sample_segment(path: str | PathLike[str], segment, metres_per_unit: float) -> ndarray:
    """Sample a straight segment's ends; points at most about 5 mm apart, and 8 at least, along any other."""

    def places(count: int) -> ndarray:
        with np.errstate(all="ignore"):
            at = np.array([segment.point(t) for t in np.linspace(0, 1, count + 1)])
        return np.stack([np.real(at), np.imag(at)], axis=1) * metres_per_unit

    rough = places(1 if type(segment) is Line else 8)
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.diff(rough, axis=0), axis=1).sum()
    if not (math.isfinite(length) and length <= MAX_LENGTH):
        raise FileFormatError(path, f"a path is {length:.3g} m long, allowed are {MAX_LENGTH:g}")
    wanted = min(math.ceil(length / 0.005), 100_000)
    return rough if len(rough) == 2 or wanted <= 8 else places(wanted)
