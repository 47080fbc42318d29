"""What is chosen of a file, and listed; names made unique, and frame rates behind key times."""

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from character_maker import make_character_glb
from helpers import run

from mapctl.errors import FileFormatError
from mapctl.formats.character import sample_times
from mapctl.formats.character import make_unique
from mapctl.formats.character import CharacterPath, choose_name, parse_character_path


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("hero.glb", CharacterPath(Path("hero.glb"))),
        ("a/hero.glb#Rig", CharacterPath(Path("a/hero.glb"), "Rig")),
        ("hero.glb#Rig/Walk", CharacterPath(Path("hero.glb"), "Rig", "Walk")),
        ("hero.glb#/Walk", CharacterPath(Path("hero.glb"), None, "Walk")),
        ("hero.glb#", CharacterPath(Path("hero.glb"))),
    ],
)
def test_paths_choose(text, wanted):
    assert parse_character_path(text) == wanted


def test_a_file_whose_name_holds_the_mark_is_itself(tmp_path):
    path = tmp_path / "take#2.bvh"
    path.write_text("x")
    assert parse_character_path(path) == CharacterPath(path)


def test_names_are_told_where_one_must_be_chosen():
    path, names = Path("a/hero.glb"), ["Rig", "Horse"]
    assert choose_name(path, names, "Horse", "armature", several=False) == 1
    assert choose_name(path, names, None, "animation", several=True) == 0
    with pytest.raises(FileFormatError, match=r"2 armatures: 'Rig', 'Horse'; choose one, as hero.glb#Rig"):
        choose_name(path, names, None, "armature", several=False)
    with pytest.raises(FileFormatError, match="no animation 'Run'; it has 'Rig', 'Horse'"):
        choose_name(path, names, "Run", "animation", several=True)


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["a", "b"], ["a", "b"]),
        (["a", "a", "a"], ["a", "a_2", "a_3"]),
        (["a", "a_2", "a"], ["a", "a_2", "a_3"]),
        (["", ""], ["", "_2"]),
    ],
)
def test_names_become_unique(names, wanted):
    assert make_unique(names) == wanted


@pytest.mark.parametrize("fps", [Fraction(30), Fraction(24), Fraction(60), Fraction(24000, 1001), Fraction(120)])
def test_the_rate_of_even_keys_is_found(fps):
    keys = (np.arange(50) / float(fps) + 0.5).astype(np.float32)
    found, times = sample_times(keys)
    assert found == fps
    assert len(times) == 50
    np.testing.assert_allclose(times, keys, atol=1e-4)


def test_sparse_keys_lie_on_frames():
    fps, times = sample_times(np.array([0.0, 10, 12, 40]) / 24)
    assert (fps, len(times)) == (24, 41) or (fps, len(times)) == (12, 21)


def test_keys_of_no_rate_are_read_at_thirty():
    fps, times = sample_times(np.array([0.0, 0.1234, 0.77, 1.3]))
    assert fps == 30
    assert times[-1] <= 1.3 < times[-1] + 1 / 30 + 1e-9


@pytest.mark.parametrize("keys", [[], [2.0], [2.0, 2.0]])
def test_one_key_is_one_frame(keys):
    assert len(sample_times(np.array(keys))[1]) == 1


def test_info_lists_skeletons_and_animations(tmp_path, capsys):
    hero = make_character_glb(tmp_path / "hero.glb", animations=("walk", "run"), frames=31).path
    assert run("info", f"{hero}#/run", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    skeleton = told["skeletons"][0]["name"]
    assert told["skeletons"] == [{"name": skeleton, "read": True, "choose": f"hero.glb#{skeleton}"}]
    assert told["animations"] == [
        {"name": name, "seconds": pytest.approx(1.0), "read": name == "run", "choose": f"hero.glb#/{name}"}
        for name in ("walk", "run")
    ]
    assert run("info", hero) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["walk", "1.00", "s", "read"] in rows
    assert ["run", "1.00", "s", "hero.glb#/run"] in rows
