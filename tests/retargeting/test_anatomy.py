"""Rigs read by anatomy: the same motion in other joint frames, units, worlds and names is the same motion."""

import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

import mapctl
from mapctl import kinematics, retarget, rotations
from mapctl.errors import RequestError
from mapctl.formats import bvh as layout
from mapctl.motion import Motion
from mapctl.retarget import put_upright
from mapctl.retarget.anatomy import RigPoses, are_sides_swapped, find_up_axis
from mapctl.retarget.doubts import assess_fit
from mapctl.retarget.reference_pose import find_tpose, upright_rotation
from mapctl.retarget.rigs import UNITS
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

UPS = ("y", "z", "x", "-y")


def load() -> Motion:
    """The example that the package brings along, with Y up and without its first frame, a T-pose."""
    motion, _ = put_upright(mapctl.load("example:noisy-walk"))
    return motion.slice(1, motion.num_frames)


def reframe(motion: Motion, frames: Tensor, *, up: str = "y", names: tuple[str, ...] | None = None) -> Motion:
    """The same motion of a skeleton whose joint j has its axes turned by frames[j] (xyzw), in a world with another up
    axis, under other names."""
    skeleton, count = motion.skeleton, motion.num_frames
    turn = upright_rotation(up)
    turn = torch.tensor([0.0, 0, 0, 1]).double() if turn is None else rotations.inverse(turn)
    names, parents = names or skeleton.names, [max(parent, 0) for parent in skeleton.parents]
    back = rotations.inverse(frames)
    world = rotations.multiply(turn.expand(count, skeleton.num_joints, 4), motion.joint_rotations())
    ends = {
        names[skeleton.index(name)]: tuple(
            rotations.rotate(back[skeleton.index(name)], torch.tensor(end).double()).tolist()
        )
        for name, end in skeleton.end_offsets.items()
    }
    return Motion(
        Skeleton(names, skeleton.parents, rotations.rotate(back[parents], skeleton.offsets), ends),
        motion.fps,
        rotations.rotate(turn.expand(count, 4), motion.root_position),
        kinematics.local_from_world(skeleton.parents, rotations.multiply(world, frames.expand(count, -1, -1))),
        {
            joint: rotations.rotate(back[skeleton.parents[joint]].expand(count, 4), offset)
            for joint, offset in motion.moving_offsets.items()
        },
    )


def random_frames(motion: Motion, seed: int) -> Tensor:
    return torch.from_numpy(Rotation.random(motion.skeleton.num_joints, random_state=seed).as_quat())


def turned_deg(one: Motion, other: Motion) -> Tensor:
    """Angle between the rotations of each canonical joint, median over the frames, degrees."""
    apart = rotations.multiply(rotations.inverse(one.joint_rotations()), other.joint_rotations())
    return torch.rad2deg(rotations.to_rotation_vector(apart).norm(dim=-1).median(dim=0).values)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    up=st.sampled_from(UPS),
    unit=st.sampled_from([*UNITS]),
    naming=st.sampled_from(["own", "prefixed", "none"]),
)
def test_any_joint_frames_world_unit_and_names_are_the_same_motion(tmp_path_factory, seed, up, unit, naming):
    motion = load()
    wanted, rigmap = retarget.to_canonical(reframe(motion, random_frames(motion, 0)))
    own = motion.skeleton.names
    names = {
        "own": own,
        "prefixed": tuple(f"hero:{name}" for name in own),
        "none": tuple(f"j{n}" for n in range(len(own))),
    }
    strange = reframe(motion, random_frames(motion, seed), up=up, names=names[naming])
    file = tmp_path_factory.mktemp("reframed") / "strange.bvh"
    source = replace(layout.choose_layout(strange, file), metres_per_unit=UNITS[unit])
    replace(strange, source=source).save(file)
    read = mapctl.load(file)
    try:
        found, again = retarget.to_canonical(read)
    except RequestError:
        assert naming == "none"  # refused in a line: never read wrongly
        return
    if read.source.unit_doubt:
        return
    if naming == "none" and again.joint_of != rigmap.joint_of:
        assert assess_fit(again, read).verdict == "doubtful"
        return
    assert again.up == up
    scale = found.root_position.norm() / wanted.root_position.norm()
    assert float(scale) == pytest.approx(1, rel=1e-3)
    assert float(turned_deg(wanted, found).max()) < 3
    apart = (wanted.joint_positions() - found.joint_positions()).norm(dim=-1)
    assert float(apart.max()) < 0.01


def roll_left(axes: dict, part: str, parts: tuple[str, ...]) -> dict:
    """A table's axes of a joint of these parts on the left, rolled by half a turn about the bone (arms: x, legs: y)."""
    if part not in {"left" + name for name in parts}:
        return axes
    turn = Rotation.from_rotvec([math.pi, 0, 0] if "Arm" in parts[0] else [0, math.pi, 0])
    return {axis: turn.apply(vector).tolist() for axis, vector in axes.items()}


@pytest.mark.parametrize("parts", [("UpperArm", "LowerArm", "Hand"), ("UpperLeg", "LowerLeg")], ids=["arm", "leg"])
def test_a_table_with_a_rolled_limb_is_overruled_and_a_users_is_doubted(parts):
    """As LaFAN1's arms were, by half a turn."""
    motion = load()
    wanted, rigmap = retarget.to_canonical(motion)
    stated = retarget.as_rig(rigmap)
    rolled = replace(stated, tpose={name: roll_left(axes, name, parts) for name, axes in stated.tpose.items()})
    zero, clip = (RigPoses.of(m, rigmap.joint_of) for m in (zero_pose(motion), motion))
    preset = find_tpose(zero, clip, rig=replace(rolled, rest="auto"), stated=False)
    turned = rotations.multiply(rotations.inverse(rigmap.tpose_quat_xyzw), preset.tpose_quat_xyzw)
    assert float(rotations.to_rotation_vector(turned).norm(dim=-1).max()) < math.radians(50)
    assert "degrees off" in preset.tpose_doubt or preset.tpose_from != "table"
    found, again = retarget.to_canonical(motion, rolled)
    assert float(turned_deg(wanted, found).max()) == pytest.approx(180, abs=1)
    assert f"left{parts[0]}" in again.tpose_doubt
    assert again.tpose_doubt in {doubt.reason for doubt in assess_fit(again, motion).doubts}


def zero_pose(motion: Motion) -> Motion:
    still = torch.tensor([0.0, 0, 0, 1]).double().expand(1, motion.num_joints, 4).clone()
    return replace(motion.slice(0, 1), local_quat_xyzw=still)


@pytest.mark.parametrize("up", UPS)
def test_a_body_on_hands_and_feet_stays_there(up):
    """A plank that faces down, its head toward +Z, without a step: hands and toes are on the floor."""
    down = torch.tensor([0.0, 0, 0, 1]).double().repeat(30, CANONICAL.num_joints, 1)
    down[:, 0] = rotations.from_rotation_vector(torch.tensor([math.pi / 2, 0.0, 0.0]).double())
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turn = torch.tensor([0.0, -sign * math.pi / 2, 0.0]).double()
        down[:, CANONICAL.index(side + "UpperArm")] = rotations.from_rotation_vector(turn)
    plank = Motion(CANONICAL, Fraction(30), torch.tensor([0.0, 0.55, 0.0]).double().repeat(30, 1), down)
    strange = reframe(plank, torch.tensor([0.0, 0, 0, 1]).double().repeat(CANONICAL.num_joints, 1), up=up)
    clip = RigPoses.of(strange, range(CANONICAL.num_joints))
    rest = RigPoses.zero(CANONICAL, range(CANONICAL.num_joints)).up()[0]
    turn = upright_rotation(up)
    rest = rest if turn is None else rotations.rotate(rotations.inverse(turn), rest)
    assert find_up_axis(clip, rest) == up


@pytest.mark.parametrize("exchanged", [False, True])
def test_sides_are_by_knees_where_feet_show_no_front(exchanged):
    """Feet that go on along the shin, as those of markerless rigs: only the knees bend one way."""
    motion, _ = retarget.to_canonical(load())
    joints = [mirror_name(name) if exchanged else name for name in CANONICAL.names]
    joint_of = [CANONICAL.index(name) for name in joints]
    for side in ("left", "right"):
        foot, toes = CANONICAL.index(side + "Foot"), CANONICAL.index(side + "Toes")
        motion.local_quat_xyzw[:, foot] = torch.tensor([0.0, 0, 0, 1]).double()
        motion.skeleton.offsets[toes] = torch.tensor([0.0, -0.1, 0.0]).double()
    clip = RigPoses.of(replace(motion), joint_of)
    assert are_sides_swapped(RigPoses.zero(motion.skeleton, joint_of), clip) is exchanged
