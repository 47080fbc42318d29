"""Key files made motions: poses are where they are wanted, on the body's rig, and only what counts is kept."""

import math

import pytest
import torch
from captures import apart_deg, on_rig
from methods import UNFINISHED
from rig_maker import Make, make, names_of
from tiny_infiller import tiny_infiller

import mapctl
from controllers.inbetweening.keyframes import build_keyframe_clip
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.intent.keyframes import KeyEntry, KeyRequest
from mapctl.kinematics import heading

RIGS = ("canonical", "bandai", "daz")


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """A walk on every rig, and on one whose world has Z up: paths by name."""
    folder = tmp_path_factory.mktemp("poses")
    result = {rig: on_rig(rig, 45) for rig in RIGS}
    result["zup"] = make(Make(names_of("ue4"), bones_along_x=True, zup=True, root="root")).motion(
        on_rig("canonical", 45)
    )
    for rig, motion in result.items():
        motion.save(folder / f"{rig}.npz")
    return {rig: str(folder / f"{rig}.npz") for rig in result}


def first_and_last(pose, *, frames=30):
    return KeyEntry(frame=0, pose=pose), KeyEntry(frame=frames, pose=pose, pose_frame=30)


def canonical_of(found):
    return retarget.to_canonical(found.motion, found.rig)[0]


def made_of(request):
    found = build_keyframe_clip(request)
    done = tween(found.motion, found.keys, tiny_infiller(drawn=0.02), rig=found.rig, settings=UNFINISHED)
    return found, done


@pytest.mark.parametrize("rig", RIGS)
def test_poses_of_the_body_that_are_not_moved_come_to_the_bit(poses, rig):
    clip = on_rig(rig, 45)
    found = build_keyframe_clip(KeyRequest(first_and_last(poses[rig])))
    assert (found.motion.num_frames, found.motion.fps) == (31, 30)
    for frame, pose in ((0, 0), (30, 30)):
        assert torch.equal(found.motion.local_quat_xyzw[frame].abs(), clip.local_quat_xyzw[pose].abs())
        assert torch.equal(found.motion.joint_positions()[frame], clip.joint_positions()[pose])


@pytest.mark.parametrize("rig", [*RIGS, "zup"])
def test_hips_are_put_turned_and_lifted_and_the_pose_stays(poses, rig):
    """In metres with Y up, whatever the file's world is."""
    key = KeyEntry(frame=30, pose=poses[rig], pose_frame=20, place=(2.0, -1.5), height=0.7, facing_deg=-120)
    found = build_keyframe_clip(KeyRequest((first_and_last(poses[rig])[0], key)))
    whole, plain = (
        canonical_of(found),
        canonical_of(build_keyframe_clip(KeyRequest(first_and_last(poses[rig], frames=20)))),
    )
    assert whole.root_position[30].tolist() == pytest.approx([2.0, 0.7, -1.5], abs=1e-9)
    assert math.degrees(float(heading(whole.local_quat_xyzw[30, 0]))) == pytest.approx(-120, abs=1e-6)
    source = retarget.to_canonical(mapctl.load(poses[rig]))[0]
    assert apart_deg(whole.local_quat_xyzw[30, 1:], source.local_quat_xyzw[20, 1:]).max() < 0.01
    assert torch.allclose(whole.root_position[0], plain.root_position[0], atol=1e-9)


@pytest.mark.parametrize(
    "rig", ["daz", *(pytest.param(rig, marks=pytest.mark.slow) for rig in ("canonical", "bandai", "zup"))]
)
def test_every_kind_of_key_is_met_in_one_motion(poses, rig):
    rigmap = retarget.to_canonical(build_keyframe_clip(KeyRequest(first_and_last(poses[rig]))).motion)[1]
    hand, foot = (
        rigmap.rig_skeleton.names[rigmap.joint_of[rigmap.skeleton.index(name)]] for name in ("leftHand", "rightFoot")
    )
    start, stop = first_and_last(poses[rig])
    between = (
        KeyEntry(frame=7, reach={hand: (0.4, 1.2, 0.5)}),
        KeyEntry(frame=13, pose=poses[rig], pose_frame=14, joints=(foot,)),
        KeyEntry(frame=19, pose=poses[rig], pose_frame=18, root_only=True, place=(0.1, 0.6)),
        KeyEntry(frame=24, pose=poses[rig], pose_frame=24),
    )
    found, done = made_of(KeyRequest((stop, *between, start)))
    rows = measure_keyframe_errors(done.motion, found.motion, found.keys, found.rig)
    assert [row["what"] for row in rows] == ["pose", "limbs", "limbs", "root", "pose", "pose"]
    assert max(row["missed_cm"] for row in rows) < 0.1
    assert done.notes == ()
    canonical, there = retarget.to_canonical(done.motion, found.rig)
    positions = retarget.rig_joint_positions(done.motion, there)
    assert positions[7, canonical.skeleton.index("leftHand")].tolist() == pytest.approx([0.4, 1.2, 0.5], abs=1e-3)
    assert canonical.root_position[19, ::2].tolist() == pytest.approx([0.1, 0.6], abs=1e-6)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (KeyEntry(frame=9, pose="gone.npz"), r"key\[2\]\.pose: gone\.npz"),
        (KeyEntry(frame=9, pose="clip.mp3"), r"key\[2\]\.pose: clip\.mp3"),
        (KeyEntry(frame=9, pose_frame=45), r"key\[2\]\.pose_frame: the frame 45 is not one of the pose's 0:45"),
        (KeyEntry(frame=9, pose_seconds=1.6), r"key\[2\]\.pose_seconds: the frame 48 is not one of the pose's 0:45"),
        (KeyEntry(frame=9, joints=("Hnad_L",)), r"key\[2\]\.joints: no hand or foot 'Hnad_L'; the nearest is Hand_L"),
        (KeyEntry(frame=9, reach={"fot_r": (0, 0, 0)}), r"key\[2\]\.reach: no hand or foot 'fot_r'; .* Foot_R"),
    ],
)
def test_what_is_not_there_is_named_with_its_key(poses, key, said):
    with pytest.raises(RequestError, match=said):
        build_keyframe_clip(KeyRequest((*first_and_last(poses["bandai"]), key), body=poses["bandai"]))
