"""What every refiner promises (see mapctl.protocols.Refiner), whatever it is made of."""

import pytest
import torch
from catalogue import REFINERS
from helpers import corpus

from mapctl.features import LAYOUT
from mapctl.protocols import Refiner

BITS = LAYOUT.slices["contacts"]
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
