"""What retargeting says of what it changed; fingers of rigs that have the same ones; the command that writes both."""

import pytest
import torch
from helpers import walk
from performers import Performer
from rig_maker import Make, make, names_of
from scipy.spatial.transform import Rotation

from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter, match_fingers, retarget_motion
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
