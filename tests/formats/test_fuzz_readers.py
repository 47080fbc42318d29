"""Readers on broken files: refused with a line, or read as the file says; and what fuzzing once found."""

import csv
import io
import struct
import zipfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from acclaim import Bone, Pair, assert_same_places
from forked_readers import fork_readers
from fuzz_readers import READERS, main, run_case, run_cases, samples
from hypothesis import given, settings
from lossy_files import GOOD
from tiny_denoiser import save_tiny_denoiser
from tiny_prior import save_tiny_prior
from tiny_weights import change_card

import mapctl
import priors
from mapctl.curves.csv_file import read_csv
from mapctl.curves.svg_file import read_svg
from mapctl.errors import CheckpointError, FileFormatError
from mapctl.formats import npz
from mapctl.formats import text as reading
from mapctl.intent.keyframe_toml import read_keys
from mapctl.intent.steering_csv import read_commands
from mapctl.recording.masks import Mask, load_masks
from mapctl.retarget.rigs import read_rig_toml

each_reader = pytest.mark.parametrize("name", READERS)


def _samples(name):
    return samples(name) or pytest.skip(f"nothing that makes a .{name} is installed")


@each_reader
def test_sound_files_are_read(name, tmp_path):
    with fork_readers():
        for sample in _samples(name)[: 2 if READERS[name].is_isolated else None]:
            assert run_case(name, sample.raw, sample.beside, tmp_path) == "read", sample.name


@each_reader
def test_a_few_broken_files(name):
    assert _samples(name)
    assert run_cases(name, range(4 if READERS[name].is_isolated else 20), seed=1)[1] == []


@pytest.mark.slow
@pytest.mark.timeout(3600)
@each_reader
def test_two_thousand_broken_files(name):
    """A failure names the case, to be repeated by tests/fuzz_readers.py."""
    assert _samples(name)
    tally, failures = run_cases(name, range(2000), seed=2)
    assert failures == []
    assert min(tally["read"], tally["refused"]) > 50


def test_real_files_are_broken_too(tmp_path, capsys):
    (tmp_path / "walk.bvh").write_text(GOOD)
    assert main(["bvh", "--cases", "30", "--seed", "3", "--folder", str(tmp_path)]) == 0
    assert "0 failed" in capsys.readouterr().out
    assert any(sample.name == "walk.bvh" for sample in samples("bvh", tmp_path))


@st.composite
def _pairs(draw):
    """Any tree of bones with any turns in any order, by any axes."""
    angle = st.floats(-360, 360, allow_nan=False)
    orders = st.permutations(list("xyz")).map("".join)
    bones, names = [], ["root"]
    for number in range(draw(st.integers(1, 6))):
        x, y, z = (draw(st.floats(-1, 1)) for _ in range(3))
        direction = np.array([x, y, z + 3.0])
        dof = draw(orders)[: draw(st.integers(0, 3))]
        axis, length = np.array([draw(angle) for _ in "xyz"]), draw(st.floats(0, 20))
        parent = draw(st.sampled_from(names))
        direction /= np.linalg.norm(direction)
        bones.append(Bone(f"b{number}", parent, direction, length, axis, draw(orders), dof))
        names.append(f"b{number}")
    frame = {"root": np.array([draw(angle) for _ in range(6)])}
    frame |= {bone.name: np.array([draw(angle) for _ in bone.dof]) for bone in bones if bone.dof}
    return Pair(tuple(bones), draw(orders), (frame,), orientation=np.array([draw(angle) for _ in "xyz"]))


@settings(max_examples=40, derandomize=True)
@given(made=_pairs())
def test_any_skeleton_is_where_the_definition_puts_it(tmp_path_factory, made):
    assert_same_places(mapctl.load(made.write(tmp_path_factory.mktemp("pair"))), made)


# --- what fuzzing found -----------------------------------------------------------------------------------------------


def _written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_commands_with_old_line_ends_are_read(tmp_path):
    path = _written(tmp_path, "a.csv", "time_s,speed_mps,heading_deg\r0,1,0\r2,1,90\r")
    assert read_commands(path).times == (0.0, 2.0)


@pytest.mark.parametrize("read", [read_commands, load_masks])
@pytest.mark.parametrize("text", ['time_s,"speed\n0,1,0\n', '"joint",start,stop\n"a"b,0,1\n', f"{'x' * 200_000}\n"])
def test_quotes_that_are_not_closed_swallow_no_lines(tmp_path, read, text):
    with pytest.raises(FileFormatError, match="CSV") as caught:
        read(_written(tmp_path, "a.csv", text))
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize("text", ["hello\n", "joint,start\n", "joint,start,stop,stop\n", "\n\n"])
def test_masks_without_their_columns_are_refused(tmp_path, text):
    """One line alone passed for a header, and the file for one without masks."""
    with pytest.raises(FileFormatError, match=r"needs the columns joint, start, stop") as caught:
        load_masks(_written(tmp_path, "a.csv", text))
    assert caught.value.line == 1


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("hips,0", "found 2 values where 3 belong"),
        ("hips,0,9,9", "found 4 values where 3 belong"),
        (f"hips,0,{'9' * 5000}", "a joint and two whole frames"),
        ("hips,0,1_0", "a joint and two whole frames"),
        ("hips,0,٣", "a joint and two whole frames"),
        (",0,3", "a joint and two whole frames"),
        ("hips,4,4", "0 <= start < stop, got 4 and 4"),
        ("hips,-1,4", "0 <= start < stop, got -1 and 4"),
    ],
)
def test_masks_that_are_none_are_refused_in_short(tmp_path, row, words):
    with pytest.raises(FileFormatError, match=words) as caught:
        load_masks(_written(tmp_path, "a.csv", f"joint,start,stop\n\n{row}\n"))
    assert caught.value.line == 3
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


def test_masks_are_read_in_any_order_of_columns_with_notes(tmp_path):
    path = _written(tmp_path, "a.csv", '\ufeffstop, start,joint,why\r\n9,3,*,"lost, all"\r\n\r\n20,10, hips ,\r\n')
    assert load_masks(path) == (Mask("*", 3, 9), Mask("hips", 10, 20))
    assert load_masks(_written(tmp_path, "b.csv", "joint,start,stop\n")) == ()


@pytest.mark.parametrize("word", ["1_000", "٣"])
def test_numbers_of_python_alone_are_none_in_a_table(tmp_path, word):
    with pytest.raises(FileFormatError, match="speed_mps must be a number"):
        read_commands(_written(tmp_path, "a.csv", f"time_s,speed_mps,heading_deg\n0,{word},0\n"))
    with pytest.raises(FileFormatError, match="expected a number"):
        read_csv(_written(tmp_path, "b.csv", f"0,0\n1,{word}\n"))


def test_an_arc_of_no_number_is_refused_without_a_warning(tmp_path, recwarn):
    drawing = '<svg><path d="M0 0 A 1e200 1e200 0 0 1 5 5"/></svg>'
    with pytest.raises(FileFormatError):
        read_svg(_written(tmp_path, "a.svg", drawing))
    assert not recwarn.list


class TestArchives:
    """npz files that are sound as zip files."""

    @pytest.fixture
    def arrays(self, tmp_path):
        (tmp_path / "good.bvh").write_text(GOOD)
        return npz.to_arrays(mapctl.load(tmp_path / "good.bvh"))

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"fps": np.array([10**9, 1])}, r"1e\+09 frames per second, allowed are 0.01 to 100000"),
            ({"offsets": np.array([[0, 0, 0], [1e200, 0, 0]])}, r"offsets at \[1, 0\]: expected a finite number below"),
            ({"end_names": np.array(["leg", "leg"]), "end_offsets": np.zeros((2, 3))}, "name a joint once"),
            ({"moving_joints": np.array([1, 1]), "moving_offsets": np.zeros((2, 3, 3))}, "name a joint once"),
            ({"names": np.array(["x" * 9000, "x" * 9000])}, "names must be unique, got"),
        ],
    )
    def test_absurd_and_doubled_values_are_refused(self, tmp_path, arrays, changes, words):
        np.savez(tmp_path / "a.npz", **{**arrays, **changes})
        if "names" in changes:
            np.savez(tmp_path / "a.npz", **{**arrays, **changes, "end_names": np.array(["x" * 9000])})
        with pytest.raises(FileFormatError, match=words) as caught:
            mapctl.load(tmp_path / "a.npz")
        assert len(str(caught.value)) < 400 + len(str(tmp_path))

    def test_half_precision_makes_no_warning(self, tmp_path, arrays, recwarn):
        np.savez(tmp_path / "a.npz", **{**arrays, "offsets": arrays["offsets"].astype(np.float16)})
        assert mapctl.load(tmp_path / "a.npz").num_joints == 2
        assert not recwarn.list

    def test_something_before_the_archive_is_no_archive(self, tmp_path, arrays):
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        with pytest.raises(FileFormatError, match=r"is not an \.npz archive"):
            mapctl.load(_written(tmp_path, "a.npz", b"\xef\xbb\xbf" + buffer.getvalue()))

    @pytest.mark.parametrize(
        "header",
        [b"{'descr': '<f8',", b'"""', b"(" * 400, b"\xff", b"{'descr': '<f8', 'fortran_order': 0, 'shape': (10,)}"],
    )
    def test_a_broken_header_of_an_array_is_refused(self, tmp_path, arrays, header):
        """numpy's parser raised tokenize.TokenError."""
        np.savez(tmp_path / "a.npz", **arrays)
        forged = b"\x93NUMPY\1\0" + struct.pack("<H", len(header) + 1) + header + b"\n"
        with zipfile.ZipFile(tmp_path / "a.npz") as old, zipfile.ZipFile(tmp_path / "b.npz", "w") as new:
            for name in old.namelist():
                new.writestr(name, forged if name == "offsets.npy" else old.read(name))
        with pytest.raises(FileFormatError, match=r"not a sound \.npz archive") as caught:
            mapctl.load(tmp_path / "b.npz")
        assert "\n" not in str(caught.value)

    def test_a_broken_archive_is_not_quoted_whole(self, tmp_path, arrays):
        """zipfile's message held the file."""
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        raw = buffer.getvalue().replace(b"format.npy", b"farmot.npy", 1)
        with pytest.raises(FileFormatError, match=r"not a sound \.npz archive") as caught:
            mapctl.load(_written(tmp_path, "a.npz", raw))
        assert len(str(caught.value)) < 300 + len(str(tmp_path))


def test_joints_without_channels_cannot_fill_the_memory(tmp_path, monkeypatch):
    """A row of one number gave as many rotations as there are joints: 32 kB a row of two letters."""
    joints = "".join(f"JOINT j{k} {{ OFFSET 0 1 0 }}\n" for k in range(900))
    head = (
        f"HIERARCHY\nROOT a\n{{ OFFSET 0 0 0 CHANNELS 1 Xrotation\n{joints}}}\nMOTION\nFrames: 50000\nFrame Time: 0.1\n"
    )
    path = _written(tmp_path, "a.bvh", head + "0\n" * 50_000)
    with pytest.raises(FileFormatError, match="50000 frames of 901 joints, allowed are 33554432 in all"):
        mapctl.load(path)
    monkeypatch.setattr(reading, "MAX_POSES", 2)
    with pytest.raises(FileFormatError, match="3 frames of 2 joints, allowed are 2"):
        mapctl.load(_written(tmp_path, "b.bvh", GOOD))


def test_the_field_limit_of_the_csv_module_is_left_alone():
    assert csv.field_size_limit() == 131_072


# --- values of another kind than the reader expects -------------------------------------------------------------------


@pytest.mark.parametrize("read", [read_keys, read_rig_toml])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"a = {'[' * 3000}{']' * 3000}", "not TOML"),
        (".".join("a" * 20_000) + " = 1", "a key of more than 64 parts"),
        ("[" + ".".join(['"a \\" b"'] * 20_000) + "]", "a key of more than 64 parts"),
        (f"a = 0x{'f' * 5000}", "not TOML"),
        (f"a = {'9' * 5000}", "not TOML"),
        ("key = []\n" + "x" * 3000 + " = 1", "there is no such key"),
        ("\n" * 5_000_000, "allowed are 4096 for a"),
    ],
    ids=lambda value: value[:8].strip(),
)
def test_toml_of_any_depth_and_length_is_refused_in_short(tmp_path, read, text, words):
    with pytest.raises(FileFormatError, match=words) as caught:
        read(_written(tmp_path, "a.toml", text))
    assert len(str(caught.value)) < 600 + len(str(tmp_path))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("also = 3", "also: input should be a valid array, got 3"),
        ("[tpose]\nhips = { x = [1, 0, 0] }", r"tpose.hips.y: this key is needed"),
        ("[tpose]\nhips = { x = [1, 0, 0], y = [2, 0, 0] }", "x and y must be two directions"),
        ("[tpose]\nhips = { x = [1, 0], y = [0, 1, 0] }", r"tpose.hips.x\[2\]"),
        ("[tpose]\nhips = { x = [1e300, 0, 0], y = [0, 1, 0] }", r"tpose.hips.x\[0\]: .* less than or equal to 1000"),
        ("name = 3", "name: input should be a valid string"),
    ],
)
def test_a_rig_of_other_types_is_refused_with_its_key(tmp_path, text, words):
    with pytest.raises(FileFormatError, match=words):
        read_rig_toml(_written(tmp_path, "a.toml", text))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": 3}, "kind: input should be a valid string"),
        ({"licence": None}, "licence: input should be a valid string"),
        ({"data": {"starts": [3] * 8}}, "starts"),
        ({"data": {"starts": ["a"]}}, "its initial states are not those of 1 clips"),
        ({"data": {"labels": "("}}, "labels"),
        ({"data": {"classes": {"bow": {}}}}, "classes"),
        ({"abilities": {"slowest": "slow"}}, "abilities.slowest"),
        ({"config": {"width": "16"}}, "width: input should be a valid integer"),
        ({"config": {"width": 10**6}}, "width is beyond"),
        ({"config": {"components": 4000}}, "its tensors do not fit its card"),
        ({"config": {"depth": 3}}, "depth"),
        ({"quality": {"windows": {"p2": []}}}, "its tensors do not fit its card"),
    ],
)
def test_a_card_of_other_types_is_refused_with_its_key(tmp_path, changes, words):
    path = save_tiny_prior(tmp_path / "a.safetensors")
    change_card(path.with_suffix(".json"), **changes)
    with pytest.raises(CheckpointError, match=words) as caught:
        priors.load(str(path))
    assert len(str(caught.value)) < 600 + len(str(tmp_path))


@pytest.mark.parametrize("text", ["[" * 20_000, '{"kind": ' + "9" * 5000 + "}", "[]", "", "NaN", '{"kind": "\\ud800"}'])
def test_a_card_that_is_none_is_refused(tmp_path, text):
    path = save_tiny_denoiser(tmp_path / "a.safetensors")
    path.with_suffix(".json").write_text(text)
    with pytest.raises(CheckpointError, match=r"a.json: no readable card"):
        priors.load_denoiser(str(path))


def test_weights_that_are_not_finite_or_cut_are_refused(tmp_path):
    path = save_tiny_denoiser(tmp_path / "a.safetensors")
    raw = path.read_bytes()
    path.write_bytes(raw[:-2] + b"\xff\xff")
    with pytest.raises(CheckpointError, match=r"the tensor '\w.*' is not finite"):
        priors.load_denoiser(str(path))
    path.write_bytes(struct.pack("<Q", 2**63) + raw[8:])
    with pytest.raises(CheckpointError, match="no readable safetensors file"):
        priors.load_denoiser(str(path))
