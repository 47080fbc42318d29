"""Jumps of a walk: found where they are, made anew, and nothing else."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from linear_inbetweener import LinearInbetweener

from controllers.shots.seams import find_jumps, repair_jumps
from mapctl.skeleton import CANONICAL, LIMBS

AT = 40
LEG = [LIMBS["leftFoot"].upper, LIMBS["leftFoot"].lower, LIMBS["leftFoot"].end, CANONICAL.index("leftToes")]


@pytest.fixture
def jumping():
    """A walk whose left leg is a third of a stride ahead from one frame on."""
    motion = walk(90)
    quats = motion.local_quat_xyzw.clone()
    quats[AT:80, LEG] = motion.local_quat_xyzw[AT + 10 :, LEG]
    return replace(motion, local_quat_xyzw=quats).slice(0, 80)


def test_a_jump_is_made_anew_and_other_frames_stay(jumping):
    assert find_jumps(jumping).nonzero()[:, 0].tolist() == [AT - 1]
    made = repair_jumps(jumping, LinearInbetweener())
    assert not bool(find_jumps(made).any())
    others = torch.tensor([*range(AT - 7), *range(AT + 7, 80)])
    assert torch.equal(made.root_position[others], jumping.root_position[others])
    assert torch.equal(made.local_quat_xyzw[others], jumping.local_quat_xyzw[others])
    moved = (made.joint_positions() - jumping.joint_positions())[AT - 1 : AT + 1].norm(dim=-1)
    assert float(moved.max()) > 0.05
