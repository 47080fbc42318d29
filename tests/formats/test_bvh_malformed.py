"""Broken BVH files get one clear line that names the place; never a crash, a hang or unbounded memory."""

import time
import tracemalloc

import numpy as np
import pytest
import torch
from lossy_files import GOOD

from mapctl import formats
from mapctl.errors import FileFormatError, MapctlError


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new, 1)


# What is broken: the text, the line of the message (None: the whole file), words it must hold.
BROKEN = {
    "no hierarchy": ("hello\n", 1, "expected 'HIERARCHY', got 'hello'"),
    "blank": ("\n \n", 1, "expected 'HIERARCHY', got the end of the file"),
    "cut in the hierarchy": (GOOD[:90], 5, "end of the file"),
    "cut before MOTION": (GOOD.split("MOTION")[0], 15, "expected ROOT or MOTION, got the end of the file"),
    "cut after MOTION": (GOOD.split("Frames")[0], 16, "expected 'Frames: COUNT'"),
    "cut after Frames": (GOOD.split("Frame Time")[0], 17, "expected 'Frame Time: SECONDS'"),
    "cut after Frame Time": (GOOD.split("\n1 90")[0], 17, "'Frames: 3' but no whole row"),
    "cut in the only row": (GOOD.split("\n2 91")[0][:-4], 17, "'Frames: 3' but no whole row"),
    "cut in a row before the last": (swap("2 91 4 ", "2 91 ").replace("Frames: 3", "Frames: 4"), 20, "frame 1 has"),
    "nan": (swap("21 31", "nan 31"), 20, r"frame 1, column 5 \(hips Xrotation\): expected a finite number"),
    "inf": (swap("3 4 5\n", "3 -inf 5\n"), 21, r"frame 2, column 8 \(leg Xrotation\)"),
    "overflow": (swap("92", "1e400"), 21, "hips Yposition"),
    "absurd": (swap("92", "1e300"), 21, "hips Yposition"),
    "word": (swap("22", "x22"), 21, "'x22'"),
    "decimal comma": (swap("22", "22,5"), 21, "'22,5'"),
    "two points": (swap("22", "2.2.5"), 21, "'2.2.5'"),
    "joined numbers": (swap("11 21", "11-21"), 20, "'11-21'"),
    "underscore": (swap("22", "2_2"), 21, "'2_2'"),
    "Arabic digits": (swap("22", "٢٢"), 21, "expected a finite number"),
    "no-break space": (swap("12 22", "12\u00a022"), 21, "expected a finite number"),
    "nan in wrapped rows": (swap("12 22", "12\nnan"), 22, r"frame 2, column 5 \(hips Xrotation\)"),
    "value missing": (swap("2 91 ", "2 "), 20, "frame 1 has 8 values, expected 9"),
    "value too many": (swap("2 91 ", "2 2 91 "), 20, "frame 1 has 10 values, expected 9"),
    "text after the rows": (GOOD + "end\n", 22, "'end'"),
    "negative frames": (swap("Frames: 3", "Frames: -3"), 17, "positive number of frames"),
    "half frames": (swap("Frames: 3", "Frames: 3.5"), 17, "positive number of frames"),
    "zero frame time": (swap("0.0333333", "0"), 18, "frame time between"),
    "negative frame time": (swap("0.0333333", "-0.03"), 18, "frame time between"),
    "nan frame time": (swap("0.0333333", "nan"), 18, "frame time between"),
    "tiny frame time": (swap("0.0333333", "1e-999999999"), 18, "frame time between"),
    "huge frame time": (swap("0.0333333", "1e999999999"), 18, "frame time between"),
    "endless frame time": (swap("0.0333333", "0.0" + "3" * 10_000), 18, "frame time between"),
    "word frame time": (swap("0.0333333", "fast"), 18, "'fast'"),
    "two roots": (swap("MOTION", "ROOT other\n{\n OFFSET 0 0 0\n}\nMOTION"), 16, "a second ROOT"),
    "no root": ("HIERARCHY\nMOTION\nFrames: 1\n", 2, "expected ROOT"),
    "joint as root": (swap("ROOT", "JOINT"), 2, "JOINT outside"),
    "brace missing": (swap("  }\n}\n", "  }\n"), 15, "joint 'hips' is still open"),
    "brace too many": (swap("}\nMOTION", "}\n}\nMOTION"), 16, "outside of a joint"),
    "no opening brace": (swap("hips\n{", "hips\n"), 4, "expected '{', got 'OFFSET'"),
    "no name": (swap("ROOT hips", "ROOT"), 3, "joint's name"),
    "no offset": (swap("    OFFSET 10 0 0\n", ""), 13, "joint 'leg' has no OFFSET"),
    "two offsets": (swap("OFFSET 10 0 0", "OFFSET 10 0 0 OFFSET 1 0 0"), 8, "a second OFFSET"),
    "short offset": (swap("OFFSET 10 0 0", "OFFSET 10 0"), 9, "the Z of OFFSET"),
    "nan offset": (swap("OFFSET 10 0 0", "OFFSET 10 nan 0"), 8, "the Y of OFFSET as a finite number"),
    "end without offset": (swap("      OFFSET 0 0 10\n", ""), 12, "End Site of line 10 has no OFFSET"),
    "two ends": (swap("    End Site", "    End Site { OFFSET 0 0 0 }\n End Site"), 11, "a second End Site"),
    "joint in an end": (swap("OFFSET 0 0 10", "OFFSET 0 0 10 JOINT x { }"), 12, "a JOINT within an End Site"),
    "channels in an end": (swap("OFFSET 0 0 10", "CHANNELS 1 Xrotation"), 12, "0 to 0 CHANNELS"),
    "seven channels": (swap("CHANNELS 6", "CHANNELS 7"), 5, "expected 0 to 6 CHANNELS"),
    "huge channels": (swap("CHANNELS 6", "CHANNELS 99999999999999"), 5, "expected 0 to 6 CHANNELS"),
    "fewer channels than said": (swap("CHANNELS 3 Zrotation", "CHANNELS 3"), 10, "expected a channel"),
    "more channels than said": (swap("CHANNELS 3", "CHANNELS 2"), 9, "expected OFFSET, CHANNELS"),
    "unknown channel": (swap("Zrotation", "Wrotation"), 5, "expected a channel as Xposition"),
    "channel twice": (swap("Xposition Yposition", "Xposition Xposition"), 5, "Euler order"),
    "axis twice on end": (swap("Zrotation Xrotation", "Xrotation Xrotation"), 5, "Euler order"),
    "two channel lists": (swap("    End", "    CHANNELS 0\n    End"), 10, "a second CHANNELS"),
    "unknown word": (swap("    End", "    LENGTH 4\n    End"), 10, "got 'LENGTH'"),
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
    "cut after a sign": (swap("Frames: 3", "Frames: 0")[:-2] + "-", 2, "'Frames: 0' but 2 whole rows"),
    "header of a recorder that died": (swap("Frames: 3", "Frames: 0"), 3, "'Frames: 0' but 3 whole rows follow; it"),
    "no line feed at the end": (swap("Frames: 3", "Frames: 2").rstrip(), 3, "'Frames: 2' but 3 whole rows follow; it"),
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
    assert lost.places[:, 0].tolist() == [False, True]


def test_the_good_file_is_good(tmp_path):
    (tmp_path / "walk.bvh").write_text(GOOD)
    assert formats.load(tmp_path / "walk.bvh").num_frames == 3


BYTES = {
    "empty": (b"", "the file is empty"),
    "zeros": (bytes(1000), "binary"),
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8, "binary"),
    "high bytes": (bytes(range(128, 256)) * 20, "expected 'HIERARCHY'"),
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


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.bvh").mkdir()
    for name, words in (
        ("folder.bvh", "is a folder"),
        ("missing.bvh", "no such file"),
        ("x" * 300 + ".bvh", "walk|name"),
    ):
        with pytest.raises(FileFormatError, match=words):
            formats.load(tmp_path / name)


def deep(joints: int) -> str:
    opening = "".join(f"JOINT j{j} {{ OFFSET 0 1 0 CHANNELS 1 Xrotation\n" for j in range(joints))
    row = " ".join(["0"] * joints)
    hierarchy = f"HIERARCHY\n{opening.replace('JOINT', 'ROOT', 1)}{'}' * joints}\n"
    return f"{hierarchy}MOTION\nFrames: 1\nFrame Time: 0.1\n{row}\n"


@pytest.mark.slow
def test_a_hierarchy_of_3000_levels_is_refused_quickly_and_one_of_900_is_read_and_written(tmp_path):
    start = time.perf_counter()
    (tmp_path / "walk.bvh").write_text(deep(3000))
    with pytest.raises(FileFormatError, match="line 1002: more than 1000 joints"):
        formats.load(tmp_path / "walk.bvh")
    (tmp_path / "walk.bvh").write_text(deep(900))
    motion = formats.load(tmp_path / "walk.bvh")
    motion.save(tmp_path / "again.bvh")
    assert formats.load(tmp_path / "again.bvh").skeleton.parents == motion.skeleton.parents
    assert time.perf_counter() - start < 5


def test_a_declared_count_allocates_nothing(tmp_path):
    (tmp_path / "walk.bvh").write_text(swap("Frames: 3", "Frames: 999999999999"))
    tracemalloc.start()
    try:
        assert formats.load(tmp_path / "walk.bvh").num_frames == 3
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def mutated(random: np.random.Generator) -> bytes:
    """The good file with a few bytes replaced, removed or repeated, or words exchanged for hostile ones."""
    hostile = (b"nan", b"{", b"}", b"-1", b"1e309", b"End Site", b"MOTION", b"", b"\xff", b"JOINT", b"99999999999")
    raw = GOOD.encode()
    for _ in range(random.integers(1, 4)):
        start = int(random.integers(len(raw)))
        stop = start + int(random.integers(1, 30))
        insert = (b"", raw[start:stop] * 2, bytes(random.integers(0, 256, 5, dtype=np.uint8)))
        words = raw.split(b" ")
        words[random.integers(len(words))] = hostile[random.integers(len(hostile))]
        choices = (*(raw[:start] + new + raw[stop:] for new in insert), raw[:start], b" ".join(words))
        raw = choices[random.integers(len(choices))] or b" "
    return raw


def test_mutated_files_are_read_or_refused_never_worse(tmp_path):
    random, messages = np.random.default_rng(1), []
    path = tmp_path / "walk.bvh"
    for _ in range(300):
        path.write_bytes(mutated(random))
        try:
            motion = formats.load(path)
        except MapctlError as error:
            messages.append(str(error))
            continue
        assert bool(motion.joint_positions().isfinite().all())
        motion.save(tmp_path / "again.bvh")
        assert formats.load(tmp_path / "again.bvh").num_frames == motion.num_frames
    assert 100 < len(messages) < 300
    assert not any("\n" in message for message in messages)
