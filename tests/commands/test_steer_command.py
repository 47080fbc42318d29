"""`mapctl steer` as a user types it, and the measures that its report is made of."""

import json
import math
import re
from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_stitcher import save_tiny_stitcher

import mapctl
from mapctl import cli
from mapctl.curves.obstacles import Obstacle
from mapctl.intent.steering import Arrival, Command, CommandTrack
from mapctl.metrics.travel import list_misses, measure_arrivals, measure_commands

SCRIPT = "time_s,speed_mps,heading_deg\n0,1.2,0\n0.2,1.0,40\n0.5,1.0,40\n"


@pytest.fixture
def steer(prior, tmp_path):
    """Runs a script in an empty folder; returns the exit status."""

    def run(script: str, *words: object) -> int:
        (tmp_path / "c.csv").write_text(script)
        return cli.main(
            ["steer", str(tmp_path / "c.csv"), "-o", str(tmp_path / "a.bvh"), "--prior", prior, *map(str, words)]
        )

    return run


@pytest.mark.slow
def test_a_script_gives_motion_and_report(steer, tmp_path, capsys):
    report = tmp_path / "r.json"
    assert steer(SCRIPT, "--report", report, "--seed", 3) == 0
    assert mapctl.load(tmp_path / "a.bvh").num_frames == 15
    printed = json.loads(report.read_text())
    assert [row["heading_deg"] for row in printed["commands"]] == pytest.approx([0, 40, 40])
    timing = printed["timing"]
    assert timing["late_frames"] == 0
    assert timing["command_latency_s"] <= 0.2
    assert {"frame_ms_p50", "frame_ms_p99", "evaluations_per_frame", "threads"} <= set(timing)
    assert {"travel", "footing", "noise"} == set(printed["ledger"])
    out = capsys.readouterr().out
    assert "1.00 m/s to 40 degrees" in out
    assert str(report) in out


def test_a_script_is_played_against_the_clock(steer, tmp_path):
    assert steer(SCRIPT, "--realtime", "--quiet") == 0
    assert mapctl.load(tmp_path / "a.bvh").num_frames == 15


@pytest.mark.slow
def test_turning_and_labels_are_printed_and_unknown_labels_refused(steer, tmp_path, capsys):
    script = "time_s,speed_mps,heading_deg,turn_deg_s,style\n0,1.2,0,30,{}\n0.4,1.2,0,,\n"
    assert steer(script.format(""), "--report", tmp_path / "r.json") == 0
    row = json.loads((tmp_path / "r.json").read_text())["commands"][0]
    assert row["turn_deg_s"] == pytest.approx(30)
    assert row["steady_heading_error_deg"] is None
    assert "turning 30 degrees/s" in capsys.readouterr().out
    (tmp_path / "a.bvh").unlink()
    assert steer(script.format("swim")) == 2
    assert "has no label 'swim', nor any other" in capsys.readouterr().err
    assert not (tmp_path / "a.bvh").exists()


@pytest.mark.slow
def test_impossible_speeds_are_lowered_and_reported(steer, capsys):
    fast = "time_s,speed_mps,heading_deg\n0,50,0\n0.2,50,0\n"
    assert steer(fast) == 0
    assert "the speed of 50 m/s at 0 s was lowered to 2.20 m/s" in capsys.readouterr().out
    assert steer(fast, "--strict") == 3


def test_a_command_that_the_walk_obeys_is_reached_at_once_and_another_never():
    motion = walk(150)
    speed = float((motion.root_position[-1] - motion.root_position[0])[::2].norm()) / (149 / 30)
    way = float(torch.atan2(*(motion.root_position[-1] - motion.root_position[0])[[0, 2]]))
    obeyed, not_obeyed = (
        measure_commands(motion, CommandTrack((0.0,), (Command(speed, way + off),)))[0] for off in (2 * math.pi, 1.0)
    )
    assert obeyed["reached_s"] == 0
    assert obeyed["steady_speed_mps"] == pytest.approx(speed, rel=0.03)
    assert obeyed["steady_heading_error_deg"] == pytest.approx(0, abs=2)
    assert not_obeyed["reached_s"] is None
    assert not_obeyed["steady_heading_error_deg"] == pytest.approx(-math.degrees(1.0), abs=2)


WALK = walk(150)
SPEED = float((WALK.root_position[-1] - WALK.root_position[60])[::2].norm()) / (89 / 30)
THERE = (float(WALK.root_position[75, 0]), float(WALK.root_position[75, 2]))
HAND = tuple(WALK.joint_positions()[100, WALK.skeleton.index("leftHand")].tolist())
NEAR_DISC, FAR_DISC = Obstacle((0.0, 3.0), 0.5), Obstacle((0.0, 9.0), 0.5)


def list_walk_misses(changes: dict) -> list[str]:
    track = CommandTrack((0.0,), (Command(**{"speed": SPEED, "heading": 0.0} | changes),))
    return list_misses(measure_commands(WALK, track), measure_arrivals(WALK, track))


# By field, what the walk does, what it does not, and the note. Its toes slide: none is planted most of the time.
FIELDS = {
    "speed": ({}, {"speed": SPEED + 0.3}, r"speed 1\.\d\d of 1\.\d\d m/s"),
    "heading": ({"heading": 0.1}, {"heading": 0.3, "facing": 0.0}, "heading 17 degrees off"),
    "facing": ({"facing": 0.2}, {"facing": 0.8}, "facing 4[56] degrees off"),
    "turning": ({"turning": 0.02}, {"turning": 0.7}, "turning 0 of 40 degrees/s"),
    "step": ({"step_length": 0.7}, {"step_length": 1.2}, r"steps of 0\.\d\d instead of 1\.20 m"),
    "gait": ({"labels": ("run", "elderly")}, {"labels": ("gait=walk-turn-left",)}, "gait walk: no foot on the ground"),
    "hand": ({"reach": {"leftHand": HAND}}, {"reach": {"leftHand": (0, 1, 30)}}, r"left hand 2\d\d\d cm short"),
    "look": ({"look_at": (0, 1.5, 90)}, {"look_at": (0, 1.5, -90)}, r"head 1[678]\d degrees off"),
    "obstacle": ({"obstacles": (FAR_DISC,)}, {"obstacles": (NEAR_DISC,)}, r"a joint \d+ cm within an obstacle"),
    "arrival": ({"arrival": Arrival(THERE, 2.5, 0.0)}, {"arrival": Arrival((9, 9), 2.5)}, "hips .* off their position"),
    "arrival's facing": ({}, {"arrival": Arrival(THERE, 2.5, 1.0)}, "facing 5[78] degrees off at"),
}


@pytest.mark.parametrize(("obeyed", "not_obeyed", "note"), FIELDS.values(), ids=list(FIELDS))
def test_each_field_that_is_not_obeyed_is_noted(obeyed, not_obeyed, note):
    assert list_walk_misses(obeyed) == []
    (found,) = list_walk_misses(not_obeyed)
    assert re.fullmatch(rf"at [02]\.[05] s: .*{note}.*", found)


def test_a_command_held_briefly_is_not_judged_and_one_after_an_arrival_is_from_there_on():
    away = Command(SPEED, 0.0, facing=2.0)
    assert list_misses(measure_commands(WALK, CommandTrack((0.0, 2.4), (away, replace(away, facing=None))))) == []
    assert list_walk_misses({"facing": 2.0, "arrival": Arrival(THERE, 2.5)})
    assert not list_walk_misses({"facing": 2.0, "arrival": Arrival((*WALK.root_position[120, [0, 2]].tolist(),), 4.0)})


def test_a_hand_may_reach_its_position_under_any_of_the_commands_that_have_it():
    early = WALK.joint_positions()[20, WALK.skeleton.index("leftHand")].tolist()
    wanted = Command(SPEED, 0.0, reach={"leftHand": tuple(early)})
    assert list_misses(measure_commands(WALK, CommandTrack((0.0, 1.0), (wanted, replace(wanted, facing=0.1))))) == []


@pytest.mark.slow
def test_a_facing_that_is_not_obeyed_fails_when_strict(steer, tmp_path, capsys):
    script = "time_s,speed_mps,heading_deg,facing_deg\n0,1.2,0,{}\n2.6,1.2,0,\n"
    assert steer(script.format(180), "--strict", "--report", tmp_path / "r.json") == 3
    report = json.loads((tmp_path / "r.json").read_text())
    assert any(re.fullmatch(r"at 0\.0 s: facing 1\d\d degrees off", miss) for miss in report["misses"])
    assert report["misses"] == report["status"]["notes"]
    assert "m/s to 0 degrees facing 180 degrees: not reached" in capsys.readouterr().out


@pytest.mark.slow
def test_targets_of_hands_and_head_and_obstacles_are_reported(steer, tmp_path, capsys):
    script = (
        "time_s,speed_mps,heading_deg,right_hand_x,right_hand_y,right_hand_z,look_x,look_y,look_z\n"
        "0,0,0,-0.3,1.1,0.4,-1,1.3,2\n2,0,0,,,,,,\n2.2,0,0,,,,,,\n"
    )
    assert steer(script, "--avoid", "0,3,0.5", "--report", tmp_path / "r.json") == 0
    first, last = json.loads((tmp_path / "r.json").read_text())["commands"][:2]
    assert first["rightHand_nearest_cm"] < 40
    assert first["look_nearest_deg"] < 60
    assert 100 < first["clearance_cm"] < 400
    assert "rightHand_nearest_cm" not in last
    assert "right hand" in capsys.readouterr().out


GOTO = "time_s,speed_mps,heading_deg,goto_x_m,goto_z_m,within_s,goto_facing_deg,pose\n0,1.2,0,,,,,\n"


def test_a_target_position_is_reached_in_time_and_reported(steer, tmp_path, capsys):
    stitcher = save_tiny_stitcher(tmp_path / "stitch.safetensors")
    replace(walk(10), licence="CC BY 4.0 (a studio)").save(tmp_path / "pose.npz")
    script = GOTO + "0.2,1.0,40,0.3,0.4,0.7,20,pose.npz:7\n"
    assert steer(script, "--report", tmp_path / "r.json", "--stitcher", stitcher) == 0
    (row,) = json.loads((tmp_path / "r.json").read_text())["arrivals"]
    assert row["frame"] == 27
    assert row["position_error_cm"] < 0.1
    assert row["facing_error_deg"] < 0.1
    assert row["pose_error_cm"] < 0.1
    assert mapctl.load(tmp_path / "a.bvh").num_frames >= 27 + 30
    printed = capsys.readouterr().out
    assert "0.9 s  at 0.3, 0.4 m: 0.00 cm off, 0.00 degrees off, joints 0.0 cm off the pose" in printed
    assert re.search(r"^licence .*; CC BY 4\.0 \(\S+\.csv\)$", printed, re.MULTILINE)


@pytest.mark.slow
def test_an_unreachable_position_is_reported_and_strict_fails(steer, tmp_path, capsys):
    stitcher = save_tiny_stitcher(tmp_path / "stitch.safetensors")
    script = GOTO + "0.2,1.0,40,30,0,0.7,,\n"
    assert steer(script, "--strict", "--stitcher", stitcher, "--report", tmp_path / "r.json") == 3
    assert re.search(r"30\.\d m away, in 0\.\d s is not obeyed: it needs [45]\d", capsys.readouterr().out)
    assert json.loads((tmp_path / "r.json").read_text())["arrivals"] == []


def test_a_command_is_not_reached_by_the_last_frames_of_its_time():
    """It must hold for 0.4 s, and a walk that comes near it in the last frame before the next has not held it."""
    motion = walk(150)
    speed = float((motion.root_position[-1] - motion.root_position[0])[::2].norm()) / (149 / 30)
    way = float(torch.atan2(*(motion.root_position[-1] - motion.root_position[0])[[0, 2]]))
    wanted = Command(speed, way)
    brief, held = (
        measure_commands(motion, CommandTrack((0.0, 2.0, 2.0 + seconds), (Command(0.0, 0.0), wanted, wanted)))[1]
        for seconds in (0.2, 0.6)
    )
    assert brief["reached_s"] is None
    assert held["reached_s"] == 0
