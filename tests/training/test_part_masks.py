"""What stays known of training windows, and the windows themselves."""

import pytest
import torch
from captures import on_rig

from mapctl.features import encode
from mapctl.inbetweening.partial_motion import EFFECTORS
from mapctl.skeleton import CANONICAL, leg_length
from priors.training.data import Corpus
from priors.training.recipes.pose_transformer import PartSettings, sample_known_parts
from priors.training.windows import PoseWindows, Variation, add_targets

BATCH = 400


def corpus():
    clips = [encode(on_rig("canonical", frames))[0].float() for frames in (90, 70)]
    return Corpus(("a/walk-1.bvh", "b/run-2.bvh"), tuple(map(len, clips)), torch.cat(clips))


WINDOWS = PoseWindows(corpus(), kinds=("walk", "run"), evenness=1.0)


def drawn(frames=40, seed=0, **settings):
    random = torch.Generator().manual_seed(seed)
    truth = add_targets(WINDOWS.draw(BATCH, frames, random))
    return truth, sample_known_parts(truth, PartSettings(**settings), random)


@pytest.mark.parametrize("frames", [8, 40])
def test_something_is_known_and_something_unknown_in_nearly_every_window(frames):
    _, shown = drawn(frames)
    known = shown.known.rotations | shown.known.root[..., None]
    assert bool(known.any(dim=2).any(dim=1).all())
    assert float((~shown.known.everything).any(dim=1).float().mean()) > 0.97


def test_gaps_alone_are_whole_poses_between_runs():
    _, shown = drawn(joints=0.0, keys=0.0, parts=0.0, several=0.0, open=0.0)
    known = shown.known
    assert torch.equal(known.rotations.all(dim=2), known.rotations.any(dim=2))
    assert torch.equal(known.root, known.rotations[..., 0])
    assert bool(known.root[:, [0, -1]].all())
    edges = torch.diff(known.root.int(), dim=1)
    assert bool(((edges == -1).sum(dim=1) == 1).all())
    bare = (edges[:, 0] == -1).float().mean()
    assert float(bare) == pytest.approx(0.4, abs=0.1)


def test_parts_are_told_within_gaps_and_targets_are_where_joints_are():
    truth, shown = drawn(joints=0.0, keys=0.0, parts=1.0)
    known = shown.known
    assert all(bool(told.any()) for told in (known.path, known.effectors, known.ground & ~known.rotations.any(dim=2)))
    assert not bool((known.effectors & known.positions[..., list(EFFECTORS)]).any())
    places = truth.world_poses()[0][..., list(EFFECTORS), :]
    torch.testing.assert_close(shown.targets[known.effectors], places[known.effectors], atol=1e-5, rtol=0)
    assert not bool((known.path & known.ground).any())
    off = (shown.root_position - truth.root_position).norm(dim=-1)
    assert float(off[known.path].mean()) > 0.003
    assert float(off[~known.path].max()) == 0


def test_windows_are_the_clips_and_varied_ones_keep_their_legs():
    truth = WINDOWS.draw(BATCH, 30, torch.Generator().manual_seed(3))
    assert bool(truth.known.everything.all())
    feet = truth.world_poses()[0][..., CANONICAL.index("leftFoot"), 1]
    own = torch.cat(
        [on_rig("canonical", n).joint_positions()[:, CANONICAL.indices(("leftFoot", "rightFoot")), 1] for n in (90, 70)]
    )
    assert float(own.min()) - 1e-4 <= float(feet.min())
    assert float(feet.max()) <= float(own.max()) + 1e-4
    varied = WINDOWS.draw(BATCH, 30, torch.Generator().manual_seed(3), variation=Variation(share=1.0))
    lengths = varied.offsets[:, CANONICAL.indices(("leftLowerLeg", "leftFoot"))].norm(dim=-1).sum(dim=1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, leg_length(CANONICAL)))
    arms = (
        varied.offsets[:, CANONICAL.index("leftHand")].norm(dim=-1)
        / CANONICAL.offsets[CANONICAL.index("leftHand")].norm()
    )
    assert 0.84 < float(arms.min()) < 0.9
    assert 1.1 < float(arms.max()) < 1.16
    mirrored = varied.offsets[:, CANONICAL.mirror_partners()] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(mirrored, varied.offsets)
