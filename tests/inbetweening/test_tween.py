"""A few keys to a whole motion: keys are met, nothing else counts, what cannot be is said or refused."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import random_motion, walk
from methods import by_method
from rig_maker import Make, make, names_of
from tiny_infiller import tiny_infiller

from controllers.inbetweening.tween import tween
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask, interpolate_missing, restore_observed
from mapctl.intent.keyframes import Drawing, Key, Keys

RIGS = ("canonical", "bandai", "daz")
ON_RIGS = [*((rig, 30) for rig in RIGS), ("daz", 120)]
LIMBS = {"canonical": ("leftHand", "rightFoot"), "bandai": ("Hand_L", "Foot_R"), "daz": ("lHand", "rFoot")}
HIPS = {"canonical": "hips", "bandai": "Hips", "daz": "hip"}


def made_of(motion, frames, *, method="infiller", drawn=0.02, **given):
    inbetweener, settings = by_method(method, tiny_infiller(drawn=drawn))
    return tween(motion, Keys.of(tuple(frames), **given), inbetweener, settings=settings)


def frames_of(fps):
    """Frames of keys in 1.5 seconds: neither evenly spread nor on the prior's moments."""
    return 0, fps // 2 + 1, fps + 3, round(1.5 * fps) - 1


def keyed(motion, frames):
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[list(frames)] = False
    return MissingMask(free[:, None].expand(-1, motion.num_joints).clone(), free)


def corrupted(motion, frames):
    """Nonsense between the keys."""
    wild = random_motion(motion.skeleton, motion.num_frames, seed=3)
    wild = replace(wild, moving_offsets={joint: wild.root_position for joint in motion.moving_offsets})
    return restore_observed(wild, motion, keyed(motion, frames))


def assert_met(result, motion, frames):
    """To the bit."""
    frames = list(frames)
    assert (result.num_frames, result.fps, result.skeleton) == (motion.num_frames, motion.fps, motion.skeleton)
    assert torch.equal(result.local_quat_xyzw[frames], motion.local_quat_xyzw[frames])
    assert torch.equal(result.root_position[frames], motion.root_position[frames])
    for joint, values in motion.moving_offsets.items():
        assert torch.equal(result.moving_offsets[joint][frames], values[frames])
    assert result.joint_positions().isfinite().all()


def same(first, second):
    quats = torch.equal(first.local_quat_xyzw, second.local_quat_xyzw)
    return quats and torch.equal(first.joint_positions(), second.joint_positions())


def missed_cm(result, motion, frame, names):
    joints = [motion.skeleton.index(name) for name in names]
    return 100 * float((result.joint_positions() - motion.joint_positions())[frame, joints].norm(dim=-1).max())


@pytest.mark.parametrize(
    ("rig", "fps", "method"),
    [("canonical", 24, "infiller"), ("bandai", 30, "infiller"), ("daz", 120, "slerp"), ("daz", 30, "auto")],
)
def test_poses_that_are_keys_are_met_to_the_bit(rig, fps, method):
    motion = on_rig(rig, round(1.5 * fps), fps=fps)
    result = made_of(motion, frames_of(fps), method=method).motion
    assert_met(result, motion, frames_of(fps))
    apart = (result.joint_positions() - motion.joint_positions()).norm(dim=-1).amax(dim=1)
    assert (apart > 1e-4).sum() > motion.num_frames // 2


@pytest.mark.parametrize(
    ("rig", "method", "given"),
    [
        ("canonical", "infiller", {}),
        ("daz", "slerp", {"limbs": True}),
        pytest.param("bandai", "auto", {"limbs": True}, marks=pytest.mark.slow),
    ],
)
def test_other_frames_change_nothing(rig, method, given):
    motion, frames = on_rig(rig, 45), frames_of(30)
    given = {"limbs": LIMBS[rig]} if "limbs" in given else given
    other = corrupted(motion, frames)
    assert not same(motion, other)
    assert same(*(made_of(each, frames, method=method, **given).motion for each in (motion, other)))


@pytest.mark.slow
def test_on_a_rig_that_only_poses_tell_other_frames_change_nothing_either():
    """Its T-pose is found from the keys; joints that only it has carry hands elsewhere, and these are met all the
    same.
    """
    result = make(Make(names_of("ue4"), bones_along_x=True, zup=True, root="root"))
    motion, frames = result.motion(walk(45, turn_rate=0.3)), (0, 11, 30, 44)
    limbs = (result.joint["leftHand"],)
    first, second = (made_of(each, frames, method="slerp", limbs=limbs) for each in (motion, corrupted(motion, frames)))
    assert same(first.motion, second.motion)
    assert max(missed_cm(first.motion, motion, frame, limbs) for frame in (11, 30)) < 0.1
    assert first.notes == ()


@pytest.mark.parametrize(
    ("rig", "fps", "method"),
    [
        *(pytest.param(*case, "infiller", marks=pytest.mark.slow if case[1] != 120 else ()) for case in ON_RIGS),
        pytest.param("bandai", 30, "auto", marks=pytest.mark.slow),
    ],
)
def test_hands_and_feet_are_met_and_the_rest_is_free(rig, fps, method):
    motion, frames = on_rig(rig, round(1.5 * fps), fps=fps), frames_of(fps)
    done = made_of(motion, frames, method=method, limbs=LIMBS[rig])
    assert_met(done.motion, motion, [frames[0], frames[-1]])
    assert done.notes == ()
    for frame in frames[1:-1]:
        assert missed_cm(done.motion, motion, frame, LIMBS[rig]) < 0.1
        assert missed_cm(done.motion, motion, frame, motion.skeleton.names) > 1


@pytest.mark.slow
def test_a_hand_whose_place_is_out_of_reach_is_said_to_miss_it():
    motion = on_rig("canonical", 45)
    root = motion.root_position.clone()
    root[22] += torch.tensor([0.0, 1.5, 0.0]).double()
    done = made_of(replace(motion, root_position=root), (0, 22, 44), limbs=("leftHand",))
    (note,) = done.notes
    assert note.startswith("frame 22: a limb stays ")
    assert note.endswith(" cm from its target, out of reach")


@pytest.mark.parametrize(("rig", "fps", "method"), [("daz", 60, "infiller"), ("bandai", 30, "auto")])
def test_the_place_and_rotation_of_the_hips_are_met_to_the_bit(rig, fps, method):
    motion, frames = on_rig(rig, round(1.5 * fps), fps=fps), frames_of(fps)
    result = made_of(motion, frames, method=method, root_only=True).motion
    assert_met(result, motion, [frames[0], frames[-1]])
    hips, between = motion.skeleton.index(HIPS[rig]), list(frames[1:-1])
    assert torch.equal(result.joint_positions()[between, hips], motion.joint_positions()[between, hips])
    assert torch.equal(result.joint_rotations()[between, hips], motion.joint_rotations()[between, hips])
    assert not torch.equal(result.local_quat_xyzw[between], motion.local_quat_xyzw[between])


@pytest.mark.parametrize(("fps", "aside"), [(24, 1), (120, 2)])
def test_hips_that_are_keys_between_two_moments_do_not_leap(fps, aside):
    """At every frame of a fast curve the hips are about as near to it as straight lines from key to key are, and go no
    faster than one walks through all keys.
    """
    motion = walk(2 * fps, fps=fps, turn_rate=1.5)
    frames = (0, fps // 2 + aside, fps + fps // 3 + aside, 2 * fps - 1)
    result = made_of(motion, frames, drawn=0.0, root_only=True).motion
    lines = interpolate_missing(motion, keyed(motion, frames))
    off, straight_off = ((each.root_position - motion.root_position).norm(dim=-1).max() for each in (result, lines))
    assert off < straight_off + 0.02
    step, own = (torch.diff(each.root_position, dim=0).norm(dim=-1).max() for each in (result, motion))
    assert step < 1.35 * own


@pytest.mark.parametrize(("fps", "keys"), [(120, (0, 1, 22, 23, 43, 44)), (30, (3, 4))])
def test_keys_may_be_one_frame_apart(fps, keys):
    motion = on_rig("bandai", 45, fps=fps)
    assert_met(made_of(motion, keys).motion, motion, keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (Keys((0,)), "at least two keys, got 1"),
        (Keys((0, 45)), "the key 45 is not one of the motion's frames 0:45"),
        (Keys.of((0, 20, 44), limbs=("Hnad_L",)), "no hand or foot 'Hnad_L'; the nearest is Hand_L"),
        (Keys((0, 20, Key(20, limbs=("Hand_L",)), 44)), "two different keys are at frame 20"),
        (Keys((Key(0, limbs=("Foot_R",)), Key(44, limbs=("Hand_L",)))), "no key gives the position of the hips"),
        (
            Keys((0, Key(44, drawing=Drawing({"hips": (0, 0), "haed": (0, 1)})))),
            "no joint 'haed' .*the nearest is Head",
        ),
        (
            Keys((0, Key(44, drawing=Drawing({"Hand_L": (0, 0), "leftHand": (0, 1)})))),
            "'leftHand' is drawn twice, by its own name and by the canonical one",
        ),
    ],
)
def test_keys_that_cannot_be_are_refused(keys, message):
    with pytest.raises(RequestError, match=message):
        tween(on_rig("bandai", 45), keys, tiny_infiller())


@pytest.mark.parametrize(
    ("joint", "given", "said"),
    [("UpperArm_L", {}, True), ("UpperArm_L", {"root_only": True}, False), ("Hips", {"root_only": True}, True)],
)
def test_neighbouring_keys_that_no_joint_could_join_are_named_with_numbers(joint, given, said):
    motion = on_rig("bandai", 45)
    half, quats = torch.tensor(0.75).double(), motion.local_quat_xyzw.clone()
    turn = torch.stack([torch.sin(half), half * 0, half * 0, torch.cos(half)])
    index = motion.skeleton.index(joint)
    quats[20, index] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    quats[21, index] = turn
    done = made_of(replace(motion, local_quat_xyzw=quats), (0, 20, 21, 44), **given)
    expected = (f"{joint} needs 45 rad/s between frames 20 and 21, faster than joints turn",)
    assert tuple(note for note in done.notes if "as abrupt as" not in note) == (expected if said else ())
