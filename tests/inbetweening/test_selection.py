"""Who fills a gap: the network, whatever it slides, and nobody where one stands and it would wander off."""

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


@pytest.mark.parametrize(("start", "stop"), [(1, 31), (1, 91), (20, 110), (1, 180)])
def test_whatever_slides_the_network_is_kept_where_it_has_an_answer(start, stop):
    """Poses of a walk that straight lines slide between: densities, which would step, do not take the gap, since behind
    MAP they are farther from mocap."""
    motion = walk(stop + (20 if start > 1 else 1))
    network = Network(sway=0.2)
    query, answer = chosen(motion, start, stop, densities=[tiny_density()], network=network)
    alone = network.propose(query)
    assert [(one.start, one.stop, one.by) for one in answer.attribute(query)] == [(start, stop, "network")]
    assert torch.equal(answer.motion.root_position, alone.motion.root_position)
    assert torch.equal(answer.motion.local_quat_xyzw, alone.motion.local_quat_xyzw)
    assert torch.equal(answer.contact_logits, alone.contact_logits)


@pytest.mark.parametrize("seconds", [2, 4, 8])
def test_somebody_who_stands_stays_where_he_is(seconds):
    motion = still(30 * seconds + 1)
    wandering = tiny_infiller(drawn=0.05)
    done = tween(motion, Keys((0, 30 * seconds)), AutoInbetweener(wandering, [tiny_density()]))
    assert [source.by for source in done.sources] == [STANDING_STILL]
    away = (done.motion.root_position - motion.root_position).norm(dim=-1)
    assert away.max() < 0.02
    assert any("standing still" in note for note in done.gap_notes)


def test_somebody_who_is_on_the_move_beside_a_gap_does_not_just_stand():
    """The same pose before and after, but hands that are in full swing."""
    motion = walk(120, cadence=1.0)
    period = 30
    motion = replace(motion, root_position=motion.root_position * torch.tensor([0.0, 1.0, 0.0]).double())
    start, stop = 20, 20 + 3 * period - 1
    query, answer = chosen(motion, start, stop, network=Network(sway=0.2))
    assert answer.attribute(query)[0].by == "network"


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
    made = hold_planted(motion, stands, free=free, rest_height=torch.full((motion.num_frames, 2), 0.0425))
    speeds = [each.joint_positions()[:, TOES].diff(dim=0).norm(dim=-1) for each in (motion, made)]
    held = (stands[1:] & stands[:-1])[12:]
    assert speeds[0][12:][held].mean() > 0.005
    assert speeds[1][12:][held].mean() < 0.002  # where legs are stretched, toes go along a little
    assert torch.equal(made.local_quat_xyzw[:12], motion.local_quat_xyzw[:12])
    assert torch.equal(made.root_position, motion.root_position)
