"""Hands on another body: at its hips, head, knees and arms, at each other and on the floor as the source's."""

import math
from dataclasses import replace

import pytest
import torch
from hand_poses import HANDS, LOWER, UPPER, arms_down, ease, palms, put_palm
from helpers import quat_xyzw
from performers import FEET, HIPJOINTS, KNEES, Performer

from mapctl.motion import Motion
from mapctl.retarget import identify_rig
from mapctl.retarget.carry import RiggedCharacter, retarget_canonical, retarget_motion
from mapctl.retarget.character import Stance
from mapctl.skeleton import CANONICAL, Skeleton

FRAMES = 60
HIPS, HEAD = 0, CANONICAL.index("head")


def standing(frames: int = FRAMES) -> Motion:
    return Performer().stands(frames)


def body_of(skeleton: Skeleton) -> RiggedCharacter:
    """A body that stands on the floor with these bones."""
    rigmap = identify_rig(skeleton)
    return RiggedCharacter(rigmap, Stance.at_rest(skeleton))


def bones(*, size: float = 1.0, arms: float = 1.0, collars: float = 1.0) -> Skeleton:
    """The canonical body with other arms and shoulders, at a size."""
    offsets = CANONICAL.offsets.clone()
    offsets[[*LOWER, *HANDS]] *= arms
    offsets[UPPER] *= collars
    return Skeleton(CANONICAL.names, CANONICAL.parents, size * offsets)


BODIES = {
    "long arms": bones(arms=1.12),
    "short arms": bones(arms=0.9),
    "wide shoulders": bones(collars=1.7),
    "small": bones(size=0.8),
    "big, with short arms": bones(size=1.25, arms=0.93),
}


def size_of(name: str) -> float:
    return float(BODIES[name].offsets[1].norm() / CANONICAL.offsets[1].norm())


def at_hip(motion: Motion, side: int = 1, *, share: float | torch.Tensor = 1.0) -> Motion:
    """The palm at the side of the hips, the elbow out."""
    sign = (1, -1)[side]
    position = motion.joint_positions()[:, HIPS] + torch.tensor([0.135 * sign, 0.10, 0.02], dtype=torch.float64)
    off = torch.tensor([0.25 * sign, -0.05, 0.12], dtype=torch.float64)
    return put_palm(motion, side, position + (1 - share) * off, points=(-sign * 0.4, -0.6, 0.6), elbow=(sign, 0, -0.4))


def at_head(motion: Motion) -> Motion:
    """The right palm on the side of the head."""
    position = motion.joint_positions()[:, HEAD] + torch.tensor([-0.10, 0.06, 0.0], dtype=torch.float64)
    return put_palm(motion, 1, position, points=(0.2, 1.0, 0.1), elbow=(-1, -0.5, 0.3))


def on_chest(motion: Motion) -> Motion:
    position = motion.joint_positions()[:, CANONICAL.index("chest")] + torch.tensor([0.02, 0.06, 0.115]).double()
    return put_palm(motion, 1, position, points=(1.0, 0.1, 0.0), elbow=(-1, -0.6, 0.0))


POSES = {"hip": (at_hip, HIPS), "head": (at_head, HEAD), "chest": (on_chest, CANONICAL.index("chest"))}


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", ["short arms", "wide shoulders", "small"])
def test_a_hand_is_where_it_was_on_the_body(pose, name):
    """Relative to what it touches, in scale; where it only turns as the source's it is centimetres off."""
    make, anchor = POSES[pose]
    clip, body = make(arms_down(standing())), body_of(BODIES[name])
    done = retarget_motion(clip, body)
    size = size_of(name)
    before, after = (palms(m, s)[:, 1] - m.joint_positions()[:, anchor] for m, s in ((clip, 1.0), (done.motion, size)))
    assert float((after - size * before).norm(dim=-1).max()) < 0.015
    assert not [note for note in done.changes.notes if "hands" in note]


def clapping(frames: int = 90) -> Motion:
    """Palms meet before the chest three times in three seconds."""
    motion = arms_down(standing(frames))
    apart = 0.03 + 0.16 * torch.sin(torch.pi * torch.arange(frames, dtype=torch.float64) / 30) ** 2
    chest = motion.joint_positions()[:, CANONICAL.index("chest")]
    for side, sign in ((0, 1.0), (1, -1.0)):
        position = chest + torch.stack([sign * apart, 0 * apart + 0.02, 0 * apart + 0.33], dim=-1)
        motion = put_palm(motion, side, position, points=(0.0, 0.6, 1.0), elbow=(sign, -1, 0))
    return motion


@pytest.mark.parametrize("name", BODIES)
def test_hands_that_clap_clap(name):
    """As near each other and in the same frames, in metres; the same way apart."""
    clip = clapping()
    done = retarget_motion(clip, body_of(BODIES[name])).motion
    size = size_of(name)
    before, after = (palms(m, s).diff(dim=1)[:, 0] for m, s in ((clip, 1.0), (done, size)))
    meet = before.norm(dim=-1) < 0.08
    assert 10 < int(meet.sum()) < 60
    assert float((after - before)[meet].norm(dim=-1).max()) < 0.012


@pytest.mark.parametrize("name", ["long arms", "big, with short arms"])
def test_a_hand_comes_to_the_hip_and_leaves_without_a_jump(name):
    share = ease(90, 15, 40) * (1 - ease(90, 55, 80))
    clip = at_hip(arms_down(standing(90)), share=share)
    done = retarget_motion(clip, body_of(BODIES[name])).motion
    size = size_of(name)
    for order, most in ((1, 1.4), (2, 2.0)):
        before, after = (
            m.joint_positions()[:, [HANDS[1], LOWER[1]]].diff(n=order, dim=0).norm(dim=-1).amax(0) for m in (clip, done)
        )
        assert (after < most * max(size, 1.0) * before + 2e-4).all(), (order, after / before)


@pytest.mark.parametrize("name", BODIES)
def test_arms_that_hang_turn_as_they_did(name):
    clip = arms_down(Performer().walks(), degrees=80)
    done = retarget_motion(clip, body_of(BODIES[name])).motion
    arms = [*UPPER, *LOWER, *HANDS]
    dots = (done.local_quat_xyzw[:, arms] * clip.local_quat_xyzw[:, arms]).sum(-1).abs()
    torch.testing.assert_close(dots, torch.ones_like(dots), atol=1e-9, rtol=0)


def on_all_fours(frames: int = FRAMES) -> Motion:
    """Hands and toes on the floor, the trunk level; hands stand still while the body sways."""
    motion = standing(frames)
    sway = 0.02 * torch.sin(torch.arange(frames, dtype=torch.float64) / 8)
    local = motion.local_quat_xyzw.clone()
    local[:, HIPS] = quat_xyzw(torch.tensor([[math.pi / 2, 0.0, 0.0]], dtype=torch.float64))
    local[:, HIPJOINTS] = quat_xyzw(torch.tensor([[-math.pi / 2, 0.0, 0.0]], dtype=torch.float64))
    local[:, KNEES] = quat_xyzw(torch.tensor([[math.pi / 2 - 0.2, 0.0, 0.0]], dtype=torch.float64))
    local[:, FEET] = quat_xyzw(torch.tensor([[1.08, 0.0, 0.0]], dtype=torch.float64))
    root = motion.root_position.clone()
    root[:, 1], root[:, 2] = 0.46, sway
    motion = replace(motion, local_quat_xyzw=local, root_position=root)
    for side, sign in ((0, 1.0), (1, -1.0)):
        position = torch.tensor([sign * 0.16, 0.03, 0.55], dtype=torch.float64).expand(frames, 3)
        motion = put_palm(motion, side, position, points=(0.0, 0.0, 1.0), elbow=(sign, 0.2, -0.3))
    return motion


@pytest.mark.parametrize("name", ["long arms", "small", "wide shoulders"])
def test_hands_on_the_floor_are_on_it_and_do_not_slide(name):
    clip, body = on_all_fours(), body_of(BODIES[name])
    done = retarget_canonical(clip, body_of(clip.skeleton), body).motion
    size = size_of(name)
    palm = palms(done, size)
    assert float((palm[..., 1] - 0.03 * size).abs().max()) < 0.012
    assert float((palm - palm[:1])[..., ::2].norm(dim=-1).max()) < 0.0015


def test_arms_that_are_too_short_get_as_near_as_they_can_and_say_so():
    share = ease(90, 15, 40) * (1 - ease(90, 50, 75))
    clip = at_hip(arms_down(standing(90)), share=share)
    done = retarget_motion(clip, body_of(bones(arms=0.55)))
    given = [note for note in done.changes.notes if note.startswith("the arms are too short")]
    assert len(given) == 1
    assert "cm off (frame " in given[0]
    miss = done.changes.hands_missed
    assert 0.01 < miss.metres < 0.3
    assert 0 < miss.frames < 90
    straight = done.motion.joint_positions()[miss.frame]
    far = float((straight[HANDS[1]] - straight[UPPER[1]]).norm()) / float(
        done.motion.skeleton.offsets[[LOWER[1], HANDS[1]]].norm(dim=-1).sum()
    )
    assert 0.95 < far < 0.999
    before, after = (m.joint_positions()[:, HANDS[1]].diff(n=2, dim=0).norm(dim=-1).max() for m in (clip, done.motion))
    assert float(after) < 3.5 * float(before)  # the hand is asked 10 cm farther within 6 frames
