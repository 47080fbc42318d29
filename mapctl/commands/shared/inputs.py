"""Readers of what options name: curves, rigs and motions."""

import os
from fractions import Fraction
from pathlib import Path

from mapctl import curves, formats
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.recording.masks import Mask, masks_from_missing
from mapctl.retarget import figure, load_rig
from mapctl.retarget.rigs import Rig
from priors.licences import note_licence

MAX_FRAMES = 3_600_000
"""Frames of the longest motion in one call: 33 hours at the priors' rate."""


def count_frames(seconds: float) -> int:
    """Convert seconds to frames at the priors' rate; RequestError for none or too many."""
    if not seconds > 0:
        raise RequestError(f"seconds must be positive, got {seconds:g}")
    if seconds * PRIOR_FPS > MAX_FRAMES:
        raise RequestError(f"seconds must be at most {MAX_FRAMES // PRIOR_FPS}, got {seconds:g}")
    return max(2, round(seconds * PRIOR_FPS))


def read_curve(text: str, metres_per_unit: float | None) -> Curve:
    """Read the curve of a CURVE option. A missing file is reported as such, not taken for a shape."""
    if any(mark in text for mark in (os.sep, os.altsep) if mark) and not Path(text).exists():
        raise RequestError(f"{text}: no such file")
    return curves.read(text, metres_per_unit=metres_per_unit)


def read_rig(text: str | None) -> Rig | None:
    """Read the rig of a --rig option: a preset, a TOML file, or that of a clip; None without the option."""
    return None if text is None else load_rig(text)


def read_rig_clip(text: str) -> tuple[Motion, Rig | None]:
    """Read the clip whose skeleton a --rig option names: a file, of a character standing in its rest pose; or a T-pose
    on the joints of a preset or a TOML file, and its rig."""
    if formats.ending_of(text) in formats.READERS:
        standing = figure.load_standing_character(text)
        return (formats.load(text) if standing is None else standing), None
    rig = load_rig(text)
    return figure.make_tpose_clip(rig), rig


def read_motion(path: Path, rig: Rig | None, *, fps: Fraction | None = None) -> Motion:
    """Read a motion in metres, from the rig's unit where it has one; `fps` is that of an .amc."""
    motion = formats.load(path, fps=fps, metres_per_unit=None if rig is None else rig.metres_per_unit)
    note_licence(str(path), motion.licence)
    return motion


def read_motion_with_gaps(path: Path, rig: Rig | None) -> tuple[Motion, tuple[Mask, ...], bool]:
    """Read a motion in which missing values may be NaN; also return their masks, and whether there are any."""
    motion, missing = formats.load_with_missing(path, metres_per_unit=None if rig is None else rig.metres_per_unit)
    note_licence(str(path), motion.licence)
    return motion, masks_from_missing(motion, missing), bool(missing.rotations.any() or missing.places.any())
