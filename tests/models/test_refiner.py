"""Refiners: the contract of any, what the LSTM may change and see, and the end effectors that it sees."""

from dataclasses import replace

import pytest
import torch
from catalogue import REFINERS
from helpers import corpus, generator
from scipy.spatial.transform import Rotation
from tiny_refiner import TINY, refiner_of, walks

from mapctl.features import LAYOUT, GroundPose
from mapctl.pose import decode
from mapctl.protocols import Refiner
from mapctl.skeleton import CANONICAL
from priors.refiner import compute_end_effectors

BITS = LAYOUT.slices["contacts"]


def clips(frames=40, count=2):
    return torch.stack([clip[:frames] for clip in walks().clips()[:count]]).double()


def with_soft_bits(features):
    soft = features.clone()
    soft[..., BITS] = torch.rand(soft[..., BITS].shape, generator=generator(), dtype=torch.float64)
    return soft


@pytest.mark.parametrize("lookahead", [0, 3])
def test_untrained_it_returns_what_it_was_given_with_hard_bits(lookahead):
    features = with_soft_bits(clips())
    refined = refiner_of(replace(TINY, lookahead=lookahead), trained=False).refine(features)
    torch.testing.assert_close(refined[..., : LAYOUT.continuous], features[..., : LAYOUT.continuous], atol=0, rtol=0)
    assert torch.equal(refined[..., BITS], (features[..., BITS] > 0.5).double())


@pytest.mark.parametrize("limit", [0.1, 2.0])
def test_what_is_added_is_bounded_whatever_the_weights(limit):
    refiner = refiner_of(replace(TINY, limit=limit), scale=1e4)
    features = clips()
    size = LAYOUT.continuous
    change = (refiner.refine(features) - features)[..., :size] / refiner.network.std[:size]
    assert float(change.abs().max()) <= limit * (1 + 1e-9)
    assert float(change.abs().median()) > 0.9 * limit  # these weights ask for far more


@pytest.mark.parametrize("lookahead", [0, 1, 3])
@pytest.mark.parametrize("changed", [1, 20, 39])
def test_a_frame_sees_the_past_and_its_look_ahead_but_nothing_later(changed, lookahead):
    refiner = refiner_of(replace(TINY, lookahead=lookahead))
    features = clips()
    other = features.clone()
    other[:, changed:, LAYOUT.slices["joint_rotations"]] += 0.3
    added = [refiner.refine(motion) - motion for motion in (features, other)]
    difference = (added[0] - added[1])[..., : LAYOUT.continuous].abs().amax((0, 2))
    first = max(0, changed - lookahead)
    assert float(difference[:first].sum()) == pytest.approx(0, abs=1e-12)
    assert float(difference[first:].min()) > 0


CLIPS = torch.stack([clip[:40] for clip in corpus().clips()[:3]]).double()


each_refiner = pytest.mark.parametrize("refiner", REFINERS.values(), ids=REFINERS)


@each_refiner
@pytest.mark.parametrize("frames", [1, 2, 40])
def test_as_many_frames_come_out_with_hard_bits(refiner, frames):
    assert isinstance(refiner, Refiner)
    refined = refiner.refine(CLIPS[:, :frames])
    assert refined.shape == (3, frames, LAYOUT.size)
    assert set(refined[..., BITS].unique().tolist()) <= {0.0, 1.0}


@each_refiner
@pytest.mark.parametrize("size", [1, 7, 39])
def test_pieces_give_the_whole(refiner, size):
    streamed = torch.cat(list(refiner.stream(CLIPS.split(size, dim=1))), dim=1)
    torch.testing.assert_close(streamed, refiner.refine(CLIPS), atol=1e-9, rtol=0)


@each_refiner
def test_it_does_not_matter_what_else_is_in_the_batch(refiner):
    one_by_one = torch.cat([refiner.refine(CLIPS[k : k + 1]) for k in range(3)])
    torch.testing.assert_close(refiner.refine(CLIPS), one_by_one, atol=1e-12, rtol=0)


JOINTS = ("hips", "head", "leftHand", "rightToes")


def clip(frames=40, number=0):
    return corpus().clips()[number][:frames].double()


def by_positions(features, joints, start):
    """From the world positions of the decoded motion; headings by hand, turned back by scipy."""
    motion = decode(features, start)
    index = [CANONICAL.index(name) for name in joints]
    world, root = motion.joint_positions()[:, index].numpy(), motion.root_position.numpy()
    heading = float(start.heading) + LAYOUT.pick(features, "heading_change")[:, 0].cumsum(0).numpy()
    rows = []
    for frame in range(1, len(features)):
        back = Rotation.from_euler("y", -heading[frame])
        ground = root[frame] * [1, 0, 1]
        velocity = 30 * (world[frame] - world[frame - 1])
        rows.append(torch.from_numpy(back.apply([*(world[frame] - ground), *velocity])).flatten())
    return torch.stack(rows)


@pytest.mark.parametrize("number", [0, 1, 4])
def test_they_are_positions_and_velocities_in_the_heading_frame_wherever_the_motion_stands(number):
    features = clip(number=number)
    found = compute_end_effectors(features[None], JOINTS)[0]
    assert found.shape == (39, 6 * len(JOINTS))
    for position in (GroundPose.origin(), GroundPose(torch.tensor([3.0, -7.0]), torch.tensor(2.5))):
        torch.testing.assert_close(found, by_positions(features, JOINTS, position), atol=1e-9, rtol=0)
