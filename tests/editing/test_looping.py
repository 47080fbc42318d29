"""A clip as a loop: no jump where it begins again, however often, on any rig."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator, walk
from rig_maker import make
from rigs_to_edit import RIGS, soft_knees

from mapctl import editing, rotations
from mapctl.editing.looping import Peaks, find_contacts
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.travel import repeat_over_ground


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


# Knees of this walk have kinks, which feet that are held make sharper: at 120 frames a second one is at the seam.
@pytest.mark.parametrize(("fps", "turn_rate", "most"), [(30, 0.5, 1), (120, 0.0, 1.3)])
def test_five_in_a_row_are_as_calm_as_the_clip(fps, turn_rate, most):
    motion = uneven(4 * fps, fps=fps, turn_rate=turn_rate)
    loop = editing.close_loop(motion)
    whole, clip = (Peaks.of(m.joint_positions(), fps) for m in (five(motion, loop), motion))
    assert whole.acceleration <= 1.3 * clip.acceleration
    assert loop.seam.acceleration <= most * clip.acceleration
    assert loop.seam.step <= clip.step
    assert whole.step <= 1.05 * clip.step
    raw = motion.slice(loop.cycle.start, loop.cycle.stop)
    jump = Peaks.of(repeat_over_ground(raw, loop.travel, 2).joint_positions(), fps)
    assert jump.acceleration > 1.3 * whole.acceleration  # without closing it there is a jump


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
    places = motion.joint_positions()[:, hips]
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    local[:, hips] = motion.joint_rotations()[:, hips]
    fixed = replace(motion, root_position=0 * places, local_quat_xyzw=local, moving_offsets={hips: places})
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
