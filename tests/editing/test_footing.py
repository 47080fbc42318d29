"""Footing alone: planted toes stand still on their floor, and nothing but legs and hips changes."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, walk
from rigs_to_edit import RIGS, on_rig, soft_knees, toe_speed

from mapctl import editing, retarget
from mapctl.editing.looping import find_contacts
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.travel import repeat_over_ground
from mapctl.skeleton import CANONICAL

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


def test_noise_is_no_reason_to_let_go():
    motion = sliding(120, 60)
    noise = 0.004 * torch.randn(120, 3, generator=generator(), dtype=torch.float64)
    noisy = replace(motion, root_position=motion.root_position + noise)
    planted = contacts_of(motion)
    assert float((contacts_of(noisy) == planted).double().mean()) > 0.9
    assert toe_speed(noisy, planted) > 0.5
    inner = planted[2:] & planted[1:-1] & planted[:-2]
    still = torch.zeros_like(planted)
    still[2:-2] = inner[1:-1]
    assert toe_speed(editing.plant_feet(noisy), still & contacts_of(noisy)) < 0.01


def test_toes_that_sink_and_float_are_put_on_the_floor():
    motion = walk(75, cadence=1.0)
    wave = 0.012 * torch.sin(torch.arange(75).double() / 9)
    uneven = replace(motion, root_position=motion.root_position + torch.stack([0 * wave, wave, 0 * wave], dim=-1))
    toes = [CANONICAL.index(side + "Toes") for side in ("left", "right")]
    planted = contacts_of(uneven)
    before, after = (m.joint_positions()[:, toes, 1] for m in (uneven, editing.plant_feet(uneven)))
    assert float(before[planted].std()) > 0.004
    assert float(after[planted].std()) < 0.5 * float(before[planted].std())
    floor = before.quantile(0.05, dim=0)
    assert float((after - floor).amin()) > -0.002


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
