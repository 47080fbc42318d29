"""A few keys to a whole motion: poses, parts, positions and drawings are met, nothing else counts; variations."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from captures import apart_deg, on_rig
from helpers import generator, random_motion, tiny_density, walk
from linear_inbetweener import LinearInbetweener
from methods import by_method
from rig_maker import Make, make, names_of
from tiny_infiller import tiny_infiller
from tiny_prior import save_tiny_prior
from tiny_tweener import tiny_tweener

import mapctl
import priors
from controllers.inbetweening.infill import infill
from controllers.inbetweening.keyframes import build_keyframe_clip, missing_between_keys
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, CanonicalClip
from controllers.inbetweening.proposers import (
    AutoInbetweener,
    RolloutInbetweener,
    SlerpInbetweener,
    lay_curve,
    propose_through_keys,
)
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from controllers.inbetweening.variations import sample_variations
from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.effector_targets import EffectorTargets, LooseKeys, view_axes
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.intent.keyframes import Drawing, Key, KeyEntry, KeyRequest, Keys
from mapctl.kinematics import heading
from mapctl.metrics import body
from mapctl.problem.window_solvers import LatentNoiseSolver, SwarmProposal
from mapctl.recording.masks import Mask, MissingMask, restore_observed
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL, LIMBS
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings

RIGS = ("canonical", "bandai", "daz")
ON_RIGS = [*((rig, 30) for rig in RIGS), ("daz", 120)]
RIG_LIMBS = {"canonical": ("leftHand", "rightFoot"), "bandai": ("Hand_L", "Foot_R"), "daz": ("lHand", "rFoot")}
HIPS = {"canonical": "hips", "bandai": "Hips", "daz": "hip"}


def made_of(motion, frames, *, method="infiller", drawn=0.02, **given):
    inbetweener, refinement = by_method(method, tiny_infiller(drawn=drawn))
    return tween(motion, Keys.of(tuple(frames), **given), inbetweener, refinement=refinement)


def frames_of(fps):
    """Frames of keys in 1.5 seconds: neither evenly spread nor on the prior's moments."""
    return 0, fps // 2 + 1, fps + 3, round(1.5 * fps) - 1


def keyed(motion, frames):
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[list(frames)] = False
    return MissingMask.of_frames(free, motion.num_joints)


def corrupted(motion, missing):
    """Nonsense wherever values do not count."""
    wild = random_motion(motion.skeleton, motion.num_frames, seed=3)
    wild = replace(wild, moving_offsets={joint: wild.root_position for joint in motion.moving_offsets})
    return restore_observed(wild, motion, missing)


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
    given = {"limbs": RIG_LIMBS[rig]} if "limbs" in given else given
    other = corrupted(motion, keyed(motion, frames))
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
    wild = corrupted(motion, keyed(motion, frames))
    first, second = (made_of(each, frames, method="slerp", limbs=limbs) for each in (motion, wild))
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
    done = made_of(motion, frames, method=method, limbs=RIG_LIMBS[rig])
    assert_met(done.motion, motion, [frames[0], frames[-1]])
    assert done.notes == ()
    for frame in frames[1:-1]:
        assert missed_cm(done.motion, motion, frame, RIG_LIMBS[rig]) < 0.1
        assert missed_cm(done.motion, motion, frame, motion.skeleton.names) > 1


@pytest.mark.slow
def test_an_unreachable_hand_target_is_reported_as_missed():
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


ENDS = [CANONICAL.index(name) for name in LIMBS]


def peaks_of(motion):
    canonical = to_canonical(motion)[0]
    return body.measure_peaks(canonical.joint_positions()[:, ENDS], canonical.root_position, float(motion.fps))


def asked(motion, keys, *, method="infiller", drawn=0.0):
    inbetweener, refinement = by_method(method, tiny_infiller(drawn=drawn))
    return tween(motion, Keys(keys), inbetweener, refinement=refinement)


HIGH, LOW = (0.5, 1.5, 0.3), (0.25, 0.35, 0.5)
REACH_QUICK = [("bandai", 30, HIGH)]
REACH_RATES = [("canonical", 30), ("bandai", 30), ("daz", 120), ("canonical", 24)]


@pytest.mark.parametrize(
    ("rig", "fps", "position"),
    [
        case if case in REACH_QUICK else pytest.param(*case, marks=pytest.mark.slow)
        for position in (HIGH, LOW)
        for case in ((*rig, position) for rig in REACH_RATES)
    ],
)
def test_a_hand_keyframe_is_reached_and_left(rig, fps, position):
    """No faster than 1.9 times the distance over the time of a smooth reach, and as calmly."""
    motion = on_rig(rig, 3 * fps, fps=fps)
    scale = float(to_canonical(motion)[0].root_position[0, 1]) / 0.95
    there = to_canonical(motion)[0].root_position[3 * fps // 2] * torch.tensor([1.0, 0.0, 1.0])
    position = tuple((there + scale * torch.tensor(position).double()).tolist())
    hand = Key(3 * fps // 2, positions={RIG_LIMBS[rig][0]: position})
    done = asked(motion, (0, hand, 3 * fps - 1))
    at = to_canonical(done.motion)[0].joint_positions()[hand.frame, CANONICAL.index("leftHand")]
    if rig != "daz":  # whose fingers' parents carry the hand elsewhere than on canonical joints
        assert (at - torch.tensor(position).double()).norm() < 0.002
    step, acceleration = peaks_of(done.motion)
    assert step < 0.15
    assert acceleration < 60


@pytest.mark.parametrize(("fps", "turn"), [(30, 1.2), (120, 0.0)])
def test_hips_keyed_at_one_frame_do_not_swing_the_body(fps, turn):
    motion = walk(3 * fps, fps=fps, turn_rate=turn)
    own = peaks_of(motion)
    done = asked(motion, (0, Key(4 * fps // 3, root_only=True), 3 * fps - 1), method="infiller")
    step, acceleration = peaks_of(done.motion)
    assert step < 1.3 * own.step
    assert acceleration < 1.5 * own.acceleration
    assert (done.motion.root_position - motion.root_position)[4 * fps // 3].norm() < 1e-9


@pytest.mark.parametrize(("share", "moves"), [(0.9, False), (1.25, True)], ids=["within reach", "beyond"])
def test_the_body_moves_for_a_hand_only_where_its_arm_does_not_reach(share, moves):
    motion, at, limb = walk(60), 30, LIMBS["leftHand"]
    shoulder = motion.joint_positions()[at, limb.upper]
    positions, wanted = torch.zeros(60, CANONICAL.num_joints, 3).double(), torch.zeros(60, CANONICAL.num_joints) > 0
    direction = torch.nn.functional.normalize(torch.tensor([0.4, 0.0, 1.0]).double(), dim=0)
    positions[at, limb.end], wanted[at, limb.end] = shoulder + share * limb.length(CANONICAL) * direction, True
    missing = torch.zeros(60, dtype=torch.bool)
    missing[15:45] = True
    mask = MissingMask.of_frames(missing, CANONICAL.num_joints)
    query = GapQuery(motion, mask, torch.arange(60) / 30.0, EffectorTargets(positions, wanted))
    result, targets = propose_through_keys(query, LinearInbetweener(), torch.Generator())
    freely = LinearInbetweener().propose(query).motion
    hips = (result.motion.root_position - freely.root_position).norm(dim=-1)
    assert bool(hips[at] > 0.01) == moves
    assert targets is not None
    assert torch.equal(targets.wanted, wanted)
    away = (targets.positions[at, limb.end] - result.motion.joint_positions()[at, limb.upper]).norm()
    assert float(away) <= limb.length(CANONICAL)


RATES = [("canonical", 30), ("bandai", 30), ("daz", 120)]
POSITION = {"root_only": "place"}


def drawing_of(canonical, frame, *, view_deg, names=CANONICAL.names, unit=100.0):
    """A drawing of the pose from there, in centimetres from anywhere."""
    seen = canonical.joint_positions()[frame] @ view_axes(torch.tensor(math.radians(view_deg)).double()).mT
    positions = {
        name: tuple((unit * seen[CANONICAL.index(name)] + torch.tensor([7.0, -3.0])).tolist()) for name in names
    }
    return Drawing(positions, view_deg)


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
    result = tween(motion, keys, tiny_tweener(), refinement=None)
    known = ~missing.joints
    assert torch.equal(result.motion.local_quat_xyzw[known], motion.local_quat_xyzw[known])
    assert torch.equal(result.motion.root_position[~missing.root], motion.root_position[~missing.root])
    assert all(row["missed_cm"] < 1e-6 for row in measure_keyframe_errors(result.motion, motion, keys))
    again = tween(corrupted(motion, missing), keys, tiny_tweener(), refinement=None)
    assert torch.equal(result.motion.local_quat_xyzw, again.motion.local_quat_xyzw)


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "fps", "method"), [*((*rate, "infiller") for rate in RATES), ("daz", 120, "slerp")])
def test_places_alone_are_met_and_nothing_else_of_the_motion_counts(rig, fps, method):
    motion = on_rig(rig, round(1.5 * fps), fps=fps)
    keys = Keys(tuple(Key(frame, **POSITION) for frame in frames_of(fps)))
    by, refinement = by_method(method, tiny_tweener() if method == "infiller" else tiny_infiller(drawn=0.02))
    result = tween(motion, keys, by, refinement=refinement)
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
    result = tween(motion, keys, tiny_tweener(), refinement=None)
    rows = measure_keyframe_errors(result.motion, motion, keys)
    assert [row["what"] for row in rows] == ["drawing", "drawing"]
    assert max(row["drawn_cm"] for row in rows) < 3
    assert rows[0]["missed_cm"] < 1e-6
    assert "missed_cm" not in rows[1]


PLACED_FRAMES = (0, 30, 75, 90)
WAY = ((0.0, 0.0), (0.5, 1.2), (0.5, 2.6), (-0.4, 3.0))
FASTEST = 2.0  # m/s


def query_of(frames=PLACED_FRAMES, way=WAY, *, drawn=False):
    loose = LooseKeys.none(91, CANONICAL.num_joints)
    loose.placed[list(frames)] = True
    loose.ground[list(frames)] = torch.tensor(way).double()
    loose.drawn[0] = drawn
    missing = MissingMask.of_frames(torch.ones(91, dtype=torch.bool), CANONICAL.num_joints)
    return GapQuery(on_rig("canonical", 91), missing, torch.arange(91).double() / 30, loose=loose)


def test_the_curve_is_at_every_place_in_its_frame_and_goes_on():
    curve, arcs = lay_curve(query_of(), FASTEST, 20)
    assert len(arcs) == 111
    assert (torch.diff(arcs) > 0).all()
    found = curve.ground_point(arcs[list(PLACED_FRAMES)])
    torch.testing.assert_close(found, torch.tensor(WAY).double(), atol=0.02, rtol=0)


@pytest.mark.parametrize(
    "query",
    [
        query_of(drawn=True),
        query_of((0, 30, 75), WAY[:3]),  # the end is open
        query_of(way=((0.0, 0.0), (0.5, 1.2), (0.5, 1.3), (-0.4, 1.5))),  # stands in between
        query_of(way=((0.0, 0.0), (0.5, 1.2), (0.5, 2.6), (-0.4, 9.0))),  # faster than anybody in the data
    ],
    ids=["drawn", "open", "stands", "too fast"],
)
def test_what_is_no_walk_is_left_to_others(query):
    assert lay_curve(query, FASTEST, 5) is None


@pytest.mark.slow
def test_auto_walks_over_root_keys_where_a_density_does_with_a_note(tmp_path):
    motion = on_rig("bandai", 60)
    keys = Keys((Key(0, root_only="place"), Key(59, root_only="place")))
    density = priors.load(str(save_tiny_prior(tmp_path / "prior.safetensors")))
    auto = AutoInbetweener(SlerpInbetweener(), [density], tweener=tiny_tweener())
    result = tween(motion, keys, auto, refinement=None)
    assert all(row["missed_cm"] < 1e-6 for row in measure_keyframe_errors(result.motion, motion, keys))
    assert result.gap_notes[0].startswith("frames 0:60: walk of ")
    whole = tween(motion, Keys((0, keys.each[1])), auto, refinement=None)
    assert not any("walk of" in note for note in whole.gap_notes)


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


def build_and_tween(request):
    found = build_keyframe_clip(request)
    done = tween(found.motion, found.keys, tiny_infiller(drawn=0.02), rig=found.rig, refinement=None)
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
    found, done = build_and_tween(KeyRequest((stop, *between, start)))
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


FRAMES, KEYS = 45, (0, 20, 23, 44)
FEW_FRAMES, FEW_KEYS = 25, (0, 10, 13, 24)
FEW = replace(INFILL_REFINEMENT, budget=Budget(evaluations=4))
QUICK = partial(
    RolloutInbetweener,
    ahead=4,
    jump=math.inf,  # a small density of drawn weights does nothing else
    solver=LatentNoiseSolver(
        rounds=1,
        lbfgs=LbfgsSettings(max_iterations=4),
        budget=Budget(evaluations=10),
        proposal=SwarmProposal(SwarmSettings(particles=4, iterations=1)),
    ),
)


JUMPING = partial(QUICK, jump=0.0, least_jump=0.0)


@pytest.fixture(scope="module")
def prior_file(tmp_path_factory):
    return save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors")


@pytest.fixture(scope="module")
def prior(prior_file):
    return priors.load(str(prior_file))


INFILLER = tiny_infiller(drawn=0.02)


def making(motion, keys):
    """Tweens of one motion by whoever is varied."""
    return lambda inbetweener, draws: tween(motion, keys, inbetweener, refinement=FEW, generator=draws)


def varied(motion, prior, *, count=3, seed=0, keys=KEYS, rolling=QUICK, **given):
    make, rollouts = making(motion, Keys.of(keys, **given)), rolling([prior], INFILLER)
    first = AutoInbetweener(INFILLER, [prior])
    return sample_variations(make, first, rollouts, count, generator=generator(seed))


@pytest.mark.parametrize(("rig", "fps"), [("canonical", 30), pytest.param("daz", 60, marks=pytest.mark.slow)])
def test_every_variation_meets_the_keys_to_the_bit_and_no_two_are_the_same(prior, rig, fps):
    motion = on_rig(rig, FEW_FRAMES * fps // 30, fps=fps)
    keys = [key * fps // 30 for key in FEW_KEYS]
    found = varied(motion, prior, keys=tuple(keys))
    positions = [one.solution.motion.joint_positions() for one in found.each]
    for one in found.each:
        result = one.solution.motion
        assert torch.equal(result.local_quat_xyzw[keys], motion.local_quat_xyzw[keys])
        assert torch.equal(result.root_position[keys], motion.root_position[keys])
    apart = [float((positions[i] - positions[j]).norm(dim=-1).max()) for i in range(3) for j in range(i)]
    assert min(apart) > 0.002  # gaps are a third of a second
    assert found.diversity.world_cm > 0.1
    assert all(torch.isfinite(torch.tensor(one.energy)) for one in found.each)


def test_a_rollout_changes_nothing_that_is_known_or_has_no_end():
    motion = on_rig("canonical", FRAMES)
    gap = CanonicalClip.of(motion, keyed(motion, (*range(5, 20), *range(30, 40)))).query()
    logits = SlerpInbetweener().propose(gap).contact_logits
    answer = QUICK([tiny_density()], SlerpInbetweener()).propose(gap, generator=generator(0))
    result, bits = answer.motion, answer.contact_logits
    assert [(source.start, source.stop) for source in answer.attribute(gap)] == [(20, 30)]
    same = torch.ones(FRAMES, dtype=torch.bool)
    same[20:30] = False
    torch.testing.assert_close(result.root_position[same], gap.motion.root_position[same])
    torch.testing.assert_close(result.local_quat_xyzw[same], gap.motion.local_quat_xyzw[same])
    assert torch.equal(bits[same], logits[same])
    assert float((result.root_position - gap.motion.root_position)[20:30].norm(dim=-1).max()) > 1e-4


def test_a_gap_in_which_every_rollout_jumps_is_left_to_the_fallback():
    motion = on_rig("canonical", FRAMES)
    missing = keyed(motion, (*range(20), *range(30, FRAMES)))
    gap = CanonicalClip.of(motion, missing).query()
    answer = JUMPING([tiny_density()], SlerpInbetweener()).propose(gap, generator=generator(0))
    (source,) = answer.attribute(gap)
    assert (source.by, source.reason) == ("slerp", "every rollout jumped")
    plain = SlerpInbetweener().propose(gap).motion.local_quat_xyzw
    torch.testing.assert_close(answer.motion.local_quat_xyzw, plain)


@pytest.mark.parametrize("frames", [(30, 45), pytest.param((8, 45), marks=pytest.mark.slow)])
def test_an_end_is_extended_by_a_density_and_a_beginning_never(prior, frames):
    motion, masks = on_rig("bandai", FRAMES), [Mask("*", 0, 2), Mask("*", *frames)]
    plain, result, again = (
        infill(motion, inbetweener, masks, refinement=None)
        for inbetweener in (INFILLER, *[AutoInbetweener(INFILLER, [prior])] * 2)
    )
    known = ~result.missing.frames
    for one in (plain, result):
        assert torch.equal(one.motion.local_quat_xyzw[known], motion.local_quat_xyzw[known])
        assert bool(one.motion.joint_positions().isfinite().all())
    apart = (result.motion.joint_positions() - plain.motion.joint_positions()).norm(dim=-1).amax(dim=-1)
    assert float(apart[:2].max()) < 1e-3
    assert float(apart[frames[0] + 3 :].min()) > 1e-4
    assert [note.split(",")[0].rpartition("extended ")[2] for note in result.notes] == [
        "backwards by infiller",
        f"by density {prior.name}",
    ]
    assert plain.notes[1].split(",")[0].endswith("extended by infiller")
    assert torch.equal(again.motion.local_quat_xyzw, result.motion.local_quat_xyzw)


@pytest.mark.slow
def test_what_leaves_nothing_to_vary_is_refused(prior):
    motion = on_rig("canonical", FRAMES)
    with pytest.raises(RequestError, match="nothing to vary"):
        varied(motion, prior, keys=tuple(range(FRAMES)))
    with pytest.raises(RequestError, match="leaves nothing to vary"):
        varied(motion.slice(0, 6), prior, keys=(0, 5))
    with pytest.raises(RequestError, match="every rollout jumped between these keys, which leaves nothing to vary"):
        varied(motion, prior, rolling=JUMPING)
    for count in (1, 1001):
        with pytest.raises(RequestError, match=f"variations are 2 to 1000, got {count}"):
            varied(motion, prior, count=count)
