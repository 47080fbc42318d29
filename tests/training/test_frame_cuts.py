"""Which frames of a file are motion: tables, found and given; rows that make no sense; sets of users, trained on."""

import re
from pathlib import Path

import mocap_folders
import pytest
import torch
from helpers import run, walk, write_corpus

from mapctl.errors import FileFormatError
from mapctl.features import encode
from priors.training.data import TABLE_NAME, Cut, find_cuts, read_corpus, read_cuts

pytestmark = pytest.mark.usefixtures("small_judgements")
STYLES = {
    "Aeroplane": {"FW": (10, 200, 15), "ID": (0, 180, 20), "TR1": (12, 170, 0)},
    "Zombie": {"FW": (33, 160, 7), "SR": (8, 190, 8)},
}
"""Frames at 60 a second before, of and after the motion."""
LABELS = r"(?P<style>[A-Za-z]+)_(?P<gait>[A-Z]+\d?)\.bvh$"


@pytest.fixture(scope="module")
def styles(tmp_path_factory):
    return mocap_folders.write_styles(tmp_path_factory.mktemp("styles") / "100STYLE", STYLES)


@pytest.fixture
def files(tmp_path):
    """Three walks of 80 frames at 30 a second."""
    return write_corpus(tmp_path / "data", 3)


def read(folder, tmp_path, **told):
    return read_corpus(folder, match="", cache=tmp_path / "cache", **told)


def table(tmp_path, *rows):
    path = tmp_path / "cuts.csv"
    path.write_text("\n".join(("file,first,last", *rows)) + "\n")
    return path


@pytest.mark.slow
def test_a_table_in_the_folder_is_found_and_leaves_the_motion(styles, tmp_path):
    found = read(styles, tmp_path)
    expected = {
        f"{style}/{style}_{kind}.bvh": encode(walk(frames, turn_rate=0.2 * number, seed=number, fps=60).resample(30))[0]
        for number, (style, clips) in enumerate(STYLES.items())
        for kind, (_, frames, _) in clips.items()
    }
    assert found.names == tuple(expected)
    for name, clip in zip(found.names, found.clips(), strict=True):
        torch.testing.assert_close(clip, expected[name].float(), atol=2e-5, rtol=0)
    assert found.cuts == ("Frame_Cuts.csv: 5 of 5 clips",)
    assert found.skipped == ()


def test_a_given_table_counts_before_one_that_is_found(styles, tmp_path):
    found = read(styles, tmp_path, cuts=table(tmp_path, "Zombie_FW.bvh,33,92", "Aeroplane/Aeroplane_ID,0,"))
    lengths = dict(zip(found.names, found.lengths, strict=True))
    assert lengths["Zombie/Zombie_FW.bvh"] == 30
    assert lengths["Aeroplane/Aeroplane_ID.bvh"] == 100  # to the end, the T-pose too
    assert lengths["Aeroplane/Aeroplane_FW.bvh"] == 100
    assert sorted(found.cuts) == ["Frame_Cuts.csv: 3 of 5 clips", "cuts.csv: 2 of 5 clips"]


@pytest.mark.parametrize(
    ("rows", "lengths"),
    [
        (("walk-0.bvh,5,44",), (40, 80, 80)),
        (("walk-0,5,44", "walk-1,,9"), (40, 10, 80)),
        (("*,8,",), (72, 72, 72)),
        (("walk-[12],8,", "*,10,", "walk-2,0,"), (70, 72, 80)),
        (("data/walk-0.bvh,5,44",), (80, 80, 80)),
    ],
)
def test_rows_name_files_their_ends_and_patterns(files, tmp_path, rows, lengths):
    assert read(files, tmp_path, cuts=table(tmp_path, *rows)).lengths == lengths


def test_takes_of_cmu_have_a_table_that_comes_with_mapctl(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (files / "walk-1.bvh").rename(files / "07_01.bvh")
    assert read(files, tmp_path, cuts=Path("cmu")).cuts == ("cmu_cuts.csv: 1 of 3 clips",)
    assert read(files, tmp_path, cuts=Path("cmu")).lengths[0] == 80 - 8
    (tmp_path / "cmu").write_text("file,first,last\n07_01,20,59\n")
    assert read(files, tmp_path, cuts=Path("cmu")).lengths[0] == 40


def test_a_cut_that_a_file_is_too_short_for_leaves_the_file_out_and_says_so(files, tmp_path):
    found = read(files, tmp_path, cuts=table(tmp_path, "walk-0,5,80", "walk-1,79,", "walk-2,0,79"))
    assert found.names == ("walk-2.bvh",)
    assert [file.reason for file in found.skipped] == [
        "cuts.csv, line 2, takes frames 5 to 80, but the file has 80",
        "cuts.csv, line 3, takes frames 79 to the end, but the file has 80",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,first,last\nwalk,1\n", "line 2: a row is file, first, last, got walk, 1"),
        ("file,first,last\nwalk,1,9\nrun,one,9\n", "line 3: a frame is a whole number from 0, got 'one'"),
        ("file,first,last\nwalk,-1,9\n", "line 2: a frame is a whole number from 0, got '-1'"),
        ("file,first,last\nwalk,1.5,9\n", "line 2: a frame is a whole number from 0, got '1.5'"),
        ("file,first,last\nwalk,20,9\n", "line 2: walk ends at frame 9, before it begins, at 20"),
        ("file,first,last\nwalk,2,9\nwalk.bvh,2,9\n", "line 3: walk has a row already: cuts.csv, line 2,"),
        ("name,first,last\n", "line 1: has the columns name, first, last, expected a table of file, first, last, or"),
        ("STYLE_NAME,FW_START\n", "line 1: lacks the column FW_STOP"),
        ("STYLE_NAME\nOld\n", "line 1: lacks the column FW_START"),
        ("STYLE_NAME,FW_START,FW_STOP\nOld,5\n", "line 2: has 2 columns, but 3 in its head"),
        ("STYLE_NAME,FW_START,FW_STOP\nOld,5,5\n", "line 2: Old_FW ends at frame 4, before it begins, at 5"),
        ("STYLE_NAME,FW_START,FW_STOP\nOld,x,5\n", "line 2: a frame is a whole number from 0, got 'x'"),
        ("", "the file is empty"),
        ("\n\n", "holds no row"),
        ('file,first,last\n"walk,1,9\n', "is no sound CSV"),
    ],
)
def test_what_makes_no_sense_is_named_with_its_row(files, tmp_path, capsys, text, said):
    (tmp_path / "cuts.csv").write_text(text)
    with pytest.raises(FileFormatError, match=re.escape(said)):
        read_cuts(tmp_path / "cuts.csv")
    words = ("train", "lstm-gmm", "--data", files, "-o", tmp_path / "run", "--cuts", tmp_path / "cuts.csv")
    assert run(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mapctl: {tmp_path / 'cuts.csv'}")
    assert said in line
    assert not (tmp_path / "run" / "checkpoint.json").exists()


def test_a_table_of_styles_says_which_clips_there_are(tmp_path):
    (tmp_path / TABLE_NAME).write_text("STYLE_NAME,FW_START,FW_STOP,ID_START,ID_STOP\nOld,5,50,N/A,N/A\nNew,,60,7,\n")
    found = find_cuts(tmp_path, None)
    assert found.find("Old/Old_FW.bvh") == Cut(5, 50, "Frame_Cuts.csv, line 2,")
    assert found.find("Old/Old_ID.bvh") is None
    assert found.find("New_FW.BVH") == Cut(0, 60, "Frame_Cuts.csv, line 3,")
    assert found.find("New_ID.bvh") == Cut(7, None, "Frame_Cuts.csv, line 3,")
    assert found.find("New_FWD.bvh") is None


SMALL = ("--width", 8, "--components", 2, "--window", 20, "--steps", 2, "--batch", 3, "--device", "cpu")
