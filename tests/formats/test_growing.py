"""A motion that is written while it is made: what was added is there whatever happens next."""

import io
import random

import numpy as np
import pytest
from helpers import run, walk

from mapctl import formats
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import growing
from mapctl.formats.growing import MotionWriter


def write(motion, pieces: int = 3) -> bytes:
    file = io.BytesIO()
    writer = MotionWriter(file)
    for first in range(0, motion.num_frames, pieces):
        writer.add(motion.slice(first, min(first + pieces, motion.num_frames)))
    assert writer.frames == motion.num_frames
    return file.getvalue()


@pytest.fixture(scope="module")
def motion():
    return walk(12)


@pytest.fixture(scope="module")
def content(motion) -> bytes:
    return write(motion)


def test_it_holds_the_exact_numbers(motion, content, tmp_path):
    path = tmp_path / "take.recording"
    path.write_bytes(content)
    read = formats.load(path)
    assert read.skeleton.names == motion.skeleton.names
    assert read.fps == motion.fps
    np.testing.assert_array_equal(read.root_position, motion.root_position)
    np.testing.assert_array_equal(read.local_quat_xyzw, motion.local_quat_xyzw)


def test_wherever_it_is_cut_all_whole_frames_are_there(motion, content):
    size = 4 + 8 * (3 + 4 * motion.num_joints)
    head = len(content) - 12 * size
    for end in (head + size, head + 2 * size - 1, head + 7 * size + 5, len(content) - 1):
        read = growing.decode("x", content[:end])
        assert read.num_frames == (end - head) // size
        np.testing.assert_array_equal(read.root_position, motion.root_position[: read.num_frames])
    for end in (0, 5, len(growing.MAGIC), len(growing.MAGIC) + 2, head - 1, head, head + size - 1):
        with pytest.raises(FileFormatError, match=r"first frame|no recording"):
            growing.decode("x", content[:end])


def test_a_damaged_frame_is_named(content):
    size = 4 + 8 * (3 + 4 * 21)
    for frame in (0, 5, 11):
        wrong = bytearray(content)
        wrong[len(content) - (12 - frame) * size + 100] ^= 1
        with pytest.raises(FileFormatError, match=f"frame {frame} is damaged"):
            growing.decode("x", bytes(wrong))


class Full(io.BytesIO):
    """A disk with room for so many bytes."""

    room = 0

    def write(self, content):
        taken = bytes(content)[: self.room]
        if not taken:
            raise OSError(28, "No space left on device")
        self.room -= len(taken)
        return super().write(taken)


def test_a_full_disk_keeps_what_was_there(motion, content):
    file = Full()
    file.room = len(content) - 1000
    writer = MotionWriter(file)
    for first in range(0, 9, 3):
        writer.add(motion.slice(first, first + 3))
    with pytest.raises(OSError, match="No space"):
        writer.add(motion.slice(9, 12))
    assert writer.frames == growing.decode("x", file.getvalue()).num_frames == 9


def test_it_is_converted_and_not_written(motion, content, tmp_path, capsys):
    (tmp_path / "take.recording").write_bytes(content[:-10])
    assert run("convert", tmp_path / "take.recording", tmp_path / "out.bvh") == 0
    assert formats.load(tmp_path / "out.bvh").num_frames == 11
    assert run("convert", tmp_path / "out.bvh", tmp_path / "again.recording") == 2
    assert "read but not written" in capsys.readouterr().err
    with pytest.raises(RequestError, match="read but not written"):
        motion.save(tmp_path / "out.recording")


def test_a_broken_file_is_refused_or_read_never_worse(content):
    chance, read = random.Random(5), 0
    for _ in range(400):
        broken = bytearray(content)
        for _ in range(chance.randint(1, 4)):
            place = chance.choice((chance.randrange(60), chance.randrange(len(broken))))
            broken[place : place + chance.choice((0, 1, 1, 4))] = chance.randbytes(chance.choice((0, 1, 4)))
        try:
            read += growing.decode("x", bytes(broken)).num_frames > 0
        except FileFormatError:
            continue
    assert read < 200
