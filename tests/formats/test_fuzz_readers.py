"""Readers on broken files: refused with a line, or read as the file says; and what fuzzing once found."""

import csv
import io
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from acclaim import Bone, Pair, assert_same_places
from forked_readers import fork_readers
from fuzz_readers import READERS, SLOWEST_SECONDS, Specimen, case, main, run_case, specimens
from hypothesis import given, settings
from lossy_files import GOOD

import mapctl
from mapctl.curves.csv_file import read_csv
from mapctl.curves.svg_file import read_svg
from mapctl.errors import FileFormatError
from mapctl.formats import npz
from mapctl.formats import text as reading
from mapctl.intent.steering_csv import read_commands
from mapctl.recording.masks import Mask, load_masks

FEW = settings(max_examples=40, derandomize=True)


@pytest.fixture(scope="module", autouse=True)
def forked():
    """Readers in processes of their own start in no time."""
    with fork_readers(SLOWEST_SECONDS - 1.0):
        yield


@pytest.fixture(scope="module")
def samples():
    return specimens()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def run_cases(samples, folder, *, seed, cases):
    """How many were read; a failure names its seed and number."""
    read = 0
    for number in range(cases):
        specimen, raw = case(samples, seed, number)
        try:
            read += run_case(specimen, raw, folder) == "read"
        except Exception as error:
            raise AssertionError(f"seed {seed}, case {number}, a broken {specimen.name}: {error!r}"[:400]) from error
    return read


@pytest.mark.slow
def test_sound_files_are_read(samples, folder):
    assert {specimen.kind for specimen in samples} == set(READERS)
    for specimen in samples:
        assert run_case(specimen, specimen.raw, folder) == "read", specimen.name


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_broken_files_are_refused_or_read_as_they_are(samples, folder, seed):
    assert 30 < run_cases(samples, folder, seed=seed, cases=250) < 230


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_ten_thousand_broken_files(samples, folder):
    assert 1000 < run_cases(samples, folder, seed=7, cases=10_000) < 9000


@pytest.mark.slow
def test_real_files_are_cut_and_mutated_too(tmp_path, capsys):
    (tmp_path / "walk.bvh").write_text(GOOD)
    assert main(["--cases", "30", "--seed", "3", str(tmp_path)]) == 0
    assert "30 cases" in capsys.readouterr().out
    assert any(specimen.name == "walk.bvh" for specimen in specimens([tmp_path]))


# --- structured inputs ------------------------------------------------------------------------------------------------


def _words(text, *more):
    return (*text.split(), *more)


_BVH = _words(
    "HIERARCHY ROOT JOINT { } OFFSET CHANNELS MOTION Frames: Xposition Zrotation a b 0 1 3 6 0.1 nan",
    "End Site",
    "Frame Time:",
    "\n",
)
_ASF = _words(
    ":root :bonedata :hierarchy :units begin end name direction length axis dof order TX RY rx XYZ limits ( "
    "# a b root 0 1 inf",
    "\n",
)
_AMC = _words(":FULLY-SPECIFIED :DEGREES :SAMPLES-PER-SECOND 1 2 3 root head lfemur 0 1e9 nan #", "\n", "\n")
_TABLE = _words('time_s speed_mps heading_deg joint start stop x z , , ; 0 1 2 1e9 -1 nan " * hips #', "\n", "\n", " ")
_SVG = _words(
    "<svg> </svg> <path d=' '/> M L C A Z 0 1 1e9 nan , scale( rotate( ) '> </g>", " ", "<g transform='", "<circle r='"
)


def _texts(words):
    return st.lists(st.sampled_from(words), max_size=60).map(" ".join)


@FEW
@given(text=st.one_of(_texts(_BVH), _texts(_BVH).map(lambda text: GOOD + text)))
def test_any_words_of_bvh(folder, text):
    run_case(Specimen("words", "bvh", b""), text.encode() or b" ", folder)


@FEW
@given(asf=_texts(_ASF), amc=_texts(_AMC), which=st.booleans())
def test_any_words_of_asf_and_amc(samples, folder, asf, amc, which):
    sound = next(specimen for specimen in samples if specimen.kind == ("amc" if which else "asf"))
    run_case(sound, (amc if which else asf).encode() or b" ", folder)


@FEW
@given(text=_texts(_TABLE), kind=st.sampled_from(("commands", "curve", "masks")))
def test_any_words_of_tables(folder, text, kind):
    heads = {"commands": "time_s,speed_mps,heading_deg\n", "curve": "x,z\n", "masks": "joint,start,stop\n"}
    for head in ("", heads[kind]):
        raw = (head + text.replace(" , ", ",")).encode() or b" "
        run_case(Specimen("words", kind, b""), raw, folder)


@FEW
@given(text=_texts(_SVG))
def test_any_words_of_drawings(folder, text):
    run_case(Specimen("words", "svg", b""), f"<svg><path d='M 0 0 L 1 1 {text}".encode(), folder)


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


@FEW
@given(told=_pairs())
def test_any_skeleton_is_where_the_definition_puts_it(folder, told):
    assert_same_places(mapctl.load(told.write(folder)), told)


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
