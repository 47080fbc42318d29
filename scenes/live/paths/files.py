"""Files of a path: a table of x and z that is written, and what is read: tables, and SVG drawings."""

import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from mapctl import curves
from mapctl.curves import csv_file, svg_file
from mapctl.curves.curve import Curve
from mapctl.errors import FileFormatError, RequestError
from mapctl.mesh.primitives import Array
from scenes.live.paths.points import Point, choose_points, sample_curve

ENDINGS = (".csv", ".tsv", ".txt", ".svg")
"""Endings of files that are read."""
NAME = "mapctl-path.csv"
"""Name under which a path is given out."""
MAX_BYTES = 8 * 2**20
"""Largest file that a browser may send."""


@dataclass(frozen=True)
class LoadedPath:
    """Points of a path that was read."""

    points: list[Point]
    """Points that can be dragged, x and z, metres."""
    closed: bool
    """Whether the last is followed by the first."""
    note: str
    """Sentence about points that are fewer than those of the file; empty if they are not."""


def write_csv(curve: Curve) -> bytes:
    """Write a curve as a table of x and z in metres, every 5 cm, as `mapctl follow` reads it; a closed one ends where
    it begins."""
    rows = "\n".join(f"{x:.4f},{z:.4f}" for x, z in sample_curve(curve))
    return f"x,z\n{rows}\n".encode()


def read_path(name: str, content: bytes) -> LoadedPath:
    """Read what a browser sent as a file of this name. MapctlError says what is wrong, without this machine's paths."""
    if len(content) > MAX_BYTES:
        raise RequestError(f"the file has {len(content) / 2**20:.0f} MiB; a path has at most {MAX_BYTES // 2**20}")
    ending = PurePosixPath(name).suffix.lower()
    if ending not in ENDINGS:
        raise RequestError(f"a path is read from {', '.join(ENDINGS)} files, not from {name[-60:]!r}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"path{ending}"
        path.write_bytes(content)
        try:
            given = _read_points(path)
            curve = curves.from_points(given)
        except FileFormatError as error:
            raise RequestError(str(error).replace(str(path), name[-60:])) from None
    points, note = choose_points(curve, given)
    return LoadedPath(points, curve.closed, note)


def _read_points(path: Path) -> Array:
    """Read points (n, 2) over the ground."""
    given = svg_file.read_svg(path) if path.suffix == ".svg" else csv_file.read_csv(path)
    return given[:, [0, -1]]
