"""Broken BVH files get one clear line that names the place; never a crash, a hang or unbounded memory."""

import tracemalloc

import pytest
import torch
from lossy_files import GOOD

from mapctl import formats
from mapctl.errors import FileFormatError


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new, 1)


# What is broken: the text, the line of the message (None: the whole file), words it must hold.
BROKEN = {
    "no hierarchy": ("hello\n", 1, "expected 'HIERARCHY', got 'hello'"),
    "cut in the hierarchy": (GOOD[:90], 5, "end of the file"),
    "cut after Frame Time": (GOOD.split("\n1 90")[0], 17, "'Frames: 3' but no whole row"),
    "cut in the only row": (GOOD.split("\n2 91")[0][:-4], 17, "'Frames: 3' but no whole row"),
    "cut in a row before the last": (swap("2 91 4 ", "2 91 ").replace("Frames: 3", "Frames: 4"), 20, "frame 1 has"),
    "nan": (swap("21 31", "nan 31"), 20, r"frame 1, column 5 \(hips Xrotation\): expected a finite number"),
    "inf": (swap("3 4 5\n", "3 -inf 5\n"), 21, r"frame 2, column 8 \(leg Xrotation\)"),
    "word": (swap("22", "x22"), 21, "'x22'"),
    "decimal comma": (swap("22", "22,5"), 21, "'22,5'"),
    "nan in wrapped rows": (swap("12 22", "12\nnan"), 22, r"frame 2, column 5 \(hips Xrotation\)"),
    "value missing": (swap("2 91 ", "2 "), 20, "frame 1 has 8 values, expected 9"),
    "value too many": (swap("2 91 ", "2 2 91 "), 20, "frame 1 has 10 values, expected 9"),
    "text after the rows": (GOOD + "end\n", 22, "'end'"),
    "negative frames": (swap("Frames: 3", "Frames: -3"), 17, "positive number of frames"),
    "zero frame time": (swap("0.0333333", "0"), 18, "frame time between"),
    "endless frame time": (swap("0.0333333", "0.0" + "3" * 10_000), 18, "frame time between"),
    "two roots": (swap("MOTION", "ROOT other\n{\n OFFSET 0 0 0\n}\nMOTION"), 16, "a second ROOT"),
    "joint as root": (swap("ROOT", "JOINT"), 2, "JOINT outside"),
    "brace missing": (swap("  }\n}\n", "  }\n"), 15, "joint 'hips' is still open"),
    "no offset": (swap("    OFFSET 10 0 0\n", ""), 13, "joint 'leg' has no OFFSET"),
    "two ends": (swap("    End Site", "    End Site { OFFSET 0 0 0 }\n End Site"), 11, "a second End Site"),
    "joint in an end": (swap("OFFSET 0 0 10", "OFFSET 0 0 10 JOINT x { }"), 12, "a JOINT within an End Site"),
    "channels in an end": (swap("OFFSET 0 0 10", "CHANNELS 1 Xrotation"), 12, "0 to 0 CHANNELS"),
    "seven channels": (swap("CHANNELS 6", "CHANNELS 7"), 5, "expected 0 to 6 CHANNELS"),
    "unknown channel": (swap("Zrotation", "Wrotation"), 5, "expected a channel as Xposition"),
    "channel twice": (swap("Xposition Yposition", "Xposition Xposition"), 5, "Euler order"),
    "two channel lists": (swap("    End", "    CHANNELS 0\n    End"), 10, "a second CHANNELS"),
    "no channels at all": (
        "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 }\nMOTION\nFrames: 1\nFrame Time: 0.1\n\n",
        4,
        "CHANNELS",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_file_is_refused_with_its_place(case, tmp_path):
    text, line, words = BROKEN[case]
    path = tmp_path / "walk.bvh"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=words) as caught:
        formats.load(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}, line {line}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 250


# What differs from `Frames: 3` and three rows: the text, the number of frames that are read, words of the warning.
UNEVEN = {
    "row too many": (GOOD + "1 2 3 4 5 6 7 8 9\n", 4, "'Frames: 3' but 4 whole rows follow; it reads those"),
    "row too few": (GOOD.split("3 92")[0], 2, "'Frames: 3' but 2 whole rows follow; it reads those"),
    "cut in a row": (GOOD[:-9], 2, "2 whole rows follow, before one that is cut off; it reads those"),
    "cut in the last number": (swap("Frames: 3", "Frames: 9").rstrip(), 2, "before one that is cut off"),
    "header of a recorder that died": (swap("Frames: 3", "Frames: 0"), 3, "'Frames: 0' but 3 whole rows follow; it"),
}


@pytest.mark.parametrize("case", UNEVEN)
def test_whole_rows_are_read_with_one_warning(case, tmp_path, capsys):
    text, frames, words = UNEVEN[case]
    path = tmp_path / "walk.bvh"
    path.write_text(text)
    motion = formats.load(path)
    assert motion.num_frames == frames
    err = capsys.readouterr().err
    assert err.startswith(f"mapctl: {path}: ")
    assert words in err
    assert err.count("\n") == 1
    same = min(frames, 3)
    (tmp_path / "good.bvh").write_text(GOOD)
    assert torch.equal(motion.root_position[:same], formats.load(tmp_path / "good.bvh").root_position[:same])
    lossy, lost = formats.load_with_missing(path)
    assert lossy.num_frames == frames
    assert not lost.rotations.any()


def test_a_cut_row_may_hold_nan(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(swap("2 91 4", "nan 91 4").replace("3 92", "nan 92")[:-9])
    motion, lost = formats.load_with_missing(path)
    assert motion.num_frames == 2
    assert lost.positions[:, 0].tolist() == [False, True]


BYTES = {
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8, "binary"),
    "zero in a row": (GOOD.replace("22", "2\0").encode(), "line 21: is a binary file"),
    "UTF-16": (GOOD.encode("utf-16"), "UTF-16"),
}


@pytest.mark.parametrize("case", BYTES)
def test_what_is_no_text_is_refused(case, tmp_path):
    raw, words = BYTES[case]
    (tmp_path / "walk.bvh").write_bytes(raw)
    with pytest.raises(FileFormatError, match=words) as caught:
        formats.load(tmp_path / "walk.bvh")
    assert str(caught.value).isprintable()


def test_a_declared_count_allocates_nothing(tmp_path):
    (tmp_path / "walk.bvh").write_text(swap("Frames: 3", "Frames: 999999999999"))
    tracemalloc.start()
    try:
        assert formats.load(tmp_path / "walk.bvh").num_frames == 3
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()
