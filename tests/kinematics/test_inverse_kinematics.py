"""From joint positions to rotations: what forward kinematics made comes back."""

from dataclasses import replace

import pytest
import torch
from captures import apart_deg, shaken
from helpers import bandai_skeleton, cmu_skeleton, generator, quat_xyzw, random_motion, walk
from hypothesis import given, settings
from hypothesis import strategies as st

from mapctl import rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Limb, Skeleton

SKELETONS = {"canonical": CANONICAL, "bandai": bandai_skeleton(), "daz": cmu_skeleton()}


def solved(places, start, skeleton=CANONICAL, **options):
    """The solution as a motion."""
    quats = inverse.solve_inverse_kinematics(places, start, skeleton, **options)
    root = options.get("root_position", places[:, 0])
    return Motion(skeleton, walk(2).fps, root, quats)


def lengths(motion):
    """Of all bones (frames, joints)."""
    places = motion.joint_positions()
    return (places[:, 1:] - places[:, list(motion.skeleton.parents[1:])]).norm(dim=-1)


@settings(max_examples=10)
@given(st.sampled_from(sorted(SKELETONS)), st.integers(0, 10_000))
def test_any_pose_comes_back_from_its_places_whatever_one_starts_from(rig, seed):
    wanted = random_motion(SKELETONS[rig], 4, seed=seed)
    start = random_motion(SKELETONS[rig], 4, seed=seed + 1)
    made = solved(wanted.joint_positions(), start.local_quat_xyzw, SKELETONS[rig])
    assert (made.joint_positions() - wanted.joint_positions()).norm(dim=-1).max() < 1e-9


ARM = Limb(*(CANONICAL.index(f"left{part}") for part in ("UpperArm", "LowerArm", "Hand")), (0, 0, -1))
LEG = Limb(*(CANONICAL.index(f"right{part}") for part in ("UpperLeg", "LowerLeg", "Foot")), (0, 0, 1))


@settings(max_examples=10)
@given(st.integers(0, 10_000))
def test_limbs_whose_bones_have_their_lengths_come_back_as_all_do(seed):
    wanted = random_motion(CANONICAL, 4, seed=seed)
    start = random_motion(CANONICAL, 4, seed=seed + 1)
    made = solved(wanted.joint_positions(), start.local_quat_xyzw, limbs=(ARM, LEG))
    away = (made.joint_positions() - wanted.joint_positions()).norm(dim=-1)
    ends = [ARM.end, LEG.end]
    # An elbow close to the line has no side to speak of: a hair of anatomy then tells, and moves it by as much.
    assert away[:, ends].max() < 1e-3
    assert away.max() < 0.02


@pytest.mark.parametrize("limb", [ARM, LEG], ids=["arm", "leg"])
@pytest.mark.parametrize("share", [0.7])
def test_a_limb_of_short_bones_that_point_the_wrong_way_bends_as_it_did(limb, share):
    """As the mean of several swings: the end's place is met all the same."""
    motion = walk(40)
    if limb is ARM:  # which hangs straight down there
        quats = motion.local_quat_xyzw.clone()
        quats[:, limb.lower] = quat_xyzw(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)).expand(40, 4)
        motion = replace(motion, local_quat_xyzw=quats)
    places = motion.joint_positions()
    shoulder, elbow, hand = places[:, limb.upper], places[:, limb.lower], places[:, limb.end]
    bend = elbow - shoulder - _along(elbow - shoulder, hand - shoulder)
    wrong = places.clone()
    # The elbow on the other side of the line from the shoulder to the hand, and nearer to it.
    wrong[:, limb.lower] = elbow - (1 + share) * bend
    close = shoulder + 0.8 * (hand - shoulder)
    wrong[:, limb.end] = close
    wrong[:, limb.lower] = close + share * (wrong[:, limb.lower] - close)
    made = solved(wrong, motion.local_quat_xyzw, limbs=(limb,)).joint_positions()
    assert (made[:, limb.end] - close).norm(dim=-1).max() < 1e-9
    now = made[:, limb.lower] - shoulder
    now = now - _along(now, close - shoulder)
    bent = bend.norm(dim=-1) > 0.02
    assert bent.any()
    assert torch.cosine_similarity(now, bend, dim=-1)[bent].min() > 0.5
    without = solved(wrong, motion.local_quat_xyzw).joint_positions()
    assert (without[:, limb.end] - close).norm(dim=-1).max() > 0.01


def _along(vector, axis):
    """The part of a vector along an axis."""
    axis = torch.nn.functional.normalize(axis, dim=-1)
    return (vector * axis).sum(-1, keepdim=True) * axis


def test_a_bent_knee_tells_the_plane_in_which_it_bends():
    """The knee itself turns about one axis only, as in the motion that the places are of."""
    motion = walk(60)
    thigh, knee, foot = (CANONICAL.index(f"left{part}") for part in ("UpperLeg", "LowerLeg", "Foot"))
    twist = quat_xyzw(torch.tensor([0.0, 0.6, 0.0], dtype=torch.float64)).expand(60, 4)
    start = motion.local_quat_xyzw.clone()
    start[:, thigh] = rotations.multiply(start[:, thigh], twist)
    made = solved(motion.joint_positions(), start, limbs=(replace(LEG, upper=thigh, lower=knee, end=foot),))
    bent = rotations.to_rotation_vector(motion.local_quat_xyzw[:, knee])[:, 0] > 0.45
    assert bent.sum() > 5
    off = apart_deg(made.local_quat_xyzw[:, thigh], motion.local_quat_xyzw[:, thigh])
    assert off[bent].max() < 0.5 * torch.rad2deg(torch.tensor(0.6))


def test_joints_that_are_not_free_stay_as_they_are():
    motion, start = walk(12), shaken(walk(12).local_quat_xyzw, 0.3)
    free = torch.rand(12, CANONICAL.num_joints, generator=generator()) < 0.5
    made = solved(motion.joint_positions(), start, free=free)
    assert apart_deg(made.local_quat_xyzw, start)[~free].max() < 1e-5
    nothing = solved(motion.joint_positions(), start, free=torch.zeros_like(free))
    assert apart_deg(nothing.local_quat_xyzw, start).max() < 1e-5


def test_a_limb_that_cannot_reach_points_at_its_place_on_rigid_bones():
    motion = walk(6)
    hand, elbow = CANONICAL.index("leftHand"), CANONICAL.index("leftLowerArm")
    places = motion.joint_positions().clone()
    places[:, hand] += torch.tensor([3.0, 2.0, -1.0])
    made = solved(places, motion.local_quat_xyzw)
    found = made.joint_positions()
    aim, bone = places[:, hand] - found[:, elbow], found[:, hand] - found[:, elbow]
    cosine = torch.cosine_similarity(aim, bone, dim=-1)
    assert cosine.min() > 1 - 1e-9
    assert torch.allclose(lengths(made), lengths(motion), atol=1e-12)


def chain(*offsets):
    """A limb of single bones."""
    names = tuple(f"j{number}" for number in range(len(offsets) + 1))
    return Skeleton(names, tuple(range(-1, len(offsets))), torch.tensor([(0.0, 0.0, 0.0), *offsets]).double())


@pytest.mark.parametrize("direction", [(0, -1, 0), (0, 0, -1), (0, 0, 0), (1e-9, -1, 0)])
def test_straight_limbs_and_opposite_directions_give_something_finite(direction):
    limb = chain((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    aim = torch.tensor(direction).double()
    places = (torch.arange(4)[:, None] * aim)[None]
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, 4, 4)
    made = solved(places, still, limb)
    assert made.local_quat_xyzw.isfinite().all()
    assert torch.allclose(made.local_quat_xyzw.norm(dim=-1), torch.ones(1, 4).double())
    if aim.any():
        assert torch.allclose(made.joint_positions(), places, atol=1e-7)
