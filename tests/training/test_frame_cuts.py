"""Which frames of a file are motion: tables, found and given; rows that make no sense; sets of users, trained on."""

from pathlib import Path

import mocap_folders
import pytest
import torch
from helpers import run, walk, write_corpus

from mapctl.features import encode
from priors.training.data import Cut, FrameCuts, read_corpus

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


def read(folder, tmp_path, **more):
    return read_corpus(folder, match="", cache=tmp_path / "cache", **more)


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
    assert found.skipped == {}


@pytest.mark.slow
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
    assert set(found.skipped) == {"walk-0.bvh", "walk-1.bvh"}
    assert "frames 5 to 80 are to be taken, but it has 80" in found.skipped["walk-0.bvh"]


@pytest.mark.parametrize(
    "text",
    [
        "file,first,last\nwalk,1\n",
        "file,first,last\nrun,one,9\n",
        "file,first,last\nwalk,-1,9\n",
        "file,first,last\nwalk,20,9\n",
        "file,first,last\nwalk,2,9\nwalk.bvh,2,9\n",
        "name,first,last\n",
        "STYLE_NAME,FW_START\n",
        "STYLE_NAME,FW_START,FW_STOP\nOld,5\n",
        "STYLE_NAME,FW_START,FW_STOP\nOld,x,5\n",
        "",
    ],
)
def test_what_makes_no_sense_is_named(files, tmp_path, capsys, text):
    (tmp_path / "cuts.csv").write_text(text)
    words = ("train", "lstm-gmm", "--data", files, "-o", tmp_path / "run", "--cuts", tmp_path / "cuts.csv", "--quiet")
    assert run(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mapctl: {tmp_path / 'cuts.csv'}")


def test_a_table_of_styles_lists_which_clips_there_are(tmp_path):
    (tmp_path / "Frame_Cuts.csv").write_text(
        "STYLE_NAME,FW_START,FW_STOP,ID_START,ID_STOP\nOld,5,50,N/A,N/A\nNew,,60,7,\n"
    )
    found = FrameCuts.of_folder(tmp_path)
    assert found.find("Old/Old_FW.bvh") == ("Frame_Cuts.csv", Cut(5, 50))
    assert found.find("Old/Old_ID.bvh") == ("", None)
    assert found.find("New_FW.BVH")[1] == Cut(0, 60)
    assert found.find("New_ID.bvh")[1] == Cut(7, None)
    assert found.find("New_FWD.bvh")[1] is None
