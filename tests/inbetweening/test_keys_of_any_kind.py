"""Halves of a body, places over the ground and drawings as keys: what they tell is met, on any rig and at any rate, and
what they do not tell changes nothing."""

import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from methods import UNFINISHED, by_method
from tiny_infiller import tiny_infiller
from tiny_tweener import tiny_tweener

from controllers.inbetweening.keyframes import missing_between_keys
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from mapctl import rotations
from mapctl.inbetweening.effector_targets import view_axes
from mapctl.inbetweening.missing import restore_observed
from mapctl.intent.keyframes import Drawing, Key, Keys
from mapctl.kinematics import heading
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL

RATES = [("canonical", 30), ("bandai", 30), ("daz", 120)]
POSITION = {"root_only": "place"}


def frames_of(fps):
    return 0, fps // 2 + 1, fps + 3, round(1.5 * fps) - 1


def drawing_of(canonical, frame, *, view_deg, names=CANONICAL.names, unit=100.0):
    """A drawing of the pose from there, in centimetres from anywhere."""
    seen = canonical.joint_positions()[frame] @ view_axes(torch.tensor(math.radians(view_deg)).double()).mT
    positions = {
        name: tuple((unit * seen[CANONICAL.index(name)] + torch.tensor([7.0, -3.0])).tolist()) for name in names
    }
    return Drawing(positions, view_deg)


def corrupted(motion, missing, *, off=0.3):
    """The motion with other values wherever they do not count."""
    turn = rotations.from_rotation_vector(torch.full((*motion.local_quat_xyzw.shape[:2], 3), off).double())
    moving = {joint: values + off for joint, values in motion.moving_offsets.items()}
    other = replace(
        motion,
        root_position=motion.root_position + off,
        moving_offsets=moving,
        local_quat_xyzw=rotations.multiply(motion.local_quat_xyzw, turn),
    )
    return restore_observed(other, motion, missing)


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "fps"), RATES)
@pytest.mark.parametrize("half", ["upper", "lower"])
def test_a_half_is_met_to_the_bit_and_the_other_does_not_count(rig, fps, half):
    motion = on_rig(rig, round(1.5 * fps), fps=fps)
    keys = Keys(tuple(Key(frame, half=half) for frame in frames_of(fps)))
    rigmap = to_canonical(motion)[1]
    missing = missing_between_keys(keys.checked(motion), motion, rigmap)
    given = {name for name, own in rigmap.joints.items() if not missing.joints[0, own]}
    legs = {name for name in rigmap.joints if name.endswith(("Leg", "Foot", "Toes"))}
    assert given == ((set(rigmap.joints) - legs) if half == "upper" else {"hips", *legs})
    result = tween(motion, keys, tiny_tweener(), settings=UNFINISHED)
    known = ~missing.joints
    assert torch.equal(result.motion.local_quat_xyzw[known], motion.local_quat_xyzw[known])
    assert torch.equal(result.motion.root_position[~missing.root], motion.root_position[~missing.root])
    assert all(row["missed_cm"] < 1e-6 for row in measure_keyframe_errors(result.motion, motion, keys))
    again = tween(corrupted(motion, missing), keys, tiny_tweener(), settings=UNFINISHED)
    assert torch.equal(result.motion.local_quat_xyzw, again.motion.local_quat_xyzw)


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "fps", "method"), [*((*rate, "infiller") for rate in RATES), ("daz", 120, "slerp")])
def test_places_alone_are_met_and_nothing_else_of_the_motion_counts(rig, fps, method):
    motion = on_rig(rig, round(1.5 * fps), fps=fps)
    keys = Keys(tuple(Key(frame, **POSITION) for frame in frames_of(fps)))
    by, settings = by_method(method, tiny_tweener() if method == "infiller" else tiny_infiller(drawn=0.02))
    result = tween(motion, keys, by, settings=settings)
    rows = measure_keyframe_errors(result.motion, motion, keys)
    assert [row["what"] for row in rows] == ["place"] * 4
    assert all(row["missed_cm"] < 1e-6 for row in rows)
    assert result.notes == ()
    canonical = to_canonical(result.motion)[0]
    way = torch.diff(to_canonical(motion)[0].root_position[[0, -1], ::2], dim=0)[0]
    facing = heading(canonical.local_quat_xyzw[:, 0])
    if method == "slerp":  # the others' poses are made up
        assert float(rotations.wrap_angle(facing[0] - torch.atan2(way[0], way[1])).abs()) < 0.5


def test_a_viewer_in_front_sees_the_left_hand_on_the_right():
    """A body that faces +Z has the left hand toward +X; seen from behind it is on the left, from his left side
    nearer."""
    left = torch.tensor([1.0, 0.3, 0.0])
    for view, right in ((0, 1.0), (180, -1.0), (90, 0.0), (-90, 0.0)):
        seen = view_axes(torch.tensor(math.radians(view))) @ left
        assert seen.tolist() == pytest.approx([right, 0.3], abs=1e-6)
    ahead = torch.tensor([0.0, 0.0, 1.0])  # whoever sees him from his left sees him walk to the left
    assert (view_axes(torch.tensor(math.radians(90.0))) @ ahead)[0] == pytest.approx(-1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "fps"), [("bandai", 30), ("cmu", 120)])
def test_drawn_keys_are_met_as_nearly_as_bones_allow(rig, fps):
    motion = on_rig(rig, round(1.5 * fps), fps=fps)
    canonical = to_canonical(motion)[0]
    first, *_, last = frames_of(fps)
    torso = ("hips", "chest", "head", "leftHand", "rightHand", "leftFoot", "rightFoot")
    keys = Keys(
        (
            Key(first, drawing=drawing_of(canonical, first, view_deg=20), placed=True),
            Key(last, drawing=drawing_of(canonical, last, view_deg=110, names=torso)),
        )
    )
    result = tween(motion, keys, tiny_tweener(), settings=UNFINISHED)
    rows = measure_keyframe_errors(result.motion, motion, keys)
    assert [row["what"] for row in rows] == ["drawing", "drawing"]
    assert max(row["drawn_cm"] for row in rows) < 3
    assert rows[0]["missed_cm"] < 1e-6
    assert "missed_cm" not in rows[1]
