"""Choice of a proposer: the network, whatever it slides, and a held pose where the character stands off."""

from dataclasses import replace

import pytest
import torch
from helpers import tiny_density, walk
from tiny_infiller import tiny_infiller

from controllers.inbetweening.pipeline import CanonicalClip
from controllers.inbetweening.proposers import STANDING_STILL, AutoInbetweener, hold_planted
from controllers.inbetweening.tween import tween
from mapctl import contacts, rotations
from mapctl.inbetweening import Proposal
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Keys
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL

TOES = [CANONICAL.index(name) for name in ("leftToes", "rightToes")]


class Network(Inbetweener):
    """Stands for a network: straight lines, along which the body sways aside by so many metres, and one hand waves."""

    def __init__(self, sway=0.0, wave=0.0):
        self.sway, self.wave = sway, wave

    def propose(self, query, *, generator=None):
        bump = torch.sin(torch.linspace(0, torch.pi, query.motion.num_frames).double())
        root, quats = query.motion.root_position.clone(), query.motion.local_quat_xyzw.clone()
        root[:, 0] += self.sway * query.missing.root * bump
        shoulder, angle = CANONICAL.index("leftUpperArm"), torch.zeros(len(root), 3).double()
        angle[:, 2] = self.wave * query.missing.root * bump
        quats[:, shoulder] = rotations.multiply(quats[:, shoulder], rotations.from_rotation_vector(angle))
        motion = replace(query.motion, root_position=root, local_quat_xyzw=quats)
        return Proposal(motion, torch.zeros(query.motion.num_frames, 2), "network")


def chosen(motion, start, stop, *, densities=(), network=None, **known):
    """The query of a motion that lacks frames, and what is proposed for it."""
    free = torch.zeros(motion.num_frames, dtype=torch.bool)
    free[start:stop] = True
    query = CanonicalClip.of(motion, MissingMask(free[:, None].expand(-1, motion.num_joints).clone(), free)).query()
    query = replace(query, **known)
    return query, AutoInbetweener(network or Network(), densities).propose(query)


def still(frames):
    motion = walk(2)
    first = torch.zeros(frames, dtype=torch.long)
    return replace(motion, root_position=motion.root_position[first], local_quat_xyzw=motion.local_quat_xyzw[first])


def test_a_standing_character_stays():
    motion = still(121)
    wandering = tiny_infiller(drawn=0.05)
    done = tween(motion, Keys((0, 120)), AutoInbetweener(wandering, [tiny_density()]))
    assert [source.by for source in done.sources] == [STANDING_STILL]
    away = (done.motion.root_position - motion.root_position).norm(dim=-1)
    assert away.max() < 0.02
    assert any("standing still" in note for note in done.gap_notes)


@pytest.mark.parametrize(
    ("sway", "frames", "by"), [(0.01, 90, "network"), (0.06, 90, STANDING_STILL), (0.06, 40, "network")]
)
def test_who_stands_may_gesture_but_not_wander(sway, frames, by):
    motion = still(frames + 2)
    query, answer = chosen(motion, 1, frames + 1, network=Network(sway=sway, wave=1.5))
    assert [source.by for source in answer.attribute(query)] == [by]
    hand = CANONICAL.index("leftHand")
    moved = (answer.motion.joint_positions() - motion.joint_positions())[:, hand].norm(dim=-1)
    assert (float(moved.max()) > 0.3) == (by == "network")


def test_planted_toes_are_held_and_what_is_known_stays():
    """A walk that slides aside: toes stand where they first stood, or in the middle of where they slid."""
    motion = walk(60)
    stands = contacts.detect_contacts(motion.joint_positions()[:, TOES], 30)
    sliding = torch.arange(60).double()[:, None] * torch.tensor([0.006, 0.0, 0.0]).double()
    motion = replace(motion, root_position=motion.root_position + sliding)
    free = torch.ones(60, dtype=torch.bool)
    free[:12] = False
    result = hold_planted(motion, stands, free=free, rest_height=torch.full((motion.num_frames, 2), 0.0425))
    speeds = [each.joint_positions()[:, TOES].diff(dim=0).norm(dim=-1) for each in (motion, result)]
    held = (stands[1:] & stands[:-1])[12:]
    assert speeds[0][12:][held].mean() > 0.005
    assert speeds[1][12:][held].mean() < 0.002  # where legs are stretched, toes go along a little
    assert torch.equal(result.local_quat_xyzw[:12], motion.local_quat_xyzw[:12])
    assert torch.equal(result.root_position, motion.root_position)
