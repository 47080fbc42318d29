"""Keys that tell a part: met, and the body goes there and comes back as bodies do, at any rate and on any rig.

A network given one position in one frame answers with that position there and with its mean beside it; the tiny
infiller (untrained: straight lines) does just that, so that a jump would show.
"""

import pytest
import torch
from captures import on_rig
from helpers import walk
from linear_inbetweener import LinearInbetweener
from methods import by_method
from tiny_infiller import tiny_infiller

from controllers.inbetweening.proposers import propose_through_keys
from controllers.inbetweening.tween import tween
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Key, Keys
from mapctl.metrics import body
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL, LIMBS

ENDS = [CANONICAL.index(name) for name in LIMBS]
HANDS = {"canonical": "leftHand", "bandai": "Hand_L", "daz": "lHand"}


def peaks_of(motion):
    canonical = to_canonical(motion)[0]
    return body.measure_peaks(canonical.joint_positions()[:, ENDS], canonical.root_position, float(motion.fps))


def asked(motion, keys, *, method="infiller", drawn=0.0):
    inbetweener, settings = by_method(method, tiny_infiller(drawn=drawn))
    return tween(motion, Keys(keys), inbetweener, settings=settings)


HIGH, LOW = (0.5, 1.5, 0.3), (0.25, 0.35, 0.5)
QUICK = [("bandai", 30, HIGH)]
RATES = [("canonical", 30), ("bandai", 30), ("daz", 120), ("canonical", 24)]


@pytest.mark.parametrize(
    ("rig", "fps", "position"),
    [
        case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow)
        for position in (HIGH, LOW)
        for case in ((*rig, position) for rig in RATES)
    ],
)
def test_a_hand_told_at_one_frame_goes_there_and_back(rig, fps, position):
    """No faster than 1.9 times the distance over the time of a smooth reach, and as calmly."""
    motion = on_rig(rig, 3 * fps, fps=fps)
    scale = float(to_canonical(motion)[0].root_position[0, 1]) / 0.95
    there = to_canonical(motion)[0].root_position[3 * fps // 2] * torch.tensor([1.0, 0.0, 1.0])
    position = tuple((there + scale * torch.tensor(position).double()).tolist())
    hand = Key(3 * fps // 2, positions={HANDS[rig]: position})
    done = asked(motion, (0, hand, 3 * fps - 1))
    at = to_canonical(done.motion)[0].joint_positions()[hand.frame, CANONICAL.index("leftHand")]
    if rig != "daz":  # whose fingers' parents carry the hand elsewhere than on canonical joints
        assert (at - torch.tensor(position).double()).norm() < 0.002
    step, acceleration = peaks_of(done.motion)
    assert step < 0.15
    assert acceleration < 60


@pytest.mark.parametrize(("fps", "turn"), [(30, 1.2), (120, 0.0)])
def test_hips_told_at_one_frame_do_not_swing_the_body(fps, turn):
    motion = walk(3 * fps, fps=fps, turn_rate=turn)
    own = peaks_of(motion)
    done = asked(motion, (0, Key(4 * fps // 3, root_only=True), 3 * fps - 1), method="infiller")
    step, acceleration = peaks_of(done.motion)
    assert step < 1.3 * own.step
    assert acceleration < 1.5 * own.acceleration
    assert (done.motion.root_position - motion.root_position)[4 * fps // 3].norm() < 1e-9


class Conditioned(LinearInbetweener):
    """One that takes hands and feet in single frames into account, as far as it says."""

    @property
    def takes_partial_keys(self) -> bool:
        return True


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
    result, targets = propose_through_keys(query, Conditioned(), torch.Generator())
    freely = Conditioned().propose(query).motion
    hips = (result.motion.root_position - freely.root_position).norm(dim=-1)
    assert bool(hips[at] > 0.01) == moves
    assert targets is not None
    assert torch.equal(targets.wanted, wanted)
    away = (targets.positions[at, limb.end] - result.motion.joint_positions()[at, limb.upper]).norm()
    assert float(away) <= limb.length(CANONICAL)
    if not moves:
        assert torch.equal(result.motion.local_quat_xyzw, freely.local_quat_xyzw)
