"""Positions of markers and joints: OpenSim's .trc, .csv in the layouts of Motive, Nexus and Mokka, .npy of joints.

A file becomes a `Capture`, from which `marker_fit` finds a motion. Gaps are NaN, in text also empty cells and three
zeros.
"""

import csv
import io
import itertools
import json
import re
import tomllib
from dataclasses import dataclass
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mapctl.errors import FileFormatError
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import LARGEST_VALUE, check_extent, decode, one_line, read_bytes, shorten, warn_once
from mapctl.formats.units import FASTEST, SLOWEST, choose_rate
from mapctl.motion import Motion

_UNITS = {"m": 1.0, "meters": 1.0, "metres": 1.0, "dm": 0.1, "cm": 0.01, "centimeters": 0.01, "mm": 0.001}
_UNITS |= {"millimeters": 0.001, "millimetres": 0.001, "in": 0.0254, "inches": 0.0254}
_BODY = (
    "pelvis lefthip righthip spine1 leftknee rightknee spine2 leftankle rightankle spine3 lefttoe righttoe neck"
    " leftcollar rightcollar head leftshoulder rightshoulder leftelbow rightelbow leftwrist rightwrist"
)
_COCO = (
    "nose leye reye lear rear leftshoulder rightshoulder leftelbow rightelbow leftwrist rightwrist"
    " lefthip righthip leftknee rightknee leftankle rightankle"
)
_H36M = (
    "pelvis righthip rightknee rightankle lefthip leftknee leftankle spine thorax nose headtop"
    " leftshoulder leftelbow leftwrist rightshoulder rightelbow rightwrist"
)
_SETS = {"SMPL": f"{_BODY} lhand rhand", "HumanML3D": _BODY, "COCO": _COCO, "H36M": _H36M}
SETS: dict[str, list[str]] = {name: words.split() for name, words in _SETS.items()}
"""Names of the joints of well-known sets, in their order."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Labelled positions of a file."""

    labels: tuple[str, ...]
    """Names of the markers or joints."""
    positions: Float[np.ndarray, "frames markers 3"]
    """Positions in the unit and the axes of the file; NaN where one is lost."""
    fps: Fraction
    """Frames per second."""
    metres_per_unit: float | None = None
    """Length of the unit that the file states, metres."""
    up: str | None = None
    """Axis that the file states to point up, as `+Z`."""


def read(
    path: str | PathLike[str],
    *,
    lossy: bool,
    fps: Fraction | float | None = None,
    markers: str | PathLike[str] | None = None,
) -> tuple[Motion, MissingValues]:
    """Read positions and fit a body to them (`marker_fit.fit`); gaps are read in any case. `fps` is the frame rate of
    a file that states none. FileFormatError names what is wrong."""
    from mapctl.formats import marker_fit

    readers = {".trc": _read_trc, ".csv": _read_csv, ".npy": _read_npy}
    return marker_fit.fit(path, readers[Path(path).suffix.lower()](path, fps), markers)


def build_capture(
    path: str | PathLike[str],
    labels: list[str],
    positions: Float[np.ndarray, "frames markers 3"],
    fps: float,
    unit: str = "",
    up: str | None = None,
) -> Capture:
    """Check what a file holds; FileFormatError for no frames or markers, and for numbers that no capture has."""
    if not positions.size:
        raise FileFormatError(path, "holds no positions of markers")
    check_extent(path, len(positions), len(labels))
    lost = ~np.isfinite(positions).all(axis=2, keepdims=True)
    positions = np.where(lost, np.nan, positions)
    _check_values(path, positions)
    if lost.all():
        raise FileFormatError(path, "every position is lost: nothing is known of the motion")
    if not SLOWEST <= fps <= FASTEST:  # also of nan
        raise FileFormatError(path, f"has {fps:g} frames per second, allowed are {SLOWEST:g} to {FASTEST:g}")
    rate = Fraction(fps).limit_denominator(1001)
    return Capture(tuple(labels), positions, rate, _UNITS.get(unit.strip().lower()), up)


def _check_values(path: str | PathLike[str], positions: Float[np.ndarray, "frames markers 3"]) -> None:
    """Raise FileFormatError for numbers so large that no capture has them."""
    if np.nanmax(np.abs(positions), initial=0) >= LARGEST_VALUE:
        raise FileFormatError(path, f"holds a position beyond {LARGEST_VALUE:g}")


def _read_trc(path: str | PathLike[str], fps: Fraction | float | None) -> Capture:
    lines = decode(path, read_bytes(path), "TRC text")[0].split("\n")
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise FileFormatError(path, "is no whole TRC file: expected PathFileType, and five lines of header")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    labels = [word.strip() for word in lines[3].rstrip().split("\t")[2::3]]
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    try:
        rate = float(header["DataRate"])
    except (KeyError, ValueError):
        raise FileFormatError(path, "the header states no DataRate", line=3) from None
    return build_capture(
        path, labels, _parse_rows(path, rows, 2 + np.arange(3 * len(labels)), 6), rate, header.get("Units", "")
    )


def _parse_rows(path: str | PathLike[str], rows: list[list[str]], columns: np.ndarray, line: int) -> np.ndarray:
    """Parse three columns a marker; an empty or a missing cell is a gap."""
    values = np.full((len(rows), len(columns)), np.nan)
    check_extent(path, len(rows), len(columns))
    for number, row in enumerate(rows):
        words = [row[column].strip() if column < len(row) else "" for column in columns]
        try:
            values[number] = [float(word) if word else np.nan for word in words]
        except ValueError as error:
            raise FileFormatError(path, f"{one_line(error)}, expected numbers", line + number) from None
    positions = values.reshape(len(rows), len(columns) // 3, 3)
    positions[(positions == 0).all(axis=2)] = np.nan
    return positions


def _read_csv(path: str | PathLike[str], fps: Fraction | float | None) -> Capture:
    """Read the first table of positions: rows of header, of which one may have X, Y, Z under names, then numbers."""
    text, _ = decode(path, read_bytes(path), "CSV text")
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise FileFormatError(path, f"is no sound CSV: {one_line(error)}") from None
    sections = [n for n, row in enumerate(rows) if row and row[0].strip().lower() == "trajectories"]
    offset = sections[0] + 1 if sections else 0
    rows = rows[offset:]
    first = next((n for n, row in enumerate(rows) if n and _is_number(row[:1] + row[2:3])), len(rows))
    header, body = rows[:first], list(itertools.takewhile(lambda row: _is_number(row[:1]), rows[first:]))
    names, columns = _find_columns(header)
    if not names or not body:
        raise FileFormatError(
            path, "is no CSV of positions: expected columns name.x, name.y, name.z, or X, Y, Z under names"
        )
    above = dict(itertools.pairwise(word.strip().lower() for row in header for word in row))
    rate = choose_rate(path, _find_rate(header, body), fps)
    unit = next((word for row in header for word in row if word.strip().lower() in _UNITS and len(word) > 1), "")
    unit = above.get("length units", unit)
    positions = _parse_rows(path, body, np.array(columns), offset + first + 1)
    return build_capture(path, names, positions, rate, unit)


def _is_number(words: list[str]) -> bool:
    return (
        bool(words)
        and all(re.fullmatch(r"\s*[-+]?\d+\.?\d*(e[-+]?\d+)?\s*|", word, re.I) for word in words)
        and bool(words[0].strip())
    )


def _find_columns(header: list[list[str]]) -> tuple[list[str], list[int]]:
    """Find the markers of a table and the columns of their coordinates, by the header's last row that has name.x,
    name.y, name.z, or X, Y, Z; the names of the latter are above: in the row called Name, else in the next one."""
    names, columns = [], []
    for n in reversed(range(len(header))):
        ends = [re.fullmatch(r"(.*?)[\s._:\-]*([xyz])", word.strip(), re.I) for word in header[n]]
        above = header[:n]
        named = (row for row in above if "name" in [word.strip().lower() for word in row[:2]])
        titles = next(named, above[-1] if above else [])
        kinds = next((row for row in above if "Position" in row), None)  # rotations have columns as well
        for c in range(len(ends) - 2):
            found = [end.groups() for end in ends[c : c + 3] if end]
            if [axis.lower() for _, axis in found] != ["x", "y", "z"] or len({name for name, _ in found}) > 1:
                continue
            name = found[0][0]
            if not name and c < len(titles) and (kinds is None or kinds[c : c + 1] == ["Position"]):
                name = titles[c].strip()
            if name:
                names.append(name)
                columns += [c, c + 1, c + 2]
        if names:
            break
    return names, columns


def _find_rate(header: list[list[str]], body: list[list[str]]) -> float | None:
    """Find the frame rate: stated in the header, or by the times in a column of that name."""
    for row in header:
        words = [word.strip().lower() for word in row]
        for key, value in itertools.pairwise(words):
            if key in ("export frame rate", "capture frame rate", "frame rate", "fps") and _is_number([value]):
                return float(value)
        if words and _is_number(words[:1]) and not any(w for w in words[1:] if w != "hz"):
            return float(words[0])  # alone in its row, as in Nexus
        for column, word in enumerate(words[:2]):
            if word.startswith("time") and len(body) > 1:
                try:
                    first, last = float(body[0][column]), float(body[-1][column])
                    rate = (len(body) - 1) / (last - first)
                except (ValueError, IndexError, ZeroDivisionError):
                    continue
                printed = 10.0 ** -len(body[-1][column].partition(".")[2])  # times are rounded, rates mostly whole
                return float(round(rate)) if abs(rate - round(rate)) <= 2 * rate * printed / abs(last - first) else rate
    return None


def _read_npy(path: str | PathLike[str], fps: Fraction | float | None) -> Capture:
    """Read (frames, joints, 3); the names are in a .toml, .json or .txt beside it, or those of a well-known set."""
    raw = read_bytes(path)
    try:
        values = np.load(io.BytesIO(raw), allow_pickle=False)
    except Exception as error:  # numpy raises whatever a forged header leads its parser to
        pickled = "; of a pickle of SMPL parameters save its poses, trans and mocap_framerate as an .npz"
        why = f"is no sound .npy array: {one_line(error)}{pickled if 'allow_pickle' in str(error) else ''}"
        raise FileFormatError(path, why) from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or values.ndim != 3 or values.shape[2] != 3:
        found = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else "an archive"
        raise FileFormatError(path, f"holds {found}, expected numbers of shape (frames, joints, 3)")
    values = values.astype(np.float64)
    _check_values(path, values)
    names, rate = _read_names(Path(path))
    if names is None:
        found = [name for name, joints in SETS.items() if len(joints) == values.shape[1]]
        if len(found) > 1 and len(values):
            found.sort(key=lambda name: _measure_flexing(values, SETS[name]))
        if not found:
            known = ", ".join(f"{len(joints)} ({name})" for name, joints in SETS.items())
            raise FileFormatError(
                path,
                f"has {values.shape[1]} joints without names: list them in a .txt beside it; known sets have {known}",
            )
        names = SETS[found[0]]
        warn_once(f"{path}: its {len(names)} joints are taken for those of {found[0]}")
    if len(names) != values.shape[1]:
        raise FileFormatError(path, f"has {values.shape[1]} joints, and the file of names beside it {len(names)}")
    return build_capture(path, names, values, choose_rate(path, rate, fps))


def _measure_flexing(positions: Float[np.ndarray, "frames joints 3"], names: list[str]) -> float:
    """Measure by how much bones of limbs change their length, and differ between sides: little by the right names."""
    total = 0.0
    for bone in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
        ends = [[names.index(side + part) for part in bone] for side in ("left", "right")]
        lengths = np.stack([np.linalg.norm(positions[:, a] - positions[:, b], axis=1) for a, b in ends])
        total += float(np.nanstd(lengths) / max(float(np.nanmean(lengths)), 1e-9))
    return total


def _read_names(path: Path) -> tuple[list[str] | None, float | None]:
    """Read the names of joints, and the frame rate where it is there, from a file beside the array."""
    for ending in (".toml", ".json", ".txt"):
        beside = path.with_suffix(ending)
        if not beside.is_file():
            continue
        text = decode(beside, read_bytes(beside), "names of joints")[0]
        try:
            found: Any = text.split() if ending == ".txt" else (json if ending == ".json" else tomllib).loads(text)
            named: dict[str, Any] = {"names": found} if isinstance(found, list) else found
            rate = named.get("fps")
            return [str(name) for name in named["names"]], None if rate is None else float(rate)
        except (ValueError, KeyError, TypeError, RecursionError, AttributeError):
            why = f"expected a list of the joints' `names`, and `fps` if known, found {shorten(text)}"
            raise FileFormatError(beside, why) from None
    return None, None
