"""Motions that are written while they are made, frame by frame, so that a crash loses none that was written.

The first line is `mapctl-recording-1`. Then, numbers least byte first: the length of an archive, 4 bytes; the archive,
as `npz` writes it, of the first frame: it tells skeleton and frame rate; and all frames, the first one too, each of the
same length: the CRC-32 of what follows, 4 bytes, and as 8-byte floats the root's position in the world, metres, and the
rotation of each joint in its parent's frame, quaternions xyzw. A frame that the end of the file cuts off is none.
"""

import io
import struct
import zlib
from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats import npz
from mapctl.formats.text import read_bytes
from mapctl.motion import Motion

MAGIC = b"mapctl-recording-1\n"
"""First line of a file."""
_LENGTH = struct.Struct("<I")
_NUMBERS = np.dtype("<f8")


class MotionWriter:
    """Appends frames to a file; what was added is in the hands of the system, which keeps it if this program dies."""

    def __init__(self, file: io.RawIOBase | io.BufferedIOBase):
        """Append to an empty file, opened for bytes without a buffer."""
        self._file = file
        self.frames = 0
        """Number of frames added."""

    def add(self, motion: Motion) -> None:
        """Add frames, of the same skeleton and rate as all before. OSError where they cannot be written: the file then
        ends with the frames before."""
        rows = _to_rows(motion)
        content = b"".join(_LENGTH.pack(zlib.crc32(row)) + row for row in map(bytes, rows))
        if not self.frames:
            content = _encode_head(motion) + content
        begun = self._file.tell()
        try:
            _write_whole(self._file, content)
        except OSError:
            self._file.truncate(begun)
            raise
        self.frames += len(rows)


def load(path: str | PathLike[str]) -> Motion:
    """Read what a MotionWriter wrote, to the last whole frame. FileFormatError names the frame that is damaged."""
    return decode(path, read_bytes(path))


def decode(path: str | PathLike[str], raw: bytes) -> Motion:
    """Read the content of a file; `path` names it in errors."""
    start = len(MAGIC) + _LENGTH.size
    if not raw.startswith(MAGIC):
        raise FileFormatError(path, f"is no recording: it does not begin with {MAGIC.decode().strip()!r}")
    if len(raw) < start:
        raise FileFormatError(path, "ends before its first frame")
    end = start + _LENGTH.unpack_from(raw, len(MAGIC))[0]
    if len(raw) < end:
        raise FileFormatError(path, "ends before its first frame")
    arrays = npz.read_arrays(path, raw[start:end])
    values = _read_frames(path, raw, end, joints=arrays["names"].size)
    arrays |= {
        "root_position_world": values[:, :3],
        "local_quat_xyzw": values[:, 3:].reshape(len(values), -1, 4),
        "moving_joints": np.zeros(0, dtype=np.int64),
        "moving_offsets": np.zeros((0, len(values), 3)),
    }
    return npz.build_motion(path, arrays)[0]


def _read_frames(path: str | PathLike[str], raw: bytes, start: int, *, joints: int) -> np.ndarray:
    """Return the numbers of the whole frames, a row each."""
    record = np.dtype([("crc", "<u4"), ("values", _NUMBERS, (3 + 4 * joints,))])
    records = np.frombuffer(raw, record, count=(len(raw) - start) // record.itemsize, offset=start)
    if not len(records):
        raise FileFormatError(path, "ends before its first frame")
    for number, (crc, values) in enumerate(records):
        if zlib.crc32(values.tobytes()) != crc:
            raise FileFormatError(path, f"frame {number} is damaged: its checksum is wrong")
    return records["values"].astype(np.float64)


def _to_rows(motion: Motion) -> np.ndarray:
    count = motion.num_frames
    parts = motion.root_position.reshape(count, -1), motion.local_quat_xyzw.reshape(count, -1)
    return np.concatenate([part.detach().cpu().double().numpy() for part in parts], axis=1).astype(_NUMBERS)


def _encode_head(motion: Motion) -> bytes:
    archive = npz.pack_arrays(npz.to_arrays(motion.slice(0, 1)))
    return MAGIC + _LENGTH.pack(len(archive)) + archive


def _write_whole(file: io.RawIOBase | io.BufferedIOBase, content: bytes) -> None:
    left = memoryview(content)
    while left:
        left = left[file.write(left) or 0 :]
