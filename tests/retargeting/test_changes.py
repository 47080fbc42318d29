"""What retargeting says of what it changed; fingers of rigs that have the same ones; the command that writes both."""

import json
import math
from dataclasses import replace

import pytest
import torch
from hand_poses import arms_down
from helpers import quat_xyzw, run, walk
from performers import Performer
from rig_maker import Make, make, names_of
from scipy.spatial.transform import Rotation

import mapctl
from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter, match_fingers, retarget_motion
from mapctl.retarget.carry.changes import Changes, Miss
from mapctl.skeleton import Skeleton

MIXAMO, UE5 = (make(Make(names_of(name), arms_down_deg=down)) for name, down in (("mixamo", 0.0), ("ue5", 45.0)))
FINGERS = [f"{side}_{finger}_bone" for side in "LR" for finger in ("Thumb1", "Index1")]


def on(made, frames: int = 40) -> Motion:
    return made.motion(walk(frames))


def test_numbers_of_a_walk():
    clip, body = Performer().walks(), Performer(size=1.25, toe_height=0.02).body()
    found = retarget_motion(clip, body).changes
    assert found.scale == pytest.approx(1.25)
    assert found.travel_ratio == pytest.approx(1.25, abs=0.01)
    assert found.hips_lowered_m < 0.01
    assert found.hands_moved_m == 0.0
    assert found.feet_missed.frames == found.hands_missed.frames == 0
    assert found.feet_missed.of_frames == 90
    assert found.unmatched_joints == found.notes == ()


def test_the_slope_of_a_tposes_feet_is_told():
    clip = Performer(droop_deg=20).walks()
    assert retarget_motion(clip, Performer().body()).changes.foot_tilt_deg == pytest.approx(-20, abs=1)


def test_notes_say_what_matters_and_nothing_else():
    assert Changes(hips_lowered_m=0.02, hands_moved_m=0.1, scale=0.7).notes == ()
    bad = Changes(
        hips_lowered_m=0.07,
        feet_missed=Miss(0.031, 12, 5, 40),
        hands_missed=Miss(0.052, 30, 9, 40),
        unmatched_joints=("Tail", "Prop"),
    )
    assert bad.notes == (
        "the legs are too short for some of the way: feet are up to 3.1 cm off (frame 12), by more than 0.5 cm in"
        " 5 of 40 frames",
        "the arms are too short for some of it: hands are up to 5.2 cm off (frame 30), by more than 1 cm in"
        " 9 of 40 frames",
        "the hips are up to 7.0 cm lower than in scale, so that the feet reach",
        "joints without a counterpart are left out: Tail, Prop",
    )


def test_joints_that_move_and_have_no_counterpart_are_named():
    """Not so a joint of the spine, whose turns the chest has; nor fingers that the other rig has."""
    clip = on(MIXAMO)
    plain = RiggedCharacter.of(on(make(Make(names_of("ue5"), extras=False))))[1]
    left = retarget_motion(clip, plain).changes.unmatched_joints
    assert {*FINGERS, "Prop_sword"} <= {*left}
    assert "Middle" not in left
    like = RiggedCharacter.of(on(UE5))[1]
    assert not {*FINGERS} & {*retarget_motion(clip, like).changes.unmatched_joints}


def test_fingers_turn_as_the_givers_in_the_tposes_frames():
    clip, body = on(MIXAMO), RiggedCharacter.of(on(UE5))[1]
    found = retarget_motion(clip, body)
    made = body.on_rig(found.motion, fingers=found.fingers)
    for name in FINGERS:
        hand = ("left" if name.startswith("L") else "right") + "Hand"
        added = []
        for motion, rig in ((clip, MIXAMO), (made, UE5)):
            frame = rig.tpose[hand]
            turn = Rotation.from_quat(motion.local_quat_xyzw[:, motion.skeleton.index(name)].numpy())
            added.append(frame * turn * frame.inv())
        assert max((added[0].inv() * added[1]).magnitude()) < 1e-6
        assert max(added[0].magnitude()) > 0.05


def test_fingers_are_matched_by_side_finger_and_place():
    def hand(*names: str):
        names = ("Hips", *names)
        return Skeleton(names, tuple(range(-1, len(names) - 1)), torch.zeros(len(names), 3))

    one = hand("LeftHandThumb1", "LeftHandThumb2", "LeftHandPinky1", "RightHandIndex1", "RightHandIndex2")
    other = hand("lThumb1", "lThumb2", "lThumb3", "rIndex0", "rRing1", "little_01_l")
    matched = {other.names[b]: one.names[a] for b, a in match_fingers(one, other).items()}
    assert matched == {
        "lThumb1": "LeftHandThumb1",
        "lThumb2": "LeftHandThumb2",
        "rIndex0": "RightHandIndex1",
        "little_01_l": "LeftHandPinky1",
    }


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    clip = arms_down(Performer().walks())
    clip.save("in.bvh")
    Performer(leg=0.8, toe_height=0.03).walks().save("rig.bvh")
    on(MIXAMO).save("mixamo.bvh")
    return tmp_path


def test_convert_writes_what_it_changed(files, capsys):
    assert run("convert", "in.bvh", "out.bvh", "--rig", "rig.bvh", "--report", "what.json") == 0
    told = json.loads((files / "what.json").read_text("utf-8"))
    assert told["request"]["command"] == "convert"
    assert told["changes"]["scale"] == pytest.approx(0.8, abs=1e-3)
    assert told["changes"]["travel_ratio"] == pytest.approx(0.8, abs=0.01)
    assert told["changes"]["feet_missed"]["of_frames"] == 90
    assert told["changes"]["notes"] == []
    assert "note:" not in capsys.readouterr().out


def test_convert_prints_notes(files, capsys):
    assert run("convert", "mixamo.bvh", "out.bvh", "--rig", "rig.bvh") == 0
    assert "note: joints without a counterpart are left out: " in capsys.readouterr().out


@pytest.mark.slow
def test_convert_keeps_the_ground(files):
    Performer(stair=0.1, upright=0.9).walks(100).save("stairs.bvh")
    risen = {}
    for mode in ("fit", "keep"):
        assert run("convert", "stairs.bvh", f"{mode}.npz", "--rig", "rig.bvh", "--ground", mode) == 0
        heights = mapctl.load(f"{mode}.npz").root_position[:, 1]
        risen[mode] = float(heights[80:].mean() - heights[:20].mean())
    assert 1.18 < risen["keep"] / risen["fit"] < 1.32


@pytest.mark.parametrize("words", [("--report", "what.json"), ("--ground", "keep")])
def test_options_of_another_rig_need_one(files, capsys, words):
    assert run("convert", "in.bvh", "out.bvh", *words) == 2
    assert f"{words[0]} is about motion on another rig; name one by --rig" in capsys.readouterr().err
    assert not (files / "out.bvh").exists()


def test_another_take_keeps_its_further_joints(files):
    """On the rig's own skeleton nothing rests that moved."""
    clip = on(MIXAMO, 30)
    clip.save("take.bvh")
    assert run("convert", "take.bvh", "out.npz", "--rig", "mixamo.bvh") == 0
    made, wanted = mapctl.load("out.npz"), mapctl.load("take.bvh")
    dots = (made.local_quat_xyzw * wanted.local_quat_xyzw).sum(-1).abs()
    assert float(2 * torch.acos(dots.clamp(max=1)).max()) < math.radians(1e-3)


def test_a_finger_that_is_at_rest_in_its_own_way_adds_nothing():
    """Whatever local rotation that rest has on either rig."""
    clip, body = on(MIXAMO), RiggedCharacter.of(on(UE5))[1]
    still = clip.local_quat_xyzw.clone()
    joint = clip.skeleton.index(FINGERS[0])
    still[:, joint] = quat_xyzw(torch.zeros(1, 3, dtype=torch.float64))
    found = retarget_motion(replace(clip, local_quat_xyzw=still), body)
    turned = found.fingers[body.rigmap.rig_skeleton.index(FINGERS[0])]
    rest = body.rigmap.idle_quat_xyzw
    own = turned.new_tensor([0, 0, 0, 1.0]) if rest is None else rest[body.rigmap.rig_skeleton.index(FINGERS[0])]
    torch.testing.assert_close((turned * own).sum(-1).abs(), torch.ones(40).double(), atol=1e-9, rtol=0)
