"""The cycle of a clip, the clip as a loop without a jump, and planted feet that stand still, on any rig."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator, walk
from rig_maker import make
from rigs_to_edit import RIGS, on_rig, soft_knees, toe_speed

from mapctl import editing, retarget, rotations
from mapctl.editing.looping import find_contacts
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.travel import repeat_over_ground
from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL


def uneven(frames: int = 120, *, fps: int = 30, turn_rate: float = 0.0, cadence: float = 0.93):
    """A walk whose strides differ: what it does in one it does otherwise in the next."""
    motion = soft_knees(walk(frames, fps=fps, turn_rate=turn_rate, cadence=cadence))
    time = torch.arange(frames).double()[:, None, None] / fps
    slow = torch.rand(1, 21, 3, generator=generator(3), dtype=torch.float64)
    wobble = 0.05 * torch.sin(2 * math.pi * (0.21 * time + slow))
    wobble[:, [motion.skeleton.index(side + part) for side in ("left", "right") for part in ("Foot", "Toes")]] = 0
    local = rotations.multiply(motion.local_quat_xyzw, rotations.from_rotation_vector(wobble))
    return replace(motion, local_quat_xyzw=local)


def five(motion, loop):
    """The loop five times over."""
    return repeat_over_ground(RiggedMotion.of(motion).with_motion(loop.motion).motion, loop.travel, 5)


def peaks(motion) -> list[float]:
    """The largest step from frame to frame, metres, and acceleration, m/s^2, of any joint."""
    positions = motion.joint_positions()
    return [float(positions.diff(n=n, dim=0).norm(dim=-1).max()) * float(motion.fps) ** (2 * n - 2) for n in (1, 2)]


@pytest.mark.parametrize(("fps", "turn_rate"), [(30, 0.5), (120, 0.0)])
def test_five_in_a_row_are_as_calm_as_the_clip(fps, turn_rate):
    motion = uneven(4 * fps, fps=fps, turn_rate=turn_rate)
    loop = editing.close_loop(motion)
    whole, clip = peaks(five(motion, loop)), peaks(motion)
    assert whole[1] <= 1.3 * clip[1]
    assert whole[0] <= 1.05 * clip[0]
    raw = motion.slice(loop.cycle.start, loop.cycle.stop)
    assert peaks(repeat_over_ground(raw, loop.travel, 2))[1] > 1.3 * whole[1]  # without closing it there is a jump


@pytest.mark.parametrize("name", RIGS)
def test_on_any_rig_it_is_exactly_periodic_in_place(name):
    motion = make(replace(RIGS[name], extras=False)).motion(uneven())  # extras shake at random
    loop = editing.close_loop(motion)
    still = editing.remove_travel(loop.motion, cycle=loop.travel)
    twice = RiggedMotion.of(still.join(still))
    joints = [twice.rigmap.joints[c] for c in ("hips", "head", "leftHand", "rightFoot")]
    bends = twice.motion.joint_positions()[:, joints].diff(n=2, dim=0).norm(dim=-1).amax(dim=1)
    frames = still.num_frames
    assert float(bends[frames - 2 : frames].max()) <= 1.05 * float(bends[: frames - 2].max())
    hips = twice.position("hips")
    assert float((hips[:, ::2] - hips[0, ::2]).norm(dim=-1).max()) < 0.1
    assert loop.motion.skeleton is motion.skeleton


def test_a_root_joint_that_stays_in_place_stays_and_the_body_goes_as_without_one():
    walked = uneven(turn_rate=1.0)
    motion = make(replace(RIGS["root on the ground"], extras=False)).motion(walked)
    hips = motion.skeleton.index("Hips")
    positions = motion.joint_positions()[:, hips]
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    local[:, hips] = motion.joint_rotations()[:, hips]
    fixed = replace(motion, root_position=0 * positions, local_quat_xyzw=local, moving_offsets={hips: positions})
    loop, alone = editing.close_loop(fixed), editing.close_loop(walked)
    assert float(loop.motion.root_position.abs().max()) < 1e-12
    torch.testing.assert_close(loop.motion.local_quat_xyzw[:, 0], local[: loop.motion.num_frames, 0])
    own = loop.motion.joint_positions()[:, hips]
    torch.testing.assert_close(own, alone.motion.root_position, atol=1e-6, rtol=0)


def test_planted_feet_move_as_they_did():
    motion = uneven(cadence=1.0)
    loop = editing.close_loop(motion)
    toes = [motion.skeleton.index(side + "Toes") for side in ("left", "right")]
    own, closed = (m.joint_positions()[:, toes] for m in (motion, loop.motion))
    cut = slice(loop.cycle.start, loop.cycle.stop)
    planted = find_contacts(own, motion.joint_positions()[:, 0], 30)[cut]
    stays = planted[1:] & planted[:-1]
    assert bool(stays.any())
    assert float((closed.diff(dim=0) - own[cut].diff(dim=0)).norm(dim=-1)[stays].max()) < 1e-4


def stand(frames: int):
    """A body that stands, and once reaches out."""
    motion = walk(frames)
    local = torch.zeros_like(motion.local_quat_xyzw)
    local[..., 3] = 1
    root = motion.root_position[:1].expand(frames, 3).clone()
    return replace(motion, local_quat_xyzw=local, root_position=root)


@pytest.mark.parametrize("fps", [25, 120])
@pytest.mark.parametrize("cadence", [0.7, 1.4])
def test_a_walk_has_one_stride(fps, cadence):
    motion = walk(4 * fps, cadence=cadence, fps=fps)
    cycle = editing.find_cycle(motion)
    given = editing.describe_cycle(motion, cycle)
    assert cycle.is_gait
    assert given["seconds"] == pytest.approx(1 / cadence, abs=0.6 / fps + 1e-9)
    assert given["steps_per_minute"] == pytest.approx(120 * cadence, rel=0.04)
    travelled = motion.root_position[cycle.stop] - motion.root_position[cycle.start]
    assert given["stride_m"] == pytest.approx(float(travelled[2]), abs=0.01)
    assert given["mismatch_cm"] < 3


def test_a_body_on_the_spot_has_a_cycle_that_is_no_gait():
    motion = walk(150, cadence=0.5)
    still = replace(motion, root_position=motion.root_position * torch.tensor([0.0, 1.0, 0.0]).double())
    cycle = editing.find_cycle(still)
    assert not cycle.is_gait
    assert cycle.frames == pytest.approx(60, abs=1)
    assert "stride_m" not in editing.describe_cycle(still, cycle)


def test_what_never_comes_back_is_refused_with_what_comes_nearest():
    frames = 90
    motion = stand(frames)
    local = motion.local_quat_xyzw.clone()
    arm = CANONICAL.index("leftUpperArm")
    reach = torch.linspace(0, 2.5, frames).double()
    local[:, arm] = rotations.from_rotation_vector(torch.stack([0 * reach, 0 * reach, reach], dim=-1))
    shift = torch.linspace(0, 3, frames).double() ** 2
    root = motion.root_position + torch.stack([0 * shift, 0 * shift, shift], dim=-1)
    with pytest.raises(RequestError, match=r"frames \d+ and \d+ come nearest, .* [\d.]+ cm apart; [\d.]+ are allowed"):
        editing.find_cycle(replace(motion, local_quat_xyzw=local, root_position=root))


LEGS = [side + part for part in ("UpperLeg", "LowerLeg", "Foot") for side in ("left", "right")]


def sliding(frames: int = 75, fps: int = 30):
    """A walk whose body drifts sideways against its feet."""
    motion = soft_knees(walk(frames, cadence=1.0, fps=fps))
    drift = torch.linspace(0, 0.25 * frames / fps / 2.5, frames).double()
    return replace(motion, root_position=motion.root_position + torch.stack([drift, 0 * drift, 0 * drift], dim=-1))


def contacts_of(motion):
    rigged = RiggedMotion.of(motion)
    return find_contacts(rigged.positions("Toes"), rigged.position("hips"), float(motion.fps))


@pytest.mark.parametrize("name", RIGS)
def test_planted_toes_are_still_on_any_rig_and_the_rest_stays_to_the_bit(name):
    motion = on_rig(name, sliding())
    planted = contacts_of(motion)
    done = editing.plant_feet(motion)
    assert toe_speed(motion, planted) > 0.08
    assert toe_speed(done, planted) < 0.002
    joints = retarget.identify_rig(motion.skeleton, motion=motion).joints
    others = [j for j in range(motion.num_joints) if j not in {joints[name] for name in LEGS}]
    assert torch.equal(done.local_quat_xyzw[:, others], motion.local_quat_xyzw[:, others])
    feet = [joints[name] for name in ("leftFoot", "rightFoot")]
    turned = (done.joint_rotations() * motion.joint_rotations())[:, feet].sum(dim=-1).abs()
    torch.testing.assert_close(turned, torch.ones_like(turned), atol=1e-6, rtol=0)


def test_feet_on_a_box_are_still_and_stay_up():
    """A walk that goes on 48 cm higher: feet there slide no more than on the floor, and rest as high as they did."""
    motion = sliding(150)
    rise = 0.48 * ((torch.arange(150) - 70) / 10).clamp(0, 1).double()
    high = replace(motion, root_position=motion.root_position + torch.stack([0 * rise, rise, 0 * rise], dim=-1))
    planted, done = contacts_of(high), editing.plant_feet(high)
    assert bool(planted[90:].any())
    assert toe_speed(done, planted) < 0.002
    heights = [RiggedMotion.of(each).positions("Toes")[..., 1] for each in (high, done)]
    assert float((heights[1] - heights[0])[planted].abs().max()) < 0.02


def test_a_loop_stays_one_with_feet_that_are_still_over_its_seam():
    loop = editing.close_loop(sliding(120))
    whole, frames = repeat_over_ground(loop.motion, loop.travel, 3), loop.motion.num_frames
    stands = contacts_of(whole).any(dim=1)
    start = next(f for f in range(frames, 2 * frames) if bool(stands[f - 2 : f + 3].all()))
    motion = whole.slice(start, start + frames)  # begins amid a contact
    planted = editing.plant_feet(motion, cycle=loop.travel)
    alone = editing.remove_travel(planted, cycle=loop.travel)
    bends = alone.join(alone).joint_positions().diff(n=2, dim=0).norm(dim=-1).amax(dim=1)
    assert float(bends[frames - 2 : frames].max()) <= float(bends[: frames - 2].max())
    before, after = (repeat_over_ground(m, loop.travel, 3) for m in (motion, planted))
    contacts = contacts_of(before)
    contacts[: frames // 2], contacts[-frames // 2 :] = False, False
    assert toe_speed(after, contacts) < 0.003
