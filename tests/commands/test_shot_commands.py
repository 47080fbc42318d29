"""Shots as a user types them: flags of follow, scene files of run, refusals in one line."""

import json

import pytest
import torch
from captures import on_rig
from helpers import run

import mapctl
from mapctl.skeleton import CANONICAL

KEYS = """
[[key]]
seconds = 1.6
look_at = [2.0, 1.4, 2.0]
"""


@pytest.fixture
def keys(tmp_path):
    """A key file."""
    path = tmp_path / "keys.toml"
    path.write_text(KEYS)
    return path


@pytest.mark.slow
def test_follow_starts_and_ends_standing_and_tells_every_wish(keys, tmp_path, capsys):
    out, report = tmp_path / "a.bvh", tmp_path / "a.json"
    words = [
        "--start",
        "stand",
        "--end",
        "stand",
        "--keys",
        keys,
        "--avoid",
        "0.5,0.9,0.2",
        "--fps",
        60,
        "--gait",
        "walk",
    ]
    assert run("follow", "line:1.8", "-o", out, "--report", report, *words) == 0
    said = capsys.readouterr().out
    assert "stand at the end" in said
    motion = mapctl.load(out)
    assert float(motion.fps) == pytest.approx(60, abs=1e-3)
    assert set(motion.skeleton.names) == set(CANONICAL.names)
    found = json.loads(report.read_text())
    names = {wish["wish"].split(" at")[0] for wish in found["wishes"]}
    assert names == {"path", "progress", "obstacles", "look", "stand"}
    assert all({"asked", "got", "residual", "unit", "holds"} <= wish.keys() for wish in found["wishes"])


@pytest.mark.slow
def test_a_scene_goes_on_from_a_clip_on_its_rig_and_keeps_apart(tmp_path):
    on_rig("bandai", 70).save(tmp_path / "clip.bvh")
    (tmp_path / "scene.toml").write_text(
        'outputs = ["a.bvh", "a.json"]\nkeep_apart = 0.6\n'
        '[[actors]]\nname = "on"\nstart = "clip.bvh:60"\ncurve = "line:2"\nspeed = "0:1.0,2:1.2"\nseconds = 1.2\n'
        '[[actors]]\nname = "by"\ncurve = "line:2"\noffset = [3, 0]\nseconds = 1.2\n'
        "[[obstacles]]\nplace = [8, 8]\nsize = [1, 2]\n"
    )
    assert run("run", tmp_path / "scene.toml", "-o", tmp_path / "out", "--quiet") in (0, 3)
    made, clip = mapctl.load(tmp_path / "out" / "a-on.bvh"), mapctl.load(tmp_path / "clip.bvh")
    assert made.skeleton.names == clip.skeleton.names
    miss = (made.joint_positions()[0] - clip.joint_positions()[60]).norm(dim=-1)
    assert float(miss.max()) < 0.01
    report = json.loads((tmp_path / "out" / "a.json").read_text())
    assert [wish["wish"] for wish in report["actors"]["by"]["wishes"]] == [
        "path",
        "progress",
        "obstacles",
        "keep apart",
    ]


REFUSED = {
    "obstacle": (["--avoid", "1,2"], "an obstacle is X,Z,RADIUS"),
    "obstacle on the start": (["--avoid", "0,0.1,0.5"], "the start is within the obstacle"),
    "start": (["--start", "sitting"], "--start: expected walk, stand or CLIP:FRAME"),
    "start clip": (["--start", "gone.bvh:3"], "gone.bvh"),
    "style": (["--style", "sad"], "knows no style 'sad', only"),
    "gait": (["--gait", "swim"], "knows no gait 'swim', only"),
    "end": (["--end", "lying"], "--end: expected walk, stand or CLIP:FRAME"),
    "end clip": (["--end", "gone.bvh:3"], "gone.bvh"),
    "open loop": (["--loop"], "a loop needs a closed curve"),
    "fps": (["--fps", "0"], "--fps must be 1 to 1000"),
    "keys": (["--keys", "gone.toml"], "gone.toml"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line_and_nothing_is_written(case, tmp_path, capsys):
    words, said = REFUSED[case]
    assert run("follow", "line:2", "-o", tmp_path / "a.bvh", *words) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert not (tmp_path / "a.bvh").exists()


def test_a_key_within_an_obstacle_is_refused(tmp_path, capsys):
    (tmp_path / "keys.toml").write_text("[[key]]\nseconds = 1\nreach = { leftHand = [0.9, 1, 1] }")
    words = ["--keys", tmp_path / "keys.toml", "--avoid", "1,1,0.3"]
    assert run("follow", "line:2", "-o", tmp_path / "a.bvh", *words) == 2
    assert "within the obstacle at 1, 1" in capsys.readouterr().err


@pytest.mark.slow
def test_a_shot_holds_a_pose_of_another_rig_and_ends_in_a_clip(tmp_path):
    on_rig("bandai", 70).save(tmp_path / "clip.bvh")
    on_rig("cmu", 40).save(tmp_path / "pose.bvh")
    (tmp_path / "keys.toml").write_text(
        f"[[key]]\nseconds = 0.9\npose = '{tmp_path / 'pose.bvh'}'\npose_frame = 20\nwithin_frames = 3\n"
    )
    words = ["--end", f"{tmp_path / 'clip.bvh'}:40", "--keys", tmp_path / "keys.toml"]
    out, report = tmp_path / "a.bvh", tmp_path / "a.json"
    assert run("follow", "line:2.4", "-o", out, "--report", report, *words) == 0
    made, clip = mapctl.load(out), mapctl.load(tmp_path / "clip.bvh")
    assert made.skeleton.names == clip.skeleton.names
    assert float((made.joint_positions()[-1] - clip.joint_positions()[40]).norm(dim=-1).max()) < 0.01
    found = json.loads(report.read_text())
    pose = next(wish for wish in found["wishes"] if wish["wish"].startswith("pose at"))
    assert pose["holds"]
    assert pose["got"] < 0.1


@pytest.mark.slow
def test_a_loop_leads_into_its_first_frame_at_any_rate(tmp_path):
    out = tmp_path / "a.bvh"
    assert run("follow", "circle:0.8", "-o", out, "--loop", "--fps", 100) == 0
    places = mapctl.load(out).joint_positions()
    steps = torch.diff(torch.cat([places, places[:1]]), dim=0).norm(dim=-1).amax(dim=1)
    assert float(steps[-1]) < 1.2 * float(steps[:-1].max())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[key]]\nlook_at = [0, 1, 2]", "key[0].seconds: "),
        ("[[key]]\nseconds = 1", "key[0].reach: "),
        ("[[key]]\nseconds = 1\nreach = { tail = [0, 1, 2] }", "key[0].reach.tail: hands and feet are"),
        ("[[key]]\nseconds = 1\nlook = [0, 1, 2]", "key[0].look: there is no such key; allowed: seconds"),
        ("key = []", "key: "),
        ("[[key]]\nseconds = 1\nlook_at = [0, 1, 2]\npose_frame = 3", "key[0].pose_frame: this is of a pose"),
        ("[[key]]\nseconds = 1\npose = 'gone.bvh'", "gone.bvh"),
        ("[[key]]\nseconds = 1\npose = 'a.bvh'\njoints = ['tail']", "key[0].joints.tail: hands and feet are"),
        ("[[key]]\nseconds = 1\nreach = { leftHand = [0, 1, 2] }\ntolerance = { rightHand = 0.1 }", "gives no place"),
        ("[[key]]\nseconds = 1\nfacing_deg = 1\nwithin_frames = -1", "key[0].within_frames: "),
        ("[[key]]\nseconds = 1\nplace = [0, 1]\n[[key]]\nseconds = 1.05\nfacing_deg = 9", "within two frames"),
        ("[[key]]\nseconds = 50\nlook_at = [0, 1, 2]", "not within"),
        ("[[key]]\nseconds = 1\nreach = { leftHand = [5, 1, 2] }", "leftHand at 1 s is to be"),
    ],
)
def test_a_key_that_cannot_be_is_named(text, said, tmp_path, capsys):
    (tmp_path / "keys.toml").write_text(text)
    words = ["--keys", tmp_path / "keys.toml", "--seconds", 2]
    assert run("follow", "line:2", "-o", tmp_path / "a.bvh", *words) == 2
    assert said in capsys.readouterr().err


def test_a_speed_of_zero_with_a_way_to_go_is_refused(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(
        'outputs = ["a.bvh"]\n[[actors]]\ncurve = "line:2"\nspeed_by_time = [[0, 0]]\nseconds = 2\n'
    )
    assert run("run", tmp_path / "scene.toml", "-o", tmp_path / "out") == 2
    assert "zero throughout" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
