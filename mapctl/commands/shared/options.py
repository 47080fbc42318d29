"""Options that several commands share: their types for tyro, and the reading of their values."""

import os
import re
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from mapctl.errors import RequestError

if TYPE_CHECKING:
    from fractions import Fraction

    from mapctl.motion import Motion
    from mapctl.recording.masks import Mask
    from mapctl.retarget.rigs import Rig

OutFile = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
DataFolder = Annotated[Path, arg(metavar="DIR")]
File = Annotated[Path, arg(metavar="FILE")]
InFile = Positional[Annotated[Path, arg(metavar="IN")]]
CurveText = Annotated[str, arg(metavar="CURVE")]
Speed = Annotated[str, arg(metavar="M/S|ARC:M/S,...")]
Number = Annotated[float, arg(metavar="NUMBER")]
Count = Annotated[int, arg(metavar="N")]
Name = Annotated[str, arg(metavar="NAME")]
MaybeFile = Annotated[Path | None, arg(metavar="FILE")]
MaybeCurve = Annotated[str | None, arg(metavar="CURVE")]
MaybeNumber = Annotated[float | None, arg(metavar="NUMBER")]
MaybeCount = Annotated[int | None, arg(metavar="N")]
MaybeName = Annotated[str | None, arg(metavar="NAME")]
MaybeRig = Annotated[str | None, arg(metavar="PRESET|FILE.toml|CLIP")]
MaybeSize = Annotated[str | None, arg(metavar="WxH")]
CameraKind = Literal["follow", "fixed", "top"]
Size = Annotated[str, arg(metavar="WxH")]

MAX_FRAMES = 3_600_000
"""Longest motion asked for in one go: 33 hours at the priors' rate."""


def check_seed(seed: int) -> None:
    """RequestError unless torch can take the seed."""
    if not 0 <= seed < 2**63:
        raise RequestError(f"the seed must be a whole number from 0 to 2^63 - 1, got {seed}")


def count_frames(seconds: float) -> int:
    """Frames of a motion of so many seconds at the priors' rate; RequestError for none or too many."""
    from mapctl.features import PRIOR_FPS

    if not seconds > 0:
        raise RequestError(f"seconds must be positive, got {seconds:g}")
    if seconds * PRIOR_FPS > MAX_FRAMES:
        raise RequestError(f"seconds must be at most {MAX_FRAMES // PRIOR_FPS}, got {seconds:g}")
    return max(2, round(seconds * PRIOR_FPS))


def parse_size(text: str) -> tuple[int, int]:
    """`1280x720` as width and height in pixels."""
    found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if found is None:
        raise RequestError(f"the size is WIDTHxHEIGHT in pixels, as 1280x720, got {text!r}")
    return int(found[1]), int(found[2])


def read_curve(text: str, metres_per_unit: float | None):
    """The curve of a CURVE option. A file that is not there is said to be so, not taken for a shape."""
    from mapctl import curves

    if os.sep in text and not Path(text).exists():
        raise RequestError(f"{text}: no such file")
    return curves.read(text, metres_per_unit=metres_per_unit)


def read_rig(text: str | None) -> "Rig | None":
    """The rig of a --rig option: a preset, a TOML file, or that of a clip; None where none is asked for."""
    from mapctl.retarget import rigs

    return None if text is None else rigs.load_rig(text)


def read_rig_clip(text: str) -> "tuple[Motion, Rig | None]":
    """Whose skeleton a --rig option asks for: a clip; or somebody who stands on the joints of a preset or a TOML file,
    and its rig."""
    from mapctl import formats
    from mapctl.retarget import figure, rigs

    if Path(text).suffix.lower() in formats.READERS:
        return formats.load(text), None
    rig = rigs.load_rig(text)
    return figure.make_tpose_clip(rig), rig


def read_motion(path: Path, rig: "Rig | None", *, fps: "Fraction | None" = None) -> "Motion":
    """A motion in metres, in the rig's unit where it tells one; `fps` is that of an .amc."""
    from mapctl import formats

    return formats.load(path, fps=fps, metres_per_unit=None if rig is None else rig.metres_per_unit)


def read_motion_with_gaps(path: Path, rig: "Rig | None") -> "tuple[Motion, tuple[Mask, ...], bool]":
    """The same, of a file that may have NaN where something was lost; masks of what was, and whether it has any."""
    from mapctl import formats
    from mapctl.recording.masks import masks_from_missing

    motion, missing = formats.load_with_missing(path, metres_per_unit=None if rig is None else rig.metres_per_unit)
    return motion, masks_from_missing(motion, missing), bool(missing.rotations.any() or missing.places.any())


def describe_request(name: str, command: Any) -> dict[str, Any]:
    """A command and its options as a report shows them."""
    values = {field.name: getattr(command, field.name) for field in fields(command)}
    return {"command": name} | {key: str(v) if isinstance(v, Path) else v for key, v in values.items()}


def collect_paths(*paths: Path | None) -> list[Path]:
    """The paths that were asked for."""
    return [path for path in paths if path is not None]
