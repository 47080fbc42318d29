"""The tweener as an in-betweener: exact keys, hips that go by the body, any length, one path predictor."""

from dataclasses import dataclass, replace

import pytest
import torch
from helpers import walk
from tiny_path import ToldPath, save_tiny_path
from tiny_tweener import save_tiny_tweener, tiny_tweener

import priors
from controllers.inbetweening.pipeline import CanonicalClip
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl import rotations
from mapctl.errors import CheckpointError
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True, eq=False)
class Told(Inbetweener):
    """Proposes what it was told."""

    proposal: Proposal
    has_style: bool = False

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        return self.proposal


def query_of(motion, *gaps):
    masks = [Mask(ALL, start, stop) for start, stop in gaps]
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def standing(frames):
    motion = walk(frames)
    return replace(
        motion,
        root_position=motion.root_position[:1].expand(frames, 3).clone(),
        local_quat_xyzw=motion.local_quat_xyzw[:1].expand(frames, 21, 4).clone(),
    )


def test_keys_stay_to_the_bit_and_are_approached_smoothly():
    query = query_of(walk(120), (1, 60), (61, 119))
    known, shown = ~query.missing.frames, query.motion
    made = tiny_tweener().propose(query).motion
    assert torch.equal(made.root_position[known], shown.root_position[known])
    same = (made.local_quat_xyzw * shown.local_quat_xyzw).sum(dim=-1).abs()
    assert float((1 - same[known]).max()) < 1e-12
    places = made.joint_positions() - made.root_position[:, None]
    step = torch.diff(places, dim=0).norm(dim=-1).mean(dim=-1)
    beside = step[[0, 59, 60, 118]]
    assert float(beside.max()) < 3 * float(step.median())


def test_hips_that_tremble_are_led_calmly():
    motion = walk(100)
    shaken = replace(motion, root_position=motion.root_position + 0.01 * (-1.0) ** torch.arange(100)[:, None])
    query = query_of(motion, (1, 99))
    calm, trembling = (
        torch.diff(tiny_tweener(path=ToldPath(told)).propose(query).motion.root_position, n=3, dim=0)[10:-10].norm()
        for told in (motion, shaken)
    )
    told = torch.diff(shaken.root_position, n=3, dim=0)[10:-10].norm()
    assert float(trembling) < 0.4 * float(told)
    assert float(calm) < float(trembling)


def test_hips_go_where_the_path_predictor_sees_them_go_and_arrive():
    motion = walk(100)
    query = query_of(motion, (1, 99))
    for stretch in (1.0, 1.3):
        made = tiny_tweener(path=ToldPath(motion, stretch)).propose(query).motion
        away = (made.root_position - motion.root_position)[:, ::2].norm(dim=-1)
        assert float(away.max()) < 0.1  # the made body faces elsewhere than the walk's
        steps = torch.diff(made.root_position[:, 2])
        assert float(steps.min()) > 0


def test_who_stands_and_whom_the_path_lets_stand_does_not_slide():
    motion = standing(240)
    made = tiny_tweener(path=ToldPath(motion)).propose(query_of(motion, (1, 239))).motion
    assert float((made.root_position - motion.root_position)[:, ::2].abs().max()) < 1e-3


def test_the_answer_moves_and_turns_with_its_keys():
    motion = walk(90, turn_rate=0.4)
    turn = rotations.about_y(torch.tensor(2.0).double())
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn.expand(90, 4), quats[:, 0])
    shift = torch.tensor([4000.0, 0.0, -90.0]).double()
    root = rotations.rotate(turn.expand(90, 4), motion.root_position) + shift
    one = tiny_tweener().propose(query_of(motion, (1, 89))).motion
    other = tiny_tweener().propose(query_of(replace(motion, root_position=root, local_quat_xyzw=quats), (1, 89))).motion
    wanted = rotations.rotate(turn.expand(90, 4), one.root_position) + shift
    assert float((wanted - other.root_position).abs().max()) < 2e-3
    assert float((one.local_quat_xyzw[:, 1:] - other.local_quat_xyzw[:, 1:]).abs().max()) < 2e-3


def test_auto_leaves_long_gaps_between_whole_poses_to_it_and_holds_who_stands():
    query = query_of(walk(200), (1, 30), (31, 190))
    auto = AutoInbetweener(SlerpInbetweener(), long=75, tweener=tiny_tweener())
    assert [source.by for source in auto.propose(query).attribute(query)] == ["slerp", "tweener"]
    plain = AutoInbetweener(SlerpInbetweener())
    assert {source.by for source in plain.propose(query).attribute(query)} == {"slerp"}
    still = query_of(standing(200), (1, 199))
    assert [source.by for source in auto.propose(still).attribute(still)] == ["standing still"]


def test_auto_keeps_a_long_gap_that_the_network_fills_and_in_which_the_body_moves():
    motion = walk(200)
    query = query_of(motion, (31, 190))
    logits = torch.zeros(200, 2)
    moving, still = Proposal(motion, logits, "transformer"), Proposal(query.motion, logits, "transformer")
    unfilled = replace(moving, others=(GapSource(31, 190, INTERPOLATION, "longer than it knows"),))
    tweened = Told(Proposal(motion, logits, "tweener"))

    def find_source(network: Proposal, tweener: Inbetweener = tweened) -> list[str]:
        auto = AutoInbetweener(Told(network), long=75, tweener=tweener)
        return [source.by for source in auto.propose(query).attribute(query)]

    assert find_source(moving) == ["transformer"]
    assert find_source(still) == ["tweener"]
    assert find_source(unfilled) == ["tweener"]
    assert find_source(moving, Told(tweened.proposal, has_style=True)) == ["tweener"]


@pytest.mark.slow
def test_auto_leaves_long_gaps_to_it_that_have_partial_keys_within():
    """A network that fills less would leap to the hand, or away from it."""
    motion, told = walk(200), (1, 190)
    auto = AutoInbetweener(SlerpInbetweener(), long=75, tweener=tiny_tweener())
    query = query_of(motion, told)
    wanted = torch.zeros(200, 21, dtype=torch.bool)
    wanted[90, CANONICAL.index("leftHand")] = True
    handed = replace(query, effector_targets=EffectorTargets(motion.joint_positions() + 0.1, wanted))
    made = auto.propose(handed)
    assert [source.by for source in made.attribute(handed)] == ["tweener"]
    free = auto.propose(query).motion.joint_positions()
    assert float((made.motion.joint_positions() - free)[90].norm(dim=-1).max()) > 1e-3
    joints, root = query.missing.joints.clone(), query.missing.root.clone()
    joints[90, 0] = root[90] = False
    hips = replace(query, missing=MissingMask(joints, root))
    made = auto.propose(hips)
    assert [source.by for source in made.attribute(hips)] == ["tweener", "tweener"]
    assert float((made.motion.root_position - motion.root_position)[90, ::2].abs().max()) < 1e-9


def test_it_goes_with_the_path_predictor_that_it_was_trained_with(tmp_path):
    predictor = str(save_tiny_path(tmp_path / "path.safetensors"))
    saved = str(save_tiny_tweener(tmp_path / "tweener.safetensors", predictor))
    assert priors.load_tweener(saved, predictor).name == saved
    assert priors.load_inbetweener(saved, predictor).card.kind == "tweener"
    with pytest.raises(CheckpointError, match="trained with the path predictor"):
        priors.load_tweener(saved, "path")
