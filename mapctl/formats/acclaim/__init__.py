"""ASF and AMC files to Motion: a joint at the start of every bone, with the rotation of that bone.

In an ASF a bone's rotation turns the bone itself, about an own frame C that is fixed in the parent's: the turn is
C R inverse(C). So in the rest pose every joint frame is aligned with the world, a joint's offset is its parent bone
from start to end, and the last bones' ends are End Sites. Bones of the root start at the root.
"""

from collections.abc import Sequence
from fractions import Fraction
from os import PathLike, fspath
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import missing
from mapctl.formats.acclaim import amc
from mapctl.formats.acclaim import asf as asf_skeleton
from mapctl.formats.acclaim.asf import AsfSkeleton
from mapctl.formats.bvh import euler
from mapctl.formats.frame_rate import FASTEST, SLOWEST
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import check_extent, read_bytes
from mapctl.formats.units import FileUnit, guess_unit
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

USUAL_FPS = Fraction(120)
"""Frames per second of a file that does not say: those of the CMU database."""
_INCH = 0.0254
"""Metres."""


def load(path: str | PathLike[str], *, fps: Fraction | float | None = None) -> Motion:
    """Read `take.amc` with the skeleton beside it, or `subject.asf+take.amc`.

    Without a name the skeleton is the .asf of the same stem, else the only one in the folder. `fps` is frames per
    second, over what the file says; else `USUAL_FPS`. Lengths are in metres by the ASF's `length`, or where that is 1
    by the size of the body. FileFormatError says what is wrong, in which line.
    """
    return _read(path, fps=fps, lossy=False)[0]


def load_with_missing(
    path: str | PathLike[str], *, fps: Fraction | float | None = None
) -> tuple[Motion, MissingValues]:
    """Read a take in which some values are NaN, and which they are; FileFormatError where all of them are."""
    return _read(path, fps=fps, lossy=True)


def _read(path: str | PathLike[str], *, fps: Fraction | float | None, lossy: bool) -> tuple[Motion, MissingValues]:
    if fps is not None and not SLOWEST <= fps <= FASTEST:
        raise RequestError(f"the frame rate must be {SLOWEST:g} to {FASTEST:g}, got {float(fps):g}")
    try:
        subject, take = find_paths(path)
    except OSError as error:  # as a name that is too long, or a folder that may not be listed
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    asf = asf_skeleton.read(subject)
    text = amc.read(take, asf, lossy=lossy)
    check_extent(take, len(text.values), len(asf.names))
    missing.check_any_known(take, np.isnan(text.values))
    degrees = asf.degrees if text.degrees is None else text.degrees
    skeleton, unit = _build_skeleton(asf)
    places = missing.interpolate_nan(_positions(asf, text.values), np.zeros(3))
    motion = Motion(
        skeleton=skeleton,
        fps=Fraction(fps or text.fps or USUAL_FPS).limit_denominator(100_000),
        root_position=torch.from_numpy((places + asf.root_position) * unit.metres_per_unit),
        local_quat_xyzw=_quaternions(asf, missing.hold_last(text.values), degrees=degrees),
        source=unit,
    )
    return motion, _find_missing(asf, np.isnan(text.values))


def _find_missing(asf: AsfSkeleton, lost: np.ndarray) -> MissingValues:
    """Find the missing values by bone; a bone without channels is missing where all channels are."""
    whole = lost.all(axis=1)
    turns = [lost[:, columns].any(axis=1) | whole for _, columns in _columns(asf, "r")]
    places = np.zeros((len(lost), len(turns)), dtype=bool)
    places[:, 0] = lost[:, _columns(asf, "t")[0][1]].any(axis=1)
    return MissingValues(torch.from_numpy(np.stack(turns, axis=1)), torch.from_numpy(places))


def find_paths(path: str | PathLike[str]) -> tuple[Path, Path]:
    """Find the skeleton's and the motion's file. FileFormatError names the candidates where the first is not clear.

    In `folder/subject.asf+take.amc` the take lies in the same folder unless it names one; `subject.asf+.amc` are two
    files of one stem.
    """
    text, file = fspath(path), Path(path)
    cut = text.lower().find(".asf+")
    if cut >= 0 and not file.exists():
        subject, take = Path(text[: cut + 4]), Path(text[cut + 5 :])
        if take.name.lower() == ".amc":
            take = take.with_name(subject.stem + take.name)
        return subject, take if len(take.parts) > 1 else subject.parent / take
    if not file.is_file():
        read_bytes(file)  # raises what is wrong with it
    near = sorted(other for other in file.parent.iterdir() if other.suffix.lower() == ".asf" and other.is_file())
    same = [other for other in near if other.stem == file.stem]
    found = same or near
    if len(found) != 1:
        names = ", ".join(other.name for other in found[:8]) or "none"
        wanted = f"name one as {found[0].name if found else 'subject.asf'}+{file.name}"
        raise FileFormatError(path, f"needs the skeleton of its subject, an .asf; beside it: {names}; {wanted}")
    return found[0], file


def _build_skeleton(asf: AsfSkeleton) -> tuple[Skeleton, FileUnit]:
    """Build joints at the bones' starts, in metres; also return the file's unit."""
    parents = list(asf.parents)
    offsets = np.concatenate([np.zeros((1, 3)), asf.ends[parents[1:]]])
    leaves = [bone for bone in range(1, len(parents)) if bone not in set(parents)]
    unit = FileUnit(_INCH / asf.length)
    if asf.length == 1:
        ends = {bone: asf.ends[bone].tolist() for bone in leaves}
        unit = guess_unit(asf.names, parents, offsets, end_offsets=ends)
    scale = unit.metres_per_unit
    sites = {asf.names[bone]: tuple((asf.ends[bone] * scale).tolist()) for bone in leaves}
    return Skeleton(asf.names, asf.parents, torch.from_numpy(offsets * scale), sites), unit


def _columns(asf: AsfSkeleton, kind: str) -> list[tuple[tuple[int, ...], list[int]]]:
    """Return by bone the axes of its channels of a kind, `t` or `r`, in file order, and their columns."""
    found, start = [], 0
    for channels in asf.channels:
        wanted = [(channel, start + place) for place, channel in enumerate(channels) if channel[0] == kind]
        found.append((tuple("xyz".index(channel[1]) for channel, _ in wanted), [column for _, column in wanted]))
        start += len(channels)
    return found


def _positions(asf: AsfSkeleton, values: np.ndarray) -> np.ndarray:
    """Return root positions (frames, 3), file unit."""
    positions = np.zeros((len(values), 3))
    axes, columns = _columns(asf, "t")[0]
    positions[:, list(axes)] = values[:, columns]
    return positions


def _quaternions(asf: AsfSkeleton, values: np.ndarray, *, degrees: bool) -> Float[Tensor, "frames joints 4"]:
    """Return the local rotations C R inverse(C), continuous in sign over time."""
    turns = np.empty((len(values), len(asf.names), 4))
    for bone, (axes, columns) in enumerate(_columns(asf, "r")):
        angles = values[:, columns[::-1]]
        # About fixed axes the first named rotation comes first; about moving ones, last.
        turns[:, bone] = euler.to_quat_xyzw(np.deg2rad(angles) if degrees else angles, _reverse_axes(axes))
    frame = torch.from_numpy(asf.axis_quat_xyzw).expand(len(values), -1, 4)
    about = rotations.multiply(rotations.multiply(frame, torch.from_numpy(turns)), rotations.inverse(frame))
    return rotations.make_sign_continuous(about)


def _reverse_axes(axes: Sequence[int]) -> tuple[int, ...]:
    return tuple(axes[::-1])
