"""Motions as numpy archives: the exact numbers, for use without this library.

Keys (frames T, joints J, travelling joints M, joints with an End Site E; lengths in metres, Y up):

- `format`: the text `mapctl-motion-1`
- `names` (J,) text; `parents` (J,) whole numbers, -1 for the root
- `offsets` (J, 3): each joint in its parent's frame at rest
- `end_names` (E,) text and `end_offsets` (E, 3): End Sites
- `fps` (2,) whole numbers: numerator and denominator of the frames per second
- `root_position_world` (T, 3); `local_quat_xyzw` (T, J, 4): each joint's rotation in its parent's frame
- `moving_joints` (M,) whole numbers and `moving_offsets` (M, T, 3): joints whose offset is animated
- `licence`: a text, only where the motion has a licence

What another format needs to write a file back as it came (`Motion.source`) is not kept.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.formats import missing
from mapctl.formats.atomic import write_bytes
from mapctl.formats.bvh import as_array
from mapctl.formats.missing import MissingValues
from mapctl.formats.text import LARGEST_VALUE, MAX_FILE_BYTES, NUMBER, one_line, read_bytes
from mapctl.formats.units import FASTEST, SLOWEST
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

FORMAT = "mapctl-motion-1"
"""Name and version of the set of keys."""

# Key: kind of number (numpy's letters) and shape, by the letters of the module's docstring.
_KEYS = {
    "format": ("U", ""),
    "names": ("U", "J"),
    "parents": ("i", "J"),
    "offsets": ("f", "J3"),
    "end_names": ("U", "E"),
    "end_offsets": ("f", "E3"),
    "fps": ("i", "2"),
    "root_position_world": ("f", "T3"),
    "local_quat_xyzw": ("f", "TJ4"),
    "moving_joints": ("i", "M"),
    "moving_offsets": ("f", "MT3"),
}

_LICENCE = "licence"
"""Key that may be missing."""
_TRACKS = ("root_position_world", "local_quat_xyzw", "moving_offsets")
"""Keys that change from frame to frame, and may hold NaN where a lossy reading is requested."""


def read(
    path: str | PathLike[str], *, lossy: bool, fps: Fraction | float | None = None
) -> tuple[Motion, MissingValues]:
    """Read what `save` wrote, or SMPL parameters (`mapctl.formats.smpl`), of which `fps` may be the frames per second.
    FileFormatError names the key that is missing or wrong. Some rotations and positions of a `lossy` archive may be
    NaN."""
    from mapctl.formats import smpl  # which reads arrays by this module

    raw = read_bytes(path)
    with _open_archive(path, raw) as archive:
        is_smpl = not set(smpl.POSES).isdisjoint(archive.files)
    if is_smpl:
        motion = smpl.build_motion(path, read_arrays(path, raw, (), smpl.KEYS), fps=fps)
        return motion, MissingValues.none(motion.num_frames, motion.num_joints)
    if fps is not None:
        raise RequestError(f"{path}: a motion of mapctl has a frame rate of its own; leave the requested one out")
    arrays = read_arrays(path, raw, tuple(_KEYS), (_LICENCE,))
    _check_shapes(path, arrays, lossy=lossy)
    lost = _replace_missing(path, arrays)
    if (found := str(arrays["format"])) != FORMAT:
        raise FileFormatError(path, f"format is {found[:40]!r}, expected {FORMAT!r}")
    if (np.abs(np.linalg.norm(arrays["local_quat_xyzw"], axis=-1) - 1) > 1e-3).any():
        raise FileFormatError(path, "local_quat_xyzw holds what is no unit quaternion")
    try:
        return _build_motion(arrays), lost
    except (MapctlError, ZeroDivisionError, ValueError, IndexError) as error:
        raise FileFormatError(path, f"does not hold a motion: {one_line(error)}") from error


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the motion under the keys above. Same motion, same bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **to_arrays(motion))
    write_bytes(path, buffer.getvalue())


def to_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """Return the arrays of a motion, by the keys above."""
    skeleton, moving = motion.skeleton, sorted(motion.moving_offsets)
    tracks = np.array([as_array(motion.moving_offsets[joint]) for joint in moving])
    return {
        "format": np.array(FORMAT),
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, dtype=np.int64),
        "offsets": as_array(skeleton.offsets),
        "end_names": np.array(list(skeleton.end_offsets), dtype=np.str_),
        "end_offsets": np.array(list(skeleton.end_offsets.values()), dtype=np.float64).reshape(-1, 3),
        "fps": np.array([motion.fps.numerator, motion.fps.denominator], dtype=np.int64),
        "root_position_world": as_array(motion.root_position),
        "local_quat_xyzw": as_array(motion.local_quat_xyzw),
        "moving_joints": np.array(moving, dtype=np.int64),
        "moving_offsets": tracks.reshape(len(moving), motion.num_frames, 3),
    } | ({_LICENCE: np.array(motion.licence)} if motion.licence else {})


def _build_motion(arrays: dict[str, np.ndarray]) -> Motion:
    names, end_names, moving = (arrays[key].tolist() for key in ("names", "end_names", "moving_joints"))
    if not set(end_names) <= set(names) or not set(moving) <= set(range(1, len(names))):
        raise MapctlError("end_names and moving_joints must be joints of the skeleton")
    if len(set(end_names)) < len(end_names) or len(set(moving)) < len(moving):
        raise MapctlError("end_names and moving_joints must name a joint once")
    fps = Fraction(*arrays["fps"].tolist())
    if not SLOWEST <= fps <= FASTEST:
        raise MapctlError(f"{float(fps):g} frames per second, allowed are {SLOWEST:g} to {FASTEST:g}")
    ends = {name: (x, y, z) for name, (x, y, z) in zip(end_names, arrays["end_offsets"].tolist(), strict=True)}
    return Motion(
        skeleton=Skeleton(tuple(names), tuple(arrays["parents"].tolist()), _tensor(arrays["offsets"]), ends),
        fps=fps,
        root_position=_tensor(arrays["root_position_world"]),
        local_quat_xyzw=_tensor(arrays["local_quat_xyzw"]),
        moving_offsets={j: _tensor(track) for j, track in zip(moving, arrays["moving_offsets"], strict=True)},
        licence=str(arrays.get(_LICENCE, "")),
    )


def read_arrays(
    path: str | PathLike[str], raw: bytes, needed: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Read arrays of an archive. Sizes are bounded before anything is unpacked, and pickled objects are refused."""
    with _open_archive(path, raw) as archive:
        if lacking := [key for key in needed if key not in archive]:
            raise FileFormatError(path, f"lacks the keys {', '.join(lacking)}")
        keys = [key for key in (*needed, *optional) if key in archive]
        if (total := sum(archive.zip.getinfo(f"{key}.npy").file_size for key in keys)) > MAX_FILE_BYTES:
            raise FileFormatError(path, f"unpacks to {total >> 20} MiB, allowed are {MAX_FILE_BYTES >> 20}")
        return {key: archive[key] for key in keys}


@contextmanager
def _open_archive(path: str | PathLike[str], raw: bytes) -> Iterator[Any]:
    if not raw.startswith(b"PK\x03\x04"):
        raise FileFormatError(path, "is not an .npz archive")
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            yield archive
    except FileFormatError:
        raise
    except Exception as error:  # zipfile and numpy raise whatever a forged archive leads their parsers to
        raise FileFormatError(path, f"is not a sound .npz archive: {one_line(error)}") from error


def _check_shapes(path: str | PathLike[str], arrays: dict[str, np.ndarray], *, lossy: bool) -> None:
    sizes = {"2": 2, "3": 3, "4": 4}
    sizes |= {"J": arrays["names"].size, "E": arrays["end_names"].size, "M": arrays["moving_joints"].size}
    sizes["T"] = len(np.atleast_1d(arrays["root_position_world"]))
    keys = _KEYS | ({_LICENCE: ("U", "")} if _LICENCE in arrays else {})
    for key, (kind, letters) in keys.items():
        values, wanted = arrays[key], tuple(sizes[letter] for letter in letters)
        if values.dtype.kind != kind or values.shape != wanted:
            found = f"{values.dtype} and shape {values.shape}"
            raise FileFormatError(path, f"{key} has {found}, expected kind {kind!r} and shape {wanted}")
        # NaN compares as not small.
        small = np.abs(values.astype(np.float64)) < LARGEST_VALUE if kind == "f" else np.True_
        if key in _TRACKS and lossy:
            small = small | np.isnan(values)
        if not small.all():
            index = np.argwhere(~small)[0].tolist()
            hint = missing.missing_hint(str(values[tuple(index)])) if key in _TRACKS else ""
            raise FileFormatError(path, f"{key} at {index}: expected {NUMBER}{hint}")


def _replace_missing(path: str | PathLike[str], arrays: dict[str, np.ndarray]) -> MissingValues:
    """Replace NaN in the arrays, and return where it was."""
    lost: list[np.ndarray] = [np.isnan(arrays[key]) for key in _TRACKS]
    missing.check_any_known(path, np.concatenate([part.ravel() for part in lost]))
    root, turns, moving = lost
    positions = np.zeros_like(turns[:, :, 0])
    positions[:, 0] = root.any(axis=-1)
    for track, joint in enumerate(arrays["moving_joints"].tolist()):
        if 0 < joint < positions.shape[1]:  # others are refused later
            positions[:, joint] = moving[track].any(axis=-1)
    if any(part.any() for part in lost):
        whole = np.where(turns.any(axis=-1, keepdims=True), np.nan, arrays["local_quat_xyzw"])
        held = missing.hold_last(whole.reshape(len(whole), -1)).reshape(whole.shape)
        never = ~held.any(axis=-1)
        held[never] = (0.0, 0.0, 0.0, 1.0)
        tracks = [missing.interpolate_nan(track, np.zeros(3)) for track in arrays["moving_offsets"]]
        arrays |= {
            "local_quat_xyzw": held,
            "moving_offsets": np.array(tracks).reshape(moving.shape),
            "root_position_world": missing.interpolate_nan(arrays["root_position_world"], np.zeros(3)),
        }
    return MissingValues(torch.from_numpy(turns.any(axis=-1)), torch.from_numpy(positions))


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))
