"""Contract of every in-betweener."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig
from catalogue import INBETWEENERS
from helpers import moved

from controllers.inbetweening.pipeline import CanonicalClip
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import ALL, Mask, MissingMask
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL

FRAMES = 50
NETWORKS = ("transformer", "infiller", "stitcher", "tweener")
MASKS = {
    "a gap": [Mask(ALL, 15, 25)],
    "two gaps": [Mask(ALL, 10, 20), Mask(ALL, 30, 33)],
    "an arm": [Mask("leftLowerArm", 0, FRAMES), Mask("leftHand", 0, FRAMES)],
    "gaps and both ends": [Mask(ALL, 0, 6), Mask(ALL, 15, 25), Mask(ALL, 30, 33), Mask(ALL, 44, FRAMES)],
}


def query_of(masks, rig="canonical"):
    motion = on_rig(rig, FRAMES)
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


@pytest.mark.parametrize("what", ["gaps and both ends", "an arm"])
@pytest.mark.parametrize("kind", INBETWEENERS)
def test_a_proposal_is_a_whole_motion_of_the_query_s_body(kind, what):
    inbetweener, query = INBETWEENERS[kind], query_of(MASKS[what])
    assert isinstance(inbetweener, Inbetweener)
    answer = inbetweener.propose(query)
    assert (answer.motion.num_frames, answer.motion.fps) == (query.motion.num_frames, query.motion.fps)
    assert answer.motion.skeleton is query.motion.skeleton
    assert bool(answer.motion.joint_positions().isfinite().all())
    assert answer.contact_logits.shape == (query.motion.num_frames, 2)
    torch.testing.assert_close(answer.motion.local_quat_xyzw.norm(dim=-1), torch.ones(()).double().expand(FRAMES, 21))


@pytest.mark.parametrize("kind", INBETWEENERS)
def test_what_is_known_hardly_moves_and_the_query_not_at_all(kind):
    query = query_of(MASKS["two gaps"])
    before = query.motion.local_quat_xyzw.clone()
    answer, known = INBETWEENERS[kind].propose(query), ~query.missing.frames
    apart = (answer.motion.joint_positions() - query.motion.joint_positions()).norm(dim=-1)
    assert float(apart[known].max()) < 1e-3
    assert torch.equal(query.motion.local_quat_xyzw, before)


@pytest.mark.parametrize("kind", INBETWEENERS)
def test_every_gap_has_a_proposer_and_the_same_generator_gives_the_same(kind):
    query = query_of(MASKS["two gaps"])
    one, other = (INBETWEENERS[kind].propose(query, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    sources = one.attribute(query)
    assert [(source.start, source.stop) for source in sources] == [(10, 20), (30, 33)]
    assert all(source.by for source in sources)
    assert sources == other.attribute(query)
    assert torch.equal(one.motion.local_quat_xyzw, other.motion.local_quat_xyzw)


@pytest.mark.parametrize("kind", NETWORKS)
def test_an_answer_moves_and_turns_with_its_query(kind):
    query, there = query_of(MASKS["a gap"]), {"turn": 2.1, "shift": (7.0, -3.0)}
    wanted = moved(INBETWEENERS[kind].propose(query).motion, **there)
    found = INBETWEENERS[kind].propose(replace(query, motion=moved(query.motion, **there))).motion
    torch.testing.assert_close(found.joint_positions(), wanted.joint_positions(), atol=2e-3, rtol=0)


@pytest.mark.parametrize(("kind", "what"), [*((kind, "a gap") for kind in NETWORKS[:3]), ("transformer", "an arm")])
def test_the_answer_to_the_mirror_image_is_the_mirror_image(kind, what):
    query = query_of(MASKS[what])
    missing = MissingMask(query.missing.joints[:, CANONICAL.mirror_partners()], query.missing.root)
    one = INBETWEENERS[kind].propose(query)
    other = INBETWEENERS[kind].propose(replace(query, motion=query.motion.mirror(), missing=missing))
    torch.testing.assert_close(one.motion.mirror().joint_positions(), other.motion.joint_positions(), atol=1e-3, rtol=0)
    torch.testing.assert_close(one.contact_logits, other.contact_logits.flip(-1), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("kind", INBETWEENERS)
def test_a_larger_body_moves_alike(kind):
    """Queries have the canonical size, whatever the performer's."""
    query = query_of(MASKS["a gap"], "daz")
    answer = INBETWEENERS[kind].propose(query)
    assert answer.motion.skeleton is query.motion.skeleton
    heights = answer.motion.root_position[:, 1]
    assert 0.8 < float(heights.min() / query.motion.root_position[:, 1].min()) < 1.25


def test_a_gap_refused_by_rollouts_falls_back_with_a_note():
    query = query_of([Mask(ALL, 10, 11), Mask(ALL, 20, 30)])
    short, rolled = INBETWEENERS["rollouts"].propose(query).attribute(query)
    assert (short.by, rolled.by) == ("slerp", "rollout of tiny")
    assert short.reason.startswith("rollouts take 0.1 to ")
