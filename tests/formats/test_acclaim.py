"""ASF and AMC in: bones where the definition puts them; files found, units and rates read, faults named by line."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from acclaim import assert_same_places, pair

import mapctl
from mapctl.errors import FileFormatError, RequestError


@pytest.mark.parametrize(("seed", "degrees", "missing"), [(0, True, 0.0), (1, False, 0.4), (2, True, 0.4)])
def test_bones_are_where_the_definition_puts_them(tmp_path, seed, degrees, missing):
    turned = {"orientation": np.array([20.0, -30, 40]), "position": np.array([1.0, 2, 3])} if seed % 2 else {}
    given = pair(seed=seed, degrees=degrees, missing=missing, **turned)
    assert_same_places(mapctl.load(given.write(tmp_path)), given)


def test_bones_that_a_take_never_names_rest(tmp_path):
    given = pair(3, seed=5)
    frames = tuple({name: v for name, v in frame.items() if name != "head"} for frame in given.frames)
    given = replace(given, frames=frames)
    assert given.full
    assert_same_places(mapctl.load(given.write(tmp_path)), given)


def test_the_rate_is_120_unless_the_file_or_the_caller_gives_one(tmp_path):
    path = pair(2).write(tmp_path)
    assert mapctl.load(path).fps == 120
    assert mapctl.load(path, fps=60).fps == 60
    assert mapctl.load(path, fps=Fraction(30000, 1001)).fps == Fraction(30000, 1001)
    path.write_text(path.read_text().replace(":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 59.94"))
    assert mapctl.load(path).fps == Fraction(2997, 50)
    assert mapctl.load(path, fps=30).fps == 30
    for wrong in (0, -1, 1e9, float("nan")):
        with pytest.raises(RequestError, match="frame rate"):
            mapctl.load(path, fps=wrong)
    with pytest.raises(RequestError, match=r"a \.bvh file has a frame rate of its own"):
        mapctl.load("walk.bvh", fps=30)


@pytest.mark.parametrize(("length", "scale"), [(0.45, 1.0), (1.0, 1.0), (2.54, 0.45 / 2.54)])
def test_lengths_come_from_the_file_or_else_from_the_body(tmp_path, length, scale):
    """`length 1` says nothing: the leg is of a person in the CMU unit, so that it is."""
    given = pair(1)
    usual = mapctl.load(given.write(tmp_path)).skeleton.offsets
    other = mapctl.load(replace(given, length=length).write(tmp_path)).skeleton.offsets
    np.testing.assert_allclose(other, usual * scale, rtol=1e-4)


def test_angles_are_in_the_unit_of_the_take_else_of_the_skeleton(tmp_path):
    given = pair(2, degrees=False)
    path = given.write(tmp_path)
    path.write_text(path.read_text().replace(":RADIANS\n", ""))
    assert_same_places(mapctl.load(path), given)


def test_files_are_read_whatever_their_blanks_case_and_line_ends(tmp_path):
    given = pair(2)
    path = given.write(tmp_path)
    plain = mapctl.load(path).joint_positions()
    for file in (path, path.with_suffix(".asf")):
        text = file.read_text().replace("begin", "BEGIN").replace("direction ", "direction\t").replace(":root", ":ROOT")
        text = (
            text.replace("lfemur", "LFemur")
            if file == path
            else text.replace(" length 0.45", " length (0.45), (a unit)")
        )
        file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(mapctl.load(path).joint_positions(), plain)


class TestFinding:
    """The skeleton of a take."""

    def test_by_name(self, tmp_path, monkeypatch):
        pair(1).write(tmp_path, subject="01", take="01_02")
        (tmp_path / "02.asf").write_text("junk")
        assert mapctl.load(f"{tmp_path}/01.asf+01_02.amc").num_frames == 1
        assert mapctl.load(f"{tmp_path}/01.asf+{tmp_path}/01_02.amc").num_frames == 1
        monkeypatch.chdir(tmp_path)
        assert mapctl.load("01.asf+01_02.amc").num_frames == 1
        with pytest.raises(FileFormatError, match=r"03\.asf: no such file"):
            mapctl.load("03.asf+01_02.amc")
        with pytest.raises(FileFormatError, match=r"01_03\.amc: no such file"):
            mapctl.load("01.asf+01_03.amc")

    @pytest.mark.parametrize("name", [f"{'x' * 300}.amc", f"{'x' * 300}.asf+x.amc", f"a.asf+{'x' * 300}.amc"])
    def test_an_impossible_name_is_refused(self, tmp_path, name):
        (tmp_path / "a.asf").write_text(pair(1).asf())
        with pytest.raises(FileFormatError, match="name too long"):
            mapctl.load(tmp_path / name)


# What is put in place of what in which file, a text on the line that the message names, words it must hold.
ASF = {
    "no section": (":version", "version", "version 1.10", "expected a section as :version"),
    "unknown section": (":name", ":nom", ":nom", "once each, got ':nom'"),
    "length word": ("length 0.45", "length short", "length short", "expected for length 1 of a finite number"),
    "root order": ("order TX", "order TW", "order TW", "each at most once"),
    "root position": ("position 0.0 0.0", "position 0.0", "position", "expected for position 3 of"),
    "no begin": ("  begin\n     id 1\n", "  start\n     id 1\n", "  start", "expected begin"),
    "no name": ("     name head\n", "", "  end\n  begin\n     id 4", "has no name"),
    "no direction": ("head\n     direction", "head\n     cofmass", "  end\n  begin\n     id 4", "no direction"),
    "nan direction": ("direction 0.0 ", "direction nan ", "direction nan", "expected for direction 3"),
    "long direction": ("direction 1.0", "direction 2.0", "direction 2.0", "direction of length 1"),
    "axis without order": (" XYZ\n", "\n", None, "an axis order as XYZ"),
    "translation": ("dof rz ry rx", "dof tz ry rx", "dof tz", "expected of rx ry rz"),
    "unknown child": ("    root lowerback", "    root back lowerback", "root back", "no bone 'back'"),
    "child twice": ("thorax head", "thorax head head", "thorax head head", "'head' has a second parent"),
    "loose bone": ("thorax head", "thorax", "begin\n     id 3", "'head' does not hang on the root"),
}


@pytest.mark.parametrize("case", ASF)
def test_a_broken_skeleton_is_refused_with_its_place(case, tmp_path):
    old, new, position, words = ASF[case]
    path = pair(2, seed=7).write(tmp_path)
    asf = path.with_suffix(".asf")
    assert old in asf.read_text()
    text = asf.read_text().replace(old, new, 1)
    asf.write_text(text)
    with pytest.raises(FileFormatError, match=words) as caught:
        mapctl.load(path)
    if position is not None:
        assert caught.value.line == text.count("\n", 0, text.index(position)) + 1
    assert str(caught.value).startswith(f"{asf}, line {caught.value.line}: ")


AMC = {
    "bone unknown": ("head", "haed", 5, "the skeleton has no bone 'haed'"),
    "value missing": ("lowerback ", "lowerback #", 6, "lowerback' has 0 values, expected 3"),
    "nan": ("lowerback ", "lowerback nan 1 1 #", 6, "'lowerback' rx: expected a finite number"),
    "bone twice": ("lowerback", "root 0 0 0 0 0 0\nlowerback", 6, "a second line for 'root' in frame 1"),
    "frame missing": ("\n2\n", "\n3\n", 27, "expected frame 2 after frame 1, got '3'"),
    "keyword": (":DEGREES", ":GRADES", 3, "expected one of :fully-specified"),
    "rate": (":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 0", 4, "samples a second, got '0'"),
    "bone left out": ("\nhead", "\n#", 27, "not every frame up to 2 holds 'head'"),
    "root left out": ("\nroot", "\n#", 4, "frame 1 has no line for the root"),
}


@pytest.mark.parametrize("case", AMC)
def test_a_broken_take_is_refused_with_its_place(case, tmp_path):
    old, new, line, words = AMC[case]
    path = pair(3, seed=7).write(tmp_path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FileFormatError, match=words) as caught:
        mapctl.load(path)
    assert str(caught.value).startswith(f"{path}, line ")
    if case != "bone unknown":
        assert caught.value.line == line, str(caught.value)
